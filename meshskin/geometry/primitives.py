"""Exact surfaces of the primitives, centred at the origin.

Each has `closest(points)` like a body; `face` is -1 and `uv` zero. Curvatures from do Carmo,
"Differential Geometry of Curves and Surfaces", chapter 3.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import Array
from ..core.se3 import orthonormal_basis, perpendicular
from .surface.closest_point import Closest

MIN_TANGENT = 1e-9
"""norm of a tangent below which it is rounding, and any other is taken"""


def _points(points: ArrayLike) -> Array:
    return np.asarray(points, dtype=float).reshape(-1, 3)


def _unit(vectors: Array, fallback: tuple[float, float, float]) -> tuple[Array, Array]:
    """Unit vectors (n, 3) and norms (n,); the fallback for zero vectors."""
    length = np.linalg.norm(vectors, axis=1)
    safe = np.where(length > 0, length, 1.0)[:, None]
    return np.where(length[:, None] > 0, vectors / safe, fallback), length


def _answer(
    foot: Array, distance: Array, normal: Array, k1: ArrayLike, k2: ArrayLike, first: Array
) -> Closest:
    """The result for curvatures k1 >= k2 (n,); `first` (n, 3): tangents along k1, or zero."""
    n = len(foot)
    curvature = np.stack([np.broadcast_to(k1, n), np.broadcast_to(k2, n)], axis=1)
    nowhere = np.linalg.norm(first, axis=1, keepdims=True) < MIN_TANGENT
    direction, _ = _unit(np.where(nowhere, perpendicular(normal), first), (1.0, 0.0, 0.0))
    return Closest(foot, distance, normal, curvature, direction, np.full(n, -1), np.zeros((n, 2)))


def _round(normal: Array) -> Array:
    """Tangents (n, 3) around the z axis; zero on it."""
    return np.stack([-normal[:, 1], normal[:, 0], np.zeros(len(normal))], axis=1)


def _steepest(normal: Array, radii: Array) -> Array:
    """Tangents (n, 3) along the first principal curvature of an ellipsoid.

    Up to its length the shape operator is diag(1/r^2), restricted to the tangent plane.
    """
    t1, t2, _ = np.moveaxis(orthonormal_basis(normal, perpendicular(normal)), 2, 0)
    a, b, c = (np.sum(s * t / radii**2, axis=1) for s, t in ((t1, t1), (t1, t2), (t2, t2)))
    angle = 0.5 * np.arctan2(2.0 * b, a - c)[:, None]
    return np.asarray(np.cos(angle) * t1 + np.sin(angle) * t2)


@dataclass(frozen=True)
class Sphere:
    """Sphere of a radius in m."""

    radius: float

    def closest(self, points: ArrayLike) -> Closest:
        """Closest points of (n, 3) points, m; the centre goes to the pole +z."""
        normal, length = _unit(_points(points), (0.0, 0.0, 1.0))
        k = 1.0 / self.radius
        return _answer(
            self.radius * normal, length - self.radius, normal, k, k, perpendicular(normal)
        )


@dataclass(frozen=True)
class Capsule:
    """Cylinder of a radius along z, `length` long, closed by half spheres (m)."""

    radius: float
    length: float

    def closest(self, points: ArrayLike) -> Closest:
        """Closest points of (n, 3) points, m; on the seams the curvature is the half sphere's."""
        p = _points(points)
        half = 0.5 * self.length
        axis = np.zeros_like(p)
        axis[:, 2] = np.clip(p[:, 2], -half, half)
        normal, gap = _unit(p - axis, (1.0, 0.0, 0.0))
        k = 1.0 / self.radius
        second = np.where(np.abs(p[:, 2]) < half, 0.0, k)
        return _answer(
            axis + self.radius * normal, gap - self.radius, normal, k, second, _round(normal)
        )


