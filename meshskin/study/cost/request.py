"""An accuracy or a time asked for: a short pilot run, and what it promises of every setting.

The pilot runs the scene on its coarsest lanes and times each part: what is paid once, for each
step, each frame and each reading. Errors follow from its Cramér-Rao bound, which goes with the
contacts to the power -1/2, from what the scene's effects leave behind without noise, and from the
numerical parts of the levels of every other knob, which are tried on its path (levels.py). Nothing
is kept from machine to machine, or from run to run.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import pyarrow as pa

from ...errors import ConfigError, StudyError
from ...estimation import metrics
from ...estimation.calibrate import calibrate
from ...physics.contact import BATCHED
from ...physics.effects import Noise
from ...recording import Recording
from ...simulation import contact_frames, effect_chain, prepare, run, sensor_tables, simulate
from .levels import COARSER, Level, loops, models, surfaces, tolerances, worth
from .numerics import Numerics
from .setting import RATES, Setting

if TYPE_CHECKING:
    from ...estimation.calibration import Calibration
    from ...scene import Belief, Scene

    T = TypeVar("T")

LANES = tuple(2.0 ** (k / 2) for k in range(-6, 2))
"""Spacings of lanes that may be chosen, over the scene's own."""
WIDEST = 0.8
"""Largest spacing of lanes over the distance at which a taxel feels a contact."""
THIN = 4
"""Every so many readings are calibrated again, to tell fixed costs from those of a reading."""
TRYING = 0.2
"""Part of the seconds asked for within which a pilot goes on to try steps, models and surfaces."""
SAFE = 0.9
"""Part of the accuracy asked for that a promise may use up: errors scatter from run to run."""


@dataclass(frozen=True)
class Request:
    """What is asked of a run: one of the two."""

    accuracy_mm: float | None = None
    """Mean error of the taxels; the cheapest setting is chosen."""
    seconds: float | None = None
    """Of the whole run, pilot and report included; the most accurate setting is chosen."""

    def __post_init__(self) -> None:
        given = [v for v in (self.accuracy_mm, self.seconds) if v is not None]
        if len(given) != 1:
            raise ConfigError("an accuracy or a time can be asked for", remedy="give one of them")
        if not (np.isfinite(given[0]) and given[0] > 0):
            what = "an accuracy" if self.seconds is None else "a time"
            raise ConfigError(
                f"{what} that is asked for must be finite", value=self.words, limit="above 0"
            )

    @property
    def words(self) -> str:
        """What is asked for."""
        if self.accuracy_mm is not None:
            return f"{self.accuracy_mm:g} mm"
        return f"{self.seconds:g} s"


@dataclass(frozen=True)
class Promise:
    """A setting, and what a run with it should come to."""

    setting: Setting
    error_mm: float
    """Mean error of the taxels against the truth."""
    numerical_mm: float
    """Shift of the taxels by step, integrator, contact model and surface, as far as they were
    tried."""
    seconds: float
    """Of the whole run by the clock on the wall, what is already spent included."""
    processor_seconds: float


