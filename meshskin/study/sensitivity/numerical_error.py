"""The numerical error of a simulation: the shift of the taxels by its discretisation alone.

The closed loop of a setting runs along the path of the reference, without noise. The pressures on
its skin are assigned to the contacts of the reference and calibrated. If both loops were equal, no
taxel would move, so errors of the surface, of the contact model and of the integration all appear
as one length: the shift of the taxels.
"""

from __future__ import annotations

import functools
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ... import effects
from ...core.arrays import Array
from ...core.errors import SimulationError
from ...effects.frames import EffectClock
from ...estimation.calibrate import calibrate
from ...exploration.plan import plan_exploration
from ...simulation.readout import contact_frames, effect_pipeline, record
from ...simulation.simulate import prepare, run
from ...simulation.state_machine import SLIDE

if TYPE_CHECKING:
    from ...effects.frames import Frames
    from ...scene.scene import Scene

SIGMA = 0.01
"""Standard deviation by which the readings of a scene without noise are weighted, relative to the
peak pressure: as in the shipped scene sphere_noisy."""


class NumericalReference:
    """A simulation at a fine setting, and the shift of others along its path.

    scene: at the fine setting; its step divides that of all others. tolerance: of the calibrations.
    compile_: of all loops, because they run many times.
    """

    def __init__(self, scene: Scene, tolerance: float, compile_: str = "always") -> None:
        self.tolerance, self.compile = tolerance, compile_
        self.scene = self.bare(scene)
        self.path = plan_exploration(self.scene).path
        self.frames = self.drive(self.scene)
        known = scene.belief().noise_sigma
        self.belief = scene.belief(noise_sigma=known or SIGMA * scene.patch.peak)
        self.readings = self.read(self.scene, self.frames)
        self.positions = self.calibrate(self.readings)

    def shift(self, scene: Scene) -> Array:
        """The shift (n, 3), m, of the taxels if `scene` replaces the reference.

        Raises SimulationError if the loop fails or loses contact, ContactError.
        """
        scene = self.bare(scene)
        return self.calibrate(self.read(scene, self.drive(scene))) - self.positions

    def bare(self, scene: Scene) -> Scene:
        """A scene without effects, its loop compiled as the reference's."""
        return scene.with_(effects=(), loop=replace(scene.loop, compile=self.compile))

    def drive(self, scene: Scene, rows: int | None = None) -> Frames:
        """The frames of a scene's loop along the reference's path, or its first `rows` rows.

        Raises SimulationError.
        """
        factor = scene.loop.dt / self.scene.loop.dt
        every = round(factor)
        if abs(factor - every) > 1e-6 or every < 1:
            raise SimulationError(
                "the step must be a multiple of the reference's", value=f"{scene.loop.dt} s"
            )
        whole = self.path if rows is None else self.path.segments[0].truncated(rows)
        path = whole.resampled(scene.loop.dt, scene.body)
        lengths = [len(segment.points) for segment in path.segments]
        machine, _ = prepare(scene, path=path)
        steps = [part for part in run(scene, machine, path) if part.phase == SLIDE]
        ends = np.cumsum([len(part.time) for part in steps])
        frames: list[Frames] = []
        for end in np.cumsum(lengths):
            count = int(np.searchsorted(ends, end)) + 1
            frames.append(contact_frames(scene, machine.loop, steps[:count]))
            steps, ends = steps[count:], ends[count:]
        wanted = sum(-(-length // scene.frame_steps) for length in lengths)
        if steps or sum(map(len, frames)) != wanted:
            raise SimulationError("the loop lost contact on the reference's path")
        return functools.reduce(lambda one, next_: one.append(next_), frames)

    def read(self, scene: Scene, frames: Frames) -> Array:
        """Pressures (m, n), Pa, without effects."""
        return effect_pipeline(scene, 0).read(frames, scene.skin.poses)

    def calibrate(self, pressures: Array) -> Array:
        """Positions (n, 3), m, from pressures (m, n), Pa, in the contacts of the reference."""
        chain = effects.EffectPipeline((), lambda frames, poses: pressures, (), (), EffectClock())
        recording = record(self.scene, self.frames, chain)
        return calibrate(recording, self.belief, tolerance=self.tolerance).positions


def mean_mm(shift: Array) -> float:
    """Mean length, mm, of shifts (n, 3), m, over the taxels that have one."""
    length = np.linalg.norm(shift, axis=1)
    return 1e3 * float(np.nanmean(length)) if np.isfinite(length).any() else float("nan")
