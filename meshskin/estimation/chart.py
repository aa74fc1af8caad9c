"""Local coordinates on a body's surface: x(y) = x_0 + T y - n/2 y^T K y, with y (2,) in m.

T holds two tangents, n is the outward normal, K the shape operator in T's basis (positive where
convex). Estimators move in charts and linearize them again about the closest surface points until
they no longer move, so that the result is on the surface exactly; K only speeds convergence.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from ..contact.reading import SHEET_FACING
from ..core.arrays import Array
from ..core.se3 import orthonormal_basis, perpendicular, shortest_rotation, transform
from ..geometry.body import Body
from ..geometry.surface.closest_point import Closest

STEP = 1e-4
"""Step of the central difference that gives the curvature from the normals, m: small against the
radii of curvature, and large enough for rounding errors of 1e-12 1/m."""
COVER = 4e-3
"""Height over a place, m, up to which a sheet covers it: more than a contact admits between a taxel
and itself (contact.reading.same_sheet) at 8 mm, and too little for an indenter to get below."""
SAME = 1e-6
"""Height, m, up to which two places are on one sheet: rays have single precision."""


@dataclass(frozen=True)
class Charts:
    """n charts, each about a point of the surface."""

    points: Array
    """x_0 (n, 3), m."""
    normals: Array
    """n (n, 3)."""
    tangents: Array
    """T (n, 3, 2), orthonormal."""
    shape: Array
    """K (n, 2, 2), 1/m, symmetric."""
    height: Array
    """Heights (n,) of the points over the surface, m."""

    @property
    def rotations(self) -> Array:
        """Frames (n, 3, 3): the tangents and the normal as columns."""
        return np.concatenate([self.tangents, self.normals[:, :, None]], axis=2)

    def __getitem__(self, rows: ArrayLike) -> Charts:
        """The charts of the given rows."""
        i = np.asarray(rows)
        return Charts(*(values[i] for values in vars(self).values()))

    def at(self, y: Array) -> Array:
        """Points (n, 3) at the coordinates `y` (n, 2), m."""
        sag = 0.5 * np.einsum("ni,nij,nj->n", y, self.shape, y)
        return self.points + np.einsum("nij,nj->ni", self.tangents, y) - self.normals * sag[:, None]

    def slope(self, y: Array) -> Array:
        """dx/dy (n, 3, 2) at the coordinates `y` (n, 2), m."""
        sag = np.einsum("nij,nj->ni", self.shape, y)
        return np.asarray(self.tangents - self.normals[:, :, None] * sag[:, None, :])


def charts_at(
    body: Body, points: Array, reference: Array | None = None, height: Array | float = 0.0
) -> Charts:
    """Charts about the surface points closest to `points` (n, 3), body frame, m, or as far above
    them as `height` (n,), m.

    reference (n, 3, 3): frames nearby, which the tangents continue by the shortest rotation; by
    default the tangents are those of `frames`.
    """
    hit = body.closest(points)
    rotation = frames(hit.normal) if reference is None else align_normals(reference, hit.normal)
    tangents = rotation[:, :, :2]
    steps = STEP * np.concatenate([tangents, -tangents], axis=2).transpose(0, 2, 1)  # (n, 4, 3)
    around = body.closest((hit.point[:, None] + steps).reshape(-1, 3)).normal.reshape(-1, 4, 3)
    slope = (around[:, :2] - around[:, 2:]) / (2 * STEP)  # dn along each tangent
    shape = np.einsum("nai,nib->nab", slope, tangents)
    height = np.broadcast_to(height, len(points))
    above = hit.point + height[:, None] * hit.normal
    return Charts(above, hit.normal, tangents, (shape + shape.transpose(0, 2, 1)) / 2, height)


def relinearized(body: Body, charts: Charts, y: Array) -> Charts:
    """Charts about the surface points closest to those of `charts` at `y` (n, 2), m.

    The tangents are continued by the shortest rotation; shape operators and heights are kept.
    """
    hit = uncovered(body, body.closest(charts.at(y)))
    rotation = align_normals(charts.rotations, hit.normal)
    above = hit.point + charts.height[:, None] * hit.normal
    return replace(charts, points=above, normals=hit.normal, tangents=rotation[:, :, :2])


def uncovered(body: Body, hit: Closest) -> Closest:
    """Surface points `hit`, where another sheet covers them that of this sheet above.

    Beyond the border of a sheet the closest point is on the one below, and back from there it stays
    below, where no indenter presses; the readings do not tell, as they depend on the place in the
    tangent plane alone.
    """
    if not hasattr(body, "project") or body.surface.smooth:
        return hit
    top = hit.point + COVER * hit.normal
    rows = np.flatnonzero(body.meets(top, -hit.normal) < COVER - body.surface.offsets[hit.face])
    above = body.project(top[rows], -hit.normal[rows])
    alike = np.einsum("ni,ni->n", above.normal, hit.normal[rows]) > SHEET_FACING
    over = alike & (above.distance < COVER - SAME)
    if not over.any():
        return hit
    values = {name: value.copy() for name, value in vars(hit).items()}
    for name, value in vars(above).items():
        values[name][rows[over]] = value[over]
    return replace(hit, **values)


def align_normals(rotations: Array, normals: Array) -> Array:
    """Frames (n, 3, 3) after the shortest rotations that take their z axes to `normals` (n, 3)."""
    broadcast = np.broadcast_to(rotations, (len(normals), 3, 3))
    return np.asarray(shortest_rotation(broadcast[:, :, 2], normals) @ broadcast)


def frames(normals: Array) -> Array:
    """Frames (n, 3, 3) with z = normal, and x transported from one frame at the mean normal.

    It is discontinuous only opposite to the mean normal. The rotation about z is a convention.
    """
    mean = normals.mean(axis=0)
    length = np.linalg.norm(mean)
    mean = mean / length if length > 1e-6 else normals[0]
    return align_normals(orthonormal_basis(mean, perpendicular(mean)), normals)


def tangential_square(tangents: Array, apart: Array) -> Array:
    """Outer products (n, 2, 2), m^2, of displacements `apart` (n, 3), m, along the tangents
    (n, 3, 2): what they add to covariances there as standard deviations."""
    along = np.einsum("nij,ni->nj", tangents, apart)
    return np.asarray(along[:, :, None] * along[:, None, :])


def poses(points: Array, rotations: Array) -> Array:
    """Poses (n, 4, 4); NaN where the point is NaN."""
    return transform(np.where(np.isfinite(points)[:, :1, None], rotations, np.nan), points)
