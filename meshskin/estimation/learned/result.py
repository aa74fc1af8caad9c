"""The result of an estimate with a learned response: taxels, the response itself, and what the data
left undetermined.
"""

from __future__ import annotations

import time
from dataclasses import replace
from functools import partial

import numpy as np

from ...core.arrays import Array, spread_rows
from ..chart import tangential_square
from ..data.global_parameters import DEPARTURES, ERROR_EXPONENT, MOTION
from ..joint import fault_detection, rejected_readings, small_effects
from ..joint.departures import FittedReadings
from ..joint.gain_changes import GAIN_CHANGES, displacements, gain_changes
from ..joint.joint_estimator import MAX_CHI2, JointEstimator
from ..joint.leaks import LOST_SHARE, further_shares, leak_covariances, lost_share
from ..joint.noise import Noise, neighbour_scatter
from ..joint.null_space import undetermined_motion
from ..joint.optimum import model_dependence
from ..joint.parametrization import SurfaceParametrization
from ..joint.pressure import CENSORED, OBSERVED
from ..joint.residual_correlations import contact_fields, larger, shared_errors
from ..joint.rival_optima import RivalOptima
from ..joint.small_effects import SmallEffects
from ..posegraph.symmetric_blocks import SingularMatrixError
from ..result import (
    ALIKE_CONTACTS,
    CENSORING,
    MOSTLY_OUTLIERS,
    SHARED_ERRORS,
    SURFACE,
    EstimatorResult,
    LearnedResponse,
    name_rivals,
)
from ..uncertainty.goodness_of_fit import GoodnessOfFit, goodness_of_fit, remedy_of_learned
from .contact_correlations import alike_errors, fewer_contacts, force_scatter
from .estimated_response import learned_response
from .lags import LAGS, MAX_LEVERAGE, lags, slope_beyond_mode
from .random_effects import RandomEffects

LEARNED_RESPONSE = "learned response: profile, exponents and compression estimated with the taxels"
FALLING = "the recorded readings fall with pressure: they were turned"
NOT_SEPARABLE = 0.9
"""Standard deviation, relative to that of its prior, from which a parameter rests on its prior."""
SHARES = "crosstalk of single taxels, of both signs"
FEW = 6.0
"""Factor of 1 / n^2 in the relative increase of the variance of a taxel with n readings."""


def learned_result(
    effects: RandomEffects,
    estimator: JointEstimator,
    rivals: RivalOptima,
    reasons: np.ndarray,
    clock: float,
) -> EstimatorResult:
    """The result for all taxels.

    Raises SingularMatrixError where the readings leave the covariance undetermined.
    """
    data, u, live = effects.data, effects.unknowns, estimator.live
    covariance, shared = _covariances(effects)
    fit = _fit(effects)
    response = learned_response(effects, shared, alike_errors(effects, covariance[:, :2, :2]))
    scale = max(_misfit(fit), fewer_contacts(response.contact_correlation), response.alike_contacts)
    small = _small_effects(effects, fit)
    tangential, factors, departures = _tangential(effects, covariance, fit, scale)
    if fit.good is False:
        tangential *= _own_misfit(effects)[:, None, None]
        # where no contact that a taxel answered reaches it, only the model has put it
        reach = float(np.median(data.reach()))
        tangential += model_dependence(estimator, fit, reach)
    placed, tangential, words, scores = _corrected(effects, fit, small, tangential)
    points, rotations = placed.points(), placed.rotations()
    apart, second = np.nan_to_num(rivals.points - points), rejected_readings.second_fits(estimator)
    tangential += tangential_square(rotations[:, :, :2], apart) + second.covariances
    departures |= scores | second.departure
    changed, reasons = gain_changes(effects.fitted()), reasons.copy()
    changed &= fit.good is not False  # the misfit of the response would pass for it
    reasons[live], reasons[live[estimator.broken]] = "", MOSTLY_OUTLIERS
    reasons[live[changed]], lost = GAIN_CHANGES, estimator.broken | changed
    infinite = np.diag([np.inf, np.inf])
    deviation = np.sqrt(np.diagonal(scale * covariance, axis1=1, axis2=2))
    faults = estimator.faults.copy()
    name_rivals(faults, live, points, rivals.points)

    def spread(values: Array, missing: object) -> Array:
        return spread_rows(values, live, len(data.ids), missing)

    return EstimatorResult(
        points=spread(np.where(lost[:, None], np.nan, points), np.nan),
        rotations=spread(rotations, np.nan),
        covariance=spread(np.where(lost[:, None, None], infinite, tangential), infinite),
        chi2=spread(_chi2(effects), np.nan),
        reasons=reasons,
        factors=_factors(effects, response, factors + words),
        unknowns=_shared_values(effects, scale * shared),
        undetermined=_not_separable(effects, shared),
        taxel_unknowns=data.parameters.of_taxels(
            u.nuisance, deviation[:, 2:], data.sigma * data.unit, live, len(data.ids)
        ),
        faults=faults,
        rivals=spread(rivals.points, np.nan),
        fit=fit,
        departures=departures,
        response=response,
        contact_errors=_errors(effects),
        additions=_additions(effects, live),
        iterates=np.stack([spread(p, np.nan) for p in effects.iterates]),
        seconds={"joint": time.perf_counter() - clock},
    )


