"""Osculating jets: polynomial height fields fitted to the vertices around each vertex.

In a frame (t1, t2, n) at a fan (fans.py) the surface is a height h(x, y), a polynomial fitted by
least squares to the vertices within a number of edges, the ring. The degree is the lowest whose
residual is explained by noise; where that is 2, rings are widened while the residual stays equal.
Source: Cazals and Pouget, "Estimating differential quantities using polynomial fitting of
osculating jets", Computer Aided Geometric Design 22 (2005): a jet of degree d gives normals to
order h^d and curvatures to order h^(d-1). CGAL has it, in C++; libigl fits quadrics alone.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import Array, Index, rows_by_key
from . import heights
from .fans import Fans, fan_frames

PLANE_TOLERANCE = 1e-5
"""largest residual of a ring that is taken as plane, relative to the radius of the ring"""
MAX_UNEXPLAINED = 0.02
"""largest sum of squared residuals of a fit to a sparse ring, over that of the heights"""
SPARE_POINTS = 2
"""points beyond the number of terms from which the residual of a fit says how good it is"""
TRUSTED_RESIDUAL = 0.01
"""relative residual of a jet that is accepted on a wider ring, and whose normal may be inclined to
its faces'"""
VARIANCE_RATIO = 2.0
"""ratio of the residual variances of two fits up to which noise explains the difference: that of an
F test at 6 and 20 degrees of freedom is exceeded by explained in 11 % of cases"""
ROUNDING = 1e-14
"""squared residual over squared heights up to which it is rounding: 1e-7 is single precision"""
MAX_RINGS = 4
"""largest ring, in edges, for noisy vertices"""
MAX_QUARTIC_FANS = 250_000
"""number of fans above which quadrics are fitted: accurate enough on faces so small, and four times
as fast (studies/speed/surface.py)"""
CHUNK = 2048
"""fans fitted at once: bounds the memory"""


@dataclass(frozen=True)
class Jets:
    """Height fields at j fans."""

    origin: Array
    """(j, 3) points of height zero, in m: the vertex, or its fitted position on noisy meshes"""
    frame: Array
    """(j, 3, 3) rows t1, t2, normal; t1 along the crease, beside one"""
    scale: Array
    """(j, 2) extents of the ring in m, by which x and y are divided"""
    coefficients: Array
    """(j, 14) of x^i y^j in the order of heights.POWERS, in m"""
    degree: NDArray[np.int64]
    """(j,) degree of each fit; 0: the faces stay flat"""
    residual: Array
    """(j,) RMS residual of the fit over the RMS height; 1 where the ring had no points to spare"""

    @property
    def normals(self) -> Array:
        """(j, 3) unit normals of the height fields where x and y are zero."""
        slope = self.coefficients[:, :2] / self.scale
        normals = self.frame[:, 2] - np.einsum("jk,jkc->jc", slope, self.frame[:, :2])
        return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


@dataclass
class _Fit:
    """Fits in progress, and their residuals."""

    jets: Jets
    rss: Array  # (j, 5) sums of squared residuals by degree; NaN: not fitted
    dof: Array  # (j, 5) their degrees of freedom
    floor: Array  # (j,) sums of squares that rounding explains


def adjacency(faces: Index, count: int) -> Any:
    """Adjacency matrix of `count` nodes, with ones on the diagonal: CSR (count, count)."""
    from scipy.sparse import csr_array, eye_array

    i = faces[:, [0, 1, 2, 1, 2, 0]].ravel()
    j = faces[:, [1, 2, 0, 0, 1, 2]].ravel()
    ones = np.ones(len(i), dtype=np.float32)
    adjacent = csr_array((ones, (i, j)), shape=(count, count))
    return csr_array(adjacent + eye_array(count, dtype=np.float32))


