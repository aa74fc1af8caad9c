"""A pilot: a short run of a scene on its coarsest lanes, each of its parts timed.

What is paid once, for each step, each frame and each reading; and how far the levels of the knobs
that a request may turn (levels.py) move the taxels on its path.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import pyarrow as pa

from ...contact import BATCHED
from ...core.errors import CalibrationError, GraphError, StudyError
from ...effects import NoiseEffect
from ...estimation.calibrate import calibrate
from ...estimation.uncertainty import metrics
from ...recording.recording import Recording
from ...simulation.contact_samplers import concatenate
from ...simulation.readout import contact_frames, effect_pipeline, record
from ...simulation.simulate import prepare, run, simulate
from .levels import COARSER, loops, models, surfaces, tolerances, worth
from .numerical_error import Numerics
from .request import LANES, Pilot, Request
from .setting import Setting

if TYPE_CHECKING:
    from ...estimation.calibration import Calibration
    from ...scene.belief import Belief
    from ...scene.scene import Scene

    T = TypeVar("T")

WIDEST = 0.8
"""Largest spacing of lanes over the distance at which a taxel feels a contact."""
THIN = 4
"""Every so many readings are calibrated again, to tell fixed costs from those of a reading."""
TRYING = 0.2
"""Part of the seconds asked for within which a pilot goes on to try steps, models and surfaces."""
LONGER = 0.05
"""Part of a run's seconds within which its estimates are tried at length."""
MAKING = 0.3
"""Part of a preparation's seconds that makes the loop's functions: the rest, planning, goes with
the path's length."""


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
    coarse = _coarse(base, scene.rig.sensing_radius)
    small = coarse.scene(scene, scene.body)
    (machine, path), preparing = timed(lambda: prepare(small))
    steps, looping = timed(lambda: list(run(small, machine, path)))

    def read() -> Recording:
        frames = contact_frames(small, machine.loop, steps)
        return record(small, frames, effect_pipeline(small, seed))

    recording, _ = timed(read)  # the first time pays for what the next ones find
    _, reading = timed(read)
    belief = small.belief()
    found = calibrate(recording, belief)  # the first one, again
    few = _thinned(recording)
    cost, less = (_estimates(data, belief, methods) for data in (recording, few))
    each = max(cost - less, 0.0) / max(len(recording.pressure) - len(few.pressure), 1)
    bound = metrics.bound_mm(recording, belief, small.skin)["mean"]
    systematic = _systematic(small, found, seed)
    count = sum(len(part.time) for part in steps)
    making = MAKING * preparing
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
        tried = _with_levels(tried, small, request)
    tried = at_length(
        tried,
        recording,
        request,
        lambda data: _estimates(data, belief, methods),
        lambda data, rest: timed(lambda: calibrate(data, belief, tolerance=rest))[1],
    )
    return replace(tried, spent=_since(began))


def _coarse(base: Setting, reach: float) -> Setting:
    """The setting with the widest lanes on which taxels still feel contacts, at `reach`, m."""
    own = base.lane_spacing
    return replace(base, lane_spacing=max(min(LANES[-1] * own, WIDEST * reach), own))


def _since(began: tuple[float, float]) -> tuple[float, float]:
    return time.perf_counter() - began[0], time.process_time() - began[1]


def _with_levels(tried: Pilot, scene: Scene, request: Request) -> Pilot:
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


def at_length(
    tried: Pilot,
    recording: Recording,
    request: Request,
    whole: Callable[[Recording], float],
    joint: Callable[[Recording, float], float],
) -> Pilot:
    """The pilot with the prices of a reading in a long recording, where caches hold it no more and
    what is paid once counts for little.

    The pilot's recording is estimated from several times over: as often as the run that would be
    chosen is longer, and as takes up to LONGER of its seconds. whole: processor seconds of all
    estimates; joint: of the joint one at a tolerance.
    """
    try:
        best = tried.choose(request)[0]
    except StudyError:
        return tried
    once, each = tried.estimating
    lanes = tried.setting.lane_spacing / best.setting.lane_spacing
    longest = min(
        tried.readings * lanes * best.setting.rate / tried.setting.rate,
        LONGER * best.processor_seconds / max(each, 1e-9),
    )
    times = round(longest / max(tried.readings, 1))
    if times < 2:
        return tried
    long = recording
    for _ in range(times - 1):
        long = concatenate(long, recording)

    def split(short: float, long: float) -> tuple[float, float]:
        """What is paid once, and for the pilot's readings."""
        grown = max(long - short, 0.0) / (times - 1)
        return max(short - grown, 0.0), grown

    once, grown = split(once + each * tried.readings, whole(long))
    resting, *others = tried.knobs
    levels = []
    for level in resting:
        first, later = split(level.reading, joint(long, level.changes["tolerance"]))
        levels.append(replace(level, once=first, reading=later))
    return replace(tried, estimating=(once, grown / tried.readings), knobs=(tuple(levels), *others))


def timed(work: Callable[[], T]) -> tuple[T, float]:
    """What comes out, and its processor seconds."""
    begin = time.process_time()
    return work(), time.process_time() - begin


def _estimates(recording: Recording, belief: Belief, methods: Sequence[str]) -> float:
    """Processor seconds of the joint estimate and of all methods, whether they find anything."""
    begin = time.process_time()
    calibrate(recording, belief)
    for method in methods:
        with suppress(CalibrationError, GraphError):
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
    rest = tuple(effect for effect in scene.effects if not isinstance(effect, NoiseEffect))
    if len(rest) == len(scene.effects):  # there is none: the pilot's own error
        error = metrics.position_errors(found, scene.skin)
    elif not rest:
        return 0.0
    else:
        quiet = simulate(scene.with_(effects=rest), seed)
        error = metrics.position_errors(calibrate(quiet, scene.belief()), scene.skin)
    return 1e3 * float(np.nanmean(error))
