"""The estimate with a learned response, whose contacts and forces have errors of their own.

    reading = response(gain amplitude(F) (profile(u) + correction(u))) + offset

The believed contact model is the mean of the profile; a smooth correction of it, the exponents of
size and amplitude in the force, the scale of the readings and a compression of strong ones are
estimated with the taxels, as are gain and offset of each taxel and the errors of each contact
(random_effects.py). Their variances follow from the data: with few contacts, or where the model
holds, the estimate is the model's.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import replace
from typing import Any

import numpy as np

from ...core.arrays import Array
from ...core.errors import CalibrationError, UnconvergedError
from ...core.progress import Stage
from ...scene.belief import RAW, Belief
from ..data.global_parameters import (
    DRIFTS,
    ELECTRONICS,
    LEARNED,
    LEARNED_PRIORS,
    PRIORS,
    SIZES,
    declared_parameters,
    nuisance_unit,
)  # fmt: skip
from ..data.measurements import Measurements
from ..data.patch_shape import over_edges
from ..joint import fault_detection, outlier_rejection
from ..joint.departures import MIN_SCORE
from ..joint.joint_estimator import JointEstimator
from ..joint.jump import Jump, jump_by_outliers, largest_jump
from ..joint.parametrization import SurfaceParametrization, Unknowns
from ..joint.pressure import CENSORED, OBSERVED
from ..joint.readings import select
from ..joint.rival_optima import RivalOptima, resolve_rivals
from ..posegraph.symmetric_blocks import SingularMatrixError
from ..result import EstimatorResult, LearnedResponse
from ..trilateration import coactivation, trilaterate
from .contact_kinds import contact_kinds
from .departure_search import first_estimate, plausible, scores, with_departures
from .deviations import Deviations
from .modules import heights_of_taxels, moved_to_modules
from .random_effects import MAX_DECREASE, MAX_ITERATIONS, RandomEffects
from .response_groups import response_groups
from .result import learned_result
from .start import Former, begin, resumed

MIN_EXTENT = 1.2
"""Least extent of the learned profile, in reaches of the believed patch."""
MAX_EXTENT = 4.0
"""Largest extent, in semi-axes of the patch."""
REACHED = 0.99
"""Share of the readings above the noise whose distances the profile covers."""
MARGIN = 1.15
"""Extent of the profile relative to these distances."""
ROUND = 0.02
"""Logarithm of the ratio of a patch's semi-axes below which it is round: a ratio that is wrong by a
quarter of it displaces its rim by less than 1 %."""
MAX_ROUNDS = 3
"""Largest number of times that outlying readings are left out and the rest is estimated again."""
USUAL_STEPS = 30
"""Usual steps of Gauss and Newton, of variances, and of searches for second optima."""
MAX_LACKING = 0.02
"""Fraction of readings beyond the believed reach from which they are selected anew: a Hertz world
has less, a cover with readings to the power 0.6 a fourth."""
LAGGING = 0.5
"""Displacement of contacts, in contact radii, up to which it may be by drag or a lag."""
MOVED = 0.02
"""Move of a taxel, in contact radii, from which it is at another optimum."""


def estimate(
    data: Measurements, stage: Stage | None = None, former: Former | None = None
) -> EstimatorResult:
    """The estimate with a learned response, from trilateration, or co-activation where it fails;
    from a former one of the same taxels, if that leads to an estimate.

    stage: whose steps are counted. Raises CalibrationError if no taxel is determined, the estimate
    does not converge, or the taxels are not arranged as in the believed modules.
    """
    if former is not None:
        with suppress(CalibrationError):
            return _estimate(former.without_misfits(data), former.excluded, stage, former)
    return _estimate(data, (), stage, None)


def _estimate(
    data: Measurements, excluded: tuple[str, ...], stage: Stage | None, former: Former | None
) -> EstimatorResult:
    """As `estimate`."""
    again: tuple[Measurements, tuple[str, ...]] | EstimatorResult = data, excluded
    try:
        while isinstance(again, tuple):  # no recursion, which would hold the memory of all
            again = _attempt(*again, stage or Stage(), former)
        return again
    except (SingularMatrixError, np.linalg.LinAlgError) as error:
        raise _unconverged(f"its normal equations are singular: {error}", data.belief) from error


def _unconverged(value: str, belief: Belief) -> UnconvergedError:
    return UnconvergedError(
        "the estimate with a learned response did not converge",
        value=value,
        remedy="record more contacts with different forces"
        + ", or believe a contact model" * (belief.readings != RAW),
    )


def _attempt(
    data: Measurements, excluded: tuple[str, ...], stage: Stage, former: Former | None
) -> EstimatorResult | tuple[Measurements, tuple[str, ...]]:
    """As `estimate`, or the measurements and departures to exclude in another attempt. excluded:
    departures that came out implausible, which are left out. Raises SingularMatrixError."""
    clock, recorded, stuck = time.perf_counter(), data, fault_detection.stuck_taxels(data)
    # readings far from the contacts, such as those that hysteresis leaves, do not tell the place
    data = coactivation.without_distant_readings(data)
    start = coactivation.initial_estimate(data, trilaterate.least_squares(data))
    live, reasons = coactivation.live_taxels(data, start, stuck.rows)
    stage.expect(USUAL_STEPS)
    data = with_learned_response(data, start.points)
    weight = every = np.ones(len(data.pressure))
    if former is not None and former.serves(live):
        effects, weight = resumed(data, live, former, stage), former.weight(data)
        first = effects.unknowns, effects.deviations
        effects.converge()
    else:
        effects, former = begin(data, live, start, stage), None
        first = effects.unknowns, effects.deviations
        effects = first_estimate(effects)
    settled = len(effects.iterates) <= MAX_ITERATIONS
    if len(bad := _displaced(effects, recorded, LAGGING)):  # departures would stand in for them
        return recorded.without_contacts(bad), excluded
    effects, departures, ended = _searched(effects, first, excluded, former)
    frozen = _frozen(effects, live, every)
    if _lacks(effects, frozen):
        effects = _restarted(effects, frozen)
        effects.converge()
        frozen = _frozen(effects, live, every)
    if ended and len(bad := _displaced(effects, recorded)):
        return recorded.without_contacts(bad), excluded
    for repeated in range(MAX_ROUNDS if ended else 1):  # others would not bring it to rest
        frozen = _frozen(effects, live, weight) if repeated else frozen
        estimator = outlier_rejection.reject_outliers(frozen)
        rivals = resolve_rivals(estimator) if ended or settled else RivalOptima.none(len(live))
        if not _changed(effects, estimator, weight):
            break
        weight = estimator.weight
        effects = _restarted(effects, estimator)
        effects.converge()
    if (decrease := effects.system().newton_step()[2]) > MAX_DECREASE * len(effects.mu):
        raise _unconverged(f"steps still decrease the cost by {decrease:.3g}", data.belief)
    if wild := [name for name in ELECTRONICS if not plausible(effects, name)]:
        if excluded:
            raise _unconverged(f"implausible {', '.join(wild)}", data.belief)
        return recorded, tuple(wild)
    fault_detection.name_left_out(estimator.faults, recorded, stuck)
    found = learned_result(effects, estimator, rivals, reasons, clock)
    if data.belief.module_slots is not None:
        found = moved_to_modules(data, found, effects.system(), live)
        if data.heights is None and (heights := heights_of_taxels(data, found)) is not None:
            return replace(recorded, heights=heights), excluded
    fitted, kinds = effects.fitted(), contact_kinds(effects)
    jump = max(largest_jump(fitted), _jump_without_errors(effects, live), key=lambda x: x.score)
    former = Former(effects, estimator, departures, ended, excluded)
    departures = {**response_groups(fitted).departure, **departures, **found.departures}
    departures |= jump.departure | kinds.departure
    displaced = jump.or_displacement(kinds.shown)
    return replace(found, departures=departures, jump=displaced, former=former)


def _searched(
    effects: RandomEffects,
    first: tuple[Unknowns, Deviations],
    excluded: tuple[str, ...],
    former: Former | None,
) -> tuple[RandomEffects, dict[str, float], bool]:
    """As `with_departures`; what a former search found holds unless others show now."""
    if former is not None:
        before = former.departures
        found = {name: score for name, (score, _) in scores(effects).items() if name in before}
        if all(score <= MIN_SCORE or before[name] > MIN_SCORE for name, score in found.items()):
            return effects, found, former.ended
    return with_departures(effects, first, excluded)


def _displaced(effects: RandomEffects, recorded: Measurements, least: float = 0.0) -> np.ndarray:
    """Contacts of `recorded` to leave out, with those that were before: those that err far more
    than most, if any is displaced by `least` contact radii; after the first time, those whose force
    does, which points that are off pass for where few others are displaced."""
    errors, touched = effects.unknowns.errors, effects.probes.touched
    bad = outlier_rejection.displaced_contacts(errors, touched, effects.data.radii)
    bad, before = outlier_rejection.minority(bad, effects.selected[0]), recorded.misfitting
    far = np.linalg.norm(errors[bad, :2], axis=1) > least * np.median(effects.data.radii)
    if len(before):
        far = np.abs(errors[bad, 2]) > outlier_rejection.LEAST_FORCE
    return np.union1d(bad, before) if far.any() else bad[:0]


def with_learned_response(data: Measurements, points: Array) -> Measurements:
    """The measurements with the parameters of a learned response; points (n, 3), m: of the taxels,
    about."""
    peak, sigma = data.nominal_peak, data.sigma
    names = (*LEARNED, *(name for name in data.parameters.names if name not in LEARNED))
    ratio = np.abs(np.log(data.patches.first / data.patches.second))
    if data.model.name == "hertz" or np.quantile(ratio, REACHED) < ROUND:
        names = tuple(name for name in names if name != "aspect")
    priors = {**LEARNED_PRIORS, **data.belief.priors}
    parameters = declared_parameters(
        (*names, "gain", "offset"), priors, data.belief.force_reference or 1.0, peak,
        data.parameters.motion,
    )  # fmt: skip
    parameters, _ = parameters.grouped(1 + len(data.belief.response_groups))
    offset = points[data.taxel] - data.points[data.contact]
    height = np.einsum("ki,ki->k", offset, data.normals[data.contact])
    across = np.sqrt(np.maximum(np.einsum("ki,ki->k", offset, offset) - height**2, 0.0))
    u = (across / data.longest[data.contact])[data.pressure > data.threshold + 5 * sigma]
    u = u[np.isfinite(u)]
    reach = float(np.median(data.reach() / data.longest))
    extent = MARGIN * float(np.quantile(u, REACHED)) if len(u) else reach
    extent = float(np.clip(extent, MIN_EXTENT * reach, max(MAX_EXTENT, MIN_EXTENT * reach)))
    belief = data.belief
    if belief.threshold == 0 and len(data.pressure):  # the least reading tells
        belief = replace(belief, threshold=float(data.pressure.min()) * (1 - 1e-9))
    return replace(data, belief=belief, parameters=parameters, noise=sigma, profile_extent=extent)


def as_learned(
    data: Measurements,
    response: LearnedResponse,
    unknowns: Mapping[str, tuple[float, float]],
    positions: Array,
) -> Measurements:
    """The measurements under a response that a calibration learned, in its unit; unknowns and
    positions (n, 3), m: of that calibration."""
    scale = data.unit / response.unit
    estimated = {label.split()[0] for label in unknowns}
    for name in sorted(estimated & {"hysteresis", "creep", *DRIFTS} - set(data.parameters.names)):
        p, more = data.parameters, np.full(SIZES[name], PRIORS[name])
        p = replace(p, names=(*p.names, name), sigma=np.append(p.sigma, more))
        data = replace(data, parameters=p)
    groups = tuple(other.taxels for other in response.others)
    data = replace(data, belief=replace(data.belief, response_groups=groups))
    data = replace(data.referred_to(response.references), learned=True)
    hit, error = data.body.closest(data.points), response.edge_error
    return replace(
        with_learned_response(data, positions),
        unevenness=over_edges(data.belief, hit, data.force, error),
        edge_error=error,
        profile_extent=response.extent,
        response_levels=response.levels,
        pressure=data.pressure * scale,
        threshold=data.threshold * scale,
        saturation=data.saturation * scale,
        ends=data.ends * scale,
        unit=response.unit,
    )


def _jump_without_errors(effects: RandomEffects, live: np.ndarray) -> Jump:
    """The jump that readings show which are outlying where contact points have no errors of their
    own: these stand in for it."""
    try:
        every = np.ones(len(effects.data.pressure))
        still = _frozen(effects, live, every, errors=np.array([0.0, 0.0, 1.0]))
        # hysteresis and creep pass for a drift without the contacts' errors
        return jump_by_outliers(outlier_rejection.reject_outliers(still), drift=False)
    except CalibrationError:
        return Jump()


def _frozen(
    effects: RandomEffects, live: np.ndarray, weight: Array, errors: Array | float = 1.0
) -> JointEstimator:
    """The taxels under the response and the contacts as estimated, which stay, with `errors` times
    their errors (m, 3)."""
    data, u, d = effects.data, effects.unknowns, effects.deviations
    observed = effects.readings.kind == OBSERVED
    noise = float(np.sqrt(np.mean(effects.spread[observed] ** 2))) * data.sigma
    names = data.parameters.nuisance_names
    sigma = tuple(getattr(d, name) * nuisance_unit(name, data.sigma) for name in names)
    frozen = replace(
        data,
        noise=noise,
        **_without_electronics(effects),
        contact_errors=errors * u.errors,
        parameters=replace(data.parameters, nuisance_sigma=sigma),
    )
    nuisance = u.nuisance * [nuisance_unit(name, data.sigma / noise) for name in names]
    estimator = JointEstimator(
        frozen, live, u.parametrization, weight.copy(), 1, shared=u.s, nuisance=nuisance,
        stage=effects.stage,
    )  # fmt: skip
    estimator.converge()
    return estimator


def _without_electronics(effects: RandomEffects) -> dict[str, Any]:
    """The readings (k,) of the recording without what hysteresis and crosstalk have added, and the
    threshold that all silent readings are below without it; by their names in Measurements."""
    pressure, readings = effects.data.pressure.copy(), effects.readings
    added = effects.data.sigma * effects.added_by(ELECTRONICS)
    recorded = readings.kind == OBSERVED
    pressure[readings.source[recorded]] -= added[recorded]
    lowered = -float(added[readings.kind == CENSORED].min(initial=0.0))
    return {"pressure": pressure, "threshold": effects.data.threshold + lowered}


def _lacks(effects: RandomEffects, frozen: JointEstimator) -> bool:
    """Whether the readings within the learned reach, which `frozen` has, are more than those within
    the believed one: without them these would seem outlying in all taxels."""
    if effects.electronics is not None:  # far readings are those that hysteresis leaves
        return False
    there = [np.sum(x.kind == OBSERVED) for x in (effects.readings, frozen.likelihood.readings)]
    return bool(there[1] > (1 + MAX_LACKING) * there[0])


def _changed(effects: RandomEffects, estimator: JointEstimator, weight: Array) -> bool:
    """Whether taxels have moved to other optima, or readings were left out."""
    moved = estimator.problem.points(estimator.state) - effects.unknowns.parametrization.points()
    far = np.linalg.norm(moved, axis=1) > MOVED * float(np.median(estimator.data.radii))
    return bool(far.any() or np.any((estimator.weight < 0.5) != (weight < 0.5)))


def _restarted(effects: RandomEffects, estimator: JointEstimator) -> RandomEffects:
    """The estimate from where the taxels are now, without outlying readings."""
    data, u = effects.data, effects.unknowns
    parametrization = estimator.problem.parametrization
    assert isinstance(parametrization, SurfaceParametrization)
    points, normals = parametrization.points(), parametrization.rotations()[:, :, 2]
    weight = np.where(estimator.weight < 0.5, 0.0, 1.0)
    reach = estimator.selected_at[2] if effects.electronics is None else 0.0
    readings = select(data, estimator.live, points, normals, reach, weight, estimator.silent_weight)
    unknowns = replace(u, parametrization=parametrization)
    return RandomEffects(data, readings, unknowns, effects.deviations, stage=effects.stage)
