"""Optima that are flatter than their curvature says: the covariance is widened to the likelihood.

Where the contacts lie on a line through a taxel, its position across the line enters the readings
by its square only: two optima merge into a flat one. Where they lie at nearly one place, the
readings tell the distance from it and little else: the likelihood is an arc. A flat optimum bends,
too, by more than its breadth: the likelihood is followed along its ridge.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace

import numpy as np

from ...core.arrays import Array
from .joint_estimator import JointEstimator
from .rival_optima import (
    OPEN_SECTOR,
    RING,
    Placed,
    batches,
    finish,
    log_odds_between,
    open_sectors,
    responses,
)

WIDTHS = (3.0, 6.0, 12.0)
"""Distances from the estimate, in its standard deviations, at which the likelihood is compared with
what the covariance says: at the second and third no taxel should be confidently wrong."""
STEPS = np.array([sign * width for width in WIDTHS for sign in (-1.0, 1.0)])
"""These to both sides."""
SAME_PLACE = 0.5
"""Rms distance of a taxel's contacts from their middle, relative to its own, below which its
likelihood is followed along an arc, too."""
PROBE = 2.0
"""Distance across the axis or arc, in standard deviations, at which the likelihood is compared with
that on it: the ridge is near the vertex of the parabola through the three."""
PROBES = (-PROBE, 0.0, PROBE)
"""PROBE to both sides."""
MAX_ACROSS = 8.0
"""Largest move by one parabola, in standard deviations across: where the readings are out of reach
the likelihood is level, and parabolas have no vertex."""
PARABOLAS = 2
"""Parabolas to the ridge. A flat optimum beside a strip of contacts on a finger's link bends by 4
standard deviations, and one parabola leaves 0.2; arcs about the contacts' middle are off by more.
"""


def widened(estimator: JointEstimator, covariance: Array, scale: float) -> Array:
    """Covariances (n, 2, 2), m^2, of the live taxels along the surface, no narrower than the
    likelihood.

    The likelihood of a taxel in an open sector is evaluated WIDTHS standard deviations to both
    sides along the weakest axis of `covariance` (n, 2, 2), and along an arc about its contacts,
    and on the ridge near these places. Where it falls at x by a factor exp(-u^2 / 2), the standard
    deviation along each axis is at least |x| / max(u, 1). scale: variance of the residuals by which
    the covariance was multiplied.
    """
    points, out = estimator.problem.points(estimator.state), covariance.copy()
    rows = np.flatnonzero(open_sectors(estimator, points) > OPEN_SECTOR)
    if not len(rows):
        return out
    copies = len(STEPS) * len(PROBES)
    for part in batches(rows, copies):
        out[part] = finish(widened_along_axis(estimator, part, covariance[part], scale))
    arcs = rows_seen_from_one_place(estimator, rows, points[rows])
    for part in batches(arcs, copies) if len(arcs) else []:
        step, _, axes = _steps(estimator, covariance[part])
        arc = _along_arcs(estimator, part, points[part], step, axes)
        wide = _to_width(estimator, part, *arc, covariance[part], out[part], scale)
        out[part] = finish(wide)
    return out


def widened_along_axis(
    estimator: JointEstimator, rows: np.ndarray, covariance: Array, scale: float
) -> Generator[None, None, Array]:
    """Covariances (r, 2, 2), m^2, of the taxels `rows`, no narrower than the likelihood along their
    weakest axis. The generator yields before every evaluation of len(STEPS) places a taxel."""
    points = estimator.problem.points(estimator.state)[rows]
    frames = estimator.problem.parametrization.rotations()[rows]
    step, _, axes = _steps(estimator, covariance)
    across, way = np.einsum("kij,kjl->lki", frames[:, :, :2], axes)
    there = points + step[:, :, None] * way
    return (yield from _to_width(estimator, rows, there, across, covariance, covariance, scale))


def _steps(estimator: JointEstimator, covariance: Array) -> tuple[Array, Array, Array]:
    """Lengths (steps, r), m, of the steps along the weakest axes of covariances (r, 2, 2), which
    are the last of their axes (r, 2, 2), and the variances (r, 2) along all."""
    value, vectors = np.linalg.eigh(covariance)
    limit = RING * float(np.median(estimator.data.reach()))
    return np.clip(STEPS[:, None] * np.sqrt(value[:, 1]), -limit, limit), value, vectors


def _to_width(
    estimator: JointEstimator, rows: np.ndarray, there: Array, across: Array, covariance: Array,
    given: Array, scale: float,
) -> Generator[None, None, Array]:  # fmt: skip
    """The covariances `given` (r, 2, 2) widened along both axes of `covariance` (r, 2, 2) to the
    likelihood on the ridge near places `there` (steps, r, 3). across: unit vectors across the
    ridge, as wide as `there` or (r, 3)."""
    value, axes = np.linalg.eigh(covariance)
    points = estimator.problem.points(estimator.state)[rows]
    frames = estimator.problem.parametrization.rotations()[rows][:, :, :2]
    breadth = np.sqrt(np.maximum(value[:, 0], 0.0))
    moves = yield from _moves(estimator, rows, points, there, across * breadth[:, None], scale)
    wide = np.abs(np.einsum("kij,kjl,ski->skl", frames, axes, moves)).max(axis=0)
    square = np.maximum(wide**2, value) - np.einsum("kil,kij,kjl->kl", axes, given, axes)
    return given + np.einsum("kil,kl,kjl->kij", axes, np.maximum(square, 0.0), axes)


def _moves(
    estimator: JointEstimator, rows: np.ndarray, points: Array, there: Array, across: Array,
    scale: float,
) -> Generator[None, None, Array]:  # fmt: skip
    """Moves (2 steps, r, 3), m, of the taxels at `points` (r, 3) by one standard deviation of the
    likelihood at places `there` (steps, r, 3), and at those of the ridge near them.

    across: a standard deviation across the ridge, as wide as `there` or (r, 3), m.
    """
    move, moves = np.zeros(there.shape[:2]), []
    copies, at = np.tile(rows, len(there)), np.broadcast_to(points, there.shape).reshape(-1, 3)
    here = Placed(estimator, copies, at, estimator.state.z[copies])
    for _ in range(PARABOLAS):
        cost = []
        for probe in PROBES:
            yield
            place = there + (move + probe)[..., None] * across
            cost.append(_log_odds(here, place)[1])
        move = move + _vertex(*cost)
    for place in (there, there + move[..., None] * across):
        yield
        place, odds = _log_odds(here, place)
        sigmas = np.sqrt(np.maximum(2 * odds / scale, 1.0))
        moves.append((place - points) / sigmas[..., None])
    return np.concatenate(moves)


def _vertex(before: Array, at: Array, after: Array) -> Array:
    """Moves, in standard deviations, to the vertices of parabolas through costs PROBE apart, as far
    as MAX_ACROSS; that far to the lower side where there is none."""
    slope, curvature = (after - before) / 2, before - 2 * at + after
    return np.clip(-PROBE * slope / np.maximum(curvature, 1e-9), -MAX_ACROSS, MAX_ACROSS)


def _log_odds(here: Placed, there: Array) -> tuple[Array, Array]:
    """The points (..., r, 3) of the body closest to `there`, and the log-likelihood (..., r) of the
    taxels `here` minus that there."""
    points = here.estimator.data.body.closest(there.reshape(-1, 3)).point
    odds = log_odds_between(here, replace(here, points=points))
    return points.reshape(there.shape), odds.reshape(there.shape[:-1])


def rows_seen_from_one_place(
    estimator: JointEstimator, rows: np.ndarray, points: Array
) -> np.ndarray:
    """Taxels, of the `rows` at `points` (r, 3), whose contacts lie closer together than a part
    SAME_PLACE of their distance: these tell little but the distance, and the likelihood is an arc.
    """
    centre, spread = _contact_centres(estimator, rows, points)
    return rows[spread < SAME_PLACE * np.linalg.norm(points - centre, axis=1)]


def _along_arcs(
    estimator: JointEstimator, rows: np.ndarray, points: Array, step: Array, axes: Array
) -> tuple[Array, Array]:
    """Places (steps, r, 3) at arc lengths `step` (steps, r), m, about the centres of the contacts
    of taxels at `points` (r, 3), and the unit vectors from the centres there; axes (r, 2, 2): of
    the covariances in the tangent planes, the weakest one last."""
    centre, _ = _contact_centres(estimator, rows, points)
    frames = estimator.problem.parametrization.rotations()[rows][:, :, :2]
    flat = np.einsum("kij,ki->kj", frames, points - centre)
    radius = np.linalg.norm(flat, axis=1)
    x = flat / radius[:, None]
    y = np.stack([-x[:, 1], x[:, 0]], axis=1)
    y *= np.where(np.einsum("ki,ki->k", y, axes[:, :, 1]) < 0, -1.0, 1.0)[:, None]
    angle = np.clip(step / radius, -np.pi, np.pi)[:, :, None]
    outward = np.cos(angle) * x + np.sin(angle) * y
    moved = radius[:, None] * outward - flat
    outward = np.einsum("kij,skj->ski", frames, outward)
    return points + np.einsum("kij,skj->ski", frames, moved), outward


def _contact_centres(
    estimator: JointEstimator, rows: np.ndarray, points: Array
) -> tuple[Array, Array]:
    """Means (r, 3), m, of the contacts that the taxels `rows` respond to, weighted by the readings,
    `points` (r, 3) where there are none; and the rms distance (r,), m, from these."""
    contacts = estimator.problem.contacts.data.points
    taxel, contact, level = responses(estimator)
    centre, spread = points.copy(), np.full(len(rows), np.inf)
    for k, row in enumerate(rows):
        mine = slice(*np.searchsorted(taxel, [row, row + 1]))
        if mine.start < mine.stop:
            weight, at = level[mine] / level[mine].sum(), contacts[contact[mine]]
            centre[k] = weight @ at
            spread[k] = np.sqrt(weight @ np.sum((at - centre[k]) ** 2, axis=1))
    return centre, spread
