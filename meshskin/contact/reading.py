"""The forward model of the readings: the mean contact pressure over the disc of each taxel."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..core.arrays import Array
from . import ContactModel, Patches
from .disc import disc_mean

if TYPE_CHECKING:
    from ..effects.frames import Frames

NODES = 32
"""Nodes of the disc mean on circular Hertz patches: error 2e-11 of the peak, so that the
simulated world is more accurate than the estimators, which use 8 (2e-6)."""
ELLIPSE_NODES = 192
"""Nodes of the disc mean on other patches: error 3e-6 of the peak at a/b = 1.5, 8e-6 at 3, below
that of the estimators' `ellipse.NODES`."""
MIN_READING = 1e-5
"""Readings on other patches, relative to the peak, below which the quadrature cannot distinguish
them from zero."""
SAMPLES = 100
"""Points along each axis of the patch at which two models are compared."""
CHUNK = 20_000
"""Readings computed at once: arrays of 0.2 MB, which fit the cache of a processor."""
SHEET_FACING = 0.5
"""Least cosine of the angle between the normals of a contact and of a taxel that it presses: 60
degrees. Patch and disc of a contact that the models hold for span less on a smooth surface."""
SHEET_SLOPE = 0.5
"""Largest slope of the chord from a contact to a taxel that it presses, against the plane whose
normal is the mean of both normals. It is 0 on a surface of constant curvature; 0.5 admits a step of
half the distance."""
SHEET_STEP = 1e-3
"""Distance from that plane, m, that is always admitted: the taxels of a rigid module lie above and
below a curved surface, on one of 32 mm radius by a millimetre."""


@dataclass(frozen=True)
class ReadingModel:
    """Pressures of taxels in contacts without effects: a `PressureField`, which effects wrap."""

    model: ContactModel
    disc_radius: float
    """Radius of the discs of the taxels, m."""
    indenter_radius: float
    """Radius of the indenter, m."""
    effective_modulus: float
    """Contact modulus E*, Pa."""

    def __call__(self, frames: Frames, poses: Array) -> Array:
        """Pressures (m, n), Pa, of taxels at `poses` (n, 4, 4) in m frames."""
        f = frames
        contacts = f.points, f.normals, f.directions, f.force, f.curvature
        return self.pressures(*contacts, poses[:, :3, 3], poses[:, :3, 2])

    def pressures(
        self,
        points: Array,
        normals: Array,
        directions: Array,
        force: Array,
        curvature: Array,
        positions: Array,
        taxel_normals: Array | None = None,
    ) -> Array:
        """Mean contact pressures (m, n), Pa, of n taxels in m contacts.

        points, normals (m, 3): contact points and outward normals; directions (m, 3): first
        principal directions of the body there; force (m,), N; curvature (m, 2), principal, 1/m;
        positions (n, 3) of the taxels on the undeformed surface, all in the body frame, m. The
        position of a taxel in the patch is its projection onto the tangent plane of the contact, as
        in Hertz's theory. With taxel_normals (n, 3), outward, a contact presses only the taxels of
        its own sheet of skin (`same_sheet`). Raises ContactError where a contact is outside the
        series or the table of the contact model.
        """
        patches = self.patches(force, curvature)
        reach = np.maximum(patches.first, patches.second) + self.disc_radius
        row, col, offset = _pairs_in_reach(points, positions, reach)
        if taxel_normals is not None:
            same = same_sheet(offset, normals[row], taxel_normals[col])
            row, col, offset = row[same], col[same], offset[same]
        out = np.zeros((len(points), len(positions)))
        if self.model.name == "hertz":
            height = np.einsum("ij,ij->i", offset, normals[row])
            distance = np.sqrt(np.maximum(np.einsum("ij,ij->i", offset, offset) - height**2, 0.0))
            a = patches.first[row]
            mean = patches.peak[row] * disc_mean(distance / a, self.disc_radius / a, nodes=NODES)
            out[row, col] = np.maximum(mean, 0.0)
            return out
        x = np.einsum("ij,ij->i", offset, directions[row])
        y = np.einsum("ij,ij->i", offset, np.cross(normals, directions)[row])
        for start in range(0, len(row), CHUNK):
            part = slice(start, start + CHUNK)
            own = patches.take(row[part])
            mean = own.reading(x[part], y[part], self.disc_radius, nodes=ELLIPSE_NODES)
            out[row[part], col[part]] = np.where(mean > MIN_READING * own.peak, mean, 0.0)
        return out

    def max_difference(self, other: ReadingModel, force: float, curvature: Array) -> float:
        """Largest difference of the readings of two models, relative to p_0 of this one; at most 1.

        In contacts under `force`, N, at principal curvatures (k, 2), 1/m, along both axes of the
        patch.
        """
        patches = [one.patches(force, curvature) for one in (self, other)]
        longest = max(float(np.max([p.first, p.second])) for p in patches)
        steps = np.linspace(0.0, longest + max(self.disc_radius, other.disc_radius), SAMPLES)
        k, (x, y, z) = len(curvature), np.eye(3)
        contacts = (np.zeros((k, 3)), np.tile(z, (k, 1)), np.tile(x, (k, 1)), np.full(k, force))
        positions = np.concatenate([np.outer(steps, x), np.outer(steps, y)])
        mine, theirs = (one.pressures(*contacts, curvature, positions) for one in (self, other))
        return min(float(np.abs(theirs - mine).max() / np.min(patches[0].peak)), 1.0)

    def patches(self, force: float | Array, curvature: Array) -> Patches:
        """Patches of contacts under `force` (...), N, at `curvature` (..., 2), 1/m."""
        return self.model.patches(
            force=force,
            curvature=curvature,
            indenter_radius=self.indenter_radius,
            effective_modulus=self.effective_modulus,
        )


def same_sheet(offset: Array, contact_normals: Array, taxel_normals: Array) -> np.ndarray:
    """Whether taxels lie on the sheet of skin that a contact presses (k,) bool.

    offset (k, 3), m: from the contact to the taxel; outward unit normals (k, 3) of both. The
    normals must face the same side, and the chord must run along the surface: between two points of
    a surface of constant curvature it is perpendicular to the sum of their normals. So a taxel on
    the far side of a plate, or on another sheet above or below, is not pressed; one that is up to a
    millimetre above or below the contact is.
    """
    total = contact_normals + taxel_normals
    across = np.einsum("ki,ki->k", offset, total)
    facing = np.einsum("ki,ki->k", contact_normals, taxel_normals) > SHEET_FACING
    step = np.maximum(SHEET_SLOPE**2 * np.sum(offset**2, axis=1), SHEET_STEP**2)
    return np.asarray(facing & (across**2 <= step * np.sum(total**2, axis=1)))


def _pairs_in_reach(
    points: Array, positions: Array, reach: Array
) -> tuple[np.ndarray, np.ndarray, Array]:
    """Contacts (k,) and taxels (k,) closer than sqrt(2) `reach` (m,), and their offsets (k, 3).

    The margin covers taxels that lie off the tangent plane by up to their distance in it.
    """
    squared = (
        np.sum(points**2, axis=1)[:, None]
        + np.sum(positions**2, axis=1)
        - 2.0 * points @ positions.T
    )
    row, col = np.nonzero(squared < (2.0 * reach**2)[:, None])
    return row, col, positions[col] - points[row]
