"""The unknowns of a layout, rigid modules in the plane or taxels on a body, and their best values.

A placement gives positions (n, D), their distances along the skin, and the derivative of the
positions with respect to its unknowns; it moves, and its stress is minimized by damped Gauss-Newton
steps.

On a body, it is at the place whose curvature agrees with it best. A body that looks the same in
several places, as a sphere does everywhere, does not tell them apart: the misfits of all places
tried say how far it does.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, Protocol, TypeVar

import numpy as np
from scipy.sparse import csr_array

from ...core.arrays import Array, far_apart, means_by_group
from ...core.se3 import orthonormal_basis
from ...geometry.body import Body
from .. import chart
from . import stress
from .alignment import aligned

T = TypeVar("T", bound="Placement")

MOVED = 1e-6
"""Largest step, m, at which a placement has converged."""
ITERATIONS = 60
"""Most Gauss-Newton steps: from a plane layout, 10 to 20 converge."""
MAX_DAMPING = 1e6
"""Damping from which no step lowers the stress."""

PLACES, TURNS = 24, 8
"""Places on a body and turns about its normal that are tried, with both mirror images: 45 degrees
apart, from which the taxels find their way."""
KEPT = 16
"""Placements, of those that start well, whose taxels are settled."""
ALIKE = 1.1
"""Misfit over that of the best placement up to which another starts as well: the best start is
often not the best end."""
EQUAL = 1.02
"""Misfit over that of the best settled placement up to which the distances do not tell them apart:
on the shipped scenes it differs by less than 1 % where the shapes differ by half a pitch."""


class Placement(Protocol):
    """Taxels of a layout and their unknowns."""

    @property
    def positions(self) -> Array:
        """(n, D), m."""

    @property
    def bulge(self) -> Array:
        """Distance along the skin over the straight one, (n, n)."""

    def jacobian(self) -> Any:
        """Derivative (n D, q) of the positions with respect to the unknowns: a sparse array."""

    def moved(self: T, step: Array) -> T:
        """The placement after a step (q,) of the unknowns."""


@dataclass(frozen=True)
class OnBody:
    """Taxels on the surface of a body: two unknowns each, along its tangents."""

    body: Body
    positions: Array
    """(n, 3), m"""
    rotations: Array
    """(n, 3, 3): two tangents and the normal."""

    @classmethod
    def at(cls, body: Body, points: Array) -> OnBody:
        """Taxels at the points of the body closest to `points` (n, 3), m."""
        hit = body.closest(points)
        return cls(body, hit.point, chart.frames(hit.normal))

    @property
    def bulge(self) -> Array:
        """By the arc whose normals at the ends are those of the body: exact on a sphere."""
        normals = self.rotations[:, :, 2]
        half = 0.5 * np.arccos(np.clip(normals @ normals.T, -1.0, 1.0))
        return np.asarray(1.0 / np.sinc(half / np.pi))

    @property
    def along(self) -> Array:
        """Distances (n, n) along the skin, m."""
        return self.bulge * stress.distances(self.positions)

    def jacobian(self) -> Any:
        """(3 n, 2 n): the tangents."""
        n = len(self.positions)
        row = np.arange(3 * n).reshape(n, 3, 1).repeat(2, axis=2)
        column = (2 * np.arange(n)[:, None, None] + np.arange(2)).repeat(3, axis=1)
        tangents = self.rotations[:, :, :2]
        return csr_array((tangents.ravel(), (row.ravel(), column.ravel())), shape=(3 * n, 2 * n))

    def moved(self, step: Array) -> OnBody:
        """On the body, after displacements `step` (2 n,), m, along the tangents."""
        move = np.einsum("nda,na->nd", self.rotations[:, :, :2], step.reshape(-1, 2))
        return OnBody.at(self.body, self.positions + move)


@dataclass(frozen=True)
class Modules:
    """Rigid modules in the plane: a translation and an angle each."""

    module: np.ndarray
    """Module (n,) of each taxel, 0 to m - 1."""
    offsets: Array
    """Positions (n, 2) in the modules' frames, m."""
    origins: Array
    """Origins (m, 2) of the modules, m."""
    angles: Array
    """(m,), rad"""

    @property
    def _arms(self) -> Array:
        """From the origin of its module to each taxel (n, 2)."""
        return rotated(self.offsets, self.angles[self.module])

    @property
    def positions(self) -> Array:
        """(n, 2), m"""
        return self.origins[self.module] + self._arms

    @property
    def bulge(self) -> Array:
        """1: the plane is flat."""
        return np.ones((len(self.module),) * 2)

    def jacobian(self) -> Any:
        """(2 n, 3 m): two translations, then the angle, of each module."""
        n, arms = len(self.module), self._arms
        value = np.zeros((n, 2, 3))
        value[:, 0, 0] = value[:, 1, 1] = 1.0
        value[:, :, 2] = np.column_stack([-arms[:, 1], arms[:, 0]])
        row = np.arange(2 * n).reshape(n, 2, 1).repeat(3, axis=2)
        column = (3 * self.module[:, None, None] + np.arange(3)).repeat(2, axis=1)
        entries = (value.ravel(), (row.ravel(), column.ravel()))
        return csr_array(entries, shape=(2 * n, 3 * len(self.angles)))

    def moved(self, step: Array) -> Modules:
        """After a step (3 m,)."""
        part = step.reshape(-1, 3)
        origins, angles = self.origins + part[:, :2], self.angles + part[:, 2]
        return replace(self, origins=origins, angles=angles)


