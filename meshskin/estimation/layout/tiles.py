"""Triangular modules that lie edge to edge in the plane, as on the flexible boards that cover iCub.

Poses of rigid modules drift over a body that bends. Which edges of which modules meet is a choice
among few, which the poses tell where they err by less than a fraction of an edge. The tiling then
has exact angles, and one unknown, the distance of neighbours.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, minimum_spanning_tree
from scipy.spatial import KDTree

from ...core.arrays import Array, median_spacing
from ...core.errors import CalibrationError
from . import stress
from .placement import Modules, rotated, settled

NORMALS = np.deg2rad([-90.0, 30.0, 150.0])
"""Directions of the outward normals of the edges in a module's frame, rad (slots.CORNERS)."""
TOLERANCE = 0.4
"""Largest misfit of two modules that meet, in distances of their centres: another edge or another
turn misfits by 1.05 at least."""
ARM = 0.5
"""Displacement, in distances of centres, for which an angle of 1 rad counts."""
NEIGHBOURS = 1.6
"""Largest distance of modules that may meet, in those that do: the next nearest is sqrt(3)."""


def tiled(modules: Modules, near: Array, unit: float) -> tuple[Modules, Array]:
    """The tiling that agrees with the poses of `modules`, and the misfit (m,), m, of each.

    Modules that no chain of edges joins are tiled apart. Each part is placed where it fits the
    given poses best, and from there by the distances of near taxels across the gaps: near (n, n),
    in a `unit`, m, and 0 where taxels are not near. The misfit is the root mean square displacement
    of a module's taxels from the given poses. Raises CalibrationError where edges contradict each
    other, or two modules take one place.
    """
    pitch = median_spacing(modules.origins)
    pairs = KDTree(modules.origins).query_pairs(1.3 * pitch, output_type="ndarray")
    gaps = modules.origins[pairs[:, 0]] - modules.origins[pairs[:, 1]]
    pitch = float(np.median(np.linalg.norm(gaps, axis=1)))  # of neighbouring modules
    meetings = _meetings(modules, pitch)
    origins, angles, part = _grown(len(modules.angles), pitch, meetings)
    wrong = [m for m in meetings if _gap(origins, angles, m, pitch) > TOLERANCE * pitch]
    apart = np.linalg.norm(origins[:, None] - origins, axis=2)
    overlapping = (apart < 0.5 * pitch) & (part[:, None] == part) & ~np.eye(len(part), dtype=bool)
    if wrong or overlapping.any():
        raise CalibrationError(
            "the modules do not tile the plane edge to edge",
            value=f"{len(wrong)} of {len(meetings)} edges contradict the others",
            remedy="use tiled=False",
        )
    grown = replace(modules, origins=origins, angles=angles)
    for k in range(part.max() + 1):
        own = part == k
        rows = own[modules.module]
        turn, shift = _alignment(grown.positions[rows], modules.positions[rows])
        origins[own] = rotated(origins[own], turn) + shift
        angles[own] += turn
    placed = replace(modules, origins=origins, angles=angles)
    if part.max() > 0:
        placed = _parts_placed(placed, part, modules.positions, near, unit)
    square = np.sum((placed.positions - modules.positions) ** 2, axis=1)
    return placed, np.sqrt(np.bincount(modules.module, square) / np.bincount(modules.module))


@dataclass(frozen=True)
class Meeting:
    """Two modules that meet: edge `edge` of the first, edge `other` of the second."""

    misfit: float
    """m"""
    first: int
    second: int
    edge: int
    other: int

    @property
    def turn(self) -> float:
        """Angle of the second module in the frame of the first, rad."""
        return float(NORMALS[self.edge] + np.pi - NORMALS[self.other])

    def reversed(self) -> Meeting:
        """The meeting as seen from the other module."""
        return Meeting(self.misfit, self.second, self.first, self.other, self.edge)


