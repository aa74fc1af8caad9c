"""Whether the position of a taxel is the only one that its readings allow.

As joint/rival_optima.py, for few taxels at once: a taxel whose contacts leave a wide sector of
directions open is started again from the other side of its contacts and from a ring about them,
with the global parameters as they are. All starts are one problem, each with a copy of the taxel.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass

import numpy as np

from ...core.arrays import Array
from ..chart import Charts
from ..data.measurements import Measurements
from ..joint.joint_estimator import JointEstimator
from ..joint.likelihood_widths import WIDTHS
from ..joint.parametrization import SurfaceParametrization
from ..joint.reduced_nlp import MAX_ITERATIONS
from ..joint.rival_optima import (
    DIRECTIONS,
    ITERATIONS,
    MAX_LOG_ODDS,
    MIN_DISTANCE,
    MIN_ON_SHEET,
    RING,
    log_odds_between,
    part_on_sheet,
    problem_of,
    readings_of,
    starting_points,
)
from ..joint.variable_projection import MAX_STEPS

COPIES = DIRECTIONS + 1
"""Starts of a taxel: the mirror image and a ring; no fewer than the distances of `WIDTHS`."""


STEPS = 2
"""Gauss-Newton steps of one part of the work: 2 ms a taxel (studies/speed/online.py)."""


@dataclass(frozen=True)
class Basins:
    """What other positions the readings of t taxels allow."""

    better: Array
    """Positions (t, 3), m, that fit better than the estimate; NaN where there is none."""
    spread: Array
    """What the tangential covariance (t, 2, 2), m^2, lacks: the distance of a position that fits
    nearly as well, and the width of a likelihood that is wider than its curvature says."""
    unique: np.ndarray
    """Whether (t,) no other position fits nearly as well."""


def examine(
    data: Measurements,
    weight: Array,
    charts: Charts,
    nuisance: Array,
    s: Array,
    covariance: Array,
) -> Generator[None, None, Basins]:
    """Look for other positions of t taxels at converged estimates, the origins of `charts`.

    The work is done in parts, between which the generator yields; it returns what was found. data:
    of COPIES copies of each taxel, one after the other; weight (k,): of the readings; nuisance
    (t, q), s (ks,): the estimates; covariance (t, 2, 2), m^2: along the charts' tangents.
    """
    t = len(charts.points)
    rows = np.arange(t * COPIES)
    own = rows // COPIES
    step = float(np.median(data.radii)) / 2
    estimator = JointEstimator(
        data, rows, SurfaceParametrization(charts[own], step), weight,
        MAX_ITERATIONS, shared=s, nuisance=nuisance[own],
    )  # fmt: skip
    points, z = charts.points[own], estimator.state.z
    reach = float(np.median(data.reach()))
    start = np.stack(starting_points(estimator, rows, points, reach))[rows % COPIES, rows]
    yield
    found = yield from _optimum(estimator, rows, start)
    valid = np.linalg.norm(found[0] - points, axis=1) > MIN_DISTANCE * reach
    valid &= part_on_sheet(estimator, rows, found[0]) >= MIN_ON_SHEET
    odds = np.where(valid, log_odds_between(estimator, rows, (points, z), found), np.inf)
    odds, places = odds.reshape(t, COPIES), found[0].reshape(t, COPIES, 3)
    best = odds.argmin(axis=1)
    odds, places = odds[np.arange(t), best], places[np.arange(t), best]
    yield
    spread = _excess_width(estimator, charts, covariance, z)
    rival = odds < MAX_LOG_ODDS
    apart = np.where(rival[:, None], places - charts.points, 0.0)
    apart = np.einsum("tij,ti->tj", charts.tangents, apart)
    return Basins(
        better=np.where((odds < 0)[:, None], places, np.nan),
        spread=spread + apart[:, :, None] * apart[:, None, :],
        unique=~rival,
    )


def _optimum(
    estimator: JointEstimator, rows: np.ndarray, start: Array
) -> Generator[None, None, tuple[Array, Array]]:
    """Points and unknowns of the optima from `start` (r, 3), as `rival_optima.optimum_from`."""
    points, z = start, estimator.state.z[rows].copy()
    for _ in range(ITERATIONS):
        z[:, :2] = 0.0
        readings = readings_of(estimator, rows, points)
        problem = problem_of(estimator, rows, points, readings)
        state = problem.start(estimator.state.s, z)
        for _ in range(MAX_STEPS // STEPS):
            yield
            problem.solve_inner(state, most=STEPS)
            if (state.decrement <= problem.inner_tolerance).all():
                break
        z = state.z.copy()
        points = estimator.data.body.closest(problem.points(state)).point
    return points, z


def _excess_width(estimator: JointEstimator, charts: Charts, covariance: Array, z: Array) -> Array:
    """What `covariance` (t, 2, 2) lacks of the width of the likelihood along its weakest axis, as
    `likelihood_widths.widened`."""
    widths = np.array([sign * width for width in WIDTHS for sign in (-1.0, 1.0)])
    t, k = len(covariance), len(widths)
    rows = (np.arange(t)[:, None] * COPIES + np.arange(k)).ravel()
    value, vectors = np.linalg.eigh(covariance)
    sigma, axis = np.sqrt(value[:, 1]), vectors[:, :, 1]
    limit = RING * float(np.median(estimator.data.reach()))
    way = np.einsum("tij,tj->ti", charts.tangents, axis)
    step = np.clip(sigma[:, None] * widths, -limit, limit)
    points = np.repeat(charts.points, k, axis=0)
    there = points + (step[:, :, None] * way[:, None]).reshape(-1, 3)
    there = estimator.data.body.closest(there).point
    odds = log_odds_between(estimator, rows, (points, z[rows]), (there, z[rows])).reshape(t, k)
    wide = (np.abs(step) / np.sqrt(np.maximum(2 * odds, 1.0))).max(axis=1)
    excess = np.maximum(wide**2 - value[:, 1], 0.0)
    return np.asarray(excess[:, None, None] * axis[:, :, None] * axis[:, None, :])
