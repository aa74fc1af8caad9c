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

import time
from dataclasses import replace

import numpy as np

from ...core.arrays import Array
from ...core.blas import single_threaded
from ...core.errors import CalibrationError
from .. import chart
from ..data.measurements import Measurements
from ..result import SURFACE, EstimatorResult
from ..trilateration import coactivation, trilaterate
from ..uncertainty.goodness_of_fit import GoodnessOfFit, goodness_of_fit
from . import fault_detection
from .joint_estimator import MAX_RELINEARIZATIONS, JointEstimator
from .module_parametrization import ModuleParametrization, align_modules
from .null_space import undetermined
from .outlier_rejection import reject_outliers
from .parametrization import Parametrization, SurfaceParametrization
from .pressure import CENSORED, OBSERVED
from .reduced_nlp import MAX_ITERATIONS, NEWTON_TOLERANCE
from .rival_optima import RivalOptima, resolve_rivals
from .variable_projection import SchurComplement

UNCONVERGED = "its position does not converge"
"""Reason of a taxel that is not determined though its trilateration is."""
MOSTLY_OUTLIERS = "most of its readings are outlying"
"""Reason of a taxel whose estimate is dropped; its fault says what was found."""
RIVAL = "a second position {:.2g} mm away fits nearly as well"
"""Fault of a taxel whose readings have two optima."""
MIN_CLEARANCE = 3.0
"""Distance of a predicted reading from threshold and saturation, in standard deviations, from which
its residual enters the test of fit: 1e-3 of such readings are censored."""
WIDENED = "the model does not fit: standard deviations hold {:.3g} times the noise, by the misfit"
"""Factor of an estimate whose test of fit fails."""
CENSORING = "silent readings, censored at the threshold"
MODULES = "rigid modules: the known places of their taxels"
MODULE_SURFACE = "body surface: modules lie on it to 0.1 mm a taxel"
UNDECLARED_GAINS = "gain and offset of each taxel, undeclared: without them taxels misfit"


@single_threaded()
def estimate(
    data: Measurements,
    start: EstimatorResult | None = None,
    iterations: int = MAX_ITERATIONS,
    tolerance: float = NEWTON_TOLERANCE,
    trilaterated: EstimatorResult | None = None,
) -> EstimatorResult:
    """The most likely unknowns, from trilateration as a start, or co-activation where it fails.

    iterations: limit of IPOPT's; tolerance: the Newton decrement at which taxels and global
    parameters are at the optimum, in units of the cost; trilaterated: the least-squares
    trilateration of `data`, if it is known. Raises CalibrationError if no taxel is determined or
    the optimizer does not converge, ContactError where the estimate leaves the contact model.
    """
    clock = time.perf_counter()
    near = coactivation.without_distant_readings(data)
    if start is None:
        fit = trilaterated if near is data else None
        start = coactivation.initial_estimate(near, fit or trilaterate.least_squares(near))
    responsive = coactivation.responsive(data, start.points)
    reasons = np.where(start.found & ~responsive, coactivation.NOISE, start.reasons)
    stuck = fault_detection.stuck_taxels(data)
    live = np.setdiff1d(np.flatnonzero(reasons == ""), stuck.rows)
    if not len(live):
        raise CalibrationError(
            "no taxel is determined by the recording",
            value=", ".join(sorted(set(map(str, reasons)))),
            remedy="touch every taxel from at least three contacts that are not on a line",
        )
    step = float(np.median(data.radii)) / 2
    parametrization: Parametrization
    if data.belief.module_slots is None:
        charts = chart.charts_at(data.body, start.points[live], start.rotations[live])
        parametrization = SurfaceParametrization(charts, step)
    else:
        placed = np.isin(np.arange(len(data.ids)), live)
        parametrization, live = align_modules(data, start.points, placed, step)
    weight = np.where(np.isin(data.taxel, stuck.rows), 0.0, 1.0)
    estimator = JointEstimator(data, live, parametrization, weight, iterations, tolerance)
    estimator.converge()
    restarted = estimator.restart(trilaterate.centroids(near)[live])
    estimator = reject_outliers(estimator)
    rivals = resolve_rivals(estimator)
    distances = np.linalg.norm(rivals.points - estimator.problem.points(estimator.state), axis=1)
    for k in np.flatnonzero(np.isfinite(distances)):
        words = (estimator.faults[live[k]], RIVAL.format(1e3 * distances[k]))
        estimator.faults[live[k]] = ", ".join(filter(None, words))
    for row, count in zip(*np.unique(data.corrupt[:, 1], return_counts=True), strict=True):
        left_out = f"{count} corrupt or negative readings left out"
        estimator.faults[row] = ", ".join(filter(None, (estimator.faults[row], left_out)))
    for row, level in zip(stuck.rows, stuck.level, strict=True):
        estimator.faults[row] = f"stuck at {level / 1e3:.3g} kPa"
    if estimator.unconverged.all():
        raise CalibrationError(
            "no taxel of the joint estimate converges",
            value=f"{len(live)} taxels still move after {MAX_RELINEARIZATIONS} linearizations",
            remedy="check the contact model and the units of force and pressure",
        )
    return _result(estimator, data, reasons, restarted, rivals, clock)


