"""What every taxel reads: the mean contact pressure over its disc (forward model of the world)."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..core.se3 import Array
from . import ContactModel
from .disc import disc_mean

if TYPE_CHECKING:
    from ..effects.frames import Frames

NODES = 32
"""Nodes of the disc mean on circular Hertz patches: finer than the estimators', so that theirs is
put to the test."""
EDGE_NODES = 192
"""Nodes of the disc mean on other patches, finer than the estimators' too: 3e-6 of the peak."""
LEAST = 1e-5
"""Readings on other patches, in parts of the peak, that the nodes cannot tell from none."""
SAMPLES = 100
"""Places along each axis at which two relations are compared."""
CHUNK = 20_000
"""Readings computed at once."""


@dataclass(frozen=True)
class ReadingModel:
    """Pressures of taxels in contacts: the `PressureField` that effects wrap."""

    model: ContactModel
    """Of contact."""
    disc_radius: float
    """Of the taxels, m."""
    indenter_radius: float
    """m."""
    effective_modulus: float
    """E*, Pa."""

    def __call__(self, frames: Frames, poses: Array) -> Array:
        """Pressures (m, n), Pa, of taxels at `poses` (n, 4, 4) in m frames."""
        contacts = (
            frames.points,
            frames.normals,
            frames.directions,
            frames.force,
            frames.curvature,
        )
        return self._read(*contacts, positions=poses[:, :3, 3])

    def max_difference(self, other: ReadingModel, force: float, curvature: Array) -> float:
        """Largest difference of what both read in contacts under `force`, N, in parts of p_0.

        At principal curvatures (k, 2), 1/m, along both axes of the patch; at most 1.
        """
        k = len(curvature)
        flat, up, across = (
            np.zeros((k, 3)),
            np.tile(np.eye(3)[2], (k, 1)),
            np.tile(np.eye(3)[0], (k, 1)),
        )
        place = {
            "indenter_radius": self.indenter_radius,
            "effective_modulus": self.effective_modulus,
        }
        found = [
            m.patches(force=force, curvature=curvature, **place) for m in (self.model, other.model)
        ]
        longest = max(float(np.max([p.first, p.second])) for p in found)
        steps = np.linspace(0.0, longest + max(self.disc_radius, other.disc_radius), SAMPLES)
        places = np.concatenate([np.outer(steps, np.eye(3)[axis]) for axis in (0, 1)])
        read = [
            one._read(flat, up, across, np.full(k, force), curvature, positions=places)
            for one in (self, other)
        ]
        return min(float(np.abs(read[1] - read[0]).max() / np.min(found[0].peak)), 1.0)

    def _read(self, *contacts: Array, positions: Array) -> Array:
        return disc_pressures(
            *contacts,
            positions=positions,
            disc_radius=self.disc_radius,
            indenter_radius=self.indenter_radius,
            effective_modulus=self.effective_modulus,
            model=self.model,
        )


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
    model: ContactModel | None = None,
) -> Array:
    """Mean contact pressures (m, n), Pa, of n taxels in m contacts.

    points, normals (m, 3): contact points and outward normals; directions (m, 3): first principal
    directions of the body there; force (m,), N; curvature (m, 2), principal, 1/m; positions (n, 3)
    of the taxels on the undeformed surface, all in the body frame; model: of contact, by default
    circular Hertz. A taxel's place in the patch is taken in the contact's tangent plane, as Hertz
    does. Raises ContactError where a contact leaves the range of the model's series.
    """
    model = model or ContactModel()
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