def _corrected(
    effects: RandomEffects, fit: GoodnessOfFit, small: dict[str, SmallEffects], tangential: Array
) -> tuple[SurfaceParametrization, Array, list[str], dict[str, float]]:
    """The taxels' places without what small effects and lags displace them by, to first order;
    their tangential covariances (n, 2, 2), m^2, with these; the effects in words; and their scores.

    tangential (n, 2, 2): covariances, m^2, without these effects.
    """
    placed, factors, departures = effects.unknowns.parametrization, [], dict[str, float]()
    for name, errors in small.items():
        if not errors.covariances.any():
            departures[name] = errors.score
        else:
            departures[f"{name}, held to first order"] = errors.score
            tangential = tangential + errors.covariances
            factors.append(f"{name}, to first order")
            placed = placed.relinearized(effects.data.body, -errors.displacements)
    if fit.good is not False:
        behind = _value(effects, "drag") or _value(effects, "friction")
        late = small_effects.held_lags(effects.fitted(), behind)
        late = late.held() if small[LAGS].displacements.any() else late  # of the same cause
        departures[small_effects.HELD_LAGS] = late.score
        factors += [small_effects.HELD_LAGS] if late.score > small_effects.NAMED else []
        tangential = tangential + late.covariances
        placed = placed.relinearized(effects.data.body, -late.displacements)
    return placed, tangential, factors, departures


def _factors(
    effects: RandomEffects, response: LearnedResponse, factors: list[str]
) -> tuple[str, ...]:
    """What the result rests on, in words; factors: of its covariances."""
    return (
        LEARNED_RESPONSE,
        *((FALLING,) if effects.data.falling else ()),
        *response.describe(),
        *((CENSORING,) if (effects.selected[0].kind == CENSORED).any() else ()),
        SURFACE,
        *factors,
        *effects.data.excluded,
    )


def _covariances(effects: RandomEffects) -> tuple[Array, Array]:
    """Covariances of the taxels (n, D, D) and of the global parameters (ks, ks).

    Raises SingularMatrixError where rounding, of a system near singular, makes variances negative.
    """
    covariance, shared = effects.system().covariances()
    variances = np.diagonal(covariance, axis1=1, axis2=2)
    if (variances <= 0).any() or (np.diag(shared) <= 0).any():
        raise SingularMatrixError(int(np.argmin(variances.min(axis=1))))
    return covariance, shared


def _value(effects: RandomEffects, name: str) -> float:
    """The estimate of a scalar global parameter; 0 if there is none."""
    return effects.data.parameters.value(name, effects.unknowns.s)


