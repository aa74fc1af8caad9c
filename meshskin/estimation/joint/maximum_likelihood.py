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

from ...core.blas import single_threaded
from ...core.errors import CalibrationError
from ...core.progress import Stage
from .. import chart
from ..data.measurements import Measurements
from ..result import EstimatorResult, name_rivals
from ..trilateration import coactivation, trilaterate
from .contacts import LinearizedContacts
from .fault_detection import misfitting_taxels, name_left_out, stuck_taxels
from .joint_estimator import MAX_RELINEARIZATIONS, JointEstimator
from .module_parametrization import align_modules
from .noise import with_estimated_edges, with_estimated_noise
from .optimum import Optimum
from .outlier_rejection import reject_outliers, without_misfitting_contacts
from .parametrization import Parametrization, SurfaceParametrization
from .reduced_nlp import MAX_ITERATIONS, NEWTON_TOLERANCE
from .rival_optima import resolve_rivals

USUAL_STEPS = 4
"""Usual steps of an estimate: the start, two linearizations, and a search for second optima."""


@single_threaded()
def optimum(
    data: Measurements,
    start: EstimatorResult | None = None,
    iterations: int = MAX_ITERATIONS,
    tolerance: float = NEWTON_TOLERANCE,
    trilaterated: EstimatorResult | None = None,
    stage: Stage | None = None,
) -> Optimum:
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
        return optimum(noisy, start, iterations, tolerance, trilaterated, stage)
    estimator = _with_edges(estimator)
    stuck, live, rivals = stuck_taxels(data), estimator.live, resolve_rivals(estimator)
    points = estimator.problem.points(estimator.state)
    name_rivals(estimator.faults, live, points, rivals.points)
    name_left_out(estimator.faults, data, stuck)
    if estimator.unconverged.all():
        raise CalibrationError(
            "no taxel of the joint estimate converges",
            value=f"{len(live)} taxels still move after {MAX_RELINEARIZATIONS} linearizations",
            remedy="check the contact model and the units of force and pressure",
        )
    estimator.problem.contacts.check(estimator.state.s)
    found = Optimum(estimator, data, reasons, restarted, rivals)
    return _without_misfitting_contacts(found, start, iterations, tolerance)


def _with_edges(estimator: JointEstimator) -> JointEstimator:
    """The estimate with the errors over edges that it shows, from where it is; contacts of taxels
    that then misfit keep those that the heights of the body let expect."""
    data = with_estimated_edges(estimator)
    if data is estimator.data:
        return estimator
    try:
        found = _converged_on(estimator, data)
        readings = found.likelihood.readings
        bad = misfitting_taxels(readings, found.residuals(), 1.0)
        if not len(bad):
            return found
        rows = readings.contact[np.isin(readings.taxel, bad)]
        unevenness = data.unevenness.copy()
        unevenness[rows] = estimator.data.unevenness[rows]
        return _converged_on(estimator, replace(data, unevenness=unevenness))
    except CalibrationError:
        return estimator


def _converged_on(estimator: JointEstimator, data: Measurements) -> JointEstimator:
    """The estimate converged on other data of the same readings and unknowns, from where it is."""
    found, state = estimator.trial(), estimator.state
    found.data, found.contacts = data, LinearizedContacts(data, state.s)
    found.relinearize(estimator.problem.parametrization, state.s, state.z, select_anew=True)
    found.converge()
    return found


def _without_misfitting_contacts(
    found: Optimum, start: EstimatorResult | None, iterations: int, tolerance: float
) -> Optimum:
    """The estimate without the few contacts whose readings misfit, where the others fit; `found`,
    that of all, where all fit or the others do not; arguments as `optimum`."""
    estimator, fit = found.estimator, found.fit
    if fit.good is not False:
        return found
    fewer = without_misfitting_contacts(estimator, fit.noise / estimator.data.sigma)
    if fewer is estimator.data:
        return found
    # with gains only where they are needed, and edges as at the start
    declared = found.declared
    fewer = replace(fewer, parameters=declared.parameters, unevenness=declared.unevenness)
    try:
        estimator.stage.expect(USUAL_STEPS)
        again = optimum(fewer, start, iterations, tolerance, stage=estimator.stage)
    except CalibrationError:
        return found
    return again if again.fit.good else found


def _converged(
    data: Measurements,
    start: EstimatorResult | None,
    iterations: int,
    tolerance: float,
    trilaterated: EstimatorResult | None,
    stage: Stage,
) -> tuple[JointEstimator, np.ndarray, np.ndarray]:
    """The converged estimate without outlying readings, the reasons (n,) of the taxels that are not
    determined, and the rows of those that were started again; arguments as `optimum`.
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
        parametrization = SurfaceParametrization.of(data, live, charts, step)
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