def fitted_modules(module: np.ndarray, offsets: Array, points: Array) -> tuple[Modules, float]:
    """Modules fitted to `points` (n, 2) of any unit and either handedness, by least squares.

    Returns them, in m, and the unit of the points, m. The mirror image that fits better is taken:
    the slots of a module tell left from right.
    """
    inner = means_by_group(offsets, module)
    o, fits = offsets - inner[module], []
    for image in (points, points * [1.0, -1.0]):
        outer = means_by_group(image, module)
        x = image - outer[module]
        unit = float(np.sqrt(np.sum(o**2) / np.sum(x**2)))
        turn = np.bincount(module, o[:, 0] * x[:, 1] - o[:, 1] * x[:, 0])
        angles = np.arctan2(turn, np.bincount(module, np.sum(o * x, axis=1)))
        found = Modules(module, offsets, unit * outer - rotated(inner, angles), angles)
        fits.append((float(np.sum((found.positions - unit * image) ** 2)), found, unit))
    return min(fits, key=lambda fit: fit[0])[1:]


def rotated(points: Array, angles: Array | float) -> Array:
    """Points (k, 2) turned by `angles` (k,) or one angle, rad, about the origin."""
    cosine, sine = np.cos(angles), np.sin(angles)
    x, y = points.T
    return np.column_stack([cosine * x - sine * y, sine * x + cosine * y])


def settled(
    start: T, lengths: Array, unit: float, free: bool, weight: Array | None = None
) -> tuple[T, float]:
    """The placement of least stress for `lengths` (n, n) in a unit, m, and that unit.

    free: the unit is estimated, too, from the value given. weight (n, n): by default that of
    relative errors.
    """
    weight = stress.weights(lengths) if weight is None else weight
    placement, cost, damping = start, _stress(start, lengths, weight, unit), 1e-3
    for _ in range(ITERATIONS):
        matrix, gradient = _normal_equations(placement, lengths, weight, unit)
        if not free:
            matrix[-1, :] = matrix[:, -1] = gradient[-1] = 0.0
            matrix[-1, -1] = 1.0
        diagonal = np.diag(matrix).copy()
        floor = 1e-9 * float(diagonal.mean())
        while True:
            damped = matrix + np.diag(damping * diagonal + floor)
            step: Array = -np.linalg.solve(damped, gradient).astype(float)
            trial = placement.moved(step[:-1])
            value = _stress(trial, lengths, weight, unit + step[-1])
            if value <= cost or damping > MAX_DAMPING:
                break
            damping *= 10.0
        if value > cost:
            break
        moved = float(np.abs(trial.positions - placement.positions).max())
        placement, cost, unit = trial, value, unit + float(step[-1])
        damping = max(damping / 10.0, 1e-9)
        if moved < MOVED:
            break
    return placement, unit


