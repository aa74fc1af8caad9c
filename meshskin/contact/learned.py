"""A pressure profile that is learned: a smooth correction of a physical one.

The correction is a cubic spline in the distance u from the contact point, relative to the patch's
semi-axes, even about u = 0 and zero from u = `extent` on. Its coefficients are those of a Gaussian
process with penalized second differences, in whitened form: with independent normal coefficients of
equal variance the correction is smooth, and its mean variance over the patch is theirs.

Source: Eilers and Marx, "Flexible smoothing with B-splines and penalties", Statistical Science 11
(1996).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..core.arrays import Array

PROFILE_SIZE = 14
"""Coefficients of a profile: intervals of a sixth of the patch's semi-axis at an extent of 2.5,
finer than any profile that the mean over a taxel's disc leaves."""


@dataclass(frozen=True)
class ProfileCorrection:
    """Smooth corrections of a pressure profile relative to its peak."""

    extent: float
    """Distance, in semi-axes, from which the correction is zero."""

    @cached_property
    def whitening(self) -> Array:
        """Spline coefficients (PROFILE_SIZE, PROFILE_SIZE) of each whitened coefficient."""
        n = PROFILE_SIZE
        second = -2 * np.eye(n + 2, n) + np.eye(n + 2, n, -1) + np.eye(n + 2, n, 1)
        second[0, 1] += 1.0  # even about u = 0
        second = second[: n + 1]
        lower = np.linalg.cholesky(second.T @ second)
        found = np.linalg.solve(lower.T, np.eye(n))
        return np.asarray(found / np.sqrt(np.mean(np.sum(found**2, axis=1))))

    def __call__(self, u: Array) -> tuple[Array, Array]:
        """Values and slopes (k, PROFILE_SIZE) in u (k,) >= 0 of the whitened basis functions."""
        step = self.extent / (PROFILE_SIZE + 1)
        t = u[:, None] / step - np.arange(PROFILE_SIZE)
        value, slope = _cubic(t)
        mirrored = _cubic(u / step + 1.0)
        value[:, 1] += mirrored[0]
        slope[:, 1] += mirrored[1]
        return value @ self.whitening, slope @ self.whitening / step


def _cubic(t: Array) -> tuple[Array, Array]:
    """The cubic B-spline with integer knots about 0, and its derivative."""
    size = np.abs(t)
    near, far = size < 1.0, np.maximum(2.0 - size, 0.0)
    value = np.where(near, 2 / 3 - size**2 + size**3 / 2, far**3 / 6)
    slope = np.where(near, -2 * size + 1.5 * size**2, -(far**2) / 2) * np.sign(t)
    return value, slope
