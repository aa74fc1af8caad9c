"""The tangent plane at the skin's centre, on which maps are drawn, and helpers of all figures."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import Array, median_spacing

MM = 1e3
"""Millimetres per metre."""
PAUSE = 3.0
"""Time between two contacts, in the median one, from which the line between them is interrupted."""
JUMP = 5.0
"""Distance between two contacts, in the median one, from which it is interrupted."""
LEAST_PITCH = 1e-3
"""Least distance between taxels, m, that drawings go by."""
LONGEST = 2.5
"""Longest error line or semi-axis that is drawn, in that of a usual taxel: longer ones would cover
their neighbours, and leave the map."""
MAX_PATH_POINTS = 4000
"""Most points of a drawn contact path: a path of 20 widths of a map has one every 4 pixels."""


@dataclass(frozen=True)
class Plane:
    """A plane through `origin` (3,), m, spanned by the rows of `axes` (2, 3), body frame."""

    origin: Array
    axes: Array

    def project(self, points: ArrayLike) -> Array:
        """Coordinates (..., 2) in the plane, mm, of points (..., 3), m."""
        return np.asarray((np.asarray(points, dtype=float) - self.origin) @ self.axes.T * MM)

    def project_covariance(self, covariances: ArrayLike) -> Array:
        """Covariances (n, 2, 2) in the plane, mm^2, of covariances (n, 3, 3), m^2, body frame.

        A covariance that is not finite gives NaN.
        """
        c = np.asarray(covariances, dtype=float)
        c = np.where(np.isfinite(c).all(axis=(-2, -1), keepdims=True), c, np.nan)
        return np.asarray(self.axes @ c @ self.axes.T * MM**2)


def path_with_breaks(points: ArrayLike, time: ArrayLike) -> tuple[Array, Array]:
    """Contact points (m, 3) at times (m,) for a line: at most about MAX_PATH_POINTS of them, with a
    row of NaN at each pause or jump, and their times."""
    p, t = np.asarray(points, dtype=float), np.asarray(time, dtype=float)
    every = max(len(p) // MAX_PATH_POINTS, 1)
    p, t = p[::every], t[::every]
    if len(p) < 2:
        return p, t
    step, wait = np.linalg.norm(np.diff(p, axis=0), axis=1), np.diff(t)
    apart = (step > JUMP * np.median(step)) | (wait > PAUSE * np.median(wait))
    at = np.flatnonzero(apart) + 1
    return np.insert(p, at, np.nan, axis=0), np.insert(t, at, np.nan)


def finite_rows(values: ArrayLike) -> Array:
    """The rows of `values` (n, k) that are finite."""
    v = np.asarray(values, dtype=float)
    return np.asarray(v[np.isfinite(v).all(axis=1)])


def tangent_plane(points: ArrayLike, normals: ArrayLike) -> Plane:
    """The tangent plane of a skin at its centre, seen from outside.

    points (n, 3), m; normals (n, 3), outward. Rows that are not finite are left out. Where the
    normals have no mean it is the plane that fits the points best. The second axis is the
    projection of the body's y axis, or of its x axis where y is within 26 degrees of the plane's
    normal.
    """
    p = finite_rows(np.reshape(points, (-1, 3)))
    origin = p.mean(axis=0) if len(p) else np.zeros(3)
    normal = finite_rows(np.reshape(normals, (-1, 3))).sum(axis=0)
    if np.linalg.norm(normal) < 1e-9:
        normal = np.linalg.svd(p - origin)[2][-1] if len(p) > 2 else np.array([0.0, 0.0, 1.0])
    normal = normal / np.linalg.norm(normal)
    up = np.eye(3)[1] if abs(normal[1]) < 0.9 else np.eye(3)[0]
    up = up - (up @ normal) * normal
    up /= np.linalg.norm(up)
    return Plane(origin, np.stack([np.cross(up, normal), up]))


def pitch(points: Array) -> float:
    """Distance (m) between taxels at points (n, 3) that drawings go by: `median_spacing`, but not
    less than LEAST_PITCH, where estimates coincide."""
    return float(np.fmax(median_spacing(points), LEAST_PITCH))


def drawn_scale(lengths: Array, wanted: float) -> tuple[float, Array]:
    """The factor by which lengths (n,) are enlarged (`enlargement`), and that (n,) by which long
    ones are then shortened: to LONGEST times what is wanted or usual."""
    factor = enlargement(lengths, wanted)
    known = lengths[np.isfinite(lengths)]
    usual = factor * float(np.median(known)) if len(known) else 0.0
    longest = LONGEST * max(wanted, usual)
    return factor, np.asarray(np.minimum(1.0, longest / np.maximum(factor * lengths, 1e-300)))


def enlargement(lengths: ArrayLike, wanted: float) -> float:
    """The largest factor of 1, 2, 5, 10, ... with which the median length is at most `wanted`.

    It is 1 where the median length is larger than that.
    """
    x = np.asarray(lengths, dtype=float).ravel()
    x = x[np.isfinite(x) & (x > 0)]
    if not len(x) or wanted <= 0:
        return 1.0
    ratio = max(wanted / float(np.median(x)), 1.0)
    decade = 10.0 ** np.floor(np.log10(ratio))
    return float(decade * max(s for s in (1, 2, 5) if s * decade <= ratio * (1 + 1e-9)))
