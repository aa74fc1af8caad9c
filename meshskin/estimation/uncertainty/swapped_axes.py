"""Contact points whose axes have other signs or another order than those of the believed body.

On a nearly symmetric body mirrored points lie on the surface almost everywhere, and the readings
fit a mirrored map. The contacts on the parts that are not symmetric show the error, also without
normals.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from ...core.arrays import Array
from ...recording.recording import JOINT_ANGLES, Recording
from ..data.measurements import Measurements
from . import verdict
from .mounted_anew import SMALL, displacements
from .verdict import FAIL, PASS, Finding, level_of

POINTS = 300
"""Contact points, at most, that are compared."""
BETTER = 1.5, 4.0
"""Ratios of the mean squared distances as recorded and with other axes: a doubt, a failure. On a
body that is symmetric within the errors of its mesh the ratio is smaller."""


@dataclass(frozen=True)
class NearerAxes:
    """Other axes with which the contact points lie nearer to the believed surface."""

    axes: Array
    """Signed permutation (3, 3)."""
    recorded: float
    """Mean squared distance, m^2, of the points from the surface as recorded."""
    nearest: float
    """Mean squared distance, m^2, with the other axes."""

    @property
    def level(self) -> str:
        """Level of the verdict for the ratio of `recorded` to `nearest`."""
        return level_of(self.recorded / max(self.nearest, 1e-300), BETTER)

    def displacements(self, points: Array) -> Array:
        """Displacements (n, 3), m, of points (n, 3), m, by the other axes if these are a failure;
        else zeros."""
        return points - points @ self.axes.T if self.level == FAIL else np.zeros_like(points)


def nearer_axes(data: Measurements, points: Array) -> NearerAxes:
    """The axes with which contact points (m, 3), m, are nearest to the believed surface.

    These are the recorded axes where the points lie on the surface, or where a displacement brings
    them nearer than other axes do: on a nearly symmetric body, points look mirrored if the body has
    moved, possibly during the recording.
    """
    rows = np.linspace(0, len(points) - 1, min(POINTS, len(points))).astype(int)
    points, recorded = points[rows], _mean_square(data, points[rows])
    if len(points) < verdict.MIN_CONTACTS or recorded <= (SMALL * data.indentation) ** 2:
        return NearerAxes(np.eye(3), recorded, recorded)
    axes = signed_permutations()
    squares = np.array([_mean_square(data, points @ turned.T) for turned in axes])
    best, nearest = int(np.argmin(squares)), float(np.min(squares))
    off = nearest > (SMALL * data.indentation) ** 2
    if off and BETTER[0] * _mean_square(data, displacements(data, points).points) < nearest:
        return NearerAxes(np.eye(3), recorded, recorded)
    return NearerAxes(axes[best], recorded, nearest)


def findings(recording: Recording, data: Measurements, points: Array) -> Iterator[Finding]:
    """Findings on the axes of contact points (m, 3), m, by their distances from the believed
    surface."""
    if recording.metadata.get("source") == JOINT_ANGLES:  # the points are the surface's
        return
    found = nearer_axes(data, points)
    if found.level == PASS:
        return
    words = (
        f"contact points lie {1e3 * found.recorded**0.5:.3g} mm off the believed surface (rms), "
        f"and {1e3 * found.nearest**0.5:.3g} mm with their axes as {_name(found.axes)} (limit: "
        f"{BETTER[0] ** 0.5:.2g} times as near): check the signs and the order of the axes of "
        "contacts and body"
    )
    yield found.level, words


def signed_permutations() -> Array:
    """The matrices (47, 3, 3), without the identity, that change the order or signs of axes."""
    every = np.array(
        [
            np.diag(signs) @ np.eye(3)[list(order)]
            for order in permutations(range(3))
            for signs in product((1.0, -1.0), repeat=3)
        ]
    )
    return every[1:]


def _mean_square(data: Measurements, points: Array) -> float:
    """Mean squared distance, m^2, of points (k, 3), m, from the believed surface."""
    return float(np.mean(data.body.closest(points).distance ** 2))


def _name(axes: Array) -> str:
    """Signed axes in words, such as (x, -y, z)."""
    found = np.abs(axes).argmax(axis=1)
    signs = axes[np.arange(3), found]
    names = ["-" * bool(s < 0) + "xyz"[k] for k, s in zip(found, signs, strict=True)]
    return f"({', '.join(names)})"
