"""Information matrices of displacements: validation, projection, weights of chordal objectives."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...core.arrays import Array
from ...core.errors import GraphError
from .validation import check_finite

INFORMATION_TOLERANCE = 1e-9
"""Largest asymmetry and negative eigenvalue of an information matrix that count as rounding,
relative to its largest entry: the rounding of files with ten digits."""
SINGULAR = 1e-12
"""A matrix is singular if its condition number is above 1 / SINGULAR: its inverse would have
fewer than four correct digits."""
MAX_INFORMATION = 1e100
"""Largest entry of an information matrix: the squares of larger ones leave double precision."""


def information_matrices(values: ArrayLike, count: int) -> Array:
    """A copy of symmetric matrices (count, 6, 6); one (6, 6) serves all."""
    array = np.array(values, dtype=float)
    if array.shape == (6, 6):
        array = np.tile(array, (count, 1, 1))
    if array.size == 0 and count == 0:
        return np.empty((0, 6, 6))
    if array.shape != (count, 6, 6):
        raise GraphError("information has the wrong shape", value=array.shape, limit=(count, 6, 6))
    check_finite("information must be finite", "edge", array)
    size = np.abs(array).max(axis=(1, 2))
    if (size > MAX_INFORMATION).any():
        row = int(np.argmax(size > MAX_INFORMATION))
        raise GraphError(
            "information is too large to compute with",
            value=f"edge {row}: {size[row]:.3g}",
            limit=f"{MAX_INFORMATION:g}",
            remedy="scale all information matrices down: the poses stay the same",
        )
    asymmetry = np.abs(array - np.swapaxes(array, 1, 2)).max(axis=(1, 2))
    array = (array + np.swapaxes(array, 1, 2)) / 2
    wrong = asymmetry > INFORMATION_TOLERANCE * size
    if wrong.any():
        row = int(np.argmax(wrong))
        raise GraphError(
            "information must be symmetric",
            value=f"edge {row}: asymmetry {asymmetry[row]:.3g}",
            limit=f"{INFORMATION_TOLERANCE:g} of its largest entry",
        )
    return array


def project_to_semidefinite(matrices: Array) -> tuple[Array, NDArray[np.bool_]]:
    """The nearest positive semidefinite matrices to `matrices` (m, k, k), and which have changed.

    Negative eigenvalues become zero; those within `INFORMATION_TOLERANCE` are rounding, and their
    matrices stay as they are.
    Source: Higham, "Computing a nearest symmetric positive semidefinite matrix", Linear Algebra
    and its Applications 103 (1988).
    """
    values, vectors = np.linalg.eigh(matrices)
    size = np.abs(matrices).max(axis=(1, 2), initial=0.0)
    indefinite = values[:, 0] < -INFORMATION_TOLERANCE * size
    projected = np.array(matrices)
    half = vectors[indefinite] * np.sqrt(np.maximum(values[indefinite], 0.0))[:, None, :]
    projected[indefinite] = half @ np.swapaxes(half, 1, 2)
    return projected, indefinite


def chordal_weights(information: Array) -> tuple[Array, Array, NDArray[np.bool_]]:
    """tau, kappa and which blocks of `information` (m, 6, 6) have an inverse of negative trace.

    tau = 3 / tr(inv(I_t)) and kappa = 3 / (2 tr(inv(I_R))), (m,) each; 0 where the block is
    singular or the trace is negative.
    Source: Rosen et al., "SE-Sync", IJRR 38 (2019), section 6.
    """
    translation, no_translation = _inverse_trace(information[:, :3, :3])
    rotation, no_rotation = _inverse_trace(information[:, 3:, 3:])
    return 3.0 * translation, 1.5 * rotation, no_translation | no_rotation


def _inverse_trace(matrices: Array) -> tuple[Array, NDArray[np.bool_]]:
    """1 / tr(inv(M)) of symmetric `matrices` (m, 3, 3), and where it is negative.

    0 where it is negative or M is singular.
    """
    values = np.linalg.eigvalsh(matrices)
    size = np.abs(values)
    singular = size.min(axis=1) <= SINGULAR * size.max(axis=1)
    trace = np.sum(1.0 / np.where(singular[:, None], 1.0, values), axis=1)
    negative = trace <= 0.0
    return np.where(singular | negative, 0.0, 1.0 / np.where(negative, 1.0, trace)), negative
