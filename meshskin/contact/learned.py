"""A pressure profile that is learned: a smooth correction of a physical one.

The correction is a cubic spline in the distance u from the contact point, relative to the patch's
semi-axes, even about u = 0 and zero from u = `extent` on. Its coefficients are those of a Gaussian
process with penalized second differences, in whitened form: with independent normal coefficients of
equal variance the correction is smooth, and its mean variance over the patch is theirs.

Source: Eilers and Marx, "Flexible smoothing with B-splines and penalties", Statistical Science 11
(1996).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np

from ..core.arrays import Array

PROFILE_SIZE = 14
"""Coefficients of a profile: intervals of a sixth of the patch's semi-axis at an extent of 2.5,
finer than any profile that remains after the mean over a taxel's disc."""


@functools.cache
def whitening() -> Array:
    """Spline coefficients (PROFILE_SIZE, PROFILE_SIZE) of each whitened coefficient."""
    n = PROFILE_SIZE
    second = -2 * np.eye(n + 2, n) + np.eye(n + 2, n, -1) + np.eye(n + 2, n, 1)
    second[0, 1] += 1.0  # even about u = 0
    second = second[: n + 1]
    lower = np.linalg.cholesky(second.T @ second)
    found = np.linalg.solve(lower.T, np.eye(n))
    return np.asarray(found / np.sqrt(np.mean(np.sum(found**2, axis=1))))


@functools.cache
def _coefficients() -> Array:
    """Coefficients of the splines about the knots -1 to PROFILE_SIZE + 3, (PROFILE_SIZE + 5,
    PROFILE_SIZE): mirrored at zero, and zero from `extent` on."""
    even = whitening()[1:2]
    return np.concatenate([even, whitening(), np.zeros((4, PROFILE_SIZE))])


@dataclass(frozen=True)
class ProfileCorrection:
    """Smooth corrections of a pressure profile relative to its peak."""

    extent: float
    """Distance, in semi-axes, from which the correction is zero."""

    def __call__(self, u: Array, whitened: Array) -> tuple[Array, Array, Array]:
        """The basis functions (k, PROFILE_SIZE) of the whitened coefficients at u (k,) >= 0, the
        correction (k,) at the coefficients `whitened` (PROFILE_SIZE,), and its slope (k,) in u."""
        step = self.extent / (PROFILE_SIZE + 1)
        t = np.minimum(u / step, PROFILE_SIZE + 1.0)
        below = np.nan_to_num(t).astype(int)  # a step too long has no distances, and infinite cost
        rows, part = np.arange(len(u)), t - below
        splines, coefficients = _coefficients(), _coefficients() @ whitened
        value, slope = np.zeros((len(u), len(splines))), np.zeros(len(u))
        for k, (b, db) in enumerate(_cubic(part)):  # four splines are not zero there
            value[rows, below + k] = b
            slope += db * coefficients[below + k]
        return (basis := value @ splines), basis @ whitened, slope / step


def _cubic(part: Array) -> list[tuple[Array, Array]]:
    """The cubic B-splines about the knots -1, 0, 1 and 2, and their derivatives, at `part` (k,)
    from 0 to 1."""
    rest = 1 - part
    a, b = part**2, rest**2  # NumPy's third power takes ten times as long as a product
    c, d = a * part, b * rest
    return [
        (d / 6, -b / 2),
        (2 / 3 - a + c / 2, -2 * part + 1.5 * a),
        (2 / 3 - b + d / 2, 2 * rest - 1.5 * b),
        (c / 6, a / 2),
    ]
