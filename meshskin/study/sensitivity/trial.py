"""Trials: a setting is run, timed, and compared with the truth and with the reference."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from typing import TypeVar

import numpy as np

from ...core.errors import ContactError, MeshskinError
from ...estimation.calibrate import calibrate
from ...estimation.joint.reduced_nlp import NEWTON_TOLERANCE
from ...estimation.uncertainty import metrics
from ...geometry.body import Body
from ...recording.recording import Recording
from ...scene.scene import Scene
from ...simulation.simulate import simulate
from .numerical_error import NumericalReference, mean_mm
from .setting import Setting

T = TypeVar("T")


def timed(work: Callable[[], T]) -> tuple[T, float]:
    """The result of a function and its processor seconds."""
    begin = time.process_time()
    return work(), time.process_time() - begin


@dataclass(frozen=True)
class Row:
    """The measurements of one setting."""

    knob: str
    """The knob that was changed; "scene": none, "chosen": several."""
    setting: Setting
    error_mm: float = float("nan")
    """Mean distance of the taxels from the truth, with the scene's noise and effects."""
    numerical_mm: float = float("nan")
    """Mean shift of the taxels by discretization, contact model and tolerance, without noise."""
    bound_mm: float = float("nan")
    """Mean error of an efficient estimate (Cramér-Rao bound); 0 without noise."""
    located: int = 0
    """Number of taxels that were located."""
    steps: int = 0
    """Number of steps of the closed loop."""
    contacts: int = 0
    """Number of contacts."""
    readings: int = 0
    """Number of readings."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Processor time of load (the fit of the surface), simulate and calibrate."""
    failure: str = ""
    """Why there are no numbers."""

    @property
    def total_mm(self) -> float:
        """Root of the sum of squares of error and numerical part, which are independent."""
        return float(np.hypot(self.error_mm, self.numerical_mm))

    @property
    def time(self) -> float:
        """Seconds of all stages."""
        return float(sum(self.seconds.values())) if self.seconds else float("nan")


class TrialRunner:
    """Runs the settings of one scene; keeps bodies, recordings and shifts that several share."""

    def __init__(self, scene: Scene, seeds: int, reference: NumericalReference) -> None:
        self.base, self.seeds, self.reference = scene, range(seeds), reference
        self._bodies: dict[tuple[object, ...], tuple[Body, float]] = {}
        self._shifts: dict[tuple[object, ...], float] = {}
        self._recordings: dict[tuple[object, ...], tuple[list[Recording], float]] = {}

    def measure(self, knob: str, setting: Setting) -> Row:
        """Run a setting; a failure gives a row that says why."""
        try:
            return self.run(knob, setting)
        except MeshskinError as error:
            return Row(knob, setting, failure=str(error))

    def run(self, knob: str, setting: Setting) -> Row:
        """Run a setting. Raises MeshskinError if it cannot be run."""
        if not setting.whole_frames:
            raise ContactError("frames do not fall on steps", value=f"{setting.rate:g} frames/s")
        scene = setting.scene(self.base, self._body(setting)[0])
        shift = self._shift(setting, scene)  # first: it leaves the loop compiled
        recordings, simulating = self._simulated(setting, scene)
        belief, truth = scene.belief(), scene.skin
        errors, calibrating, tolerance_mm, located = [], 0.0, 0.0, []
        for recording in recordings:
            asked = setting.method, setting.tolerance
            found, seconds = timed(partial(calibrate, recording, belief, *asked))
            calibrating += seconds
            error = metrics.position_errors(found, truth)
            errors.append(1e3 * float(np.nanmean(error)))
            located.append(int(np.isfinite(error).sum()))
            if setting.method == "joint" and setting.tolerance > NEWTON_TOLERANCE:
                tight = calibrate(recording, belief, tolerance=self.reference.tolerance)
                tolerance_mm += mean_mm(found.positions - tight.positions) / len(recordings)
        first, count = recordings[0], len(recordings)
        return Row(
            knob,
            setting,
            error_mm=float(np.mean(errors)),
            numerical_mm=float(np.hypot(shift, tolerance_mm)),
            bound_mm=metrics.bound_mm(first, belief, truth)["mean"],
            located=min(located),
            steps=first.motion.num_rows if first.motion is not None else 0,
            contacts=len(first.time),
            readings=len(first.pressure),
            seconds={
                "load": self._body(setting)[1],
                "simulate": simulating / count,
                "calibrate": calibrating / count,
            },
        )

    def _body(self, setting: Setting) -> tuple[Body, float]:
        """The body with its surface fitted, and the seconds of the fit."""
        key = setting.faces, setting.degree

        def fit() -> Body:
            body = setting.body(self.base.body)
            if body.mesh is self.base.body.mesh:  # without its caches, so that the fit is timed
                body = replace(body, mesh=body.mesh.copy(include_cache=False))
            body.closest(self.base.skin.positions)
            return body

        if key not in self._bodies:
            self._bodies[key] = timed(fit)
        return self._bodies[key]

    def _simulated(self, setting: Setting, scene: Scene) -> tuple[list[Recording], float]:
        key = setting.simulated
        if key not in self._recordings:
            self._recordings[key] = timed(lambda: [simulate(scene, s) for s in self.seeds])
        return self._recordings[key]

    def _shift(self, setting: Setting, scene: Scene) -> float:
        """Mean shift, mm, by the simulation of a setting, on the base's lanes and at its rate."""
        key = setting.physics
        if key not in self._shifts:
            own = Setting.of(self.base)
            alike = replace(setting, lane_spacing=own.lane_spacing, rate=own.rate)
            self._shifts[key] = mean_mm(self.reference.shift(alike.scene(self.base, scene.body)))
        return self._shifts[key]
