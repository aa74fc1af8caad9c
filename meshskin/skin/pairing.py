"""Pairing of the taxels of two skins by iterative closest points, with their rigid alignment.

Units (modules of twelve ids, or single taxels) are paired with the mutually nearest unit of the
other skin, and the alignment is fitted to the pairs, from several initial alignments. A unit paired
with one of another id has moved.

Source: Besl, McKay, "A Method for Registration of 3-D Shapes", IEEE PAMI 14(2), 1992.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial import KDTree

from ..core import se3
from ..core.arrays import Array, Index, neighbour_distances
from ..core.value import Value
from .slots import Ids

MAX_ITERATIONS = 20
"""Largest number of pairings from one initial alignment. In tests/skin/test_compare.py they
repeat after four at most."""
MOVED_RATIO = 0.5
"""A unit has moved to another one only if that is nearer than this part of the distance to the unit
of the same id: noise smaller than a third of the spacing is not taken for a motion."""
SAME_PLACE = 0.35
"""Largest distance of a unit from the place of another, in distances to its own nearest neighbour:
below half of it, where it would be as near to that neighbour."""


@dataclass(frozen=True, eq=False)
class Pairing(Value):
    """Which taxels of skin B are at the positions of those of skin A."""

    pose: Array
    """(4, 4) T_a_b"""
    size: int
    """ids in a unit: 12 for modules, 1 for taxels"""
    moved: dict[int, int]
    """units paired with one of another number: number in A -> number in B"""
    rows_a: Index
    rows_b: Index
    """rows of paired taxels"""
    score: float
    """mean distance of units of A to their partners, or to the nearest unit of B, m"""

    def distances(self, at_a: Array, at_b: Array) -> Array:
        """(p,) distances of the pairs of taxels after the alignment, m."""
        return distances(self.pose, at_a[self.rows_a], at_b[self.rows_b])


def pair(ids_a: Ids, at_a: Array, ids_b: Ids, at_b: Array, size: int) -> Pairing | None:
    """The best pairing of units of `size` ids; None if the skins have no such units in common."""
    units_a, units_b, shared = np.unique(ids_a // size), np.unique(ids_b // size), None
    if size > 1:
        shared = _shared_slots(ids_a, ids_b, size)
        if shared is None or min(len(units_a), len(units_b)) < 2:
            return None
    rows_a, rows_b = _rows(ids_a, units_a, size, shared), _rows(ids_b, units_b, size, shared)
    best: tuple[float, Array, Index] | None = None
    for start in _initial_alignments(ids_a, at_a, ids_b, at_b):
        pose, partner = start, np.full(len(units_a), -2)
        for _ in range(MAX_ITERATIONS):
            aligned = se3.transform_points(pose, at_b[rows_b])
            nearest, vacant = _partners(at_a[rows_a], aligned, units_a, units_b)
            now = _consistent(nearest, units_a, units_b, vacant)
            if np.array_equal(now, partner):
                break
            partner = now
            paired = partner >= 0
            if paired.sum() * rows_a.shape[1] < 3:
                break
            there = at_b[rows_b[partner[paired]]].reshape(-1, 3)
            pose = _robust_align(there, at_a[rows_a[paired]].reshape(-1, 3))
        score = _score(at_a[rows_a], se3.transform_points(pose, at_b[rows_b]), partner)
        if best is None or score < best[0]:
            best = score, pose, partner
    assert best is not None
    score, pose, partner = best
    paired = partner >= 0
    pairs = dict(zip(units_a[paired].tolist(), units_b[partner[paired]].tolist(), strict=True))
    rows = np.flatnonzero(np.isin(ids_a // size, list(pairs)))
    target = np.array([pairs[unit] for unit in (ids_a[rows] // size).tolist()], dtype=np.int64)
    expected = size * target + ids_a[rows] % size
    _, found, rows_there = np.intersect1d(expected, ids_b, return_indices=True)
    if len(found) >= 3:
        pose = _robust_align(at_b[rows_there], at_a[rows[found]])
    changed = {u: v for u, v in pairs.items() if u != v}
    return Pairing(pose, size, changed, rows[found], rows_there, score)


def pairing_by_id(at_a: Array, at_b: Array, rows_a: Index, rows_b: Index) -> Pairing | None:
    """The pairing of taxels of the same id, in these rows; None if there are fewer than 3.

    Of a robust alignment and the least-squares alignment it has the one of smaller rms distance.
    """
    if len(rows_a) < 3:
        return None
    a, b = at_a[rows_a], at_b[rows_b]
    poses = _robust_align(b, a), se3.align(b, a)
    pose = min(poses, key=lambda pose: float(np.sum(distances(pose, a, b) ** 2)))
    return Pairing(pose, 1, {}, rows_a, rows_b, float(distances(pose, a, b).mean()))


def distances(pose: Array, at_a: Array, at_b: Array) -> Array:
    """(n,) distances of points (n, 3) of A to those of B, which `pose` T_a_b aligns, m."""
    return np.asarray(np.linalg.norm(at_a - se3.transform_points(pose, at_b), axis=1))


def _shared_slots(ids_a: Ids, ids_b: Ids, size: int) -> Ids | None:
    """Slots that every unit of both skins has; None if there are fewer than 3."""
    every = [
        np.bincount(i % size, minlength=size) == len(np.unique(i // size)) for i in (ids_a, ids_b)
    ]
    shared = np.flatnonzero(every[0] & every[1])
    return shared if len(shared) >= 3 else None


def _rows(ids: Ids, units: Ids, size: int, shared: Ids | None) -> Index:
    """Rows (units, slots) of the taxels of each unit among sorted ids."""
    expected = size * units[:, None] + (np.zeros(1, dtype=np.int64) if shared is None else shared)
    return np.searchsorted(ids, expected)


def _initial_alignments(ids_a: Ids, at_a: Array, ids_b: Ids, at_b: Array) -> list[Array]:
    """Transforms T_a_b: the identity, by equal ids, and four that align the principal axes."""
    starts = [np.eye(4)]
    _, rows_a, rows_b = np.intersect1d(ids_a, ids_b, return_indices=True)
    if len(rows_a) >= 3:
        starts.append(_robust_align(at_b[rows_b], at_a[rows_a]))
    axes = []
    for points in (at_a, at_b):
        centre = points.mean(axis=0)
        r = np.linalg.svd(points - centre, full_matrices=False)[2].T
        r[:, 2] *= np.sign(np.linalg.det(r))
        axes.append(se3.transform(r, centre))
    for flip in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)):
        half_turn = se3.transform(np.diag(np.array(flip, dtype=float)), np.zeros(3))
        starts.append(axes[0] @ half_turn @ se3.inverse(axes[1]))
    return starts


def _robust_align(source: Array, target: Array) -> Array:
    """The alignment (4, 4) of the points whose residual is within 3 medians of all."""
    inliers = np.arange(len(source))
    pose = se3.align(source, target)
    for _ in range(10):
        off = np.linalg.norm(se3.transform_points(pose, source) - target, axis=1)
        now = np.flatnonzero(off <= 3.0 * np.median(off) + 1e-12)
        if len(now) < 3 or np.array_equal(now, inliers):
            break
        inliers = now
        pose = se3.align(source[inliers], target[inliers])
    return pose


def _partners(at_a: Array, at_b: Array, units_a: Ids, units_b: Ids) -> tuple[Index, Ids]:
    """For each unit of A (u, s, 3) its partner among those of B (v, s, 3), -1 if it has none; and
    the units of A at whose place there is none of B.

    The unit of the same id is the partner unless another one is at the place, much nearer, and
    nearest both ways.
    """
    k = at_a.shape[1]
    flat_a, flat_b = at_a.reshape(len(at_a), -1), at_b.reshape(len(at_b), -1)
    off_a, near_a = KDTree(flat_b).query(flat_a)
    _, near_b = KDTree(flat_a).query(flat_b)
    mutual = near_b[near_a] == np.arange(len(at_a))
    partner = np.full(len(at_a), -1)
    _, a, b = np.intersect1d(units_a, units_b, return_indices=True)
    partner[a] = b
    own = np.full(len(at_a), np.inf)
    own[a] = np.linalg.norm(flat_a[a] - flat_b[b], axis=1)
    neighbour = neighbour_distances(flat_a)
    at_place = (off_a < SAME_PLACE * neighbour) & (off_a < MOVED_RATIO * own - 1e-6 * np.sqrt(k))
    swap = mutual & at_place & (near_a != partner)
    partner[swap] = near_a[swap]
    # of the same id, but now the partner of another unit
    partner[np.isin(partner, near_a[swap]) & ~swap] = -1
    return partner, units_a[off_a >= SAME_PLACE * neighbour]


def _consistent(partner: Index, units_a: Ids, units_b: Ids, vacant: Ids) -> Index:
    """The partners without moves that belong neither to a cycle nor to a renumbering.

    A unit may only move to a number whose unit moves too, or that A does not have, or whose place
    is `vacant` in B; and only from a number to which another unit moves, or that B does not have.
    """
    partner = partner.copy()
    known_a, known_b = set(units_a.tolist()) - set(vacant.tolist()), set(units_b.tolist())
    index_b = {unit: k for k, unit in enumerate(units_b.tolist())}
    row_a = {unit: k for k, unit in enumerate(units_a.tolist())}
    rows = np.flatnonzero(partner >= 0)
    pairs = zip(units_a[rows].tolist(), units_b[partner[rows]].tolist(), strict=True)
    moved = {u: v for u, v in pairs if u != v}
    while True:
        taken = set(moved.values())
        inconsistent = [
            u
            for u, v in moved.items()
            if (v in known_a and v not in moved) or (u in known_b and u not in taken)
        ]
        if not inconsistent:
            return partner
        for unit in inconsistent:
            for number in (unit, moved.pop(unit)):
                if number in row_a and number not in moved:
                    partner[row_a[number]] = index_b.get(number, -1)


def _score(at_a: Array, at_b: Array, partner: Index) -> float:
    """Mean distance of units to their partners, or else to the nearest unit, m."""
    has = partner >= 0
    off = KDTree(at_b.reshape(len(at_b), -1)).query(at_a.reshape(len(at_a), -1))[0]
    off = off / np.sqrt(at_a.shape[1])
    paired = at_a[has] - at_b[partner[has]]
    off[has] = np.sqrt(np.mean(np.sum(paired**2, axis=2), axis=1))
    return float(off.mean())
