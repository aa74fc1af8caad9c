"""Readings of a few taxels under the joint estimator's model: linearized at an estimate, or
estimated anew from all their readings, with the global parameters as they are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.arrays import Array
from .. import chart
from ..chart import Charts
from ..data.measurements import Measurements
from ..joint import fault_detection as faults
from ..joint.contacts import LinearizedContacts
from ..joint.joint_estimator import JointEstimator
from ..joint.likelihood import Likelihood, select
from ..joint.noise import clear_of_limits
from ..joint.outlier_rejection import irls
from ..joint.parametrization import SurfaceParametrization
from ..joint.pressure import CENSORED, OBSERVED, costs
from ..joint.reduced_nlp import MAX_ITERATIONS
from ..joint.variable_projection import SchurComplement
from ..trilateration import trilaterate

KNOWN = 1e18
"""Information that stands for a known global parameter: 1e-9 of any unit."""


@dataclass(frozen=True)
class NewReadings:
    """k readings of t taxels in new contacts, linearized at the present estimates."""

    taxel: np.ndarray
    """Row (k,) of the taxel."""
    contact: np.ndarray
    """Row (k,) of the contact among the new ones."""
    jacobian: Array
    """Derivatives (k, D + ks) in the taxel's unknowns and the global parameters."""
    rate: Array
    curvature: Array
    """First and second derivatives (k,) of the costs."""
    residual: Array
    """Residuals (k,) in standard deviations of noise and estimate together."""
    clear: np.ndarray
    """Observed readings (k,) bool whose prediction is well inside the sensor's range."""


def new_readings(
    data: Measurements, charts: Charts, step: Array, nuisance: Array, s: Array, covariance: Array
) -> NewReadings:
    """The readings of t taxels in new contacts; `data` has these and no others.

    charts (t), step (t, 2), nuisance (t, q), s (ks,): the present estimates; covariance
    (t, D + ks, D + ks): of the taxels' own unknowns and s.
    """
    t = len(step)
    contacts = LinearizedContacts(data, s).at(s)
    log_radius = float(np.median(np.log(contacts.radii / data.radii)))
    points, slopes = charts.at(step), charts.slope(step)
    found = select(
        data, np.arange(t), points, charts.normals, log_radius, np.ones(len(data.taxel)), np.ones(t)
    )
    own = found.taxel
    mu, by = Likelihood(data, found).predict(found.contact, points[own], nuisance[own], contacts)
    along = np.einsum("kia,ik->ka", slopes[own], by[:3])
    jacobian = np.concatenate([along, by[3:].T], axis=1)
    level = found.level / data.sigma
    _, rate, curvature = costs(mu, level, found.kind)
    variance = 1 + np.einsum("ki,kij,kj->k", jacobian, covariance[own], jacobian)
    residual = faults.residuals(found, mu, data.sigma) / np.sqrt(variance)
    clear = (found.kind == OBSERVED) & clear_of_limits(mu, data, np.sqrt(variance))
    return NewReadings(own, found.contact, jacobian, rate, curvature, residual, clear)


@dataclass(frozen=True)
class LocalEstimate:
    """t taxels estimated from all their readings, and what these readings say."""

    charts: Charts
    nuisance: Array
    gradient: Array
    """(t, D + ks), with the priors of the taxel's own unknowns."""
    hessian: Array
    square: Array
    """Sum (t,) of the squared residuals of the clear readings, in units of the noise."""
    freedom: Array
    """Their number (t,) less their leverages."""
    outlying: np.ndarray
    """Outlying readings (t,)."""
    fits: np.ndarray
    """Whether (t,) the estimate converged and its readings, without outlying ones, fit."""


def local_estimator(
    data: Measurements, points: Array, rotations: Array | None, nuisance: Array, s: Array
) -> JointEstimator:
    """The converged estimate of the taxels of `data` from `points` (t, 3), m, with s (ks,) known.

    rotations (t, 3, 3): frames nearby that the charts continue; nuisance (t, q): their start.
    """
    charts = chart.charts_at(data.body, points, rotations)
    estimator = JointEstimator(
        data,
        np.arange(len(points)),
        SurfaceParametrization(charts, float(np.median(data.radii)) / 2),
        np.ones(len(data.taxel)),
        MAX_ITERATIONS,
        shared=s,
        nuisance=nuisance,
    )
    estimator.converge()
    return estimator


def without_outliers(estimator: JointEstimator, scale: float) -> tuple[JointEstimator, np.ndarray]:
    """The estimate with outlying readings of misfitting taxels weighted down, and the taxels (t,)
    bool that misfit all the same. scale: standard deviation of most residuals, at least 1."""
    misfits = np.zeros(len(estimator.live), dtype=bool)
    suspects = _suspects(estimator, scale)
    if len(suspects):
        estimator.restart(trilaterate.centroids(estimator.data))
        suspects = _suspects(estimator, scale)
    if not len(suspects):
        return estimator, misfits
    trial = estimator.trial()
    if np.isfinite(irls(trial, suspects, scale, True)):
        estimator = trial
    misfits[_suspects(estimator, scale)] = True
    return estimator, misfits


def _suspects(estimator: JointEstimator, scale: float) -> np.ndarray:
    return faults.misfitting_taxels(estimator.likelihood.readings, estimator.residuals(), scale)


def summary(estimator: JointEstimator, misfits: np.ndarray) -> LocalEstimate:
    """What the readings say at a converged estimate."""
    problem, state, n = estimator.problem, estimator.state, len(estimator.live)
    parametrization = problem.parametrization
    assert isinstance(parametrization, SurfaceParametrization)
    blocks, moments, local = problem.blocks(state), state.moments, 3 + problem.per_taxel
    size = parametrization.size + problem.per_taxel
    hessian = np.empty((n, size + len(state.s), size + len(state.s)))
    hessian[:, :size, :size] = blocks.hessian
    hessian[:, :size, size:] = blocks.coupling
    hessian[:, size:, :size] = np.swapaxes(blocks.coupling, 1, 2)
    hessian[:, size:, size:] = moments.hessian[:, local:, local:]
    gradient = np.concatenate([blocks.gradient, moments.gradient[:, local:]], axis=1)
    readings, r = estimator.likelihood.readings, estimator.residuals()
    known = SchurComplement(0.0, np.zeros(len(state.s)), KNOWN * np.eye(len(state.s)))
    kept = readings.weight - problem.leverages(state, known)
    level = np.where(readings.kind == CENSORED, estimator.data.threshold, readings.level)
    clear = clear_of_limits(r + level / estimator.data.sigma, estimator.data)
    clear &= readings.kind == OBSERVED
    weight, owner = readings.weight[clear], readings.taxel[clear]
    outlying = np.bincount(readings.taxel, faults.outliers(readings), n).astype(int)
    read = np.bincount(readings.taxel, readings.kind == OBSERVED, n)
    fits = ~(misfits | estimator.unconverged) & (outlying <= faults.MAX_TAXEL_OUTLIERS * read)
    return LocalEstimate(
        charts=parametrization.charts,
        nuisance=state.z[:, parametrization.size :].copy(),
        gradient=gradient,
        hessian=hessian,
        square=np.bincount(owner, weight * r[clear] ** 2, n).astype(float),
        freedom=np.bincount(owner, kept[clear], n).astype(float),
        outlying=outlying,
        fits=fits,
    )