def _misfit(fit: GoodnessOfFit) -> float:
    """Factor of the variances by residuals that are larger than the noise."""
    return 1.0 if fit.good is True else max(fit.reduced, 1.0)


def _tangential(
    effects: RandomEffects, covariance: Array, fit: GoodnessOfFit, scale: float
) -> tuple[Array, list[str], dict[str, float]]:
    """Tangential covariances (n, 2, 2), m^2, with errors that readings and contacts share, what
    these are in words, and their scores.

    covariance (n, D, D): of independent errors; scale: its factor by the misfit, or by contacts
    that tell less than they seem to.
    """
    fitted = effects.fitted()
    errors, fields = shared_errors(fitted), contact_fields(fitted)
    own, added = _misfit(fit) * covariance[:, :2, :2], errors.covariances(fitted)
    tangential = larger(scale * covariance[:, :2, :2], own + added)
    factors = [SHARED_ERRORS.format(errors.where)] if added.any() else []
    if fields.covariances.any():
        # a misfit would pass for displacements of any size: its part of the residuals counts
        part = 1.0 if fit.good is not False else max(1 - 1 / fit.reduced, 0.0)
        tangential = larger(tangential, own + part * fields.covariances)
        factors.append(ALIKE_CONTACTS)
    departures = {**errors.beyond(added, own), **fields.departure}
    if fit.good is not False:
        shifted = small_effects.shifted_patches(fitted, _value(effects, "patch_shift"))
        tangential = tangential + shifted.covariances
        factors += [small_effects.SHIFTED] if shifted.score > small_effects.NAMED else []
    tangential *= _few_readings(effects)[:, None, None]
    rejected = rejected_readings.displacements(fitted, effects.spread**-2.0, effects.spread)
    both = np.stack([rejected, displacements(_whole(effects), 1.0)])
    tangential += leak_covariances(fitted, _value(effects, "crosstalk")) + np.einsum(
        "sni,snj->nij", both, both
    )
    return tangential, factors, departures


def _whole(effects: RandomEffects) -> FittedReadings:
    """All readings with their full weights, outlying ones, too, at the contacts' errors."""
    fitted = effects.fitted()
    observed, precision = effects.readings.kind == OBSERVED, effects.spread**-2.0
    off = effects.mu - effects.readings.level / effects.data.sigma
    return replace(
        fitted,
        rate=np.where(observed, precision * off, fitted.rate),
        curvature=np.where(observed, precision, fitted.curvature),
        system=None,
    )


def _small_effects(effects: RandomEffects, fit: GoodnessOfFit) -> dict[str, SmallEffects]:
    """Small errors of the readings, by their names; none where the readings do not fit, as other
    errors would pass for these."""
    none = SmallEffects.none(len(effects.unknowns.nuisance))
    if fit.good is False:
        return dict.fromkeys((LAGS, SHARES, LOST_SHARE), none)
    fitted, late, likeliest = effects.fitted(), none, ""
    shares, lost = further_shares(fitted), lost_share(fitted)
    if np.mean(small_effects.contact_leverages(fitted)) <= MAX_LEVERAGE:
        late = lags(fitted, partial(slope_beyond_mode, effects))
        scores = {LAGS: late.score, SHARES: shares.score, LOST_SHARE: lost.score}
        likeliest = max(scores, key=lambda name: scores[name])
    found = {LAGS: late, SHARES: shares, LOST_SHARE: lost}  # each passes for the others
    found = {name: one if name == likeliest else one.held() for name, one in found.items()}
    if (at := effects.data.parameters.columns.get("gain_drift")) is not None:
        found[small_effects.OWN_DRIFTS] = small_effects.own_drifts(
            fitted, effects.data.drifts @ effects.unknowns.s[at]
        )
    return found


def _chi2(effects: RandomEffects) -> Array:
    """Squared residuals per degree of freedom (n,) of the taxels."""
    readings, n = effects.readings, len(effects.unknowns.nuisance)
    recorded = readings.kind == OBSERVED
    square = np.bincount(readings.taxel, effects.residuals() ** 2 * recorded, n)
    return np.asarray(square / np.maximum(np.bincount(readings.taxel, recorded, n) - 2, 1))


