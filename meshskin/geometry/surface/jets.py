"""Vertex jets: polynomial height fields fitted to the vertices around each vertex.

At a fan (fans.py: a vertex, on one side of the creases that meet there), in a frame (t1, t2, n),
the surface is the height h(x, y), a polynomial fitted by least squares to the vertices within some
edges. The degree is the lowest whose residual is no larger than chance makes it; where the vertices
are so noisy that this is a quadric, wider rings are taken as long as the residual stays the same.
Source: Cazals and Pouget, "Estimating differential quantities using polynomial fitting of
osculating jets", Computer Aided Geometric Design 22 (2005): a degree-d jet gives normals to order
h^d and curvatures to order h^(d-1).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .fans import Fans
from .frames import fan_frames
from .heights import (
    DEGREE,
    MAX_RESIDUAL,
    POWERS,
    TERMS,
    decaying,
    least_squares,
    plausible,
    powers,
    rank_revealing_qr,
)

Array = NDArray[np.float64]
Index = NDArray[np.intp]

PLANE_TOLERANCE = 1e-5
"""bound of the residual of a ring that is taken as flat, relative to the ring's radius"""
MAX_UNEXPLAINED = 0.02
"""share of the heights' squares that a fit without spare points may leave"""
SPARE_POINTS = 2
"""points of a ring, beyond the terms of the fit and the fan itself, that a fit should have"""
TRUSTED_RESIDUAL = 0.01
"""miss of a jet that is trusted on a wider ring, and with a normal that leans from its faces'"""
VARIANCE_RATIO = 2.0
"""ratio of the variances of two fits' residuals that noise alone explains"""
ROUNDING = 1e-14
"""square of a residual over that of the heights from which rounding explains it"""
MAX_RINGS = 4
"""edges within which noisy vertices are averaged, at most"""
MAX_QUARTIC_FANS = 250_000
"""fans beyond which quadrics are fitted: exact enough on faces so small, and four times as fast"""
CHUNK = 2048
"""vertices fitted at once: bounds the memory"""


@dataclass(frozen=True)
class Jets:
    """Height fields at j fans."""

    origin: Array
    """(j, 3) where the height is zero, in m: the vertex, or its mean place among noisy ones"""
    frame: Array
    """(j, 3, 3) rows t1, t2, normal; t1 along the crease, beside one"""
    scale: Array
    """(j, 2) extents of the ring in m, which x and y are divided by"""
    coefficients: Array
    """(j, 14) of x^i y^j in the order of POWERS, in m"""
    degree: NDArray[np.int64]
    """(j,) degree of each fit; 0: the faces stay flat here"""
    residual: Array
    """(j,) residual of the fit over its heights, RMS; 1 where the ring had no points to spare"""

    @property
    def normals(self) -> Array:
        """(j, 3) unit normals of the height fields where x and y are zero."""
        slope = self.coefficients[:, :2] / self.scale
        normals = self.frame[:, 2] - np.einsum("jk,jkc->jc", slope, self.frame[:, :2])
        return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


@dataclass
class _Fit:
    """The fits in progress, and their residuals."""

    jets: Jets
    rss: Array  # (j, 5) sum of squares of the residual by degree; row's NaN: not fitted
    dof: Array  # (j, 5) its degrees of freedom
    floor: Array  # (j,) sum of squares that rounding explains


def adjacency(faces: Index, count: int) -> Any:
    """Which of `count` nodes share an edge, and each with itself: CSR (count, count) of ones."""
    from scipy.sparse import csr_array, eye_array

    i = faces[:, [0, 1, 2, 1, 2, 0]].ravel()
    j = faces[:, [1, 2, 0, 0, 1, 2]].ravel()
    ones = np.ones(len(i), dtype=np.float32)
    step = csr_array((ones, (i, j)), shape=(count, count))
    return csr_array(step + eye_array(count, dtype=np.float32))


