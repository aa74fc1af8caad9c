"""Joint maximum likelihood: all readings of all contacts, every unknown at once.

Unknown are two coordinates of every taxel in a chart of the surface, or the poses of rigid modules,
nuisance parameters of each taxel where declared, and the global parameters (E*, force, indenter,
body). The taxels are eliminated (variable_projection.py); IPOPT finds the global parameters
(reduced_nlp.py). Charts and contacts are linearized at the solution until nothing moves, so that
all are on the surface. The Hessian is Gauss-Newton's: the exact one leads to wrong optima from
starts as near as 0.7 mm. Convergence is judged by the Newton decrement and by every taxel's
chi-square, not by IPOPT's status; a taxel that misfits is started again from the centroid of its
contacts.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...core.arrays import Array, spread_rows
from ...core.blas import single_threaded
from ...core.errors import CalibrationError
from ...core.progress import Stage
from .. import chart
from ..data.global_parameters import RADIUS_TOLERANCE, radius_deviation
from ..data.measurements import Measurements
from ..result import (
    CENSORING,
    MOSTLY_OUTLIERS,
    SURFACE,
    EstimatorResult,
    join_words,
    name_rivals,
)  # fmt: skip
from ..trilateration import coactivation, trilaterate
from ..uncertainty.goodness_of_fit import GoodnessOfFit
from .fault_detection import stuck_taxels
from .joint_estimator import MAX_RELINEARIZATIONS, JointEstimator
from .likelihood_widths import widened
from .model_departures import ModelDepartures
from .module_parametrization import (
    MODULE_SURFACE,
    MODULES,
    ModuleParametrization,
    align_modules,
)
from .noise import scale_and_fit, with_estimated_noise
from .null_space import undetermined, undetermined_motion
from .outlier_rejection import reject_outliers, without_misfitting_contacts
from .parametrization import Parametrization, SurfaceParametrization
from .reduced_nlp import MAX_ITERATIONS, NEWTON_TOLERANCE
from .rival_optima import RivalOptima, resolve_rivals

UNCONVERGED = "its position does not converge"
"""Reason of a taxel that is not determined though its trilateration is."""
WIDENED = (
    "the model does not fit: standard deviations hold {:.3g} times the noise, by the misfit, and "
    "the distance from the pressure-weighted mean of the contact points, which needs no model"
)
"""Factor of an estimate whose test of fit fails."""
ESTIMATED_NOISE = "noise of {:.3g} Pa, estimated from {} pairs of neighbouring contacts"
USUAL_STEPS = 4
"""Usual steps of an estimate: the start, two linearizations, and a search for second optima."""
RADIUS = "indenter radius within {:.0%} (1 sigma), which widens the standard deviation of E*"
UNDECLARED_GAINS = "gain and offset of each taxel, undeclared: without them taxels misfit"


@single_threaded()
def estimate(
    data: Measurements,
    start: EstimatorResult | None = None,
    iterations: int = MAX_ITERATIONS,
    tolerance: float = NEWTON_TOLERANCE,
    trilaterated: EstimatorResult | None = None,
    stage: Stage | None = None,
) -> EstimatorResult:
    """The most likely unknowns, from trilateration as a start, or co-activation where it fails.

    An unknown noise is estimated first; the estimate is then made with it.

    iterations: limit of IPOPT's; tolerance: the Newton decrement at which taxels and global
    parameters are at the optimum, in units of the cost; trilaterated: the least-squares
    trilateration of `data`, if it is known; stage: whose steps are counted. Raises
    CalibrationError if no taxel is determined or the optimizer does not converge, ContactError
    where the estimate leaves the contact model.
    """
    stage = stage or Stage()
    estimator, reasons, restarted = _converged(
        data, start, iterations, tolerance, trilaterated, stage
    )
    if (noisy := with_estimated_noise(data, estimator)) is not data:
        stage.expect(USUAL_STEPS)
        return estimate(noisy, start, iterations, tolerance, trilaterated, stage)
    stuck, live, rivals = stuck_taxels(data), estimator.live, resolve_rivals(estimator)
    points = estimator.problem.points(estimator.state)
    name_rivals(estimator.faults, live, points, rivals.points)
    for row, count in zip(*np.unique(data.corrupt[:, 1], return_counts=True), strict=True):
        left_out = f"{count} corrupt, stuck or negative readings left out"
        estimator.faults[row] = join_words(estimator.faults[row], left_out)
    for row, level in zip(stuck.rows, stuck.level, strict=True):
        estimator.faults[row] = f"stuck at {level / 1e3:.3g} kPa"
    if estimator.unconverged.all():
        raise CalibrationError(
            "no taxel of the joint estimate converges",
            value=f"{len(live)} taxels still move after {MAX_RELINEARIZATIONS} linearizations",
            remedy="check the contact model and the units of force and pressure",
        )
    result = _result(estimator, data, reasons, restarted, rivals)
    return _without_misfitting_contacts(estimator, data, result, start, iterations, tolerance)


def _without_misfitting_contacts(
    estimator: JointEstimator,
    data: Measurements,
    result: EstimatorResult,
    start: EstimatorResult | None,
    iterations: int,
    tolerance: float,
) -> EstimatorResult:
    """The estimate without the few contacts whose readings misfit, where the others fit; `result`,
    that of all, where all fit or the others do not; arguments as `estimate`."""
    fit = result.fit
    if fit is None or fit.good is not False:
        return result
    fewer = without_misfitting_contacts(estimator, fit.noise / estimator.data.sigma)
    if fewer is estimator.data:
        return result
    fewer = replace(fewer, parameters=data.parameters)  # with gains only where they are needed
    try:
        estimator.stage.expect(USUAL_STEPS)
        again = estimate(fewer, start, iterations, tolerance, stage=estimator.stage)
    except CalibrationError:
        return result
    return again if again.fit is not None and again.fit.good else result


def _converged(
    data: Measurements,
    start: EstimatorResult | None,
    iterations: int,
    tolerance: float,
    trilaterated: EstimatorResult | None,
    stage: Stage,
) -> tuple[JointEstimator, np.ndarray, np.ndarray]:
    """The converged estimate without outlying readings, the reasons (n,) of the taxels that are not
    determined, and the rows of those that were started again; arguments as `estimate`.
    """
    near = coactivation.without_distant_readings(data)
    if start is None:
        fit = trilaterated if near is data else None
        start = coactivation.initial_estimate(near, fit or trilaterate.least_squares(near))
    stuck = stuck_taxels(data)
    live, reasons = coactivation.live_taxels(data, start, stuck.rows)
    step = float(np.median(data.radii)) / 2
    parametrization: Parametrization
    if data.belief.module_slots is None:
        charts = chart.charts_at(data.body, start.points[live], start.rotations[live])
        parametrization = SurfaceParametrization(charts, step)
    else:
        placed = np.isin(np.arange(len(data.ids)), live)
        parametrization, live = align_modules(data, start.points, placed, step)
    weight = np.where(np.isin(data.taxel, stuck.rows), 0.0, 1.0)
    stage.step()
    estimator = JointEstimator(
        data, live, parametrization, weight, iterations, tolerance, stage=stage
    )
    estimator.converge()
    restarted = estimator.restart(trilaterate.centroids(near)[live])
    return reject_outliers(estimator), reasons, restarted


def _result(
    estimator: JointEstimator,
    declared: Measurements,
    reasons: np.ndarray,
    restarted: np.ndarray,
    rivals: RivalOptima,
) -> EstimatorResult:
    """The result for all taxels; `declared`: the data with the belief's own parameters."""
    data, problem, state = estimator.data, estimator.problem, estimator.state
    problem.contacts.check(state.s)
    parameters, parametrization = data.parameters, problem.parametrization
    reduced = problem.reduce(state)
    scale, fit = scale_and_fit(estimator, reduced)
    found = ModelDepartures.of(estimator, fit)

    def spread(values: Array, missing: object) -> Array:
        return spread_rows(values, estimator.live, len(data.ids), missing)

    def dropped(covariance: Array) -> Array:
        infinite = np.diag([np.inf] * covariance.shape[1])
        return spread(np.where(lost[:, None, None], infinite, covariance), infinite)

    covariance, shared = (scale * part for part in problem.covariances(state, reduced))
    lost, reasons = estimator.unconverged | estimator.broken, reasons.copy()
    reasons[estimator.live] = ""
    reasons[estimator.live[estimator.broken]] = MOSTLY_OUTLIERS
    reasons[estimator.live[estimator.unconverged]] = UNCONVERGED
    unit = 1.0 if data.noise is not None and not data.noise_pairs else scale
    information, gains = problem.information(state)
    six: Array | None = None
    if isinstance(parametrization, ModuleParametrization):
        six = parametrization.covariances(covariance[:, :6, :6])
        tangential, factors = six[:, :2, :2], [MODULES, MODULE_SURFACE]
    else:
        own = widened(estimator, covariance[:, :2, :2], scale)
        tangential, factors = _tangential(estimator, own, fit, found, rivals)
        tangential = tangential + found.rejected(scale**0.5)
    undeclared = parameters.nuisance_names != declared.parameters.nuisance_names
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
            *((UNDECLARED_GAINS,) if undeclared else ()),
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
        departures=found.scores(estimator),
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
        return tangential + _model_dependence(estimator, fit), [SURFACE]
    added, words = found.covariances()
    return tangential + added, [SURFACE, *words]


