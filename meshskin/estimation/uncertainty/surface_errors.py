"""Errors of the believed surface: along its normals, and those of its size."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ...core.arrays import Array

if TYPE_CHECKING:
    from ...geometry.body import Body
    from ..data.measurements import Measurements

LEAST_HEIGHT = 0.1
"""Least distance of the surface from the middle, along the normals, relative to the diagonal of the
bounds: a flat sheet of skin is part of a body, whose size does not follow from it; a ball has 0.29,
a cylinder eight times as long as its radius 0.19."""


def growth(body: Body, points: Array) -> Array:
    """Displacements (n, 3) of points (n, 3), m, on a body that grows about its middle until its
    surface has moved by 1 along the normals, in the root mean square over its area.

    Contact points of a body and of an indenter's pose that have the same wrong scale lie on the
    surface, and a learned response has no length: no reading shows it.
    """
    mesh = body.mesh
    middle = mesh.bounds.mean(axis=0)
    height = np.einsum("fi,fi->f", mesh.triangles_center - middle, mesh.face_normals)
    mean = float(np.sqrt(np.average(height**2, weights=mesh.area_faces)))
    least = LEAST_HEIGHT * float(np.linalg.norm(np.ptp(mesh.bounds, axis=0)))
    return np.asarray((points - middle) / max(mean, least))


def local_means(data: Measurements, distance: Array) -> tuple[Array, Array]:
    """Means (n,), m, of the distances (m,), m, of each taxel's contact points from the believed
    surface, weighted by pressure squared, and their variances (n,), m^2; zeros without readings
    above zero.
    """
    weight, n, h = data.pressure**2, len(data.ids), distance[data.contact]
    share = weight / np.maximum(np.bincount(data.taxel, weight, n), 1e-300)[data.taxel]
    mean = np.asarray(np.bincount(data.taxel, share * h, n), dtype=float)
    scatter = float(np.sum((h - mean[data.taxel]) ** 2)) / max(len(h) - n, 1)
    return mean, np.asarray(scatter * np.bincount(data.taxel, share**2, n))


def normal_variance(data: Measurements, distance: Array) -> Array:
    """Variance (n,), m^2, of the surface under each taxel along its normal, by the distances (m,),
    m, of its contact points; of a taxel without readings, by those of all.
    """
    mean, variance = local_means(data, distance)
    return np.where(data.counts > 0, mean**2 + variance, np.mean(distance**2))
