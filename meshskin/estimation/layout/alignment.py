"""Alignment of a layout with other positions: what co-activation does not determine is fitted."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import check_array
from ...core.arrays import Array
from ...core.errors import ConfigError


def aligned(
    points: ArrayLike, target: ArrayLike, scale: bool = False, mirror: bool = True
) -> Array:
    """`points` (n, D) after the motion that takes them to `target` (n, D) by least squares.

    scale: a common factor is fitted, too; mirror: the mirror image is taken where it fits better.
    Rows that are not finite in either do not count, and stay as they are or move along. Plane
    points (n, 2) may have a target in space (n, 3). Raises ConfigError.

    Source: Umeyama, IEEE PAMI 13 (1991).
    """
    x, y = check_array("points to align", points), check_array("target of an alignment", target)
    if x.ndim != 2 or y.ndim != 2 or len(x) != len(y) or not 2 <= x.shape[1] <= y.shape[1] <= 3:
        raise ConfigError(
            "points and target of an alignment differ in shape", value=(x.shape, y.shape)
        )
    if x.shape[1] < y.shape[1]:
        x = np.column_stack([x, np.where(np.isfinite(x[:, 0]), 0.0, np.nan)])
    both = np.isfinite(x).all(axis=1) & np.isfinite(y).all(axis=1)
    if both.sum() < 3:
        raise ConfigError("an alignment needs points", value=int(both.sum()), limit="at least 3")
    a, b = x[both] - x[both].mean(axis=0), y[both] - y[both].mean(axis=0)
    u, s, vt = np.linalg.svd(b.T @ a)
    sign = np.ones(len(s))
    if not mirror:
        sign[-1] = np.sign(np.linalg.det(u @ vt))
    rotation = (u * sign) @ vt
    factor = float(np.sum(s * sign) / np.sum(a**2)) if scale else 1.0
    return np.asarray(factor * (x - x[both].mean(axis=0)) @ rotation.T + y[both].mean(axis=0))


def root_mean_square(offsets: Array) -> float:
    """Root mean square length of the finite rows of `offsets` (n, D)."""
    square = np.sum(offsets**2, axis=1)
    return float(np.sqrt(np.mean(square[np.isfinite(square)])))
