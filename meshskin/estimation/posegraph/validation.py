"""The arrays of a pose graph: validation (a checked copy, or a GraphError), and what follows from
information matrices: their projection and the weights of chordal objectives."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.arrays import Array
from ...core.errors import GraphError

ROTATION_TOLERANCE = 1e-6
"""Largest entry of R^T R - I: files with seven digits stay below it."""
INFORMATION_TOLERANCE = 1e-9
"""Largest asymmetry and negative eigenvalue of an information matrix that count as rounding,
relative to its largest entry: the rounding of files with ten digits."""
SINGULAR = 1e-12
"""A matrix is singular if its condition number is above 1 / SINGULAR: its inverse would have
fewer than four correct digits."""
MAX_INFORMATION = 1e100
"""Largest entry of an information matrix: the squares of larger ones leave double precision."""


def transforms(name: str, values: ArrayLike, count: int | None = None) -> Array:
    """A copy of rigid transforms (count, 4, 4)."""
    array = np.array(values, dtype=float, order="C")  # compiled code reads rows
    if array.size == 0 and name == "measurements":
        array = array.reshape(0, 4, 4)
    shape = (len(array) if count is None else count, 4, 4)
    if array.shape != shape or (not len(array) and name == "poses"):
        wanted = "(n, 4, 4)" if count is None else str(shape)
        raise GraphError(f"{name} have the wrong shape", value=array.shape, limit=wanted)
    _refuse(~np.isfinite(array).all(axis=(1, 2)), f"{name} must be finite", "row {}".format)
    r = array[:, :3, :3]
    error = np.abs(np.swapaxes(r, 1, 2) @ r - np.eye(3)).max(axis=(1, 2), initial=0.0)
    error = np.where(np.linalg.det(r) > 0, error, np.inf)
    error = np.maximum(error, np.abs(array[:, 3] - [0, 0, 0, 1]).max(axis=1, initial=0.0))
    _refuse(
        np.asarray(error > ROTATION_TOLERANCE), f"{name} must be rigid transforms",
        lambda row: f"row {row} with an error of {error[row]:.3g}",
        limit=ROTATION_TOLERANCE, remedy="normalize the rotations",
    )  # fmt: skip
    return array


def edge_indices(values: ArrayLike, poses: int) -> NDArray[np.int64]:
    """A copy of pairs (m, 2) of different pose numbers below `poses`."""
    given = np.array(values, order="C")
    if given.size == 0:
        return np.empty((0, 2), dtype=np.int64)
    if given.ndim != 2 or given.shape[1] != 2:
        raise GraphError("edges have the wrong shape", value=given.shape, limit="(m, 2)")
    if not np.issubdtype(given.dtype, np.integer):
        raise GraphError("edges must be integers", value=given.dtype)
    edges = given.astype(np.int64)
    _refuse(
        np.any((edges < 0) | (edges >= poses), axis=1),
        "an edge refers to a pose that does not exist",
        lambda row: f"edge {row} {tuple(edges[row].tolist())}", limit=f"0 to {poses - 1}",
    )  # fmt: skip
    _refuse(
        edges[:, 0] == edges[:, 1], "an edge must join two different poses",
        lambda row: f"edge {row}, pose {edges[row, 0]} twice",
        remedy="remove it: it contains no information about the poses",
    )  # fmt: skip
    return edges


def information_matrices(values: ArrayLike, count: int) -> Array:
    """A copy of symmetric matrices (count, 6, 6); one (6, 6) serves all."""
    array = np.array(values, dtype=float, order="C")
    if array.shape == (6, 6):
        array = np.tile(array, (count, 1, 1))
    if array.size == 0 and count == 0:
        return np.empty((0, 6, 6))
    if array.shape != (count, 6, 6):
        raise GraphError("information has the wrong shape", value=array.shape, limit=(count, 6, 6))
    _refuse(
        ~np.isfinite(array).all(axis=(1, 2)), "information must be finite", "edge {}".format
    )  # fmt: skip
    size = np.abs(array).max(axis=(1, 2))
    _refuse(
        size > MAX_INFORMATION, "information is too large to compute with",
        lambda row: f"edge {row}: {size[row]:.3g}", limit=f"{MAX_INFORMATION:g}",
        remedy="scale all information matrices down: the poses stay the same",
    )  # fmt: skip
    asymmetry = np.abs(array - np.swapaxes(array, 1, 2)).max(axis=(1, 2))
    _refuse(
        asymmetry > INFORMATION_TOLERANCE * size, "information must be symmetric",
        lambda row: f"edge {row}: asymmetry {asymmetry[row]:.3g}",
        limit=f"{INFORMATION_TOLERANCE:g} of its largest entry",
    )  # fmt: skip
    return np.asarray((array + np.swapaxes(array, 1, 2)) / 2)


def project_to_semidefinite(matrices: Array) -> tuple[Array, NDArray[np.bool_]]:
    """The nearest positive semidefinite matrices to `matrices` (m, k, k), and which have changed.

    Negative eigenvalues become zero; those within `INFORMATION_TOLERANCE` are rounding, and their
    matrices stay as they are.
    Source: Higham, "Computing a nearest symmetric positive semidefinite matrix", Linear Algebra
    and its Applications 103 (1988).
    """
    try:
        np.linalg.cholesky(matrices)
        return matrices, np.zeros(len(matrices), dtype=bool)
    except np.linalg.LinAlgError:  # not all are positive definite
        values, vectors = np.linalg.eigh(matrices)
    size = np.abs(matrices).max(axis=(1, 2), initial=0.0)
    indefinite = values[:, 0] < -INFORMATION_TOLERANCE * size
    projected = np.array(matrices)
    half = vectors[indefinite] * np.sqrt(np.maximum(values[indefinite], 0.0))[:, None, :]
    projected[indefinite] = half @ np.swapaxes(half, 1, 2)
    return projected, indefinite


def chordal_weights(
    information: Array,
) -> tuple[Array, Array, NDArray[np.bool_], NDArray[np.bool_]]:
    """tau, kappa, and which of `information` (m, 6, 6) have a block whose inverse has a negative
    trace, and which one that is indefinite and whose inverse has a positive one.

    tau = 3 / tr(inv(I_t)) and kappa = 3 / (2 tr(inv(I_R))), (m,) each; 0 where the block is
    singular or the trace is negative.
    Source: Rosen et al., "SE-Sync", IJRR 38 (2019), section 6.
    """
    translation, *wrong = _inverse_trace(information[:, :3, :3])
    rotation, *also = _inverse_trace(information[:, 3:, 3:])
    negative, indefinite = (one | other for one, other in zip(wrong, also, strict=True))
    return 3.0 * translation, 1.5 * rotation, negative, indefinite


def _inverse_trace(matrices: Array) -> tuple[Array, NDArray[np.bool_], NDArray[np.bool_]]:
    """1 / tr(inv(M)) of symmetric `matrices` (m, 3, 3), where it is negative, and where it is
    positive though M is indefinite.

    0 where it is negative or M is singular.
    """
    values = np.linalg.eigvalsh(matrices)
    size = np.abs(values)
    singular = size.min(axis=1) <= SINGULAR * size.max(axis=1)
    trace = np.sum(1.0 / np.where(singular[:, None], 1.0, values), axis=1)
    negative = trace <= 0.0
    indefinite = ~(singular | negative) & (values[:, 0] < 0.0)
    inverse = np.where(singular | negative, 0.0, 1.0 / np.where(negative, 1.0, trace))
    return inverse, negative, indefinite


def _refuse(bad: NDArray[np.bool_], what: str, value: Callable[[int], str], **facts: Any) -> None:
    """Raise GraphError, with the `value` of the first of the rows (n,) that are bad, if any is."""
    if bad.any():
        raise GraphError(what, value=value(int(np.argmax(bad))), **facts)
