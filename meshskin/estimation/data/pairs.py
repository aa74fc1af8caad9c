"""Pairs of a contact and a taxel: near each other, or informative though the taxel was silent."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ...contact.disc import invert_disc_mean
from ...contact.reading import same_sheet
from ...core.arrays import Array
from .measurements import Measurements

REACH_MARGIN = 0.4e-3
"""Distance beyond patch and disc within which a taxel still counts as in reach, m: readings are
selected again when taxels and contacts have moved by half of it."""
SILENT_SIGMAS = 4.0
"""An expected pressure further below the threshold than this, in standard deviations, makes silence
certain: the omitted cost -log Phi(4) is 3e-5, and the omitted information below 1e-3 of a
reading's."""
SILENT_FACING = 0.65
"""Least cosine of the angle between the normals of a contact and of a taxel whose silence informs.
At 60 degrees a taxel is no longer pressed (`same_sheet`): errors of the normals by up to ten decide
there whether it answers, and a wrong silence costs as much as an outlying reading."""
MAX_SLANT = 1.25
"""Bound on the distance in space relative to the distance across the normal, for a taxel near a
contact: holds up to 37 degrees out of the contact's tangent plane (arccos(1 / 1.25))."""
CHUNK = 8192
"""Taxels whose contacts are searched at once: bounds the memory."""


def near_pairs(
    data: Measurements, points: Array, normals: Array, radius: Array
) -> tuple[np.ndarray, np.ndarray]:
    """Contacts and taxels less than `radius` (m,), m, apart across the normal, on the same sheet.

    points (n, 3), m, and outward normals (n, 3): of the taxels.
    """
    furthest = MAX_SLANT * float(radius.max())
    found: list[tuple[np.ndarray, np.ndarray]] = []
    for begin in range(0, len(points), CHUNK):
        part = cKDTree(points[begin : begin + CHUNK])
        pairs = part.sparse_distance_matrix(data.contact_tree, furthest, output_type="ndarray")
        taxel, contact = pairs["i"] + begin, pairs["j"]
        offset = points[taxel] - data.points[contact]
        height = np.einsum("ki,ki->k", offset, data.normals[contact])
        keep = pairs["v"] ** 2 - height**2 < radius[contact] ** 2
        keep &= same_sheet(offset, data.normals[contact], normals[taxel])
        found.append((contact[keep], taxel[keep]))
    contacts, taxels = zip(*found, strict=True)
    return np.concatenate(contacts), np.concatenate(taxels)


def answering(data: Measurements, contact: np.ndarray, taxel: np.ndarray) -> np.ndarray:
    """Whether taxels (k,) still answered at the time of contacts (k,), bool."""
    last = np.full(len(data.ids), len(data.points))
    last[data.ended[:, 0]] = data.ended[:, 1]
    return np.asarray(contact <= last[taxel])


def silent_pairs(
    data: Measurements, live: np.ndarray, points: Array, normals: Array, scale: float
) -> tuple[np.ndarray, np.ndarray]:
    """Contacts and taxels (rows of `live`) without a reading, where that informs.

    points (n, 3), m, and outward normals (n, 3): of the taxels `live`;
    scale: contact radii relative to those at nominal E*.
    """
    if data.lost:
        return np.empty(0, dtype=int), np.empty(0, dtype=int)
    level = np.maximum(data.threshold - SILENT_SIGMAS * data.sigma, 0.0)
    level = level / (data.peaks * scale**-2)
    if "offset" in data.parameters.nuisance_names:  # the pressure at rest is not known, then
        level = np.zeros_like(level)
    a = scale * data.longest
    # A circle of the longer semi-axis under Hertz's profile has at least the patch's pressure.
    contact, taxel = near_pairs(data, points, normals, data.reach(scale) + REACH_MARGIN)
    met, row = np.unique(contact, return_inverse=True)
    radius = a[met] * invert_disc_mean(level[met], data.disc / a[met], tolerance=1e-3)
    offset = points[taxel] - data.points[contact]
    height = np.einsum("ki,ki->k", offset, data.normals[contact])
    across = np.einsum("ki,ki->k", offset, offset) - height**2
    within = across < (radius[row] + REACH_MARGIN) ** 2
    contact, taxel = contact[within], taxel[within]
    number = live[taxel] * len(data.points) + contact
    mine = np.isin(np.arange(len(data.ids)), live)[data.taxel]
    known = data.taxel[mine] * len(data.points) + data.contact[mine]
    left_out = data.corrupt[:, 1] * len(data.points) + data.corrupt[:, 0]
    read = np.sort(np.concatenate([known, left_out]))
    if len(read):
        silent = read[np.minimum(np.searchsorted(read, number), len(read) - 1)] != number
        silent &= ~np.isin(contact, np.union1d(data.misfitting, data.unread))
        silent &= answering(data, contact, live[taxel])
        facing = np.einsum("ki,ki->k", data.normals[contact], normals[taxel])
        silent &= facing > SILENT_FACING
        contact, taxel = contact[silent], taxel[silent]
    return contact, taxel
