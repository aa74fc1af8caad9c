"""Trials: a setting is run, timed, and compared with the truth and with the reference."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ...core.errors import ContactError, MeshskinError
from ...estimation.calibrate import calibrate
from ...estimation.joint.newton import NEWTON_TOLERANCE
from ...estimation.uncertainty import metrics
from ...simulation.simulate import simulate
from .numerical_error import Numerics, mean_mm
from .setting import Setting

if TYPE_CHECKING:
    from ...geometry.body import Body
    from ...recording.recording import Recording
    from ...scene.scene import Scene


@dataclass(frozen=True)
class Row:
    """One setting, measured."""

    knob: str
    """Which knob was turned; "scene": none, "chosen": several."""
    setting: Setting
    error_mm: float = float("nan")
    """Mean distance of the taxels from the truth, under the scene's noise and effects."""
    numerical_mm: float = float("nan")
    """Mean shift of the taxels by discretisation, contact model and tolerance, without noise."""
    bound_mm: float = float("nan")
    """Mean error that the readings let one expect at best (Cramér-Rao); 0 without noise."""
    located: int = 0
    """Taxels found."""
    steps: int = 0
    """Of the closed loop."""
    contacts: int = 0
    readings: int = 0
    seconds: dict[str, float] = field(default_factory=dict)
    """Processor time of load (the surface's fit), simulate and calibrate."""
    failure: str = ""
    """Why there are no numbers."""

    @property
    def total_mm(self) -> float:
        """Error and numerical part together: they have nothing to do with each other."""
        return float(np.hypot(self.error_mm, self.numerical_mm))

    @property
    def time(self) -> float:
        """Seconds of all stages."""
        return float(sum(self.seconds.values())) if self.seconds else float("nan")


class Bench:
    """Where the settings of one scene are tried; keeps what several of them share.

    `numerics` makes the simulations beside the reference when first asked for.
    """

    def __init__(self, scene: Scene, seeds: int, numerics: Callable[[Bench], Numerics]) -> None:
        self.base, self.seeds = scene, range(seeds)
        self._numerics_of = numerics
        self._numerics: Numerics | None = None
        self._bodies: dict[tuple[object, ...], tuple[Body, float]] = {}
        self._shifts: dict[tuple[object, ...], float] = {}
        self._recordings: dict[tuple[object, ...], tuple[list[Recording], float]] = {}

    @property
    def numerics(self) -> Numerics:
        """The reference."""
        if self._numerics is None:
            self._numerics = self._numerics_of(self)
        return self._numerics

    def forget(self) -> None:
        """Let the next trials load and simulate anew."""
        self._bodies.clear()
        self._recordings.clear()

    def scene(self, setting: Setting) -> Scene:
        """The scene at a setting."""
        return setting.scene(self.base, self._body(setting)[0])

    def measure(self, knob: str, setting: Setting) -> Row:
        """Run a setting; a failure is a row, too."""
        try:
            return self.run(knob, setting)
        except MeshskinError as error:
            return Row(knob, setting, failure=str(error))

    def run(self, knob: str, setting: Setting) -> Row:
        """Run a setting. Raises what keeps it from running."""
        if not setting.whole_frames:
            raise ContactError("frames do not fall on steps", value=f"{setting.rate:g} frames/s")
        scene = self.scene(setting)
        shift = self._shift(setting, scene)  # first: it leaves the loop compiled
        recordings, simulating = self._simulated(setting, scene)
        belief, truth = scene.belief(), scene.skin
        errors, calibrating, off, located = [], 0.0, 0.0, []
        for recording in recordings:
            begin = time.process_time()
            found = calibrate(recording, belief, setting.method, setting.tolerance)
            calibrating += time.process_time() - begin
            error = metrics.position_errors(found, truth)
            errors.append(1e3 * float(np.nanmean(error)))
            located.append(int(np.isfinite(error).sum()))
            if setting.method == "joint" and setting.tolerance > NEWTON_TOLERANCE:
                tight = calibrate(recording, belief, tolerance=self.numerics.tolerance)
                off += mean_mm(found.positions - tight.positions) / len(recordings)
        count, bound = len(recordings), metrics.bound_mm(recordings[0], belief, truth)["mean"]
        return Row(
            knob,
            setting,
            error_mm=float(np.mean(errors)),
            numerical_mm=float(np.hypot(shift, off)),
            bound_mm=bound,
            located=min(located),
            steps=recordings[0].motion.num_rows if recordings[0].motion is not None else 0,
            contacts=len(recordings[0].time),
            readings=len(recordings[0].pressure),
            seconds={
                "load": self._body(setting)[1],
                "simulate": simulating / count,
                "calibrate": calibrating / count,
            },
        )

    def _body(self, setting: Setting) -> tuple[Body, float]:
        """The body with its surface fitted, and the seconds of that."""
        key = setting.faces, setting.degree
        if key not in self._bodies:
            begin = time.process_time()
            body = setting.body(self.base.body)
            if body.mesh is self.base.body.mesh:  # made anew, to be timed
                body = replace(body, mesh=body.mesh.copy(include_cache=False))
            body.closest(self.base.skin.positions)
            _ = body.mesh.moment_inertia  # of the payload
            self._bodies[key] = body, time.process_time() - begin
        return self._bodies[key]

    def _simulated(self, setting: Setting, scene: Scene) -> tuple[list[Recording], float]:
        key = setting.simulated
        if key not in self._recordings:
            begin = time.process_time()
            made = [simulate(scene, seed) for seed in self.seeds]
            self._recordings[key] = made, time.process_time() - begin
        return self._recordings[key]

    def _shift(self, setting: Setting, scene: Scene) -> float:
        """Mean shift, mm, of a setting's simulation, on the base's lanes and at its rate."""
        key: Any = setting.physics
        if key not in self._shifts:
            own = Setting.of(self.base)
            alike = replace(setting, lane_spacing=own.lane_spacing, rate=own.rate)
            self._shifts[key] = mean_mm(self.numerics.shift(alike.scene(self.base, scene.body)))
        return self._shifts[key]
