"""Readings of a few taxels under the joint estimator's model, with the global parameters as they
are: linearized at an estimate, estimated anew from all readings, or searched for other positions.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass, replace

import numpy as np

from ...core.arrays import Array
from .. import chart
from ..chart import Charts, tangential_square
from ..data.measurements import Measurements
from ..joint import fault_detection as faults
from ..joint.contacts import LinearizedContacts
from ..joint.joint_estimator import JointEstimator
from ..joint.likelihood import Likelihood
from ..joint.likelihood_widths import widened_along_axis
from ..joint.noise import clear_of_limits, predictions
from ..joint.outlier_rejection import irls
from ..joint.parametrization import SurfaceParametrization
from ..joint.pressure import OBSERVED, costs
from ..joint.readings import select
from ..joint.reduced_nlp import MAX_ITERATIONS
from ..joint.rival_optima import MAX_LOG_ODDS, likeliest_rivals
from ..joint.variable_projection import SchurComplement
from ..trilateration import trilaterate

STEPS = 3
"""Gauss-Newton steps of a bounded estimate, before its charts are linearized again: from where a
taxel was, two are usual; one that needs more goes on in the next frame."""
RIVAL_STEPS = 2
"""Those of one part of the search for other positions: 2 ms a taxel (studies/speed/online.py)."""
NEWTON_TOLERANCE = 1e-6
"""Newton decrement at which a taxel is at its optimum: within 1.4e-3 standard deviations."""
MAX_DECREMENT = 1e-3
"""Newton decrement from which a taxel waits for more steps: 0.045 standard deviations, a step that
the linearization bears."""
MAX_RESIDUAL = faults.CUTOFF
"""Residual, in standard deviations of noise and estimate, from which a new reading is left out."""
MIN_CONTRADICTIONS = 3
"""Outlying readings of a contact, and more than half of its readings, from which it is rejected."""
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
    linearized = LinearizedContacts(data, s)
    contacts, log_radius = linearized.at(s), linearized.log_growth(s)
    points, slopes = charts.at(step), charts.slope(step)
    found = select(
        data, np.arange(t), points, charts.normals, log_radius, np.ones(len(data.taxel)), np.ones(t)
    )
    own = found.taxel
    likelihood = Likelihood(data, found)
    mu, by = likelihood.predict(
        found.contact, points[own], nuisance[own], contacts, likelihood.groups(own)
    )
    by = by[: 3 + nuisance.shape[1] + likelihood.shared]
    along = np.einsum("kia,ik->ka", slopes[own], by[:3])
    jacobian = np.concatenate([along, by[3:].T], axis=1)
    level = found.level / data.sigma
    _, rate, curvature = costs(mu, level, found.kind)
    variance = 1 + found.precision * np.einsum("ki,kij,kj->k", jacobian, covariance[own], jacobian)
    residual = faults.residuals(found, mu, data.sigma) / np.sqrt(variance)
    clear = (
        (found.kind == OBSERVED) & faults.even(found) & clear_of_limits(mu, data, np.sqrt(variance))
    )
    rate, curvature = rate * found.precision, curvature * found.precision
    return NewReadings(own, found.contact, jacobian, rate, curvature, residual, clear)


def contradictions(
    new: NewReadings, sure: np.ndarray, m: int, scale: float
) -> tuple[np.ndarray, np.ndarray]:
    """Which readings (k,) are outlying, and which of the m contacts are rejected: most of their
    readings by taxels that are `sure` (k,) bool are. scale: as `advance`."""
    beyond = np.abs(new.residual) > MAX_RESIDUAL * scale
    count = np.bincount(new.contact, sure, m)
    contradicting = np.bincount(new.contact, beyond & sure, m)
    return beyond, (contradicting >= MIN_CONTRADICTIONS) & (2 * contradicting > count)


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
    converged: np.ndarray
    """Whether (t,) it converged."""


def local_estimator(
    data: Measurements,
    weight: Array,
    points: Array,
    rotations: Array,
    nuisance: Array,
    s: Array,
    live: np.ndarray | None = None,
) -> JointEstimator:
    """An estimate of the taxels of `data` from `points` (t, 3), m, with s (ks,) known.

    weight (k,): of the readings; rotations (t, 3, 3): frames nearby that the charts continue;
    nuisance (t, q): their start; live (t,): their rows, by default all.
    """
    live = np.arange(len(points)) if live is None else live
    charts = chart.charts_at(data.body, points, rotations)
    step = float(np.median(data.radii)) / 2
    return JointEstimator(
        data, live, SurfaceParametrization(charts, step), weight, MAX_ITERATIONS,
        NEWTON_TOLERANCE, shared=s, nuisance=nuisance,
    )  # fmt: skip


def advance(estimator: JointEstimator, scale: float) -> np.ndarray:
    """A bounded number of steps towards the optimum, and one towards the weights of the readings of
    misfitting taxels. Returns the taxels (t,) bool that misfit all the same.

    scale: standard deviation of most residuals, at least 1. Weights are the probabilities that a
    reading is sound, as the batch estimate has them in the end; where a taxel fits with all its
    readings, all count.
    """
    estimator.converge(1, STEPS)
    readings, r = estimator.likelihood.readings, estimator.residuals()
    unweighted = replace(readings, weight=np.ones_like(readings.weight))
    suspects = faults.misfitting_taxels(unweighted, r, scale)
    suspected = np.isin(readings.taxel, suspects)
    weight = np.ones_like(readings.weight)
    own = suspected & (readings.kind == OBSERVED)
    size = r / faults.spread(readings, scale)
    cutoff = faults.equal_odds_cutoff(size[own])
    weight[suspected] = faults.robust_weights(size[suspected], 0.0, cutoff)
    if np.abs(weight - readings.weight).max(initial=0.0) >= faults.WEIGHT_TOLERANCE:
        estimator.reweight(weight)
        unanswered = faults.unanswered_presses(estimator.likelihood.readings)
        if unanswered.any():
            estimator.silent_weight[np.unique(readings.taxel[unanswered])] = 0.0
            estimator.reweight(np.where(unanswered, 0.0, weight))
    return _misfits(estimator, scale)


def search(estimator: JointEstimator, scale: float) -> tuple[JointEstimator, np.ndarray]:
    """The converged estimate without outlying readings, as the batch estimate finds it; and the
    taxels (t,) bool that misfit all the same. scale: as `advance`."""
    estimator.converge()
    suspects = np.flatnonzero(_misfits(estimator, scale))
    if len(suspects):
        estimator.restart(trilaterate.centroids(estimator.data))
        suspects = np.flatnonzero(_misfits(estimator, scale))
    trial = estimator.trial()
    if len(suspects) and np.isfinite(irls(trial, suspects, scale, True)):
        estimator = trial
    return estimator, _misfits(estimator, scale)


def _misfits(estimator: JointEstimator, scale: float) -> np.ndarray:
    readings, out = estimator.likelihood.readings, np.zeros(len(estimator.live), dtype=bool)
    out[faults.misfitting_taxels(readings, estimator.residuals(), scale)] = True
    return out


def summary(estimator: JointEstimator, misfits: np.ndarray) -> LocalEstimate:
    """What the readings say at a converged estimate."""
    problem, state, n = estimator.problem, estimator.state, len(estimator.live)
    shared = estimator.likelihood.shared
    parametrization = problem.parametrization
    assert isinstance(parametrization, SurfaceParametrization)
    blocks, moments, local = problem.blocks(state), state.moments, 3 + problem.per_taxel
    size = parametrization.size + problem.per_taxel
    hessian = np.empty((n, size + shared, size + shared))
    hessian[:, :size, :size] = blocks.hessian
    hessian[:, :size, size:] = blocks.coupling
    hessian[:, size:, :size] = np.swapaxes(blocks.coupling, 1, 2)
    hessian[:, size:, size:] = moments.hessian[:, local:, local:]
    gradient = np.concatenate([blocks.gradient, moments.gradient[:, local:]], axis=1)
    readings, r = estimator.likelihood.readings, estimator.residuals()
    known = SchurComplement(0.0, np.zeros(shared), KNOWN * np.eye(shared))
    kept = readings.weight - problem.leverages(state, known)
    clear = clear_of_limits(predictions(readings, r, estimator.data), estimator.data)
    clear &= (readings.kind == OBSERVED) & faults.even(readings)
    weight, owner = readings.weight[clear], readings.taxel[clear]
    outlying = np.bincount(readings.taxel, faults.outliers(readings), n).astype(int)
    read = np.bincount(readings.taxel, readings.kind == OBSERVED, n)
    converged = blocks.decrement < MAX_DECREMENT
    fits = ~misfits & converged & (outlying <= faults.MAX_TAXEL_OUTLIERS * read)
    return LocalEstimate(
        charts=parametrization.charts,
        nuisance=state.z[:, parametrization.size :].copy(),
        gradient=gradient,
        hessian=hessian,
        square=np.bincount(owner, weight * r[clear] ** 2, n).astype(float),
        freedom=np.bincount(owner, kept[clear], n).astype(float),
        outlying=outlying,
        fits=fits,
        converged=converged,
    )


def examine(
    data: Measurements, weight: Array, charts: Charts, nuisance: Array, s: Array, covariance: Array
) -> Generator[None, None, tuple[Array, Array, np.ndarray]]:
    """Look for other positions of t taxels at converged estimates, the origins of `charts`, as the
    batch estimate does (joint/rival_optima.py, joint/likelihood_widths.py).

    The work is done in parts, between which the generator yields. It returns positions (t, 3), m,
    that fit better, NaN where there is none; what the tangential covariance (t, 2, 2), m^2, lacks:
    the distance of a position that fits nearly as well, and the width of a likelihood that is wider
    than its curvature says; and whether (t,) no other position fits nearly as well.
    data: of these taxels; weight (k,): of the readings; nuisance (t, q), s (ks,): the estimates;
    covariance (t, 2, 2), m^2: along the charts' tangents.
    """
    rows = np.arange(len(charts.points))
    step = float(np.median(data.radii)) / 2
    estimator = JointEstimator(
        data, rows, SurfaceParametrization(charts, step), weight,
        MAX_ITERATIONS, shared=s, nuisance=nuisance,
    )  # fmt: skip
    yield
    places, odds = yield from likeliest_rivals(estimator, rows, charts.points, RIVAL_STEPS)
    yield
    wide = yield from widened_along_axis(estimator, rows, covariance, 1.0)
    rival = odds < MAX_LOG_ODDS
    apart = np.where(rival[:, None], places - charts.points, 0.0)
    better = np.where((odds < 0)[:, None], places, np.nan)
    return better, wide - covariance + tangential_square(charts.tangents, apart), ~rival