def _taxel_unknowns(estimator: JointEstimator, covariance: Array) -> dict[str, Array]:
    """Nuisance parameters of all taxels with their standard deviations (., 2), by name; covariance
    (G, D, D): of the groups."""
    data, problem = estimator.data, estimator.problem
    sigma = np.sqrt(np.diagonal(covariance, axis1=1, axis2=2))
    groups, found = np.arange(problem.parametrization.count), {}
    each = zip((estimator.state.z, sigma), (np.nan, np.inf), strict=True)
    values = [
        spread_rows(problem.nuisance(part, groups), estimator.live, len(data.ids), missing)
        for part, missing in each
    ]
    for k, name in enumerate(data.parameters.nuisance_names):
        unit = 1.0 if name == "gain" else data.sigma
        found[name] = np.stack([part[:, k] * unit for part in values], axis=1)
    return found


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


def _model_dependence(estimator: JointEstimator, fit: GoodnessOfFit) -> Array:
    """What to add to the tangential covariances (n, 2, 2), m^2, where the model does not fit.

    The pressure-weighted mean of its contact points needs no model: its distance from the estimate
    counts as a standard deviation, by the part of the residuals' variance that is not noise.
    """
    parametrization = estimator.problem.parametrization
    means = trilaterate.centroids(estimator.data)[estimator.live]
    apart = np.nan_to_num(means - parametrization.points())
    square = chart.tangential_square(parametrization.rotations()[:, :, :2], apart)
    return np.asarray((1 - 1 / fit.reduced) * square)
