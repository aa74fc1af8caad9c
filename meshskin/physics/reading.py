"""What every taxel reads: the mean contact pressure over its disc (forward model of the world)."""

from __future__ import annotations

import numpy as np

from ..se3 import Array
from .contact import hertz
from .contact.disc import disc_mean

NODES = 32
"""Nodes of the disc mean: finer than the estimators', so that theirs is put to the test."""


def disc_pressures(
    points: Array,
    normals: Array,
    force: Array,
    curvature: Array,
    *,
    positions: Array,
    disc_radius: float,
    indenter_radius: float,
    effective_modulus: float,
) -> Array:
    """Mean Hertz pressures (m, n), Pa, of n taxels in m contacts.

    points, normals (m, 3): contact points and outward normals; force (m,), N; curvature (m, 2),
    principal, 1/m; positions (n, 3) of the taxels on the undeformed surface, all in the body frame.
    A taxel's distance from the contact is taken in the contact's tangent plane, as Hertz does.
    """
    radius = hertz.relative_radius(curvature, indenter_radius)
    a = hertz.contact_radius(force, radius, effective_modulus)
    peak = hertz.peak_pressure(force, a)
    out = np.zeros((len(points), len(positions)))
    # |x - c|^2 bounds the tangential distance from above on no surface, from below on none: take
    # the candidates generously, then the tangential distance exactly
    squared = (
        np.sum(points**2, axis=1)[:, None]
        + np.sum(positions**2, axis=1)
        - 2.0 * points @ positions.T
    )
    row, col = np.nonzero(squared < (2.0 * (a + disc_radius) ** 2)[:, None])
    offset = positions[col] - points[row]
    along = np.einsum("ij,ij->i", offset, normals[row])
    distance = np.sqrt(np.maximum(np.einsum("ij,ij->i", offset, offset) - along**2, 0.0))
    mean = disc_mean(distance / a[row], disc_radius / a[row], nodes=NODES)
    out[row, col] = peak[row] * np.maximum(mean, 0.0)
    return out
