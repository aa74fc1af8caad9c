"""The first run of a request: its scene on wide lanes, which a pilot measures the parts of.

It is also the result of a request for a time that is too short for another run.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ...core.arrays import median_spacing
from ...core.deadline import PAGE_SECONDS, Deadline
from ...core.progress import Progress, Stage
from ...estimation.calibrate import Estimation
from ...estimation.calibration import Calibration
from ...exploration.path import Path as ExplorationPath
from ...recording.recording import Recording
from ...scene.scene import Scene
from ...simulation.rollout import Steps
from ...simulation.simulate import prepare, record_steps, run
from ...simulation.simulator import Simulator
from .setting import Setting
from .trial import timed

FIRST_STEPS, MEASURED_STEPS = 3, 20
"""Usual steps of a first run and of measuring its parts, of the stage "pilot"."""
LANES = tuple(2.0 ** (k / 2) for k in range(-6, 2))
"""Spacings of lanes that may be chosen, relative to the scene's own, from 1/8 to 1.4: each changes
the expected error by 19 %."""
WIDEST = 0.8
"""Largest spacing of lanes relative to the distance at which a taxel responds to a contact: every
taxel must respond."""
PER_CONTACT = 1.1e-3
"""Least processor seconds of a first run for each contact that `least_seconds` counts: 1.1 ms
(sphere_noisy) to 2 ms (a shank of the iCub) were measured."""
PER_BYTE, PER_ASCII_BYTE = 2e-7, 5e-8
"""Least processor seconds of loading, checking and covering a mesh for each byte of its file:
binary STL 2.3e-7 to 2.7e-7 (1,310,720 and 81,920 faces), OBJ 4e-7, PLY 7e-7; ASCII STL 6e-8."""
TIMED = (".stl", ".obj", ".ply")
"""Mesh files of which this was measured, and that hold little but vertices and faces."""
PACED = 0.1
"""Part of the loop from which its pace is known: the approach and the first touch are over."""
AFTER_LOOP = 1.3
"""Least processor time of recording and calibrating, in units of that of the loop (measured: 1.4 on
the paper's sphere with noise, 1.5 without, 3 to 8 on other bodies)."""


@dataclass(frozen=True)
class FirstRun:
    """A scene on wide lanes, run and calibrated: the least that a request gives."""

    scene: Scene
    setting: Setting
    words: str
    """The setting, beside the scene's own."""
    path: ExplorationPath
    machine: Simulator
    steps: list[Steps]
    estimation: Estimation
    calibration: Calibration
    seconds: tuple[float, float]
    """Processor seconds of planning, and of running the loop."""

    @property
    def recording(self) -> Recording:
        """What was calibrated."""
        return self.estimation.recording

    def read(self, seed: int) -> Recording:
        """The recording of the steps."""
        return record_steps(self.scene, self.machine, self.path, self.steps, seed)


def least_loading(tables: Mapping[str, Any], folder: Path) -> float:
    """A lower bound of the processor seconds of loading the scene of merged TOML tables whose paths
    start from `folder`, from the size of its mesh file; 0 for formats that may hold images, too."""
    body = tables.get("body")
    mesh = folder / str(body.get("mesh", "")) if isinstance(body, Mapping) else folder
    if mesh.suffix.lower() not in TIMED or not mesh.is_file():
        return 0.0
    with mesh.open("rb") as opened:
        ascii_stl = opened.read(5) == b"solid"
    return mesh.stat().st_size * (PER_ASCII_BYTE if ascii_stl else PER_BYTE)


def least_seconds(scene: Scene) -> float:
    """A lower bound of the processor seconds of a first run, from the size of the
    skin: contacts on wide lanes cover a disc of its area, and a rim in which taxels still respond.
    """
    setting, radius = Setting.of(scene), scene.rig.sensing_radius
    lane = _widest_lanes(setting, radius).lane_spacing
    positions = scene.skin.positions
    spacing = median_spacing(positions)
    area = len(positions) * np.sqrt(3) / 2 * spacing**2  # of a hexagonal lattice
    disc = np.pi * (np.sqrt(area / np.pi) + radius) ** 2
    contacts = disc / (lane * scene.exploration.speed / setting.rate)
    return PER_CONTACT * float(contacts)


def first_run(
    scene: Scene, seed: int, deadline: Deadline, progress: Progress | None = None
) -> FirstRun:
    """Run a scene on wide lanes. Raises OutOfTime, and as `simulate` and `calibrate`."""
    base = Setting.of(scene)
    coarse = _widest_lanes(base, scene.rig.sensing_radius)
    small, hook = coarse.scene(scene, scene.body), deadline.hook(progress, PAGE_SECONDS)
    quiet = deadline.hook(None, PAGE_SECONDS)
    stage = Stage(hook, "pilot", FIRST_STEPS + MEASURED_STEPS)
    (machine, path), preparing = timed(lambda: prepare(small))
    stage.step()
    began = deadline.spent[1]

    def looped(_: str, done: int, total: int) -> None:
        """Raise OutOfTime as soon as the pace of the loop shows that the rest does not fit."""
        spent, rest = deadline.spent[1] - began, 0.0
        if done > PACED * total:
            rest = spent * ((1 + AFTER_LOOP) * total / done - 1)
        deadline.check(PAGE_SECONDS + rest)

    steps, looping = timed(lambda: list(run(small, machine, path, looped)))
    stage.step()
    estimation = Estimation(record_steps(small, machine, path, steps, seed), small.belief())
    found = estimation.calibrate(progress=quiet)
    stage.step()
    words, seconds = coarse.words(base), (preparing, looping)
    return FirstRun(small, coarse, words, path, machine, steps, estimation, found, seconds)


def _widest_lanes(base: Setting, radius: float) -> Setting:
    """The setting with the widest lanes on which taxels respond to contacts within `radius`, m."""
    own = base.lane_spacing
    return replace(base, lane_spacing=max(min(LANES[-1] * own, WIDEST * radius), own))
