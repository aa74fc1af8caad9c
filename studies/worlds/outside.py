"""Pressures that no contact model of the package describes: patches that are oblong or skewed, two
contacts, drag.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from . import sphere
from .profiles import REACH, Array, Profile
from .sphere import Touch
from .world import Pressures

TURN = 2.4
"""Angle, rad, from one patch that turns to the next: the golden angle, so that all occur."""


@dataclass(frozen=True)
class Oblong:
    """Elliptic patches: `profile` stretched by sqrt(aspect) along one tangent, shrunk across it."""

    profile: Profile
    aspect: float
    turns: bool = False
    """Whether the long axis differs from contact to contact."""

    def __call__(self, touch: Touch, positions: Array) -> Array:
        """Means (m, n), Pa, of the pressure over the taxels' discs."""
        first, second = sphere.tangents(touch.points)
        angle = TURN * np.arange(len(touch.points))[:, None] * self.turns + 0.5
        axis = np.cos(angle) * first + np.sin(angle) * second
        stretch = self.aspect**0.5

        def pressure(x: Array, y: Array, force: Array) -> Array:
            return self.profile(np.hypot(x / stretch, y * stretch), force)

        return over_discs(touch, positions, axis, pressure)


@dataclass(frozen=True)
class Skewed:
    """Sliding contacts that press more in front, by (1 + skew x) at x radii along the motion."""

    profile: Profile
    radius: float
    """m."""
    skew: float = 0.3

    def __call__(self, touch: Touch, positions: Array) -> Array:
        """Means (m, n), Pa, of the pressure over the taxels' discs."""
        motion = directions(touch) if len(touch.points) > 1 else sphere.tangents(touch.points)[0]

        def pressure(x: Array, y: Array, force: Array) -> Array:
            factor = np.maximum(1 + self.skew * x / self.radius, 0.0)
            return factor * self.profile(np.hypot(x, y), force)

        return over_discs(touch, positions, motion, pressure)


@dataclass(frozen=True)
class Pair:
    """A second contact of the same force beside some of the contacts."""

    pressures: Pressures
    share: float = 0.1
    """Of the contacts."""
    distance: float = 8e-3
    """Of the second contact, m, in any direction."""

    def __call__(self, touch: Touch, positions: Array) -> Array:
        """Sums (m, n), Pa."""
        rng, m = np.random.default_rng(len(touch.points)), len(touch.points)
        second = np.flatnonzero(rng.random(m) < self.share)
        angle = rng.uniform(-np.pi, np.pi, m)[second, None]
        first, other = (along[second] for along in sphere.tangents(touch.points))
        along = np.cos(angle) * first + np.sin(angle) * other
        beside = sphere.moved(touch.points[second], along, self.distance)
        pressure = self.pressures(touch, positions)
        pressure[second] += self.pressures(Touch(beside, touch.force[second]), positions)
        return pressure


@dataclass(frozen=True)
class Drag:
    """Sliding contacts: the skin is dragged along, and the patch lags behind the motion."""

    pressures: Pressures
    lag: float
    """m."""

    def __call__(self, touch: Touch, positions: Array) -> Array:
        """Pressures (m, n), Pa."""
        if len(touch.points) < 2:
            return self.pressures(touch, positions)
        points = sphere.moved(touch.points, directions(touch), -self.lag)
        return self.pressures(Touch(points, touch.force), positions)


def directions(touch: Touch) -> Array:
    """Unit tangents (m, 3) along the path of the contacts."""
    motion = np.gradient(touch.points, axis=0)
    motion -= np.sum(motion * touch.normals, axis=1, keepdims=True) * touch.normals
    return np.asarray(motion / np.linalg.norm(motion, axis=1, keepdims=True))


def over_discs(
    touch: Touch, positions: Array, axis: Array, pressure: Callable[[Array, Array, Array], Array]
) -> Array:
    """Means (m, n), Pa, over the discs of taxels at `positions` (n, 3), m, of the pressure (x, y,
    force) -> Pa at distances x, y (k,), m, along unit tangents `axis` (m, 3) and across them."""
    offset = positions - touch.points[:, None, :]
    across = np.cross(touch.normals, axis)
    x, y = (np.einsum("mnj,mj->mn", offset, along) for along in (axis, across))
    near = np.hypot(x, y) < REACH
    force = np.broadcast_to(touch.force[:, None], near.shape)[near]
    node, weight = np.polynomial.legendre.leggauss(6)
    out, mean = np.zeros_like(x), np.zeros(len(force))
    for radius, w in zip(sphere.DISC_RADIUS * np.sqrt((node + 1) / 2), weight, strict=True):
        for turn in 2 * np.pi * np.arange(12) / 12:
            u, v = x[near] + radius * np.cos(turn), y[near] + radius * np.sin(turn)
            mean += w / 24 * pressure(u, v, force)
    out[near] = mean
    return out
