"""What every taxel reads: the mean contact pressure over its disc (forward model of the world)."""

from __future__ import annotations

import numpy as np

from ..se3 import Array
from .contact import Model
from .contact.disc import disc_mean

NODES = 32
"""Nodes of the disc mean on circular Hertz patches: finer than the estimators', so that theirs is
put to the test."""
EDGE_NODES = 192
"""Nodes of the disc mean on other patches, finer than the estimators' too: 3e-6 of the peak."""
LEAST = 1e-5
"""Readings on other patches, in parts of the peak, that the nodes cannot tell from none."""
CHUNK = 20_000
"""Readings computed at once."""


def disc_pressures(
    points: Array,
    normals: Array,
    directions: Array,
    force: Array,
    curvature: Array,
    *,
    positions: Array,
    disc_radius: float,
    indenter_radius: float,
    effective_modulus: float,
    model: Model | None = None,
) -> Array:
    """Mean contact pressures (m, n), Pa, of n taxels in m contacts.

    points, normals (m, 3): contact points and outward normals; directions (m, 3): first principal
    directions of the body there; force (m,), N; curvature (m, 2), principal, 1/m; positions (n, 3)
    of the taxels on the undeformed surface, all in the body frame; model: of contact, by default
    circular Hertz. A taxel's place in the patch is taken in the contact's tangent plane, as Hertz
    does. Raises ContactError where a contact leaves the range of the model's series.
    """
    model = model or Model()
    patches = model.patches(
        force=force,
        curvature=curvature,
        indenter_radius=indenter_radius,
        effective_modulus=effective_modulus,
    )
    reach = np.maximum(patches.first, patches.second)
    row, col, offset = _candidates(points, positions, reach + disc_radius)
    along = np.einsum("ij,ij->i", offset, normals[row])
    out = np.zeros((len(points), len(positions)))
    if model.name == "hertz":
        distance = np.sqrt(np.maximum(np.einsum("ij,ij->i", offset, offset) - along**2, 0.0))
        a = patches.first[row]
        mean = patches.peak[row] * disc_mean(distance / a, disc_radius / a, nodes=NODES)
        out[row, col] = np.maximum(mean, 0.0)
        return out
    x = np.einsum("ij,ij->i", offset, directions[row])
    y = np.einsum("ij,ij->i", offset, np.cross(normals, directions)[row])
    for start in range(0, len(row), CHUNK):
        part = slice(start, start + CHUNK)
        own = patches.take(row[part])
        mean = own.reading(x[part], y[part], disc_radius, nodes=EDGE_NODES)
        out[row[part], col[part]] = np.where(mean > LEAST * own.peak, mean, 0.0)
    return out


def _candidates(
    points: Array, positions: Array, reach: Array
) -> tuple[np.ndarray, np.ndarray, Array]:
    """Contacts (k,), taxels (k,) that may be within `reach` (m,) of them, offsets (k, 3).

    |x - c|^2 bounds the tangential distance from above on no surface, from below on none: the
    candidates are taken generously.
    """
    squared = (
        np.sum(points**2, axis=1)[:, None]
        + np.sum(positions**2, axis=1)
        - 2.0 * points @ positions.T
    )
    row, col = np.nonzero(squared < (2.0 * reach**2)[:, None])
    return row, col, positions[col] - points[row]
