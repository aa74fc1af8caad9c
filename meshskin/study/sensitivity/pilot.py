"""A pilot: a short run of a scene on wide lanes, each of its parts timed.

It gives the seconds that are spent once, per step, per frame and per reading, and the shift of the
taxels by the levels of the knobs that a request may change, measured along its path (as `cost`
measures it). The estimator is not such a knob: a run uses all of them in any case, and the joint
estimate has the smallest error.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np

from ...contact import BATCHED
from ...core.arrays import Array
from ...core.deadline import REPORT_SECONDS, Deadline
from ...core.errors import (
    CalibrationError,
    ConfigError,
    ContactError,
    GraphError,
    ReachError,
    SimulationError,
    StudyError,
)
from ...core.progress import Progress, Stage
from ...effects import NoiseEffect
from ...estimation.calibrate import Estimation, calibrate
from ...estimation.calibration import Calibration
from ...estimation.cross_validation import subset
from ...estimation.uncertainty import metrics
from ...geometry.body import Body
from ...recording.recording import Recording
from ...scene.belief import Belief
from ...scene.scene import Scene
from ...simulation.contact_samplers import concatenate
from ...simulation.simulate import simulate
from .first_run import FIRST_STEPS, LANES, MEASURED_STEPS, FirstRun
from .knobs import COARSER, FINER, RATES, TOLERANCES, Level, contact_models, integrators, worthwhile
from .numerical_error import NumericalReference, geometry, mean_mm
from .request import Pilot, Request
from .setting import Setting
from .trial import timed

THIN = 4
"""Every THIN-th contact is calibrated again, to separate fixed seconds from those of a reading."""
LEVELS_SHARE = 0.2
"""A pilot measures levels only if it has used less than this part of the seconds asked for."""
REPEAT_SHARE = 0.05
"""Part of the predicted seconds of a run that long recordings are estimated for."""
BUILD_SHARE = 0.3
"""Part of the seconds of a preparation that builds the functions of the loop. The rest, planning,
is proportional to the length of the path."""


def pilot(
    scene: Scene,
    first: FirstRun,
    request: Request,
    methods: Sequence[str],
    seed: int,
    deadline: Deadline,
    progress: Progress | None = None,
) -> Pilot:
    """Measure the parts of a first run. methods: run beside the joint estimate.

    Raises OutOfTime, and as `simulate` and `calibrate`.
    """
    base, coarse, small = Setting.of(scene), first.setting, first.scene
    (preparing, looping), recording, found = first.seconds, first.recording, first.calibration
    hook, belief = deadline.hook(progress, REPORT_SECONDS), small.belief()
    stage = Stage(None, "pilot", FIRST_STEPS + MEASURED_STEPS)
    stage.progress, stage.done = hook, FIRST_STEPS
    _, reading = timed(lambda: first.read(seed))  # the first time takes longer
    stage.step()
    few, _ = subset(recording, belief, np.arange(len(recording.time)) % THIN == 0)
    parts = [_estimates(data, belief, methods, stage) for data in (recording, few)]
    cost, less = (sum(part.values()) for part in parts)
    each = max(cost - less, 0.0) / max(len(recording.pressure) - len(few.pressure), 1)
    bound = metrics.bound_mm(recording, belief, small.skin)["mean"]
    systematic = _systematic(small, found, seed)
    count = sum(len(part.time) for part in first.steps)
    building = BUILD_SHARE * preparing
    lanes, widest = (base.lane_spacing * factor for factor in LANES), coarse.lane_spacing
    spacings = dict.fromkeys((*(x for x in lanes if x < widest * (1 + 1e-9)), widest))
    measured = Pilot(
        base, coarse, count, len(recording.time), len(recording.pressure), bound, systematic,
        tuple(spacings), tuple(base.rate * r for r in RATES),
        (worthwhile(tolerance_levels(recording, belief)),),
        fixed=building + REPORT_SECONDS,
        each_step=(preparing - building + looping) / count,
        each_contact=reading / max(len(recording.time), 1),
        estimating=(max(cost - each * len(recording.pressure), 0.0), each),
        spent=deadline.spent,
        shares={method: part / cost for method, part in parts[0].items()},
    )  # fmt: skip
    stage.step()
    if request.seconds is None or measured.spent[0] < LEVELS_SHARE * request.seconds:
        measured = _with_levels(measured, small, request)
    stage.step()
    measured = with_long_recording(
        measured,
        recording,
        request,
        lambda data: sum(_estimates(data, belief, methods, stage).values()),
        lambda data, rest: timed(lambda: calibrate(data, belief, tolerance=rest))[1],
    )
    stage.end()
    return replace(measured, spent=deadline.spent)


def _with_levels(measured: Pilot, scene: Scene, request: Request) -> Pilot:
    """The pilot with levels of loop, contact model and surface.

    Their reference is Runge-Kutta at half the step. Other steps and contact models are measured if
    the run would take longer with them than their measurement.
    """
    loop = replace(scene.loop, integrator="rk4")
    fine = scene.with_(loop=replace(loop, dt=loop.dt / 2))
    reference = NumericalReference(fine, 1e-10, scene.loop.compile)
    own = loop_levels(reference, scene, (1,))
    knobs = [*measured.knobs, worthwhile(own)]
    if request.accuracy_mm is not None:
        knobs.append(surface_levels(reference, scene, request.accuracy_mm))
    measured = replace(measured, knobs=tuple(knobs))
    try:
        best = measured.choose(request)[0].setting
    except StudyError:
        return measured
    lanes = measured.setting.lane_spacing / best.lane_spacing
    if lanes > 2 * len(COARSER) * len(own):
        knobs[1] = worthwhile(own + loop_levels(reference, scene, COARSER))
    if measured.growth(best) > 2 * len(BATCHED):
        knobs.append(worthwhile(contact_levels(reference, scene)))
    return replace(measured, knobs=tuple(knobs))


def with_long_recording(
    measured: Pilot,
    recording: Recording,
    request: Request,
    whole: Callable[[Recording], float],
    joint: Callable[[Recording, float], float],
) -> Pilot:
    """The pilot with the seconds of a reading in a long recording, which does not fit the caches.

    The recording of the pilot is repeated: as often as the run that would be chosen is longer, and
    as takes up to REPEAT_SHARE of its seconds. whole: gives the processor seconds of all estimates
    of a recording; joint: those of the joint estimate at a tolerance.
    """
    try:
        best = measured.choose(request)[0]
    except StudyError:
        return measured
    once, each = measured.estimating
    longest = min(
        measured.readings * measured.growth(best.setting),
        REPEAT_SHARE * best.processor_seconds / max(each, 1e-9),
    )
    times = round(longest / max(measured.readings, 1))
    if times < 2:
        return measured
    long = recording
    for _ in range(times - 1):
        long = concatenate(long, recording)

    def split(short: float, long: float) -> tuple[float, float]:
        """The seconds that are spent once, and those of the pilot's readings."""
        proportional = max(long - short, 0.0) / (times - 1)
        return max(short - proportional, 0.0), proportional

    once, proportional = split(once + each * measured.readings, whole(long))
    tolerances, *others = measured.knobs
    levels = []
    for level in tolerances:
        first, later = split(level.reading, joint(long, level.changes["tolerance"]))
        levels.append(replace(level, once=first, reading=later))
    return replace(
        measured,
        estimating=(once, proportional / measured.readings),
        knobs=(tuple(levels), *others),
    )


