"""The circles of trilateration: the distance of a taxel from a contact by each reading.

Under a circular patch a reading gives one distance, across the contact's normal. Under an ellipse
with semi-axes a and b along t_1 and t_2 it gives a closed curve. In the plane scaled by g/a along
t_1 and g/b along t_2, g = sqrt(a b), that curve is a circle for a point reading, and nearly one for
a disc's mean: its radius is evaluated in the direction of the present estimate of the taxel.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Self

import numpy as np

from ...contact.ellipse import NODES, ellipse_gradient, invert_ellipse_mean
from ...core.arrays import Array, sums_by_group
from ..data.measurements import Measurements

SLOPE_FLOOR = 0.05
"""Slope of the profile, relative to p_0/a, below which the weight of a circle falls no further:
where the slope vanishes, noise over slope overstates the error of a distance that is bounded by the
patch."""


@dataclass(frozen=True)
class Circles:
    """k circles, sorted by the one of n unknown points that each belongs to."""

    owner: np.ndarray
    """Unknown point (k,) of each circle, rising."""
    reading: np.ndarray
    """Row (k,) of the reading."""
    centres: Array
    """Contact points (k, 3), m."""
    normals: Array
    """Contact normals (k, 3): a distance is measured across them."""
    radii: Array
    """Distances (k,), m."""
    weights: Array
    """1 / standard deviation of the distance (k,), 1/m."""
    steepness: Array
    """Slope of the profile (k,) relative to p_0/a."""
    patch: Array
    """Contact radius (k,), m."""
    count: int
    """n."""

    def sum(self, values: Array) -> Array:
        """Sums (n, ...) over the circles of each point, of values (k, ...)."""
        return sums_by_group(values, self.owner, self.count)

    def select(self, keep: np.ndarray) -> Self:
        """The circles where `keep` (k,) is true."""
        names = [f.name for f in fields(self) if f.name != "count"]
        return replace(self, **{name: getattr(self, name)[keep] for name in names})

    def distance(self, offset: Array) -> tuple[Array, Array]:
        """Distances (k,), m, of points `offset` (k, 3), m, from the centres, and their gradients
        (k, 3).
        """
        across = offset - self.normals * np.einsum("ki,ki->k", offset, self.normals)[:, None]
        distance = np.sqrt(np.einsum("ki,ki->k", across, across) + 1e-18)
        return distance, across / distance[:, None]

    def conic(self, offset: Array, tangents: Array) -> tuple[Array, Array]:
        """c (k, 2) and b (k,) of the equations q(y) - 2 c . y + b = r^2 of points y in planes.

        The planes pass through the points from which the centres are at `offset` (k, 3), m, along
        `tangents` (k, 3, 2). q is a quadratic form that is nearly the same for all circles of a
        point, so that differences of the equations are linear in y.
        """
        c = np.einsum("kij,ki->kj", tangents, offset)
        return c, np.einsum("kj,kj->k", c, c)


@dataclass(frozen=True)
class Ellipses(Circles):
    """Circles in planes that are scaled along the patches' axes."""

    first: Array
    """g/a t_1 (k, 3)."""
    second: Array
    """g/b t_2 (k, 3)."""

    def distance(self, offset: Array) -> tuple[Array, Array]:
        """Scaled distances (k,), m, of points `offset` (k, 3), m, and their gradients (k, 3)."""
        u, v = (np.einsum("ki,ki->k", offset, axis) for axis in (self.first, self.second))
        distance = np.sqrt(u * u + v * v + 1e-18)
        gradient = u[:, None] * self.first + v[:, None] * self.second
        return distance, gradient / distance[:, None]

    def conic(self, offset: Array, tangents: Array) -> tuple[Array, Array]:
        """c (k, 2) and b (k,) as `Circles.conic`, of the scaled distances."""
        c, b = np.zeros((len(offset), 2)), np.zeros(len(offset))
        for axis in (self.first, self.second):
            u = np.einsum("ki,ki->k", offset, axis)
            c += u[:, None] * np.einsum("kij,ki->kj", tangents, axis)
            b += u * u
        return c, b


def circles(
    data: Measurements,
    points: Array,
    rows: np.ndarray | None = None,
    owner: np.ndarray | None = None,
    nodes: int = NODES,
) -> Circles:
    """The circles of the readings `rows` (all by default), owned by their taxels or by `owner`.

    points (n, 3), m: estimates of the taxels; they and the `nodes` of the disc mean have an effect
    under elliptic patches only.
    """
    rows = np.arange(len(data.pressure)) if rows is None else rows
    owners = data.taxel[rows] if owner is None else owner
    order = np.argsort(owners, kind="stable")
    rows, owners = rows[order], owners[order]
    contact = data.contact[rows]
    scale = data.peaks[contact] / data.radii[contact]
    axes: list[Array] = []
    if data.model.name == "hertz":
        radii, steepness = data.distance[rows], data.slope[rows] / scale
    else:
        radii, steepness, axes = _scaled_distances(data, points, rows, nodes)
    found = (
        owners,
        rows,
        data.points[contact],
        data.normals[contact],
        radii,
        scale * np.hypot(steepness, SLOPE_FLOOR) / data.spread[contact],
        steepness,
        data.radii[contact],
        len(data.ids) if owner is None else int(owners.max(initial=-1)) + 1,
    )
    return Ellipses(*found, *axes) if axes else Circles(*found)


def _scaled_distances(
    data: Measurements, points: Array, rows: np.ndarray, nodes: int
) -> tuple[Array, Array, list[Array]]:
    """Scaled distance and steepness (k,) of the readings `rows`, in the directions of their taxels
    at `points`, and both scaled axes (k, 3).
    """
    distinct, inverse = np.unique(rows, return_inverse=True)
    contact = data.contact[distinct]
    patch, g = data.patches.take(contact), data.radii[contact]
    axes = data.directions[contact], np.cross(data.normals[contact], data.directions[contact])
    offset = points[data.taxel[distinct]] - data.points[contact]
    toward = np.stack([np.einsum("ki,ki->k", offset, axis) for axis in axes], axis=1)
    length = np.linalg.norm(toward, axis=1, keepdims=True)
    toward = np.where(length > 0, toward / np.where(length > 0, length, 1.0), [1.0, 0.0])
    shape = patch.first, patch.second, data.disc, patch.exponent, nodes
    r = invert_ellipse_mean(data.pressure[distinct] / patch.peak, toward, *shape)
    gradient = ellipse_gradient(r * toward[:, 0], r * toward[:, 1], *shape)[1:3]
    slope = np.einsum("ki,ik->k", toward, gradient)
    first, second = g / patch.first, g / patch.second
    scale = np.hypot(first * toward[:, 0], second * toward[:, 1])
    scaled = [
        (size[:, None] * axis)[inverse] for size, axis in zip((first, second), axes, strict=True)
    ]
    return (r * scale)[inverse], (np.abs(slope) * g / scale)[inverse], scaled