@dataclass(frozen=True)
class Pilot:
    """What a short run showed; seconds are processor time."""

    base: Setting
    """The scene's own setting."""
    setting: Setting
    """The pilot's."""
    steps: int
    contacts: int
    readings: int
    bound_mm: float
    """Mean error at the Cramér-Rao bound; 0 without noise."""
    systematic_mm: float
    """Mean error without noise."""
    knobs: tuple[tuple[Level, ...], ...]
    """The levels of every knob beside lanes and rate that was tried, the scene's own first."""
    fixed: float
    """Making the loop, writing, and drawing the report."""
    each_step: float
    """Planning and running."""
    each_contact: float
    """Reading the skin."""
    estimating: tuple[float, float]
    """Fixed, and for each reading: of the estimate and all that runs beside it."""
    spent: tuple[float, float]
    """On the wall and of the processor, from the run's beginning until the pilot was over."""

    @property
    def slowdown(self) -> float:
        """Seconds on the wall for each of the processor, as the machine was under the pilot."""
        return max(self.spent[0] / max(self.spent[1], 1e-9), 1.0)

    def promise(self, setting: Setting, levels: Sequence[Level] = ()) -> Promise:
        """Of a setting of lanes and rate, with these levels of other knobs."""
        lanes = self.setting.lane_spacing / setting.lane_spacing
        many = lanes * setting.rate / self.setting.rate
        error = float(np.hypot(self.bound_mm / np.sqrt(many), self.systematic_mm))
        once, each = self.estimating
        more = self.fixed + self.each_step * self.steps * lanes
        more += self.each_contact * self.contacts * many + once + each * self.readings * many
        for level, (own, *_) in zip(levels, self.knobs, strict=bool(levels)):
            more += level.once - own.once + (level.along - own.along) * lanes
            more += (level.reading - own.reading) * many
            setting = replace(setting, **level.changes)
            error = float(np.hypot(error, level.error_mm))
        return Promise(
            setting,
            error,
            float(np.sqrt(sum(level.numerical_mm**2 for level in levels))),
            self.spent[0] + more * self.slowdown,
            self.spent[1] + more,
        )

    def promises(self) -> list[Promise]:
        """Of all settings that may be chosen."""
        widest = self.setting.lane_spacing * (1 + 1e-9)
        lanes = [self.base.lane_spacing * factor for factor in LANES]
        lanes = [x for x in lanes if x < widest] + [self.setting.lane_spacing]
        made = [
            self.promise(replace(self.base, lane_spacing=x, rate=self.base.rate * r), levels)
            for x in dict.fromkeys(lanes)
            for r in RATES
            for levels in product(*self.knobs)
        ]
        return [promise for promise in made if promise.setting.whole_frames]

    def choose(self, request: Request) -> list[Promise]:
        """The settings that keep a request, the best first. Raises StudyError if none does."""
        promises = self.promises()

        def total(p: Promise) -> float:
            return float(np.hypot(p.error_mm, p.numerical_mm))

        if request.accuracy_mm is not None:
            kept = [p for p in promises if total(p) <= SAFE * request.accuracy_mm]
            if kept:
                return sorted(kept, key=lambda p: p.processor_seconds)
            best = min(promises, key=total)
            raise StudyError(
                "the accuracy is out of reach",
                value=request.words,
                limit=f"{total(best):.3g} mm in {best.seconds:.3g} s at best",
                remedy="quieter taxels, or fewer effects that the calibration does not know",
            )
        assert request.seconds is not None
        kept = [p for p in promises if p.seconds <= request.seconds]
        if kept:
            return sorted(kept, key=lambda p: (total(p), p.seconds))
        quick = min(promises, key=lambda p: p.seconds)
        raise StudyError(
            "the time is too short",
            value=request.words,
            limit=f"{quick.seconds:.3g} s for {total(quick):.3g} mm at least",
            remedy="give more seconds",
        )


def pilot(
    scene: Scene,
    request: Request,
    methods: Sequence[str],
    drawing: Callable[[Calibration], float],
    seed: int,
    began: tuple[float, float],
) -> Pilot:
    """A short run of a scene.

    methods: run beside the joint estimate; drawing: tells the processor seconds of a report; began:
    perf_counter and process_time when the run was begun. Raises what a run raises.
    """
    base = Setting.of(scene)
    reach = float(scene.patch.semi_axes[-1]) + scene.skin.disc_radius
    own = base.lane_spacing
    coarse = replace(base, lane_spacing=max(min(LANES[-1] * own, WIDEST * reach), own))
    small = coarse.scene(scene, scene.body)
    (machine, path), preparing = timed(lambda: prepare(small))
    steps, looping = timed(lambda: list(run(small, machine, path)))

    def read() -> Recording:
        frames = contact_frames(small, machine.loop, steps)
        return Recording(*sensor_tables(small, frames, effect_chain(small, seed)), _header(small))

    recording, _ = timed(read)  # the first time pays for what the next ones find
    _, reading = timed(read)
    belief = small.belief()
    found = calibrate(recording, belief)  # the first one, again
    few = _thinned(recording)
    cost, less = (_estimates(data, belief, methods) for data in (recording, few))
    each = max(cost - less, 0.0) / max(len(recording.pressure) - len(few.pressure), 1)
    bound = 0.0
    if belief.noise_sigma is not None:
        bound = 1e3 * metrics.cramer_rao(recording, belief, small.skin).mean
    systematic = _systematic(small, found, seed)
    count = sum(len(part.time) for part in steps)
    making = 0.3 * preparing  # the loop's functions; planning goes with the path
    tried = Pilot(
        base, coarse, count, len(recording.time), len(recording.pressure), bound, systematic,
        (worth(tolerances(recording, belief)),),
        fixed=making + drawing(found),
        each_step=(preparing - making + looping) / count,
        each_contact=reading / max(len(recording.time), 1),
        estimating=(max(cost - each * len(recording.pressure), 0.0), each),
        spent=_since(began),
    )  # fmt: skip
    if request.seconds is None or tried.spent[0] < TRYING * request.seconds:
        tried = _turned(tried, small, request)
    return replace(tried, spent=_since(began))