def fit_jets(vertices: Array, fans: Fans, degree: int = heights.DEGREE) -> Jets:
    """Jets of at most the given degree (2 to 4) on the 2-ring of every fan.

    Where a ring is too small or too regular for the degree, or the fit is implausible, the next
    lower degree is fitted, finally on the 1-ring; a fan without a plausible fit keeps flat faces.
    """
    points, count = vertices[fans.vertex], len(fans.vertex)
    if count > MAX_QUARTIC_FANS:
        degree = 2
    adjacent = adjacency(fans.corner, count)
    frame = fan_frames(points, fans)
    jets = Jets(
        points.copy(), frame, np.ones((count, 2)), np.zeros((count, len(heights.POWERS))),
        np.zeros(count, dtype=np.int64), np.ones(count),
    )  # fmt: skip
    fits = _Fit(jets, np.full((count, 5), np.nan), np.zeros((count, 5)), np.zeros(count))
    rings = adjacent @ adjacent
    _fit_rings(fits, np.arange(count), rings, degree)
    if degree == heights.DEGREE:
        _smooth_noise(fits, adjacent, rings, fans.on_crease)
    small = np.diff(rings.indptr) <= heights.TERMS[degree] + SPARE_POINTS
    poor = np.flatnonzero((jets.degree == 0) & small)
    if len(poor):  # beside a crease: a wider ring, if the surface is smooth that far
        _fit_rings(fits, poor, rings[poor] @ adjacent, degree)
        jets.degree[poor[jets.residual[poor] > 0.03 * TRUSTED_RESIDUAL]] = 0
    poor = np.flatnonzero(jets.degree == 0)
    if len(poor):
        for near in (rings, adjacent):
            _fit_sparse(fits, poor, near[poor], degree)
            poor = poor[jets.degree[poor] == 0]
    return jets


def _fit_rings(fits: _Fit, rows: Index, rings: Any, degree: int) -> None:
    """Fit the fans `rows` (r,) to their rings, the rows of `rings` (r, n), in place."""
    jets = fits.jets
    for _, members, ring in _groups(rows, rings):
        local = _local(jets, members, ring)
        solved, values, rss = heights.least_squares(local, jets.scale[members], degree)
        if len(ring[0]) <= heights.TERMS[degree] + SPARE_POINTS:
            solved &= heights.decaying(values)
        done = members[solved]
        fits.rss[done, 2 : degree + 1] = rss[solved]
        fits.dof[done, 2:] = [max(len(ring[0]) - 1 - heights.TERMS[d], 0) for d in (2, 3, 4)]
        squares = np.sum(local[solved, 2] ** 2, axis=1)
        fits.floor[done] = ROUNDING * squares
        jets.coefficients[done] = 0.0
        jets.coefficients[done, : values.shape[1]] = values[solved]
        jets.degree[done] = degree
        if len(ring[0]) - 1 > heights.TERMS[degree]:
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


def _smooth_noise(fits: _Fit, adjacent: Any, rings: Any, fixed: NDArray[np.bool_]) -> None:
    """Lower the degree, then widen the rings, of fans whose residual is explained by noise.

    Only where most of the mesh is noisy: a scan, not a few bad vertices. Residuals are pooled over
    adjacent fans. Fans off the creases and borders move to the fitted height.
    """
    full = ~np.isnan(fits.rss[:, 4])
    if not full.any():
        return
    rss, dof = np.where(full[:, None], fits.rss, 0.0), np.where(full[:, None], fits.dof, 0.0)
    total, freedom = adjacent @ rss[:, 2:], np.maximum(adjacent @ dof[:, 2:], 1e-9)
    variance = total / freedom
    explained = VARIANCE_RATIO * variance[:, 2]
    noisy = full & (variance[:, 1] <= explained) & (freedom[:, 2] >= 6)
    noisy &= total[:, 2] > adjacent @ np.where(full, fits.floor, 0.0)
    if noisy.sum() <= 0.5 * len(full):
        return
    explained = np.maximum(explained, VARIANCE_RATIO * np.median(variance[noisy, 2]))
    known = freedom[:, 2] >= 6
    noisy, quadric = (known & (variance[:, k] <= explained) for k in (1, 0))
    cubic = np.flatnonzero(noisy & ~quadric)
    _fit_rings(fits, cubic, rings[cubic], 3)
    rows = np.flatnonzero(quadric)
    limit = explained[rows]
    _fit_rings(fits, rows, rings[rows], 2)
    ring = rings[rows]
    for _ in range(MAX_RINGS - 2):
        ring = ring @ adjacent
        accepted = _average(fits.jets, rows, ring, limit, ~fixed[rows])
        rows, limit, ring = rows[accepted], limit[accepted], ring[accepted]
    fits.jets.residual[known & (fits.jets.degree > 0)] = 0.0  # their residual is noise


