"""Contact points whose axes have other signs or another order than the believed body's.

On a nearly symmetric body mirrored points lie on the surface almost everywhere, and the readings
fit: the map is mirrored, too. The contacts on what is not symmetric show it, also without normals.
"""

from __future__ import annotations

from itertools import permutations, product
from typing import TYPE_CHECKING

import numpy as np

from ...core.arrays import Array
from ...recording.recording import JOINT_ANGLES
from . import verdict
from .contact_errors import offsets
from .verdict import PASS, Finding, level_of

if TYPE_CHECKING:
    from ...recording.recording import Recording
    from ..calibration import Calibration
    from ..data.measurements import Measurements

POINTS = 300
"""Contact points, at most, that are compared."""
SMALL = 0.02
"""Distance of the points from the surface (rms), in depths of the indentation, up to which they are
on it: 0.04 mm for the paper's skin."""
BETTER = 1.5, 4.0
"""Ratio of the mean squared distances as recorded and with other axes from which it is a doubt, and
a failure. On a body that is symmetric but for its mesh's errors, both differ by less."""


def findings(recording: Recording, data: Measurements, calibration: Calibration) -> list[Finding]:
    """What the distances of contact points from the believed surface say of their axes."""
    computed = recording.metadata.get("source") == JOINT_ANGLES  # the points are the surface's
    if computed or len(data.points) < verdict.MIN_CONTACTS:
        return []
    rows = np.linspace(0, len(data.points) - 1, min(POINTS, len(data.points))).astype(int)
    points = data.points[rows]
    moved = points + offsets(data, calibration.unknowns)[rows]
    recorded = min(_mean_square(data, points), _mean_square(data, moved))
    depth = float(np.median(data.radii**2 * data.relative_curvature))
    if recorded <= (SMALL * depth) ** 2:
        return []
    axes = signed_permutations()
    squares = np.array([_mean_square(data, points @ turned.T) for turned in axes])
    best = int(np.argmin(squares))
    level = level_of(recorded / max(float(squares[best]), 1e-300), BETTER)
    if level == PASS:
        return []
    words = (
        f"contact points lie {1e3 * recorded**0.5:.3g} mm off the believed surface (rms), and "
        f"{1e3 * squares[best] ** 0.5:.3g} mm with their axes as {_name(axes[best])} (limit: "
        f"{BETTER[0] ** 0.5:.2g} times as near): check the signs and the order of the axes of "
        "contacts and body"
    )
    return [(level, words)]


def signed_permutations() -> Array:
    """The 47 matrices (47, 3, 3), but the identity, that change the order and signs of axes."""
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
    """Signed axes, as (x, -y, z)."""
    found = np.abs(axes).argmax(axis=1)
    signs = axes[np.arange(3), found]
    names = ["-" * bool(s < 0) + "xyz"[k] for k, s in zip(found, signs, strict=True)]
    return f"({', '.join(names)})"