def _stress(placement: Placement, lengths: Array, weight: Array, unit: float) -> float:
    """Half the stress, m^2: each pair is in the sum twice."""
    along = placement.bulge * stress.distances(placement.positions)
    return 0.25 * float(np.sum(weight * (along - unit * lengths) ** 2))


def _normal_equations(
    placement: Placement, lengths: Array, weight: Array, unit: float
) -> tuple[Array, Array]:
    """Gauss-Newton matrix (q + 1, q + 1) and gradient of the stress; the last unknown: the unit."""
    x, bulge = placement.positions, placement.bulge
    n, dimension = x.shape
    offset = x[:, None] - x[None]
    straight = np.maximum(np.linalg.norm(offset, axis=2), 1e-12)
    slope = bulge[:, :, None] * offset / straight[:, :, None]  # d distance_ij / d x_i
    residual = weight * (bulge * straight - unit * lengths)
    blocks = -np.einsum("ij,ija,ijb->iajb", weight, slope, slope)
    own = np.einsum("ij,ija,ijb->iab", weight, slope, slope)
    blocks[np.arange(n), :, np.arange(n), :] += own
    jacobian = placement.jacobian()
    size = n * dimension
    inner = jacobian.T @ (jacobian.T @ blocks.reshape(size, size)).T
    border = -jacobian.T @ np.einsum("ij,ija->ia", weight * lengths, slope).ravel()
    matrix = np.block([[inner, border[:, None]], [border, 0.5 * np.sum(weight * lengths**2)]])
    toward = jacobian.T @ np.einsum("ij,ija->ia", residual, slope).ravel()
    return matrix, np.append(toward, -0.5 * np.sum(residual * lengths))


def places_on(body: Body) -> Array:
    """Places (p, 3), m, all over the body, where the middle of a skin may be."""
    vertices = np.asarray(body.facets.vertices)
    order = np.random.default_rng(0).permutation(len(vertices))
    apart = float(np.linalg.norm(np.ptp(vertices, axis=0))) / PLACES
    return np.asarray(vertices[far_apart(vertices, order, apart, PLACES)])


def best_on_body(
    body: Body, plane: Array, lengths: Array, unit: float, middles: Array
) -> tuple[OnBody, Array, int]:
    """The placement of least stress of a layout `plane` (n, 2), m, on a body.

    lengths (n, n) in a `unit`, m; middles (p, 3): where the middle of the layout is tried. Of
    placements that fit equally well, it is the one most like the others. Returns it, the root mean
    square distances (n,), m, of its taxels from those of the others, aligned, and the number of
    middles where one starts as well.
    """
    trials = [
        (start, k) for k, middle in enumerate(middles) for start in _starts(body, plane, middle)
    ]
    cost = np.array([stress.misfit(start.along, lengths, unit) for start, _ in trials])
    good = np.flatnonzero(cost <= ALIKE * cost.min())
    tried = good[np.unique(np.linspace(0, len(good) - 1, KEPT).astype(int))]
    ends = [settled(trials[k][0], lengths, unit, free=False)[0] for k in tried]
    ends.sort(key=lambda end: stress.misfit(end.along, lengths, unit))
    least = stress.misfit(ends[0].along, lengths, unit)
    equal = [e.positions for e in ends if stress.misfit(e.along, lengths, unit) <= EQUAL * least]
    square = np.array([[np.sum((aligned(b, a) - a) ** 2, axis=1) for b in equal] for a in equal])
    chosen = int(np.argmin(np.median(square.mean(axis=2), axis=1)))
    spread = np.sqrt(square[chosen].mean(axis=0))
    return ends[chosen], spread, len({trials[k][1] for k in good})


def _starts(body: Body, plane: Array, middle: Array) -> list[OnBody]:
    """Placements with the layout's middle at a point of the body, in all turns and both images."""
    hit = body.closest(middle[None])
    basis = orthonormal_basis(hit.normal[0])[:, :2]
    centred = plane - plane.mean(axis=0)
    return [
        OnBody.at(body, hit.point[0] + rotated(centred * [1.0, image], angle) @ basis.T)
        for angle in 2 * np.pi * np.arange(TURNS) / TURNS
        for image in (1.0, -1.0)
    ]
