"""What a mesh leaves open of the surface between its vertices, as an error of contact heights.

    h_i + e_c(i),    e_c ~ N(0, sigma^2),    sigma = rms(d) / sqrt(3)

d is the height of the smooth surface over the plane of a face. Exporters put the vertices on the
real surface, which is then the smooth one; decimation that keeps the volume puts them outside, so
that the faces are the better surface. The real one is taken to lie uniformly between the two. Its
error is alike in a cell c as wide as a face, as faces are decimated one by one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.arrays import Array, sums_by_group
from ...geometry.body import Body
from ...geometry.surface.closest_point import Closest
from ..data.registration import CELL, cells


@dataclass(frozen=True)
class MeshError:
    """The error of a body's surface."""

    sigma: float = 0.0
    """Standard deviation along the normals, m."""
    cell: float = CELL
    """Size of the cells in which it is alike, m, at least that of dents."""

    @classmethod
    def of(cls, body: Body, hit: Closest, stated: float = 0.0) -> MeshError:
        """The error of `body` about the points `hit`, and the standard deviation, m, that is
        `stated` of it; the former is zero for a primitive."""
        if body.exact is not None:
            return cls(stated)
        over = over_faces(body, hit)
        width = float(np.sqrt(np.median(body.mesh.area_faces[hit.face])))
        return cls(float(np.hypot(stated, np.sqrt(np.mean(over**2) / 3))), max(CELL, width))

    def without(self, points: Array, weight: Array, columns: Array) -> Array:
        """W columns (m, k), with W the inverse covariance (m, m) of heights at points (m, 3), m,
        that have independent errors of precisions `weight` (m,), 1/m^2, besides this one.

        W = D - D Z (Z^T D Z + 1 / sigma^2)^-1 Z^T D, with Z the membership of the cells.
        """
        cell, weighted = cells(points, self.cell), weight[:, None] * columns
        if not self.sigma:
            return np.asarray(weighted)
        share = 1 / (np.bincount(cell, weight) + self.sigma**-2)
        common = sums_by_group(weighted, cell) * share[:, None]
        return np.asarray(weighted - weight[:, None] * common[cell])


def over_faces(body: Body, hit: Closest) -> Array:
    """Heights (m,), m, of the smooth surface over the planes of the faces at the points `hit`; 0 on
    a primitive, whose surface is known."""
    if body.exact is not None:
        return np.zeros(len(hit.point))
    corner = body.mesh.triangles[hit.face, 0]
    return np.einsum("mi,mi->m", hit.point - corner, body.mesh.face_normals[hit.face])