def _meetings(modules: Modules, pitch: float) -> list[Meeting]:
    """The pairs of modules that meet within TOLERANCE, by the edges that fit best; best first."""
    found = []
    for i, j in KDTree(modules.origins).query_pairs(NEIGHBOURS * pitch, output_type="ndarray"):
        trials = [Meeting(0.0, int(i), int(j), a, b) for a in range(3) for b in range(3)]
        gap = [_gap(modules.origins, modules.angles, m, pitch) for m in trials]
        best = int(np.argmin(gap))
        if gap[best] < TOLERANCE * pitch:
            found.append(replace(trials[best], misfit=gap[best]))
    return sorted(found, key=lambda m: m.misfit)


def _gap(origins: Array, angles: Array, meeting: Meeting, pitch: float) -> float:
    """Misfit, m, of a meeting at given poses, displacement and turn together."""
    i, j = meeting.first, meeting.second
    normal = angles[i] + NORMALS[meeting.edge]
    target = origins[i] + pitch * np.array([np.cos(normal), np.sin(normal)])
    turn = angles[j] - angles[i] - meeting.turn
    off = float(np.linalg.norm(origins[j] - target))
    return float(np.hypot(off, ARM * pitch * abs(np.angle(np.exp(1j * turn)))))


def _grown(count: int, pitch: float, meetings: list[Meeting]) -> tuple[Array, Array, np.ndarray]:
    """Origins (m, 2), angles (m,) and part (m,) of modules along the best meetings.

    Each part begins at a module of its own, at the origin.
    """
    origins, angles = np.zeros((count, 2)), np.zeros(count)
    at = {(m.first, m.second): m for m in meetings}
    at |= {(m.second, m.first): m.reversed() for m in meetings}
    row, column = np.array(list(at), dtype=np.int32).reshape(-1, 2).T  # as csgraph has indices
    weight = [max(m.misfit, 1e-9) for m in at.values()]  # SciPy takes a zero for a missing edge
    tree = minimum_spanning_tree(csr_array((weight, (row, column)), shape=(count, count)))
    parts, part = connected_components(tree, directed=False)
    for first in [int(np.argmax(part == k)) for k in range(parts)]:
        order, before = breadth_first_order(tree, first, directed=False)
        for k in order[1:]:
            m = at[int(before[k]), int(k)]
            normal = angles[m.first] + NORMALS[m.edge]
            origins[k] = origins[m.first] + pitch * np.array([np.cos(normal), np.sin(normal)])
            angles[k] = angles[m.first] + m.turn
    return origins, angles, part


def _alignment(source: Array, target: Array) -> tuple[float, Array]:
    """Angle, rad, and displacement (2,), m, that take `source` (m, 2) to `target` best."""
    a, b = source - source.mean(axis=0), target - target.mean(axis=0)
    angle = float(np.arctan2(np.sum(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0]), np.sum(a * b)))
    return angle, target.mean(axis=0) - rotated(source, angle).mean(axis=0)


def _parts_placed(
    modules: Modules, part: np.ndarray, target: Array, near: Array, unit: float
) -> Modules:
    """Tiled modules whose parts (m,) are moved as rigid bodies to the distances `near` (n, n).

    The whole is where it fits `target` (n, 2) best. Paths are left out: one that goes around a gap
    is too long, and inside a part nothing is left to find but the unit.
    """
    count = part.max() + 1
    own = part[modules.module]
    start = Modules(own, modules.positions, np.zeros((count, 2)), np.zeros(count))
    weight = np.where(near > 0, stress.weights(near), 0.0)
    bodies, _ = settled(start, near, unit, free=True, weight=weight)
    turn, shift = _alignment(bodies.positions, target)
    whole = Modules(part, modules.origins, bodies.origins, bodies.angles)
    origins = rotated(whole.positions, turn) + shift
    return replace(modules, origins=origins, angles=modules.angles + bodies.angles[part] + turn)
