"""How an arm may hold a skin on the indenter: all its postures, whatever path is planned later."""

from __future__ import annotations

import numpy as np

from ..core.se3 import Array, inverse
from ..geometry.geodesics import rotate_about, transport_along
from . import posture
from .contact_rig import ContactRig

PLACES = 10
"""Places of the skin that are tried."""


def postures(setup: ContactRig, sites: Array) -> Array:
    """Configurations (k, n) in which sites (m, 3), body frame, are pressed on the indenter.

    Some of the sites, far apart, at all spins about the normal, in every posture within the joints'
    limits; (0, n) where there is none. The setup has an arm.
    """
    assert setup.arm is not None
    assert setup.mount is not None
    hit = setup.body.closest(sites[spread(sites, PLACES)])
    points, normals = hit.point[:, None], hit.normal[:, None]
    spins = 2 * np.pi * np.arange(posture.SPINS) / posture.SPINS
    tangents = np.stack([transport_along(normal)[0] for normal in normals])[:, None]
    headings = rotate_about(normals, tangents, spins)
    poses = setup.poses(setup.tips(points, normals), normals, headings)
    found = posture.nodes(setup.arm, poses @ inverse(setup.mount), stretch=1)
    return found.q[found.good]


def spread(points: Array, count: int) -> np.ndarray:
    """Rows of at most `count` of the points (m, 3), each farthest from those before it.

    Source: Gonzalez, "Clustering to minimize the maximum intercluster distance" (1985).
    """
    rows = [0]
    gap = np.linalg.norm(points - points[0], axis=1)
    while len(rows) < count and gap.max() > 0:
        rows.append(int(gap.argmax()))
        gap = np.minimum(gap, np.linalg.norm(points - points[rows[-1]], axis=1))
    return np.array(rows)
