"""Taxels of two skins paired, and the rigid motion between them, found together.

Units (modules of twelve ids, or single taxels) are paired with the nearest unit of the other skin,
both ways, and the motion is fitted to the pairs (iterated closest point), from several starts. A
unit whose nearest is not its namesake has moved.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core import se3

Array = NDArray[np.float64]
Ids = NDArray[np.int64]

ROUNDS = 20
"""pairings of one start, at most"""
CLEARLY = 0.5
"""of its namesake's distance: a unit nearer than that to another has moved"""
HERE = 0.35
"""of the distance to the nearest other unit of the skin: so near a unit lies where another does"""


@dataclass(frozen=True)
class Pairing:
    """Which taxels of skin B lie where those of skin A do."""

    pose: Array
    """(4, 4) T_a_b"""
    size: int
    """ids of a unit"""
    moved: dict[int, int]
    """unit of A -> unit of B"""
    rows_a: NDArray[np.intp]
    rows_b: NDArray[np.intp]
    """rows of paired taxels"""
    score: float
    """mean distance in m of paired taxels; a unit without partner counts by the farthest pair"""


def pair(ids_a: Ids, at_a: Array, ids_b: Ids, at_b: Array, size: int) -> Pairing | None:
    """The best pairing of units of so many ids, from all starts; None where units are not alike."""
    units_a, units_b, shared = _units(ids_a, size), _units(ids_b, size), None
    if size > 1:
        shared = _shared_slots(ids_a, ids_b, size)
        if shared is None or min(len(units_a), len(units_b)) < 2:
            return None
    rows_a, rows_b = _rows(ids_a, units_a, size, shared), _rows(ids_b, units_b, size, shared)
    best: tuple[float, Array, NDArray[np.intp]] | None = None
    for start in _starts(ids_a, at_a, ids_b, at_b):
        pose, partner = start, np.full(len(units_a), -2)
        for _ in range(ROUNDS):
            near = _partners(at_a[rows_a], moved(pose, at_b[rows_b]), units_a, units_b)
            now = _closed(near, units_a, units_b)
            if np.array_equal(now, partner):
                break
            partner = now
            has = partner >= 0
            if has.sum() * rows_a.shape[1] < 3:
                break
            one, two = at_a[rows_a[has]].reshape(-1, 3), at_b[rows_b[partner[has]]].reshape(-1, 3)
            pose = _robust(two, one)
        score = _score(at_a[rows_a], moved(pose, at_b[rows_b]), partner)
        if best is None or score < best[0]:
            best = score, pose, partner
    assert best is not None
    score, _, partner = best
    has = partner >= 0
    pairs = dict(zip(units_a[has].tolist(), units_b[partner[has]].tolist(), strict=True))
    rows = np.flatnonzero(np.isin(ids_a // size, list(pairs)))
    there = np.array([pairs[unit] for unit in (ids_a[rows] // size).tolist()], dtype=np.int64)
    wanted = size * there + ids_a[rows] % size
    _, found, rows_there = np.intersect1d(wanted, ids_b, return_indices=True)
    pose = _robust(at_b[rows_there], at_a[rows[found]])
    renamed = {u: v for u, v in pairs.items() if u != v}
    return Pairing(pose, size, renamed, rows[found], rows_there, score)


def _units(ids: Ids, size: int) -> Ids:
    return np.unique(ids // size)


def _shared_slots(ids_a: Ids, ids_b: Ids, size: int) -> Ids | None:
    """Slots that every unit of both skins has; None where there are fewer than 3."""
    counts = [
        np.bincount(ids % size, minlength=size) / len(_units(ids, size)) for ids in (ids_a, ids_b)
    ]
    shared = np.flatnonzero((counts[0] == 1.0) & (counts[1] == 1.0))
    return shared if len(shared) >= 3 else None


def _rows(ids: Ids, units: Ids, size: int, shared: Ids | None) -> NDArray[np.intp]:
    """Rows (units, slots) of the taxels of each unit; ids are sorted."""
    wanted = size * units[:, None] + (np.zeros(1, dtype=np.int64) if shared is None else shared)
    return np.searchsorted(ids, wanted)


def _starts(ids_a: Ids, at_a: Array, ids_b: Ids, at_b: Array) -> list[Array]:
    """Motions T_a_b to begin with: none, by ids, and of the principal axes onto each other."""
    starts = [np.eye(4)]
    _, rows_a, rows_b = np.intersect1d(ids_a, ids_b, return_indices=True)
    if len(rows_a) >= 3:
        starts.append(_robust(at_b[rows_b], at_a[rows_a]))
    axes = []
    for points in (at_a, at_b):
        middle = points.mean(axis=0)
        r = np.linalg.svd(points - middle, full_matrices=False)[2].T
        r[:, 2] *= np.sign(np.linalg.det(r))
        axes.append(se3.transform(r, middle))
    for flip in ((1, 1, 1), (1, -1, -1), (-1, 1, -1), (-1, -1, 1)):
        turn = se3.transform(np.diag(np.array(flip, dtype=float)), np.zeros(3))
        starts.append(axes[0] @ turn @ se3.inverse(axes[1]))
    return starts


def _robust(source: Array, target: Array) -> Array:
    """The motion (4, 4) of most of the points: those within 3 medians of the rest are kept."""
    kept = np.arange(len(source))
    pose = se3.align(source, target)
    for _ in range(10):
        off = np.linalg.norm(moved(pose, source) - target, axis=1)
        now = np.flatnonzero(off <= 3.0 * np.median(off) + 1e-12)
        if len(now) < 3 or np.array_equal(now, kept):
            break
        kept = now
        pose = se3.align(source[kept], target[kept])
    return pose


def _partners(at_a: Array, at_b: Array, units_a: Ids, units_b: Ids) -> NDArray[np.intp]:
    """For each unit of A (u, s, 3) that of B (v, s, 3) that lies there; -1 where none does.

    A namesake stays the partner unless another unit is clearly nearer and is nearest both ways.
    """
    k = at_a.shape[1]
    flat_a, flat_b = at_a.reshape(len(at_a), -1), at_b.reshape(len(at_b), -1)
    off_a, near_a = _tree(flat_b).query(flat_a)
    _, near_b = _tree(flat_a).query(flat_b)
    mutual = near_b[near_a] == np.arange(len(at_a))
    partner = np.full(len(at_a), -1)
    _, a, b = np.intersect1d(units_a, units_b, return_indices=True)
    partner[a] = b
    own = np.full(len(at_a), np.inf)
    own[a] = np.linalg.norm(flat_a[a] - flat_b[b], axis=1)
    room = _tree(flat_a).query(flat_a, k=2)[0][:, 1]
    there = (off_a < HERE * room) & (off_a < CLEARLY * own - 1e-6 * np.sqrt(k))
    swap = mutual & there & (near_a != partner)
    partner[swap] = near_a[swap]
    taken = np.isin(partner, near_a[swap]) & ~swap  # a namesake that is another's partner now
    partner[taken] = -1
    return partner


def _closed(partner: NDArray[np.intp], units_a: Ids, units_b: Ids) -> NDArray[np.intp]:
    """The partners, without moves that are neither part of a cycle nor of a new name.

    A unit may only move to the number of one that moves too, or that A does not have, and only
    from a number that another takes, or that B does not have.
    """
    partner = partner.copy()
    known_a, known_b = set(units_a.tolist()), set(units_b.tolist())
    index_b = {unit: k for k, unit in enumerate(units_b.tolist())}
    row_a = {unit: k for k, unit in enumerate(units_a.tolist())}
    rows = np.flatnonzero(partner >= 0)
    pairs = zip(units_a[rows].tolist(), units_b[partner[rows]].tolist(), strict=True)
    moved = {u: v for u, v in pairs if u != v}
    while True:
        taken = set(moved.values())
        loose = [
            u
            for u, v in moved.items()
            if (v in known_a and v not in moved) or (u in known_b and u not in taken)
        ]
        if not loose:
            return partner
        for unit in loose:
            for here in (unit, moved.pop(unit)):
                if here in row_a and here not in moved:
                    partner[row_a[here]] = index_b.get(here, -1)


def _score(at_a: Array, at_b: Array, partner: NDArray[np.intp]) -> float:
    """Mean distance of paired taxels; units without partner count by the distance to any."""
    has = partner >= 0
    off = _tree(at_b.reshape(len(at_b), -1)).query(at_a.reshape(len(at_a), -1))[0]
    off = off / np.sqrt(at_a.shape[1])
    paired = at_a[has] - at_b[partner[has]]
    off[has] = np.sqrt(np.mean(np.sum(paired**2, axis=2), axis=1))
    return float(off.mean())


def moved(pose: Array, points: Array) -> Array:
    """Points (..., 3) after a motion (4, 4)."""
    return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])


def _tree(points: Array) -> Any:
    from scipy.spatial import KDTree

    return KDTree(points)
