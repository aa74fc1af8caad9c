"""Polynomial height fields of degree 1 to 4 in two variables, fitted in batches."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import Array

DEGREE = 4
"""highest degree"""
POWERS = tuple((d - j, j) for d in range(1, DEGREE + 1) for j in range(d + 1))
"""(i, j) of the 14 monomials x^i y^j, by total degree, without the constant"""
TERMS = {d: (d + 1) * (d + 2) // 2 - 1 for d in range(1, DEGREE + 1)}
"""number of monomials up to each degree"""
MIN_PIVOT = 1e-4
"""least sine of the angle between a column of the fit and the columns before it"""
RANK_TOLERANCE = 0.02
"""least such sine of a column that is kept where a ring does not determine all columns"""
MAX_SLOPE, MAX_HIGH_ORDER = 2.0, 0.8
"""bounds of the sums of absolute coefficients, of all and of those above degree 2, of a plausible
fit over the radius of its ring; on a sphere, with q = ring radius / sphere radius, the sums are
q + q^3 / 2 and q^3 / 2: q up to 1.1 is plausible"""
MAX_HIGH_ORDER_RATIO = 0.2
"""largest terms above degree 2, over those of degree 2, of a plausible fit without spare points"""
MAX_RESIDUAL = 0.01
"""largest RMS residual of a plausible fit, relative to the radius of the ring"""


def least_squares(
    local: Array, scale: Array, degree: int
) -> tuple[NDArray[np.bool_], Array, Array]:
    """Least-squares heights of rings (g, 3, k) by Cholesky: which are plausible, coefficients, RSS.

    The sums of squared residuals (g, degree - 1) are those of the degrees from 2: the columns are
    in the order of degree, so one factor serves all.
    """
    columns = powers(local[:, 0], local[:, 1], degree)  # (g, c, k)
    g, c, k = columns.shape
    if k - 1 < c:  # the fan itself, one of the k, has height zero
        return np.zeros(g, dtype=bool), np.zeros((g, c)), np.zeros((g, degree - 1))
    height = local[:, 2]
    length = np.sqrt(np.einsum("gck,gck->gc", columns, columns))
    length[length == 0.0] = 1.0
    columns /= length[:, :, None]
    normal = columns @ np.swapaxes(columns, 1, 2) + 1e-13 * np.eye(c)  # never exactly singular
    factor = np.linalg.cholesky(normal)
    diagonal = np.diagonal(factor, axis1=1, axis2=2)
    half = np.linalg.solve(factor, columns @ height[..., None])
    values = np.linalg.solve(np.swapaxes(factor, 1, 2), half)[..., 0] / length
    explained = np.cumsum(half[..., 0] ** 2, axis=1)[
        :, [TERMS[d] - 1 for d in range(2, degree + 1)]
    ]
    rss = np.maximum(np.sum(height**2, axis=1)[:, None] - explained, 0.0)
    good = (np.min(diagonal, axis=1) > MIN_PIVOT) & plausible(values, scale)
    good &= rss[:, -1] < (MAX_RESIDUAL * scale.min(axis=1)) ** 2 * k
    return good, values, rss


def rank_revealing_qr(columns: Array, height: Array) -> tuple[Array, Array, Array, Array]:
    """QR factors of columns (g, c, k) by Gram-Schmidt, without columns that depend on those before.

    Gives the norms of the columns (g, c), Q^T height (g, c), R (g, c, c), and which columns (g, c)
    are kept.
    """
    length = np.maximum(np.sqrt(np.einsum("gck,gck->gc", columns, columns)), 1e-300)
    g, c, _ = columns.shape
    q, r, kept = np.zeros_like(columns), np.zeros((g, c, c)), np.zeros((g, c), dtype=bool)
    for j in range(c):
        rest = columns[:, j] / length[:, j, None]
        for _ in range(2):  # a second pass restores orthogonality
            along = np.einsum("gck,gk->gc", q[:, :j], rest)
            rest = rest - np.einsum("gc,gck->gk", along, q[:, :j])
            r[:, :j, j] += along
        size = np.sqrt(np.einsum("gk,gk->g", rest, rest))
        kept[:, j] = size > RANK_TOLERANCE
        q[:, j] = np.where(kept[:, j, None], rest / np.maximum(size, 1e-300)[:, None], 0.0)
        r[:, :j, j] *= kept[:, j, None]
        r[:, j, j] = np.where(kept[:, j], size, 1.0)
    return length, np.einsum("gck,gk->gc", q, height), r, kept


def plausible(values: Array, scale: Array) -> NDArray[np.bool_]:
    """Whether coefficients (g, c), m, on rings of extents `scale` (g, 2), m, are small enough."""
    shortest = scale.min(axis=1)
    slope = np.sum(np.abs(values[:, :2]) / scale, axis=1)
    size = np.abs(values) / shortest[:, None]
    return np.asarray(
        (slope + size[:, 2:].sum(axis=1) < MAX_SLOPE) & (size[:, 5:].sum(axis=1) < MAX_HIGH_ORDER)
    )


def decaying(values: Array) -> NDArray[np.bool_]:
    """Whether the terms of coefficients (g, c) above degree 2 are small next to those of it."""
    wave, bend = np.abs(values[:, 5:]).sum(axis=1), np.abs(values[:, 2:5]).sum(axis=1)
    return np.asarray(wave <= MAX_HIGH_ORDER_RATIO * bend)


def powers(x: Array, y: Array, degree: int) -> Array:
    """Monomials x^i y^j, 1 <= i + j <= degree, of x, y (g, k) -> (g, c, k)."""
    out = np.empty((x.shape[0], TERMS[degree], x.shape[1]))
    out[:, 0], out[:, 1] = x, y
    start = 0
    for d in range(2, degree + 1):
        here = start + d
        out[:, here : here + d] = out[:, start:here] * x[:, None]
        out[:, here + d] = out[:, here - 1] * y
        start = here
    return out


def heights(coefficients: Array, x: Array, y: Array, degree: int = DEGREE) -> Array:
    """Heights h(x, y), m, of jets (14, ...) at x, y (...), which are relative to their scales.

    Coefficients beyond `degree` are taken as zero.
    """
    c = dict(zip(POWERS, coefficients, strict=True))
    total = np.zeros_like(x)
    for i in range(degree, -1, -1):  # Horner in x, whose coefficients are Horner in y
        row = np.zeros_like(x)
        for j in range(degree - i, -1, -1):
            row *= y
            if i or j:
                row += c[i, j]
        total *= x
        total += row
    return total