@dataclass(frozen=True)
class Cylinder:
    """Cylinder of a radius along z, `length` long, closed by flat caps (m)."""

    radius: float
    length: float

    def closest(self, points: ArrayLike) -> Closest:
        """Closest points of (n, 3) points, m.

        On a rim the normal points from the foot to the point, and the curvature is the side's.
        Points on the axis, nearer to the side than to a cap, go to +x.
        """
        p = _points(points)
        half = 0.5 * self.length
        radial, reach = _unit(p * [1.0, 1.0, 0.0], (1.0, 0.0, 0.0))
        up = np.where(p[:, 2:] < 0.0, -1.0, 1.0) * [0.0, 0.0, 1.0]
        side, cap = reach - self.radius, np.abs(p[:, 2]) - half
        rim = (side > 0.0) & (cap > 0.0)
        flat = (cap >= side) & ~rim
        foot = radial * np.where(flat, reach, self.radius)[:, None]
        foot[:, 2] = np.where(rim | flat, half * up[:, 2], p[:, 2])
        corner, gap = _unit(p - foot, (1.0, 0.0, 0.0))
        normal = np.where(rim[:, None], corner, np.where(flat[:, None], up, radial))
        distance = np.where(rim, gap, np.maximum(side, cap))
        side = np.where(flat, 0.0, 1.0 / self.radius)
        return _answer(foot, distance, normal, side, 0.0, _round(normal))


@dataclass(frozen=True)
class Torus:
    """Torus about z: a circle of radius `minor` carried round a circle of radius `major` (m)."""

    major: float
    minor: float

    def closest(self, points: ArrayLike) -> Closest:
        """Closest points of (n, 3) points, m; points on the axis go to +x."""
        p = _points(points)
        flat = p * [1.0, 1.0, 0.0]
        radial, _ = _unit(flat, (1.0, 0.0, 0.0))
        normal, gap = _unit(p - self.major * radial, (0.0, 0.0, 1.0))
        outward = np.sum(normal * radial, axis=1)
        foot = self.major * radial + self.minor * normal
        around = outward / (self.major + self.minor * outward)
        meridian = np.cross(_round(radial), normal)
        return _answer(foot, gap - self.minor, normal, 1.0 / self.minor, around, meridian)


@dataclass(frozen=True)
class Ellipsoid:
    """Ellipsoid of three semi-axes along x, y, z (m)."""

    radii: tuple[float, float, float]

    def closest(self, points: ArrayLike) -> Closest:
        """Closest points of (n, 3) points, m, by bisection and Newton on the multiplier.

        Source: Eberly, "Distance from a Point to an Ellipse, an Ellipsoid, or a Hyperellipsoid".
        """
        p = _points(points)
        r = np.asarray(self.radii, dtype=float)
        y = np.maximum(np.abs(p), 1e-12 * r.min())  # off the symmetry planes: one root, no cases
        low = np.max(r * y - r**2, axis=1)  # f(low) >= 0 >= f(high) for the falling f below
        high = np.linalg.norm(r * y, axis=1) - np.min(r) ** 2
        t = 0.5 * (low + high)
        for _ in range(200):
            q = r * y / (t[:, None] + r**2)
            f = np.sum(q**2, axis=1) - 1.0
            low, high = np.where(f > 0, t, low), np.where(f > 0, high, t)
            newton = t + 0.5 * f / np.sum(q**2 / (t[:, None] + r**2), axis=1)
            after = np.where((newton > low) & (newton < high), newton, 0.5 * (low + high))
            if np.all(np.abs(after - t) <= 1e-16 * r.max() ** 2):
                break
            t = after
        foot = np.copysign(r**2 * y / (t[:, None] + r**2), p)
        foot /= np.sqrt(np.sum((foot / r) ** 2, axis=1))[:, None]
        normal, steep = _unit(foot / r**2, (0.0, 0.0, 1.0))
        distance = np.copysign(np.linalg.norm(p - foot, axis=1), np.sum((p / r) ** 2, axis=1) - 1.0)
        gauss = 1.0 / (np.prod(r) ** 2 * steep**4)
        mean = (np.sum(r**2) - np.sum(foot**2, axis=1)) / (2.0 * np.prod(r) ** 2 * steep**3)
        spread = np.sqrt(np.maximum(mean**2 - gauss, 0.0))
        first = _steepest(normal, r)
        return _answer(foot, distance, normal, mean + spread, mean - spread, first)
