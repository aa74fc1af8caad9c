"""What published kinds of sensors read under a rigid sphere, in closed form: readings (r; F).

r is the distance from the contact point, m; F the normal force, N; R the relative radius of
curvature, m. Readings are scaled to pressures, Pa.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from .profiles import Array, Winkler


@dataclass(frozen=True)
class Barometer:
    """A barometer cast in incompressible rubber: the hydrostatic pressure under a point force.

    Source: Johnson, section 3.2; the sensor: Y. Tenzer, L. Jentoft and R. Howe, The feel of MEMS
    barometers, IEEE Robotics and Automation Magazine 21 (2014).
    """

    depth: float = 3e-3
    """Of the barometer below the surface, m."""

    def __call__(self, r: Array, force: Array) -> Array:
        """Pressures, Pa."""
        return np.asarray(force * self.depth / (2 * np.pi * np.hypot(r, self.depth) ** 3))


@dataclass(frozen=True)
class Capacitor:
    """A capacitor whose dielectric is a foundation of neo-Hookean columns: it reads the relative
    rise of the capacitance, which grows without limit as the gap closes.

    Stress under a stretch s: G (1 / s^2 - s). Source: L. Treloar, The Physics of Rubber Elasticity
    (1975), section 5.2; the sensor: A. Schmitz and others, IEEE Transactions on Robotics 27 (2011).
    """

    shear: float = 30e3
    """G, Pa."""
    gap: float = 2e-3
    """m."""
    radius: float = Winkler().radius
    """R, m."""

    def __call__(self, r: Array, force: Array) -> Array:
        """Rises of the capacitance times G, Pa."""
        # F = 2 pi R gap G (1 / s + s^2 / 2 - 3 / 2), s the stretch in the middle
        load = np.asarray(force / (2 * np.pi * self.radius * self.gap * self.shear))
        low, high = np.zeros_like(load), np.ones_like(load)
        for _ in range(60):
            s = (low + high) / 2
            harder = 1 / s + s**2 / 2 - 1.5 > load
            low, high = np.where(harder, s, low), np.where(harder, high, s)
        stretch = np.minimum(high + r**2 / (2 * self.radius * self.gap), 1.0)
        return np.asarray(self.shear * (1 / stretch - 1))


@dataclass(frozen=True)
class Magnet:
    """A magnet in incompressible rubber above a magnetometer: the change of its field, read as the
    length of three components.

    Both move as points of a half-space under a point force. Source: Johnson, section 3.2; J. D.
    Jackson, Classical Electrodynamics (1999), section 5.6; the sensor: T. P. Tomo and others, IEEE
    Robotics and Automation Letters 3 (2018).
    """

    shear: float = 0.3e6
    """Shear modulus, Pa."""
    depth: float = 2.5e-3
    """Of the magnet below the surface, m."""
    height: float = 3e-3
    """Of the magnet above the magnetometer, m."""

    def __call__(self, r: Array, force: Array) -> Array:
        """Changes of the field, relative to the field at rest, times the shear modulus, Pa."""
        r, force = np.broadcast_arrays(r, force)
        moved = self._moved(r, force, self.depth)
        moved = moved - self._moved(r, force, self.depth + self.height)
        along, across = 1 - moved[0] / self.height, moved[1] / self.height
        length = np.hypot(along, across)
        axial = (1.5 * (along / length) ** 2 - 0.5) / length**3
        radial = 1.5 * along * across / length**5
        return np.asarray(self.shear * np.hypot(axial - 1, radial))

    def _moved(self, r: Array, force: Array, z: float) -> Array:
        """Displacements (2, ...), m, down and outwards, of points at a depth z, m."""
        length = np.hypot(r, z)
        down, out = z**2 / length**3 + 1 / length, r * z / length**3
        return np.asarray(force / (4 * np.pi * self.shear) * np.stack([down, out]))
