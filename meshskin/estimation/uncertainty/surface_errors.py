"""Errors of the believed surface: along its normals, of its size, of its tilt, and other sheets.

Where contacts are computed from the centre of an indenter, R away from them, a surface that is
tilted by g displaces them along it by R g.

Parts of a CAD mesh overlap and lie in each other's seams, so that two surfaces that face the same
way are some tenths of a millimetre apart. Readings do not tell which of them a taxel is on: a
contact presses the taxels on both. `Body.skinned` closes them into one surface.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ...contact.reading import SHEET_FACING, SHEET_STEP
from ...core.arrays import Array, means_by_group, sums_by_group
from ...geometry.body import Body
from ..data.measurements import Measurements

LEAST_HEIGHT = 0.1
"""Least distance of the surface from the middle, along the normals, relative to the diagonal of the
bounds. It is 0.29 for a ball and 0.19 for a cylinder eight times as long as its radius; for a flat
sheet, which is a part of a body only, it is near zero."""
FLAT = 0.01
"""Regularization of the slope of heights over contacts: a mean square of the distances from their
plane, relative to that along it, as contacts hardly vary along the normal."""
SAME = 1e-6
"""Distance, m, up to which a hit is on the sheet of the taxel: rays have single precision."""


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


def tilts(data: Measurements, points: Array, distance: Array) -> Array:
    """Displacements (n, 3), m, of contacts that are computed as the points (m, 3), m, below an
    indenter's centre, by the tilt of the real surface against the believed one.

    The tilt is the slope of the distances (m,), m, across the contacts of a taxel; the centre is
    a radius away from the contact.
    """
    n, weight = len(data.ids), data.pressure**2
    values = np.column_stack([points, distance])[data.contact]
    off = values - means_by_group(values, data.taxel, n, weight)[data.taxel]
    arm, rise = off[:, :3], off[:, 3]
    normal = sums_by_group(weight[:, None, None] * arm[:, :, None] * arm[:, None, :], data.taxel, n)
    trace = np.maximum(np.trace(normal, axis1=1, axis2=2), 1e-300)
    normal += FLAT * trace[:, None, None] * np.eye(3)
    along = sums_by_group((weight * rise)[:, None] * arm, data.taxel, n)
    slope = np.linalg.solve(normal, along[:, :, None])[:, :, 0]
    return np.asarray(data.belief.indenter.radius * slope)


def sheet_covariance(body: Any, points: Array) -> Array:
    """What another sheet adds to the covariances (n, 6, 6) of poses at `points` (n, 3), m, taxel
    frame: its distance along the normal and its tilt, squared.

    It faces the same way and is so near that contacts of the taxel press it, too: the taxel may be
    on either. Both are measured from the surface below the taxel: those of a rigid module are off
    it. Zero where there is none, or where a point is not known.
    """
    out = np.zeros((len(points), 6, 6))
    rows = np.flatnonzero(np.isfinite(points).all(axis=1))
    if not len(rows) or not hasattr(body, "project"):  # an exact surface has one sheet
        return out
    own = body.closest(points[rows])
    height, tilt = np.zeros(len(rows)), np.zeros(len(rows))
    for way in (1.0, -1.0):  # rays from above and from below
        start = own.point + way * SHEET_STEP * own.normal
        hit = body.project(start, -way * own.normal)
        cosine = np.einsum("ij,ij->i", hit.normal, own.normal)
        apart = np.abs(SHEET_STEP - hit.distance)
        farther = (
            (cosine > SHEET_FACING) & (apart < SHEET_STEP) & (apart > np.maximum(height, SAME))
        )
        height = np.where(farther, apart, height)
        tilt = np.where(farther, np.arccos(np.clip(cosine, -1.0, 1.0)), tilt)
    out[rows, 2, 2] = height**2
    out[rows, 3, 3] = out[rows, 4, 4] = tilt**2
    return out