def fit_jets(vertices: Array, fans: Fans, degree: int = DEGREE, order: int = 2) -> Jets:
    """Jets of at most the given degree (2 to 4) on the `order`-ring of every fan.

    Where a ring is too small or too regular for the degree, or the fit is not believable, the next
    lower one is fitted, on the 1-ring at last; a fan that nothing fits keeps its flat faces.
    """
    points, count = vertices[fans.vertex], len(fans.vertex)
    if count > MAX_QUARTIC_FANS:
        degree = 2
    step = adjacency(fans.corner, count)
    frame = fan_frames(points, fans)
    jets = Jets(
        points.copy(), frame, np.ones((count, 2)), np.zeros((count, len(POWERS))),
        np.zeros(count, dtype=np.int64), np.ones(count),
    )  # fmt: skip
    work = _Fit(jets, np.full((count, 5), np.nan), np.zeros((count, 5)), np.zeros(count))
    reach = step
    for _ in range(order - 1):
        reach = reach @ step
    _fit_rings(work, np.arange(count), reach, degree)
    if degree == DEGREE:
        _smooth_noise(work, step, reach, fans.on_crease)
    small = np.diff(reach.indptr) <= TERMS[degree] + SPARE_POINTS
    poor = np.flatnonzero((jets.degree == 0) & small)
    if len(poor):  # beside a crease rings are small: one more, if the surface is smooth that far
        _fit_rings(work, poor, reach[poor] @ step, degree)
        jets.degree[poor[jets.residual[poor] > 0.03 * TRUSTED_RESIDUAL]] = 0
    poor = np.flatnonzero(jets.degree == 0)
    if len(poor):
        for near in (reach, step):
            _fit_sparse(work, poor, near[poor], degree)
            poor = poor[jets.degree[poor] == 0]
    return jets


def _fit_rings(work: _Fit, rows: Index, reach: Any, degree: int) -> None:
    """Fit the fans `rows` (r,) to their rings, the rows of `reach` (r, n), in place."""
    jets = work.jets
    start, index = reach.indptr.astype(np.intp), reach.indices
    size = np.diff(start)
    for group in size_groups(size):
        members = rows[group]
        ring = index[start[group][:, None] + np.arange(size[group[0]])]
        local = _local(jets, members, ring)
        solved, values, rss = least_squares(local, jets.scale[members], degree)
        if len(ring[0]) <= TERMS[degree] + SPARE_POINTS:
            solved &= decaying(values)
        done = members[solved]
        work.rss[done, 2 : degree + 1] = rss[solved]
        work.dof[done, 2:] = [max(len(ring[0]) - 1 - TERMS[d], 0) for d in (2, 3, 4)]
        squares = np.sum(local[solved, 2] ** 2, axis=1)
        work.floor[done] = ROUNDING * squares
        jets.coefficients[done] = 0.0
        jets.coefficients[done, : values.shape[1]] = values[solved]
        jets.degree[done] = degree
        if len(ring[0]) - 1 > TERMS[degree]:
            jets.residual[done] = np.sqrt(rss[solved, -1] / np.maximum(squares, 1e-300))


def _local(jets: Jets, members: Index, ring: Index) -> Array:
    """Rings (g, k) in the fans' frames: x and y relative to the scales, the height in m (g, 3, k).

    Sets the scales.
    """
    frame = jets.frame[members]
    local = frame @ np.swapaxes(jets.origin[ring] - jets.origin[members][:, None], 1, 2)
    scale = np.max(np.abs(local[:, :2]), axis=2)
    longest = np.max(scale, axis=1, keepdims=True)
    scale = np.maximum(scale, np.where(longest > 0, 1e-6 * longest, 1.0))
    jets.scale[members] = scale
    local[:, :2] /= scale[:, :, None]
    return np.asarray(local)


def _smooth_noise(work: _Fit, step: Any, reach: Any, split: NDArray[np.bool_]) -> None:
    """Lower the degree, and then widen the rings, of fans whose residual is no more than noise.

    Only where most of the mesh is noisy: a scan, not a few bad vertices. Residuals are pooled over
    the fans next to each other. Fans inside the surface move to the fitted height.
    """
    full = ~np.isnan(work.rss[:, 4])
    if not full.any():
        return
    rss, dof = np.where(full[:, None], work.rss, 0.0), np.where(full[:, None], work.dof, 0.0)
    total, freedom = step @ rss[:, 2:], np.maximum(step @ dof[:, 2:], 1e-9)
    variance = total / freedom
    chance = VARIANCE_RATIO * variance[:, 2]
    noisy = full & (variance[:, 1] <= chance) & (freedom[:, 2] >= 6)
    noisy &= total[:, 2] > step @ np.where(full, work.floor, 0.0)
    if noisy.sum() <= 0.5 * len(full):
        return
    chance = np.maximum(chance, VARIANCE_RATIO * np.median(variance[noisy, 2]))
    known = freedom[:, 2] >= 6
    noisy, quadric = (known & (variance[:, k] <= chance) for k in (1, 0))
    cubic = np.flatnonzero(noisy & ~quadric)
    _fit_rings(work, cubic, reach[cubic], 3)
    rows = np.flatnonzero(quadric)
    limit = chance[rows]
    _fit_rings(work, rows, reach[rows], 2)
    ring = reach[rows]
    for _ in range(MAX_RINGS - 2):
        ring = ring @ step
        accepted = _average(work.jets, rows, ring, limit, ~split[rows])
        rows, limit, ring = rows[accepted], limit[accepted], ring[accepted]
    work.jets.residual[known & (work.jets.degree > 0)] = 0.0  # what they miss is noise