def _own_misfit(effects: RandomEffects) -> Array:
    """Factors (n,), at least 1, of the variances of taxels whose residuals are far larger than
    those of most: where the model does not fit, one noise is not that of all."""
    chi2 = _chi2(effects)
    own = chi2 / max(float(np.median(chi2)), 1e-300)
    return np.where(own > MAX_CHI2, own, 1.0)


def _few_readings(effects: RandomEffects) -> Array:
    """Factors (n,) of the taxels' variances where few readings determine their four unknowns: the
    variances of gains, offsets and contacts are taken as known, and so is the linearization."""
    readings = effects.readings
    count = np.bincount(readings.taxel, readings.kind == OBSERVED, len(effects.unknowns.nuisance))
    return np.asarray(1 + FEW / np.maximum(count, 1.0) ** 2)


def _errors(effects: RandomEffects) -> Array:
    """Errors (m, 3) of the contacts; NaN of those that were left out."""
    errors = effects.unknowns.errors.copy()
    errors[effects.data.misfitting] = np.nan
    return errors


def _additions(effects: RandomEffects, live: np.ndarray) -> Array | None:
    """As `EstimatorResult.additions`; live: rows of the taxels."""
    p, readings = effects.data.parameters, effects.readings
    if not {*DEPARTURES} & {*p.names, *p.nuisance_names}:
        return None
    added = effects.data.sigma * effects.added_by(DEPARTURES)
    return np.column_stack([readings.contact, live[readings.taxel], added])


def _fit(effects: RandomEffects) -> GoodnessOfFit:
    """The test of fit: residuals against the known noise, or against the scatter of neighbouring
    contacts, whose residuals have the same leverages."""
    readings, r = effects.readings, effects.residuals()
    clear = effects.clear()
    known, noise = effects.noise_known, Noise(1.0, 0)
    if not known:
        points, rows = effects.data.points, np.flatnonzero(clear)
        noise = neighbour_scatter(readings, points, r, rows, lambda a, b: np.full(len(a), 2.0))
    fit = goodness_of_fit(
        chi2=float(readings.weight[clear] @ r[clear] ** 2) / noise.scale**2,
        freedom=float(readings.weight[clear] @ (1 - effects.leverages[clear] * known)),
        noise_known=known,
        outlying=int(np.sum(fault_detection.outliers(readings))),
        pairs=noise.pairs,
        remedy=remedy_of_learned(effects.data.belief),
    )
    return replace(fit, noise=noise.scale * effects.deviations.noise * effects.data.sigma)


def _shared_values(effects: RandomEffects, covariance: Array) -> dict[str, tuple[float, float]]:
    """Global parameters but for the profile, and the deviations of the contacts' errors."""
    parameters, d = effects.data.parameters, effects.deviations
    m = max(int(effects.probes.touched.sum()), 1)
    found = parameters.named(effects.unknowns.s, covariance)
    for label in parameters.labels[parameters.columns["profile"]]:
        del found[label]
    found["contact_scatter"] = d.position, d.position / float(np.sqrt(4 * m))
    force = force_scatter(effects)
    measured = effects.data.force_measured  # else it contains the errors of the estimated forces
    found["force_scatter"] = force, force / float(np.sqrt(2 * m)) if measured else force
    return found


def _not_separable(effects: RandomEffects, covariance: Array) -> tuple[str, ...]:
    """Shared parameters that rest on their priors, in words."""
    parameters = effects.data.parameters
    sigma = np.sqrt(np.diag(covariance))
    weak = tuple(
        f"{label} is not determined"
        for k, label in enumerate(parameters.labels)
        if not label.startswith(("profile", MOTION, ERROR_EXPONENT))
        and sigma[k] > NOT_SEPARABLE * parameters.sigma[k]
    )
    return (*weak, *undetermined_motion(parameters, covariance))