def _since(began: tuple[float, float]) -> tuple[float, float]:
    return time.perf_counter() - began[0], time.process_time() - began[1]


def _turned(tried: Pilot, scene: Scene, request: Request) -> Pilot:
    """The pilot with levels of loop, contact model and surface, from Runge-Kutta at half the step.

    Other steps and models are tried where the run would take longer over them than trying does.
    """
    loop = replace(scene.loop, integrator="rk4")
    fine = scene.with_(loop=replace(loop, dt=loop.dt / 2))
    numerics = Numerics(fine, 1e-10, scene.loop.compile)
    own = loops(numerics, scene, (1,))
    knobs = [*tried.knobs, worth(own)]
    if request.accuracy_mm is not None:
        knobs.append(surfaces(numerics, scene, request.accuracy_mm))
    tried = replace(tried, knobs=tuple(knobs))
    try:
        best = tried.choose(request)[0].setting
    except StudyError:
        return tried
    lanes = tried.setting.lane_spacing / best.lane_spacing
    if lanes > 2 * len(COARSER) * len(own):
        knobs[1] = worth(own + loops(numerics, scene, COARSER))
    frames = lanes * best.rate / tried.setting.rate
    if frames > 2 * len(BATCHED):
        knobs.append(worth(models(numerics, scene)))
    return replace(tried, knobs=tuple(knobs))


def timed(work: Callable[[], T]) -> tuple[T, float]:
    """What comes out, and its processor seconds."""
    begin = time.process_time()
    return work(), time.process_time() - begin


def _header(scene: Scene) -> dict[str, Any]:
    return {
        "taxel_ids": np.asarray(scene.skin.ids).tolist(),
        "disc_radius_m": scene.skin.disc_radius,
        "threshold_pa": scene.threshold,
        "force_reference_n": scene.law.force_reference,
    }


def _estimates(recording: Recording, belief: Belief, methods: Sequence[str]) -> float:
    """Processor seconds of the joint estimate and of all methods."""
    begin = time.process_time()
    for method in ("joint", *methods):
        calibrate(recording, belief, method=method)
    return time.process_time() - begin


def _thinned(recording: Recording) -> Recording:
    """Every fourth contact of a recording."""
    keep = np.arange(len(recording.time)) % THIN == 0
    return Recording(
        recording.contacts.filter(pa.array(keep)),
        recording.readings.filter(pa.array(keep[recording.reading_contact])),
        recording.metadata,
    )


def _systematic(scene: Scene, found: Calibration, seed: int) -> float:
    """Mean error, mm, that is left without noise."""
    rest = tuple(effect for effect in scene.effects if not isinstance(effect, Noise))
    if len(rest) == len(scene.effects):  # there is none: the pilot's own error
        error = metrics.position_errors(found, scene.skin)
    elif not rest:
        return 0.0
    else:
        quiet = simulate(scene.with_(effects=rest), seed)
        error = metrics.position_errors(calibrate(quiet, scene.belief()), scene.skin)
    return 1e3 * float(np.nanmean(error))