def _average(
    jets: Jets, rows: Index, reach: Any, limit: Array, moving: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Quadrics on wide rings where the residual's variance keeps to the limit (r,): which rows.

    A `moving` fan takes the fitted height as its origin.
    """
    start, index = reach.indptr.astype(np.intp), reach.indices
    size = np.diff(start)
    accepted = np.zeros(len(rows), dtype=bool)
    for group in size_groups(size):
        members = rows[group]
        keep = jets.frame[members], jets.scale[members]
        local = _local(jets, members, index[start[group][:, None] + np.arange(size[group[0]])])
        columns = powers(local[:, 0], local[:, 1], 2)
        constant = np.broadcast_to(moving[group][:, None, None], (*columns.shape[:1], 1, 1))
        columns = np.concatenate([columns, constant * np.ones((1, 1, columns.shape[2]))], axis=1)
        normal = columns @ np.swapaxes(columns, 1, 2)
        normal += 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(6)
        values = np.linalg.solve(normal, columns @ local[:, 2, :, None])[..., 0]
        miss = np.einsum("gck,gc->gk", columns, values) - local[:, 2]
        freedom = size[group[0]] - 6
        good = np.einsum("gk,gk->g", miss, miss) <= limit[group] * max(freedom, 0)
        good &= plausible(np.asarray(values[:, :5], dtype=float), jets.scale[members])
        accepted[group] = good
        jets.frame[members[~good]], jets.scale[members[~good]] = keep[0][~good], keep[1][~good]
        done = members[good]
        jets.coefficients[done, :5] = values[good, :5]
        jets.coefficients[done, 5:] = 0.0
        jets.degree[done] = 2
        shift = np.where(moving[group][good], values[good, 5], 0.0)
        jets.origin[done] += shift[:, None] * jets.frame[done, 2]
    return accepted


def _fit_sparse(work: _Fit, rows: Index, reach: Any, degree: int) -> None:
    """Fit fans whose rings do not determine a polynomial: of all that fit, the least one.

    A coarse cylinder's side is of this kind: its vertices lie on two circles.
    """
    jets = work.jets
    start, index = reach.indptr.astype(np.intp), reach.indices
    size = np.diff(start)
    for group in size_groups(size):
        members = rows[group]
        local = _local(jets, members, index[start[group][:, None] + np.arange(size[group[0]])])
        height, scale = local[:, 2], jets.scale[members]
        extent = scale.min(axis=1)
        best = np.full(len(members), np.inf)
        length, half, triangle, kept = rank_revealing_qr(
            powers(local[:, 0], local[:, 1], degree), height
        )
        for trial in range(degree, 0, -1):
            c = TERMS[trial]
            values = np.linalg.solve(triangle[:, :c, :c], half[:, :c, None])[..., 0] / length[:, :c]
            rss = np.sum(height**2, axis=1) - np.sum(half[:, :c] ** 2, axis=1)
            rss, rank = np.maximum(rss, 0.0), kept[:, :c].sum(axis=1)
            freedom = size[group[0]] - 1 - rank
            good = plausible(values, scale) & (rss < (MAX_RESIDUAL * extent) ** 2 * size[group[0]])
            good &= rss < MAX_UNEXPLAINED * np.sum(height**2, axis=1) + 1e-300
            if trial == 1:
                good &= rss < (PLANE_TOLERANCE * extent) ** 2 * size[group[0]]
            elif trial > 2:
                good &= (freedom > 0) | decaying(values)
            variance = rss / np.maximum(freedom, 1)
            best = np.minimum(best, np.where(good, variance, np.inf))
            chosen = good & ((jets.degree[members] == 0) | (variance <= VARIANCE_RATIO * best))
            done = members[chosen]
            jets.coefficients[done] = 0.0
            jets.coefficients[done, : values.shape[1]] = values[chosen]
            jets.degree[done] = trial
            squares = np.maximum(np.sum(height**2, axis=1), 1e-300)
            jets.residual[done] = np.where(freedom > SPARE_POINTS, np.sqrt(rss / squares), 1.0)[
                chosen
            ]


def size_groups(size: Index) -> list[Index]:
    """Indices grouped by equal `size` (n,), in groups of at most CHUNK."""
    if not len(size):
        return []
    by_size = np.argsort(size, kind="stable")
    cuts = np.flatnonzero(np.diff(size[by_size])) + 1
    groups = np.split(by_size, cuts)
    return [g[k : k + CHUNK] for g in groups for k in range(0, len(g), CHUNK)]
