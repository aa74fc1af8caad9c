"""The most likely unknowns with their statistics: covariances, the test of fit, and what the
readings show beyond the model.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ...core.arrays import Array, spread_rows
from ...scene.belief import Belief
from .. import chart
from ..data.measurements import Measurements
from ..result import CENSORING, MOSTLY_OUTLIERS, SURFACE, EstimatorResult
from ..trilateration import trilaterate
from ..uncertainty.goodness_of_fit import GoodnessOfFit
from .joint_estimator import JointEstimator
from .likelihood_widths import widened
from .model_departures import ModelDepartures
from .module_parametrization import MODULE_SURFACE, MODULES, ModuleParametrization
from .noise import scale_and_fit
from .null_space import undetermined, undetermined_motion
from .rival_optima import RivalOptima
from .variable_projection import SchurComplement

UNCONVERGED = "its position does not converge"
"""Reason of a taxel that is not determined though its trilateration is."""
WIDENED = (
    "the model does not fit: standard deviations are those of {:.3g} times the noise, and include "
    "the distance from the pressure-weighted mean of the contact points, which needs no model"
)
"""Factor of an estimate whose test of fit fails."""
ESTIMATED_NOISE = "noise of {:.3g} Pa, estimated from {} pairs of neighbouring contacts"
RADIUS_TOLERANCE = 0.03
"""Relative standard deviation of the indenter's radius, which readings cannot tell from E*. Chosen:
0.3 mm of 10 mm, as a worn or printed indenter has it."""
RADIUS = "indenter radius within {:.0%} (1 sigma), which widens the standard deviation of E*"
UNDECLARED_GAINS = "gain and offset of each taxel, undeclared: without them taxels misfit"


@dataclass(frozen=True)
class Optimum:
    """The most likely unknowns, before their statistics, which take as long to compute."""

    estimator: JointEstimator
    declared: Measurements
    """The data with the belief's own parameters."""
    reasons: np.ndarray
    """Why a taxel (n,) is not determined."""
    restarted: np.ndarray
    """Rows of the taxels that were started again."""
    rivals: RivalOptima

    @cached_property
    def reduced(self) -> SchurComplement:
        """The problem of the global parameters."""
        return self.estimator.problem.reduce(self.estimator.state)

    @cached_property
    def scale_and_fit(self) -> tuple[float, GoodnessOfFit]:
        """The factor of the covariances, and the test of fit."""
        return scale_and_fit(self.estimator, self.reduced)

    @property
    def fit(self) -> GoodnessOfFit:
        """The test of fit."""
        return self.scale_and_fit[1]

    @property
    def undeclared_gains(self) -> bool:
        """Whether taxels have a gain and an offset that the belief does not declare."""
        names = self.declared.parameters.nuisance_names
        return bool(self.estimator.data.parameters.nuisance_names != names)

    @cached_property
    def found(self) -> ModelDepartures:
        """What the readings show beyond the model."""
        return ModelDepartures.of(self.estimator, self.fit)

    @cached_property
    def departures(self) -> dict[str, float]:
        """The score of each, by its name."""
        return self.found.scores(self.estimator)

    def result(self) -> EstimatorResult:
        """The statistics for all taxels."""
        estimator, rivals, restarted = self.estimator, self.rivals, self.restarted
        data, problem, state = estimator.data, estimator.problem, estimator.state
        parameters, parametrization = data.parameters, problem.parametrization
        (scale, fit), found = self.scale_and_fit, self.found

        def spread(values: Array, missing: object) -> Array:
            return spread_rows(values, estimator.live, len(data.ids), missing)

        def dropped(covariance: Array) -> Array:
            infinite = np.diag([np.inf] * covariance.shape[1])
            return spread(np.where(lost[:, None, None], infinite, covariance), infinite)

        covariance, shared = (scale * part for part in problem.covariances(state, self.reduced))
        lost, reasons = estimator.unconverged | estimator.broken, self.reasons.copy()
        named = np.where(estimator.broken, MOSTLY_OUTLIERS, "")
        reasons[estimator.live] = np.where(estimator.unconverged, UNCONVERGED, named)
        unit = 1.0 if data.noise is not None and not data.noise_pairs else scale
        information, gains = problem.information(state)
        six: Array | None = None
        if isinstance(parametrization, ModuleParametrization):
            six = parametrization.covariances(covariance[:, :6, :6])
            tangential, factors = six[:, :2, :2], [MODULES, MODULE_SURFACE]
        else:
            wide = widened(estimator, covariance[:, :2, :2], scale)
            tangential, factors = _tangential(estimator, wide, fit, found, rivals)
            tangential = tangential + found.rejected(estimator, scale**0.5)
        modulus, modulus_sigma = _modulus(estimator, shared)
        return EstimatorResult(
            points=spread(np.where(lost[:, None], np.nan, parametrization.points()), np.nan),
            rotations=spread(parametrization.rotations(), np.nan),
            covariance=dropped(tangential),
            pose_covariances=None if six is None else dropped(six),
            chi2=spread(estimator.chi2 / unit, np.nan),
            reasons=reasons,
            factors=(
                *_factors(data, fit),
                *factors,
                *((UNDECLARED_GAINS,) if self.undeclared_gains else ()),
                *parameters.describe_priors(),
                *(() if modulus_sigma is None else (RADIUS.format(RADIUS_TOLERANCE),)),
            ),
            modulus=modulus,
            modulus_sigma=modulus_sigma,
            unknowns=parameters.named(state.s, shared),
            undetermined=(
                *undetermined(parameters, information / unit, gains),
                *undetermined_motion(parameters, shared),
            ),
            taxel_unknowns=_taxel_unknowns(estimator, covariance),
            faults=estimator.faults,
            rivals=spread(rivals.points, np.nan),
            fit=fit,
            departures=self.departures,
            jump=found.jump.shown,
            iterates=np.stack([spread(points, np.nan) for points in estimator.iterates]),
            restarted=estimator.live[restarted],
            seconds=estimator.seconds,
        )


