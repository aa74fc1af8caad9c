"""Pressure under a rigid sphere on a curved body, in closed form: p(r; F).

r is the distance from the contact point, m; F the normal force, N; R the relative radius of
curvature, m: 1/R = 1/R_indenter + 1/R_body. The integral of p over the plane is F.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RectBivariateSpline
from scipy.special import ive, roots_legendre

Array = NDArray[np.float64]
Profile = Callable[[Array, Array], Array]
"""(distances from the contact point, m; forces, N), of shapes that broadcast -> pressures, Pa."""
FORCES = np.geomspace(1.5, 6.0, 13)
"""Forces, N, at which profiles and their means over a taxel's disc are tabulated."""
REACH = 0.02
"""Distance, m, from the contact point beyond which nothing is pressed."""


@dataclass(frozen=True)
class Hertz:
    """A half-space (K. L. Johnson, Contact Mechanics, 1985, section 4.2)."""

    modulus: float = 0.2e6 / (1 - 0.49**2)
    """E*, Pa."""
    radius: float = 1 / (1 / 0.01 + 1 / 0.1)
    """R, m."""

    def __call__(self, r: Array, force: Array) -> Array:
        """Pressures, Pa."""
        a = (3 * force * self.radius / (4 * self.modulus)) ** (1 / 3)
        peak = 3 * force / (2 * np.pi * a**2)
        return np.asarray(peak * np.sqrt(np.maximum(1 - (r / a) ** 2, 0.0)))


@dataclass(frozen=True)
class Winkler:
    """A foundation of independent springs: thin foam (Johnson, section 4.3)."""

    stiffness: float = 3.5e7
    """Pressure per depth, Pa/m."""
    radius: float = 1 / (1 / 0.01 + 1 / 0.1)
    """R, m."""

    def __call__(self, r: Array, force: Array) -> Array:
        """Pressures, Pa."""
        depth = np.sqrt(force / (np.pi * self.stiffness * self.radius))
        return np.asarray(self.stiffness * np.maximum(depth - r**2 / (2 * self.radius), 0.0))


@dataclass(frozen=True)
class Bell:
    """A Gaussian bell whose width grows as force^(1/3): a thick soft cover."""

    width: float = 4e-3
    """Standard deviation, m, at 3 N."""

    def __call__(self, r: Array, force: Array) -> Array:
        """Pressures, Pa."""
        w = self.width * (force / 3.0) ** (1 / 3)
        return np.asarray(force / (2 * np.pi * w**2) * np.exp(-0.5 * (r / w) ** 2))


@dataclass(frozen=True, eq=False)
class Tabulated:
    """A profile by its values on a grid, interpolated by cubic splines."""

    r: Array
    """Distances (k,), m, increasing from 0."""
    force: Array
    """Forces (f,), N, increasing."""
    pressure: Array
    """Pressures (f, k), Pa."""

    @cached_property
    def _spline(self) -> RectBivariateSpline:
        return RectBivariateSpline(np.log(self.force), self.r, self.pressure, kx=3, ky=3, s=0)

    def __call__(self, r: Array, force: Array) -> Array:
        """Pressures, Pa; zero beyond the last distance. Raises ValueError for other forces."""
        r, force = np.broadcast_arrays(r, force)
        if force.size and not self.force[0] <= force.min() <= force.max() <= self.force[-1]:
            raise ValueError(
                f"forces of {force.min():.3g} to {force.max():.3g} N are outside the table of "
                f"{self.force[0]:.3g} to {self.force[-1]:.3g} N"
            )
        value = self._spline.ev(np.log(force.ravel()), r.ravel()).reshape(r.shape)
        return np.where(r <= self.r[-1], np.maximum(value, 0.0), 0.0)


def blurred(profile: Profile, sigma: float) -> Tabulated:
    """The profile behind a cover that spreads every load over a Gaussian of `sigma`, m.

    The convolution of radial functions in the plane: (G * p)(r) = integral of p(s) (s / sigma^2)
    exp(-(r^2 + s^2) / (2 sigma^2)) I_0(r s / sigma^2) ds.
    """
    r = np.arange(0.0, REACH, 5e-5)
    node, weight = roots_legendre(2000)
    s, ds = REACH * (node + 1) / 2, REACH * weight / 2
    kernel = s / sigma**2 * np.exp(-((r[:, None] - s) ** 2) / (2 * sigma**2))
    kernel *= ive(0, r[:, None] * s / sigma**2)
    return Tabulated(r, FORCES, (profile(s, FORCES[:, None]) * ds) @ kernel.T)