def _average(
    jets: Jets, rows: Index, rings: Any, limit: Array, moving: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Quadrics on wide rings where the residual variance is within `limit` (r,): which rows.

    The origin of a `moving` fan moves to the fitted height.
    """
    accepted = np.zeros(len(rows), dtype=bool)
    for group, members, ring in _groups(rows, rings):
        keep = jets.frame[members], jets.scale[members]
        local = _local(jets, members, ring)
        columns = heights.powers(local[:, 0], local[:, 1], 2)
        constant = np.broadcast_to(moving[group][:, None, None], (*columns.shape[:1], 1, 1))
        columns = np.concatenate([columns, constant * np.ones((1, 1, columns.shape[2]))], axis=1)
        normal = columns @ np.swapaxes(columns, 1, 2)
        normal += 1e-9 * np.trace(normal, axis1=1, axis2=2)[:, None, None] * np.eye(6)
        values = np.linalg.solve(normal, columns @ local[:, 2, :, None])[..., 0]
        miss = np.einsum("gck,gc->gk", columns, values) - local[:, 2]
        freedom = ring.shape[1] - 6
        good = np.einsum("gk,gk->g", miss, miss) <= limit[group] * max(freedom, 0)
        good &= heights.plausible(np.asarray(values[:, :5], dtype=float), jets.scale[members])
        accepted[group] = good
        jets.frame[members[~good]], jets.scale[members[~good]] = keep[0][~good], keep[1][~good]
        done = members[good]
        jets.coefficients[done, :5] = values[good, :5]
        jets.coefficients[done, 5:] = 0.0
        jets.degree[done] = 2
        shift = np.where(moving[group][good], values[good, 5], 0.0)
        jets.origin[done] += shift[:, None] * jets.frame[done, 2]
    return accepted


def _fit_sparse(fits: _Fit, rows: Index, rings: Any, degree: int) -> None:
    """Fit fans whose rings do not determine a polynomial, by the columns that they do determine.

    An example is the side of a coarse cylinder, whose vertices lie on two circles.
    """
    jets = fits.jets
    for _, members, ring in _groups(rows, rings):
        local, count = _local(jets, members, ring), ring.shape[1]
        height, scale = local[:, 2], jets.scale[members]
        extent = scale.min(axis=1)
        best = np.full(len(members), np.inf)
        length, half, triangle, kept = heights.rank_revealing_qr(
            heights.powers(local[:, 0], local[:, 1], degree), height
        )
        for trial in range(degree, 0, -1):
            c = heights.TERMS[trial]
            values = np.linalg.solve(triangle[:, :c, :c], half[:, :c, None])[..., 0] / length[:, :c]
            rss = np.sum(height**2, axis=1) - np.sum(half[:, :c] ** 2, axis=1)
            rss, rank = np.maximum(rss, 0.0), kept[:, :c].sum(axis=1)
            freedom = count - 1 - rank
            good = rss < (heights.MAX_RESIDUAL * extent) ** 2 * count
            good &= heights.plausible(values, scale)
            good &= rss < MAX_UNEXPLAINED * np.sum(height**2, axis=1) + 1e-300
            if trial == 1:
                good &= rss < (PLANE_TOLERANCE * extent) ** 2 * count
            elif trial > 2:
                good &= (freedom > 0) | heights.decaying(values)
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


def _groups(rows: Index, rings: Any) -> Iterator[tuple[Index, Index, Index]]:
    """Fans `rows` (r,) by the size of their rings, the rows of `rings` (r, n); at most CHUNK each.

    Yields indices (g,) into `rows`, the fans (g,), and their rings (g, k).
    """
    start, index = rings.indptr.astype(np.intp), rings.indices
    size = np.diff(start)
    for same in rows_by_key(size):
        for group in np.split(same, range(CHUNK, len(same), CHUNK)):
            if len(group):
                yield group, rows[group], index[start[group][:, None] + np.arange(size[group[0]])]