def _tangential(
    estimator: JointEstimator,
    own: Array,
    fit: GoodnessOfFit,
    found: ModelDepartures,
    rivals: RivalOptima,
) -> tuple[Array, list[str]]:
    """Tangential covariances (n, 2, 2), m^2, of single taxels, and what they rest on, in words;
    own (n, 2, 2): of independent errors."""
    parametrization = estimator.problem.parametrization
    apart = np.nan_to_num(rivals.points - parametrization.points())
    tangential = own + chart.tangential_square(parametrization.rotations()[:, :, :2], apart)
    if fit.good is False:
        return tangential + model_dependence(estimator, fit), [SURFACE]
    added, words = found.covariances()
    return tangential + added, [SURFACE, *words]


def _taxel_unknowns(estimator: JointEstimator, covariance: Array) -> dict[str, Array]:
    """Nuisance parameters of all taxels with their standard deviations (., 2), by name; covariance
    (G, D, D): of the groups."""
    data, problem, z = estimator.data, estimator.problem, estimator.state.z
    deviation, groups = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2)), np.arange(len(z))
    values, sigma = (problem.nuisance(part, groups) for part in (z, deviation))
    rows, count = estimator.live, len(data.ids)
    return data.parameters.of_taxels(values, sigma, data.sigma, rows, count)


def _modulus(estimator: JointEstimator, covariance: Array) -> tuple[float, float | None]:
    """E*, Pa, and its standard deviation, None where it is known; covariance (ks, ks): of the
    global parameters."""
    data, parameters = estimator.data, estimator.data.parameters
    modulus = data.modulus * float(np.exp(parameters.value("modulus", estimator.state.s)))
    if "modulus" not in parameters.names:
        return modulus, None
    own = np.sqrt(np.diag(covariance))[parameters.columns["modulus"]][0]
    by_radius = radius_deviation(data.belief, data.curvature)
    return modulus, modulus * float(np.hypot(own, by_radius))


def _factors(data: Measurements, fit: GoodnessOfFit) -> list[str]:
    """What the readings and the contacts that are used have in the estimate, in words."""
    factors = ["pressure of each reading"]
    if data.noise is not None:
        factors.append(CENSORING)
    if data.noise_pairs:
        factors.append(ESTIMATED_NOISE.format(data.noise, data.noise_pairs))
    if fit.good is False:
        factors.append(WIDENED.format(fit.reduced**0.5))
    return [*factors, *data.excluded]


def model_dependence(estimator: JointEstimator, fit: GoodnessOfFit, least: float = 0.0) -> Array:
    """What to add to the tangential covariances (n, 2, 2), m^2, where the model does not fit.

    The pressure-weighted mean of its contact points needs no model: its distance from the estimate
    counts as a standard deviation, by the part of the residuals' variance that is not noise. Below
    `least`, m, it does not.
    """
    parametrization = estimator.problem.parametrization
    means = trilaterate.centroids(estimator.data)[estimator.live]
    apart = np.nan_to_num(means - parametrization.points())
    apart[np.linalg.norm(apart, axis=1) < least] = 0.0
    square = chart.tangential_square(parametrization.rotations()[:, :, :2], apart)
    return np.asarray((1 - 1 / fit.reduced) * square)


def radius_deviation(belief: Belief, curvature: Array) -> float:
    """Standard deviation of ln E* by that of the indenter's radius R, at contacts with principal
    curvatures (m, 2), 1/m.

    The width of a Hertz patch depends on E* (1/R + k), k being the body's mean curvature, so that
    ln E* changes by ln R times 1 / (1 + R k).
    """
    bend = belief.indenter.radius * curvature.mean(axis=1)
    return RADIUS_TOLERANCE * float(np.median(1 / np.maximum(1 + bend, 0.1)))
