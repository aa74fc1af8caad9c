"""Array types, and operations on arrays and groups of rows that NumPy does not have."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""Real numbers."""
Index = NDArray[np.intp]
"""Rows of arrays."""


MAD = 0.6745
"""Median absolute value of a standard normal variable."""
_NEXT, _AFTER = np.array([1, 2, 0]), np.array([2, 0, 1])
"""Coordinates in cyclic order."""


def cross(a: Array, b: Array) -> Array:
    """Cross products (..., 3) of vectors (..., 3), bit for bit those of `numpy.cross`, which takes
    four times as long for a few vectors."""
    return np.asarray(a[..., _NEXT] * b[..., _AFTER] - a[..., _AFTER] * b[..., _NEXT])


HUBER = 1.5
"""Residual, in standard deviations, beyond which its Huber weight decreases: 95 % efficient without
outliers (Huber, "Robust Statistics", 1981)."""


def huber_weights(r: Array, sigma: float) -> Array:
    """Huber's weights (m,), in units of 1 / sigma^2, of residuals (m,) of standard deviation
    `sigma`."""
    return np.minimum(1.0, HUBER * sigma / np.maximum(np.abs(r), 1e-300)) / sigma**2


def huber_cost(r: Array, limit: float = HUBER) -> float:
    """Sum of Huber's costs of residuals (m,), in standard deviations, that grow linearly from
    `limit` on."""
    size = np.abs(r)
    return float(np.sum(np.where(size < limit, size**2 / 2, limit * size - limit**2 / 2)))


def robust_sigma(values: Array) -> float:
    """Standard deviation of normal variables of mean zero, estimated from the median of their
    absolute values, which a minority of outliers hardly changes. values (n,), one or more."""
    return float(np.median(np.abs(values))) / MAD


def spread_rows(values: Array, rows: Index, count: int, missing: object) -> Array:
    """An array (count, ...) with the `values` (k, ...) at the `rows` (k,), elsewhere `missing`."""
    out = np.empty((count, *values.shape[1:]))
    out[:] = missing
    out[rows] = values
    return out


def ranges(first: Index, count: Index) -> Index:
    """The integers first[k], ..., first[k] + count[k] - 1 of every k, concatenated."""
    return np.repeat(first - np.cumsum(count) + count, count) + np.arange(count.sum())


def runs(mask: NDArray[np.bool_]) -> list[slice]:
    """The slices of consecutive True values of `mask` (n,)."""
    change = np.flatnonzero(np.diff(np.concatenate([[False], mask, [False]]).astype(int)))
    return [slice(int(a), int(b)) for a, b in change.reshape(-1, 2)]


def sums_by_group(values: Array, group: NDArray[np.integer], groups: int = 0) -> Array:
    """Sums (m, ...) of the rows of `values` (k, ...) that have the same number in `group` (k,).

    m is `groups`, or the largest number plus one if that is more.
    """
    flat = values.reshape(len(values), int(np.prod(values.shape[1:])))
    sums = np.stack([np.bincount(group, column, groups) for column in flat.T], axis=1, dtype=float)
    return sums.reshape(len(sums), *values.shape[1:])


def means_by_group(
    values: Array, group: NDArray[np.integer], groups: int = 0, weight: Array | None = None
) -> Array:
    """Means (m, ...) of the rows of `values` (k, ...) that have the same number in `group` (k,),
    with `weight` (k,), by default equal; m as in `sums_by_group`; NaN where a group has no
    weight."""
    weight = np.ones(len(values)) if weight is None else weight
    axes = (-1, *[1] * (values.ndim - 1))
    total = np.bincount(group, weight, groups).reshape(axes)
    with np.errstate(invalid="ignore"):
        return sums_by_group(weight.reshape(axes) * values, group, groups) / total


def spreads_by_group(
    points: Array, group: NDArray[np.integer], weight: Array | None = None
) -> Array:
    """Mean square distances (t,) of the points (k, 3) of each group (k,) that has weight from their
    mean, with `weight` (k,), by default equal."""
    off = points - means_by_group(points, group, weight=weight)[group]
    square = means_by_group(np.sum(off**2, axis=1), group, weight=weight)
    return square[np.isfinite(square)]


def rows_by_key(keys: NDArray[Any]) -> list[Index]:
    """Rows of equal `keys` (n,), in the order of the keys; one empty group for no keys."""
    order = np.argsort(keys, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(keys[order])) + 1)


def far_apart(points: Array, order: Index, reach: float, count: int) -> Index:
    """The first rows in `order` that are farther than `reach` (m) from each other, at most `count`.

    points (n, 3), m.
    """
    from scipy.spatial import KDTree

    tree, chosen, beside = KDTree(points), list[int](), np.zeros(len(points), dtype=bool)
    for k in order.tolist():
        if len(chosen) == count:
            break
        if not beside[k]:
            chosen.append(k)
            beside[tree.query_ball_point(points[k], reach)] = True
    return np.array(chosen, dtype=np.intp)


def neighbour_distances(points: Array) -> Array:
    """Distance (n,) of each of the points (n, D), two or more, to the nearest other."""
    from scipy.spatial import KDTree

    return np.asarray(KDTree(points).query(points, k=2)[0][:, 1])


def median_spacing(points: Array) -> float:
    """Median of `neighbour_distances` of the finite points (n, 3); NaN for fewer than two."""
    points = points[np.isfinite(points).all(axis=1)]
    return float(np.median(neighbour_distances(points))) if len(points) > 1 else float("nan")


def nearest_rows(times: Array, wanted: Array) -> Index:
    """Row (m,) of the rising `times` (n,), two or more, nearest to each of `wanted` (m,)."""
    after = np.clip(np.searchsorted(times, wanted), 1, len(times) - 1)
    return np.where(wanted - times[after - 1] < times[after] - wanted, after - 1, after)


def last_known(values: NDArray[np.number], missing: NDArray[np.bool_]) -> NDArray[np.number]:
    """The values (n, t) with the last known one where they are missing, or the first."""
    row = np.where(missing, 0, np.arange(len(values))[:, None])
    np.maximum.accumulate(row, axis=0, out=row)
    filled = np.take_along_axis(values, row, axis=0)
    first = np.take_along_axis(values, np.argmin(missing, axis=0)[None], axis=0)
    known = np.logical_or.accumulate(~missing, axis=0)
    return np.nan_to_num(np.where(known, filled, first), posinf=0.0, neginf=0.0)
