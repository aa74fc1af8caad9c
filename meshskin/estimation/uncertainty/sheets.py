"""Sheets of a body close above or below another: readings do not tell which of them a taxel is on.

Parts of a CAD mesh overlap and lie in each other's seams, so that two surfaces that face the same
way are some tenths of a millimetre apart. A contact presses the taxels on both. `Body.skinned`
closes them into one surface.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from ...contact.reading import SHEET_FACING, SHEET_STEP
from ...core.arrays import Array

SAME = 1e-6
"""Distance, m, up to which a hit is on the sheet of the taxel: rays are single precision."""


def covariance(body: Any, points: Array, normals: Array) -> Array:
    """What another sheet adds to the covariances (n, 6, 6) of poses at `points` (n, 3), m, with
    `normals` (n, 3), taxel frame: its distance along the normal and its tilt, squared.

    It faces the same way and is so near that contacts of the taxel press it, too: the taxel may be
    on either. Zero where there is none, or where a point is not known.
    """
    out = np.zeros((len(points), 6, 6))
    rows = np.flatnonzero(np.isfinite(points).all(axis=1))
    if not len(rows) or not hasattr(body, "project"):  # an exact surface has one sheet
        return out
    height, tilt = np.zeros(len(rows)), np.zeros(len(rows))
    for way in (1.0, -1.0):  # rays from above and from below
        start = points[rows] + way * SHEET_STEP * normals[rows]
        hit = body.project(start, -way * normals[rows])
        cosine = np.einsum("ij,ij->i", hit.normal, normals[rows])
        apart = np.abs(SHEET_STEP - hit.distance)
        farther = (
            (cosine > SHEET_FACING) & (apart < SHEET_STEP) & (apart > np.maximum(height, SAME))
        )
        height = np.where(farther, apart, height)
        tilt = np.where(farther, np.arccos(np.clip(cosine, -1.0, 1.0)), tilt)
    out[rows, 2, 2] = height**2
    out[rows, 3, 3] = out[rows, 4, 4] = tilt**2
    return out
