"""Validation of the arrays of a pose graph: a checked copy, or a GraphError."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.arrays import Array
from ...core.errors import GraphError

ROTATION_TOLERANCE = 1e-6
"""Largest entry of R^T R - I: files with seven digits stay below it."""


def transforms(name: str, values: ArrayLike, count: int | None = None) -> Array:
    """A copy of rigid transforms (count, 4, 4)."""
    array = np.array(values, dtype=float)
    if array.size == 0 and name == "measurements":
        array = array.reshape(0, 4, 4)
    shape = (len(array) if count is None else count, 4, 4)
    if array.shape != shape or (not len(array) and name == "poses"):
        wanted = "(n, 4, 4)" if count is None else str(shape)
        raise GraphError(f"{name} have the wrong shape", value=array.shape, limit=wanted)
    check_finite(f"{name} must be finite", "row", array)
    r = array[:, :3, :3]
    error = np.abs(np.swapaxes(r, 1, 2) @ r - np.eye(3)).max(axis=(1, 2), initial=0.0)
    error = np.where(np.linalg.det(r) > 0, error, np.inf)
    error = np.maximum(error, np.abs(array[:, 3] - [0, 0, 0, 1]).max(axis=1, initial=0.0))
    if (error > ROTATION_TOLERANCE).any():
        row = int(np.argmax(error > ROTATION_TOLERANCE))
        raise GraphError(
            f"{name} must be rigid transforms",
            value=f"row {row} with an error of {error[row]:.3g}",
            limit=ROTATION_TOLERANCE,
            remedy="normalize the rotations",
        )
    return array


def edge_indices(values: ArrayLike, poses: int) -> NDArray[np.int64]:
    """A copy of pairs (m, 2) of different pose numbers below `poses`."""
    given = np.array(values)
    if given.size == 0:
        return np.empty((0, 2), dtype=np.int64)
    if given.ndim != 2 or given.shape[1] != 2:
        raise GraphError("edges have the wrong shape", value=given.shape, limit="(m, 2)")
    if not np.issubdtype(given.dtype, np.integer):
        raise GraphError("edges must be integers", value=given.dtype)
    edges = given.astype(np.int64)
    outside = ((edges < 0) | (edges >= poses)).any(axis=1)
    if outside.any():
        row = int(np.argmax(outside))
        raise GraphError(
            "an edge refers to a pose that does not exist",
            value=f"edge {row} {tuple(edges[row].tolist())}",
            limit=f"0 to {poses - 1}",
        )
    loop = edges[:, 0] == edges[:, 1]
    if loop.any():
        row = int(np.argmax(loop))
        raise GraphError(
            "an edge must join two different poses",
            value=f"edge {row}, pose {edges[row, 0]} twice",
            remedy="remove it: it contains no information about the poses",
        )
    return edges


def check_finite(message: str, item: str, array: Array) -> None:
    """Raise GraphError with the number of the first `item` of `array` (n, k, k) not finite."""
    bad = np.flatnonzero(~np.isfinite(array).all(axis=(1, 2)))
    if len(bad):
        raise GraphError(message, value=f"{item} {bad[0]}")
