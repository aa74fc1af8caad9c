"""The place of every catalogue world: a cap of taxels on a sphere, touched along a spiral."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from .profiles import Array

RADIUS, INDENTER_RADIUS = 0.1, 0.01
"""Radii of body and indenter, m."""
DISC_RADIUS, SPACING = 2e-3, 5e-3
"""Radius of a taxel's disc and distance of neighbours, m."""
MARGIN = 5.5e-3
"""Width, m, of the band outside the outermost taxels that is touched, too."""
FORCE, FORCE_SPREAD = 3.0, 0.05
"""Mean contact force, N, and the standard deviation of its logarithm."""
WAVES = 200
"""Cosines of a random field."""
FRAME = 0.05
"""Time from one contact to the next, s."""


@dataclass(frozen=True)
class Touch:
    """m contacts: what is pressed where."""

    points: Array
    """Contact points (m, 3), m, on the sphere about the origin."""
    force: Array
    """Forces (m,), N."""

    @property
    def normals(self) -> Array:
        """Outward normals (m, 3)."""
        return self.points / np.linalg.norm(self.points, axis=1, keepdims=True)


def taxels(count: int, seed: int) -> Array:
    """Positions (count, 3), m: a hexagonal lattice of any origin and heading, laid on the cap."""
    rng = np.random.default_rng([seed, 0])
    k = np.arange(-40, 41)
    i, j = (g.ravel() for g in np.meshgrid(k, k))
    flat = SPACING * np.column_stack([i + 0.5 * j, np.sqrt(0.75) * j])
    flat += SPACING * rng.uniform(-0.5, 0.5, 2)
    near = flat[np.argsort(np.hypot(*flat.T), kind="stable")[:count]]
    turn = rng.uniform(-np.pi, np.pi)
    c, s = np.cos(turn), np.sin(turn)
    return on_sphere(near @ np.array([[c, s], [-s, c]]))


def spiral(count: int, positions: Array, seed: int) -> Touch:
    """Contacts evenly over the skin and MARGIN around it, from the middle outwards, in time order.

    The turns are as far apart as neighbours on a turn; forces vary by FORCE_SPREAD.
    """
    rng = np.random.default_rng([seed, 1])
    reach = RADIUS * np.arccos(np.clip(positions[:, 2] / RADIUS, -1, 1)).max() + MARGIN
    radius = reach * np.sqrt((np.arange(count) + 0.5) / count)
    angle = 2 * np.pi * radius / np.sqrt(np.pi * reach**2 / count) + rng.uniform(-np.pi, np.pi)
    flat = radius[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return Touch(on_sphere(flat), FORCE * np.exp(FORCE_SPREAD * rng.normal(size=count)))


def on_sphere(flat: Array) -> Array:
    """Points (k, 3), m, at the arc lengths and headings of `flat` (k, 2), m, from the pole."""
    length = np.hypot(*flat.T)
    heading = flat / np.maximum(length, 1e-300)[:, None]
    angle = length / RADIUS
    return RADIUS * np.column_stack([np.sin(angle)[:, None] * heading, np.cos(angle)])


def disc_nodes() -> Array:
    """Nodes (200, 2), m, of equal weights on a taxel's disc: rings, each mirrored in both axes.

    A pattern that is not symmetric would shift every reading to one side.
    """
    radius = DISC_RADIUS * np.sqrt((np.arange(10) + 0.5) / 10)
    angle = 2 * np.pi * (np.arange(20) + 0.5) / 20
    nodes = radius[:, None, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return np.asarray(nodes.reshape(-1, 2))


def tangents(points: Array) -> tuple[Array, Array]:
    """Two orthonormal tangents (k, 3) of the sphere at each point."""
    normal = points / np.linalg.norm(points, axis=1, keepdims=True)
    first = np.cross(normal, [0.0, 1.0, 0.0])
    first /= np.linalg.norm(first, axis=1, keepdims=True)
    return first, np.cross(normal, first)


def moved(points: Array, along: Array, by: Array | float) -> Array:
    """Points (k, 3) of the sphere, moved by `by`, m, along tangents (k, 3), and put back on it."""
    out = points + np.reshape(by, (-1, 1)) * along
    return np.asarray(RADIUS * out / np.linalg.norm(out, axis=1, keepdims=True))


def scattered(touch: Touch, sigma: Array, seed: int) -> Touch:
    """The contacts as a robot measures them: off by `sigma` (m,), m, along each of two tangents."""
    first, second = tangents(touch.points)
    off = sigma * np.random.default_rng([seed, 2]).normal(size=(2, len(touch.points)))
    return replace(touch, points=moved(moved(touch.points, first, off[0]), second, off[1]))


def advanced(touch: Touch, frames: float) -> Touch:
    """The contacts where they are `frames` later."""
    return replace(touch, points=moved(touch.points, np.gradient(touch.points, axis=0), frames))


def stiffness(points: Array, length: float, seed: int) -> Array:
    """A Gaussian random field (m,) of deviation 1 at the points, correlated over `length`, m.

    Random Fourier features (Rahimi and Recht, 2007) of the squared exponential.
    """
    rng = np.random.default_rng([seed, 9])
    waves, phases = rng.normal(size=(3, WAVES)) / length, rng.uniform(0, 2 * np.pi, WAVES)
    return np.asarray(np.sqrt(2 / WAVES) * np.cos(points @ waves + phases).sum(axis=1))


def distances(touch: Touch, positions: Array) -> Array:
    """Distances (m, n), m, of the positions from the contact points across the contact normals."""
    offset = positions - touch.points[:, None, :]
    along = np.einsum("mnj,mj->mn", offset, touch.normals)
    return np.sqrt(np.maximum(np.sum(offset**2, axis=2) - along**2, 0.0))
