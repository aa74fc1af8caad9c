"""Tilt of the real surface against the believed one, as the heights of contacts show it.

    t_i = R g_i,    g_i = the slope of the heights across the contacts of taxel i

Where contacts are computed from the centre of an indenter, R away from them, a surface that is
tilted by g displaces them along it.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ...core.arrays import Array, means_by_group, sums_by_group

if TYPE_CHECKING:
    from ..data.measurements import Measurements

FLAT = 0.01
"""Mean square of the distances of contacts from a plane, relative to that along it, which the slope
of their heights across it is regularized by: along the normal contacts hardly vary."""


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