def _estimates(
    recording: Recording, belief: Belief, methods: Sequence[str], stage: Stage
) -> dict[str, float]:
    """Processor seconds of the joint estimate and of all methods, including those that fail."""
    seconds, begin = {}, time.process_time()
    estimation = Estimation(recording, belief)
    for method in ("joint", *methods):
        with suppress(*(() if method == "joint" else (CalibrationError, GraphError))):
            estimation.calibrate(method)
        now = time.process_time()
        seconds[method], begin = now - begin, now
        stage.step()
    return seconds


def _systematic(scene: Scene, found: Calibration, seed: int) -> float:
    """Mean error, mm, without noise."""
    rest = tuple(effect for effect in scene.effects if not isinstance(effect, NoiseEffect))
    if len(rest) == len(scene.effects):  # without noise: the pilot's own error
        error = metrics.position_errors(found, scene.skin)
    elif not rest:
        return 0.0
    else:
        quiet = simulate(scene.with_(effects=rest), seed)
        error = metrics.position_errors(calibrate(quiet, scene.belief()), scene.skin)
    return 1e3 * float(np.nanmean(error))


FINE = 0.1
"""Finer faces are tried if the scene's own surface takes more than this part of the accuracy asked
for. Coarser ones would save nothing, because they would have to be fitted besides."""


