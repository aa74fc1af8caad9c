"""A body, or an indenter, that moved during a recording, as found by the contact points.

One displacement brings the contact points before the move onto the believed surface, another one
those after it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ...core.arrays import Array
from ..data.measurements import Measurements
from .verdict import Finding, doubt

PLACES = 16
"""Number of contacts, evenly spaced, at which a body may have moved."""
POINTS = 1000
"""Contact points, at most, that are compared."""
SMALL = 0.02
"""Distance of the points from the surface (rms), in depths of the indentation, up to which they are
on it: 0.04 mm for the paper's skin."""
WEAK = 0.03
"""Singular value, relative to the largest, below which a displacement hardly changes the distances:
along such directions it is set to zero."""
BETTER = 6.0
"""Ratio of the mean squared distances after one and after two displacements, from which a move is
named. It is 4 for a steady drift, which is named as such."""


@dataclass(frozen=True)
class Displacements:
    """Two displacements of contact points that bring them nearest to the believed surface."""

    part: float
    """Part of the contacts before the second one."""
    points: Array
    """The points (k, 3), m, as moved."""
    one: float
    """Mean squared distance, m^2, after one displacement of all points."""
    two: float
    """Mean squared distance, m^2, after the two displacements."""
    apart: float
    """Length, m, of the difference of the two."""


def displacements(data: Measurements, points: Array) -> Displacements:
    """The two displacements of contact points (k, 3), m, in the order of their times.

    A depth that all points share, as of a body of another size, is estimated, too, and subtracted.
    """
    hit, count = data.body.closest(points), len(points)
    best, found = np.inf, list[Array]()
    for begin in range(0, count, -(-count // PLACES)):
        later = (np.arange(count) >= begin)[:, None]
        columns = np.hstack([hit.normal * ~later, hit.normal * later, np.ones((count, 1))])
        x = np.linalg.lstsq(columns, hit.distance, rcond=WEAK)[0]
        left = float(np.sum((hit.distance - columns @ x) ** 2))
        if not found or left < best:
            best, part, apart = left, begin / count, float(np.linalg.norm(x[3:6] - x[:3]))
            moved = points - np.where(later, x[3:6], x[:3]) - x[6] * hit.normal
            found = [*found[:1], moved]
    one, two = (float(np.mean(data.body.closest(p).distance ** 2)) for p in (found[0], found[-1]))
    return Displacements(part, found[-1], one, two, apart)


def findings(data: Measurements, points: Array) -> Iterator[Finding]:
    """Findings on contact points (m, 3), m, by their distances from the believed surface."""
    rows = np.linspace(0, len(points) - 1, min(POINTS, len(points))).astype(int)
    if len(rows) < 2 * PLACES:
        return
    found = displacements(data, points[rows])
    if found.one < max((SMALL * data.indentation) ** 2, BETTER * found.two):
        return
    yield doubt(
        f"the body or the indenter has moved in the course of the recording, at about "
        f"{found.part:.0%} of it: with one displacement of all contact points these lie "
        f"{1e3 * found.one**0.5:.2g} mm off the believed surface (rms); if those from there on are "
        f"displaced by another {1e3 * found.apart:.1g} mm, {1e3 * found.two**0.5:.2g} mm (limit: "
        f"{BETTER**0.5:g} times nearer); calibrate the parts one by one, or record again"
    )
