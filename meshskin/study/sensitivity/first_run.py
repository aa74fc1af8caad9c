"""The first run of a request: its scene on wide lanes, which a pilot measures the parts of.

It is also the result of a request for a time that is too short for another run.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from ...core.deadline import REPORT_SECONDS, Deadline
from ...core.progress import Progress, Stage
from ...estimation.calibrate import calibrate
from ...simulation.simulate import prepare, record_steps, run
from .setting import Setting
from .trial import timed

if TYPE_CHECKING:
    from ...estimation.calibration import Calibration
    from ...exploration.path import Path as ExplorationPath
    from ...recording.recording import Recording
    from ...scene.scene import Scene
    from ...simulation.rollout import Steps
    from ...simulation.simulator import Simulator

FIRST_STEPS, MEASURED_STEPS = 3, 20
"""Usual steps of a first run and of measuring its parts, of the stage "pilot"."""
LANES = tuple(2.0 ** (k / 2) for k in range(-6, 2))
"""Spacings of lanes that may be chosen, relative to the scene's own, from 1/8 to 1.4: each changes
the expected error by 19 %."""
WIDEST = 0.8
"""Largest spacing of lanes relative to the distance at which a taxel responds to a contact: every
taxel must respond."""


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
    recording: Recording
    calibration: Calibration
    seconds: tuple[float, float]
    """Processor seconds of planning, and of running the loop."""
    report_seconds: float
    """Processor seconds of its report, as predicted."""

    def read(self, seed: int) -> Recording:
        """The recording of the steps."""
        return record_steps(self.scene, self.machine, self.path, self.steps, seed)


def first_run(
    scene: Scene,
    drawing: Callable[[Calibration], float],
    seed: int,
    deadline: Deadline,
    progress: Progress | None = None,
) -> FirstRun:
    """Run a scene on wide lanes. drawing: returns the processor seconds of a report.

    Raises OutOfTime, and as `simulate` and `calibrate`.
    """
    base = Setting.of(scene)
    coarse = _widest_lanes(base, scene.rig.sensing_radius)
    small, hook = coarse.scene(scene, scene.body), deadline.hook(progress, REPORT_SECONDS)
    quiet = deadline.hook(None, REPORT_SECONDS)
    stage = Stage(hook, "pilot", FIRST_STEPS + MEASURED_STEPS)
    (machine, path), preparing = timed(lambda: prepare(small))
    stage.step()
    steps, looping = timed(lambda: list(run(small, machine, path, quiet)))
    stage.step()
    recording = record_steps(small, machine, path, steps, seed)
    found = calibrate(recording, small.belief(), progress=quiet)
    stage.step()
    seconds = preparing, looping
    words, report = coarse.words(base), drawing(found)
    return FirstRun(small, coarse, words, path, machine, steps, recording, found, seconds, report)


def _widest_lanes(base: Setting, radius: float) -> Setting:
    """The setting with the widest lanes on which taxels respond to contacts within `radius`, m."""
    own = base.lane_spacing
    return replace(base, lane_spacing=max(min(LANES[-1] * own, WIDEST * radius), own))