def loop_levels(
    reference: NumericalReference, scene: Scene, factors: Iterable[float]
) -> tuple[Level, ...]:
    """Time steps, as factors on the scene's own, with each integrator.

    Those with which the loop cannot be run are left out.
    """
    own, out = scene.loop, []
    for factor, integrator in product(factors, integrators(scene)):
        try:
            loop = replace(own, dt=own.dt * factor, integrator=integrator)
            made = reference.bare(scene.with_(loop=loop))
            frames, seconds = timed(partial(reference.drive, made))
        except (ConfigError, ContactError, ReachError, SimulationError):
            continue
        moved = reference.calibrate(reference.read(made, frames)) - reference.positions
        changes = {"dt": loop.dt, "integrator": integrator}
        out.append(Level(changes, mean_mm(moved), along=seconds))
    return tuple(out)


def contact_levels(reference: NumericalReference, scene: Scene) -> tuple[Level, ...]:
    """The contact models that hold where the scene's own model holds."""
    out = []
    for name in sorted(contact_models(scene), key=lambda name: name != scene.model.name):
        made = reference.scene.with_(contact=name)

        def positions(made: Scene = made) -> Array:
            return reference.calibrate(reference.read(made, reference.frames))

        found, seconds = timed(positions)
        moved = mean_mm(found - reference.positions)
        out.append(Level({"contact": name}, moved, reading=seconds))
    return tuple(out)


def tolerance_levels(recording: Recording, belief: Belief) -> tuple[Level, ...]:
    """Tolerances of the joint estimate."""
    out, tightest = [], None
    for tolerance in reversed(TOLERANCES):
        found, seconds = timed(partial(calibrate, recording, belief, tolerance=tolerance))
        tightest = found.positions if tightest is None else tightest
        moved = mean_mm(found.positions - tightest)
        out.append(Level({"tolerance": tolerance}, error_mm=moved, reading=seconds))
    return tuple(out)


def surface_levels(
    reference: NumericalReference, scene: Scene, accuracy_mm: float
) -> tuple[Level, ...]:
    """Faces of a primitive's mesh, compared with its exact surface.

    Finer ones, with the highest degree of the surface, are tried only if the scene's own take more
    than FINE of the accuracy.
    """
    own = Setting.of(scene)
    if own.faces is None:
        return (Level(),)
    error = geometry(reference).mean_mm
    out = [Level({"faces": own.faces, "degree": own.degree}, error)]
    if error > FINE * accuracy_mm:
        for faces in (own.faces, FINER * own.faces):

            def fit(faces: int = faces) -> Body:
                body = replace(own, faces=faces, degree=4).body(scene.body)
                body.closest(scene.skin.positions)
                return body

            body, once = timed(fit)
            made = reference.scene.with_(body=body)
            there = geometry(NumericalReference(made, reference.tolerance, reference.compile))
            out.append(Level({"faces": faces, "degree": 4}, there.mean_mm, once=once))
    return tuple(out)