def _result(
    estimator: JointEstimator,
    declared: Measurements,
    reasons: np.ndarray,
    restarted: np.ndarray,
    rivals: RivalOptima,
    clock: float,
) -> EstimatorResult:
    """The result for all taxels; `declared`: the data with the belief's own parameters."""
    data, problem, state = estimator.data, estimator.problem, estimator.state
    problem.contacts.check(state.s)
    parameters, parametrization = data.parameters, problem.parametrization

    def spread(values: Array, missing: object) -> Array:
        out = np.empty((len(data.ids), *values.shape[1:]))
        out[:] = missing
        out[estimator.live] = values
        return out

    def dropped(covariance: Array) -> Array:
        infinite = np.diag([np.inf] * covariance.shape[1])
        return spread(np.where(lost[:, None, None], infinite, covariance), infinite)

    reduced = problem.reduce(state)
    covariance, global_covariance = problem.covariances(state, reduced)
    lost, reasons = estimator.unconverged | estimator.broken, reasons.copy()
    reasons[estimator.live] = ""
    reasons[estimator.live[estimator.broken]] = MOSTLY_OUTLIERS
    reasons[estimator.live[estimator.unconverged]] = UNCONVERGED
    scale, fit = _scale_and_fit(estimator, reduced)
    unit = scale if data.noise is None else 1.0
    information, gains = problem.information(state)
    if isinstance(parametrization, ModuleParametrization):
        six = scale * parametrization.covariances(covariance[:, :6, :6])
        tangential, pose_covariances = six[:, :2, :2], dropped(six)
        surface: tuple[str, ...] = (MODULES, MODULE_SURFACE)
    else:
        apart = np.nan_to_num(rivals.points - parametrization.points())
        apart = np.einsum("kij,ki->kj", parametrization.rotations()[:, :, :2], apart)
        tangential = scale * covariance[:, :2, :2] + apart[:, :, None] * apart[:, None, :]
        pose_covariances = None
        surface = (SURFACE,)
    if parameters.nuisance_names != declared.parameters.nuisance_names:
        surface += (UNDECLARED_GAINS,)
    silent: tuple[str, ...] = (CENSORING,) if data.noise is not None else ()
    if fit.good is False:
        silent += (WIDENED.format(fit.reduced**0.5),)
    if data.left_out:
        silent += (f"without {data.left_out} contacts in which the contact model does not hold",)
    sigma = np.sqrt(scale * np.diagonal(covariance, axis1=1, axis2=2))
    groups = np.arange(parametrization.count)
    units = [data.sigma if name == "offset" else 1.0 for name in parameters.nuisance_names]
    nuisance = spread(problem.nuisance(state.z, groups) * units, np.nan)
    nuisance_sigma = spread(problem.nuisance(sigma, groups) * units, np.inf)
    global_sigma = np.sqrt(np.diag(scale * global_covariance))
    modulus, modulus_sigma = (
        data.modulus * float(np.exp(parameters.value("modulus", state.s))),
        None,
    )
    if "modulus" in parameters.names:
        modulus_sigma = modulus * float(global_sigma[parameters.columns["modulus"]][0])
    return EstimatorResult(
        points=spread(np.where(lost[:, None], np.nan, parametrization.points()), np.nan),
        rotations=spread(parametrization.rotations(), np.nan),
        covariance=dropped(tangential),
        pose_covariances=pose_covariances,
        chi2=spread(estimator.chi2 / unit, np.nan),
        reasons=reasons,
        factors=("pressure of each reading", *silent, *surface, *parameters.describe_priors()),
        modulus=modulus,
        modulus_sigma=modulus_sigma,
        unknowns={
            label: (float(value), float(deviation))
            for label, value, deviation in zip(
                parameters.labels, state.s, global_sigma, strict=True
            )
        },
        undetermined=undetermined(parameters, information / unit, gains),
        taxel_unknowns={
            name: np.stack([nuisance[:, k], nuisance_sigma[:, k]], axis=1)
            for k, name in enumerate(parameters.nuisance_names)
        },
        faults=estimator.faults,
        rivals=spread(rivals.points, np.nan),
        fit=fit,
        iterates=np.stack([spread(points, np.nan) for points in estimator.iterates]),
        restarted=estimator.live[restarted],
        seconds=estimator.seconds | {"joint": time.perf_counter() - clock},
    )


def _scale_and_fit(
    estimator: JointEstimator, reduced: SchurComplement
) -> tuple[float, GoodnessOfFit]:
    """The factor of the covariances, and the test of fit.

    The factor is the variance of the residuals where the noise is not known, else 1, or what the
    test shows where it fails. An unknown noise is estimated from neighbouring contacts. Each
    residual has the variance 1 less the leverage of its reading. The test uses readings that
    the model predicts well inside the sensor's range; that choice does not depend on the reading,
    so that the residuals are not censored.
    """
    data, problem, state = estimator.data, estimator.problem, estimator.state
    readings, r = estimator.likelihood.readings, estimator.residuals()
    kept = readings.weight - problem.leverages(state, reduced)
    known = data.noise is not None
    freedom = float(kept[readings.kind == OBSERVED].sum())
    scale = 1.0 if known else float(state.moments.square.sum()) / max(freedom, 1.0)
    level = np.where(readings.kind == CENSORED, data.threshold, readings.level)
    mu = r + level / data.sigma
    clear = mu > data.threshold / data.sigma + MIN_CLEARANCE
    clear &= mu < data.saturation / data.sigma - MIN_CLEARANCE
    clear &= ~estimator.broken[readings.taxel]
    noise, pairs = 1.0, 0
    if not known:
        noise, pairs = fault_detection.neighbour_scatter(readings, r, data.points)
        noise = max(noise, fault_detection.MIN_SCALE)
    fit = goodness_of_fit(
        chi2=float(readings.weight[clear] @ r[clear] ** 2) / noise**2,
        freedom=float(np.sum(kept[clear])),
        noise_known=known,
        outlying=int(np.sum(fault_detection.outliers(readings))),
        pairs=pairs,
    )
    fit = replace(fit, noise=noise * data.sigma)
    if fit.good is False:
        scale = max(scale, fit.reduced * noise**2)
    return scale, fit
