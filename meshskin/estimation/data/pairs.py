"""Pairs of a contact and a taxel: near each other, or silent where that says something."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ...contact.disc import invert_disc_mean
from ...core.se3 import Array

if TYPE_CHECKING:
    from .measurements import Measurements

SPARE = 0.4e-3
"""Reach beyond patch and disc within which a taxel may be read, m."""
QUIET = 4.0
"""Sigmas below the threshold beyond which a silent reading says nothing: 1e-3 of a heard one."""
SLANT = 1.25
"""Distance in space over the one across the normal, at most, of a taxel near a contact."""
CHUNK = 8192
"""Taxels whose contacts are looked for at once."""


def near_pairs(data: Measurements, points: Array, radius: Array) -> tuple[np.ndarray, np.ndarray]:
    """Contacts and taxels (rows of `points`) less than `radius` (m,) apart across the normal, m."""
    from scipy.spatial import cKDTree

    furthest = SLANT * float(radius.max())
    tree = cKDTree(data.points)
    found: list[tuple[np.ndarray, np.ndarray]] = []
    for begin in range(0, len(points), CHUNK):
        part = cKDTree(points[begin : begin + CHUNK])
        pairs = part.sparse_distance_matrix(tree, furthest, output_type="ndarray")
        taxel, contact = pairs["i"] + begin, pairs["j"]
        offset = points[taxel] - data.points[contact]
        height = np.einsum("ki,ki->k", offset, data.normals[contact])
        keep = pairs["v"] ** 2 - height**2 < radius[contact] ** 2
        found.append((contact[keep], taxel[keep]))
    contacts, taxels = zip(*found, strict=True)
    return np.concatenate(contacts), np.concatenate(taxels)


def silent_pairs(
    data: Measurements, live: np.ndarray, points: Array, stretch: float
) -> tuple[np.ndarray, np.ndarray]:
    """Contacts and taxels (rows of `live`, at `points`) whose silence says something.

    Where the pressure to expect is more than `QUIET` sigma below the threshold, it says nothing.
    """
    level = np.maximum(data.threshold - QUIET * data.sigma, 0.0) / (data.peaks * stretch**-2)
    if "offset" in data.shared.local_names:  # where a taxel falls silent is not known, then
        level = np.zeros_like(level)
    a = stretch * data.longest
    # A circle of the longer semi-axis under Hertz's profile has at least the patch's pressure.
    radius = a * invert_disc_mean(level, data.disc / a, tolerance=1e-3) + SPARE
    contact, taxel = near_pairs(data, points, radius)
    number = live[taxel] * len(data.points) + contact
    heard = np.sort(data.taxel * len(data.points) + data.contact)
    if len(heard):
        found = heard[np.minimum(np.searchsorted(heard, number), len(heard) - 1)]
        quiet = found != number
        contact, taxel = contact[quiet], taxel[quiet]
    return contact, taxel
