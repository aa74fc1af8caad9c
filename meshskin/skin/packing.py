"""Modules packed on a surface: laid on the triangles of a relaxed lattice, and pushed apart.

Rows of triangles do not close up on a curved surface. A relaxed lattice spreads what is too much
all over it: modules on its triangles crowd everywhere a little, and pushing each pair apart lets
nearly all settle. Where some overlap when nothing moves any more, the most crowded ones go.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry import region as regions
from ..geometry.body import Body
from . import lattice, slots, tile

Array = NDArray[np.float64]
Index = NDArray[np.intp]

CLOSER = 0.985
"""spacing of the lattice, relative to the modules': a few too many settle better than too few"""
CLEAR = 0.2e-3
"""m, the least gap between modules that are taken as settled"""
ROUNDS, PUSHES = 80, 12
"""rounds at most, and pushes in each"""
REACH = 5e-3
"""m, how far modules may move towards each other in a round and still be noticed"""
STILL = 0.9
"""share of the overlap that a round must leave less of, or the most crowded modules go"""
GONE = 80
"""of how many modules one goes at a time"""


def pack(body: Body, region: regions.Region, first: lattice.Lattice, spacing: float) -> Array:
    """Poses (m, 4, 4) of modules over a region that do not overlap, about `spacing` (m) apart."""
    side = CLOSER * spacing * np.sqrt(3.0)
    sites = lattice.relax(body, region, lattice.fill(body, region, side, first), side)
    corners = sites.at.point[_triangles(sites, side)]
    middles = corners.mean(axis=1)
    at = body.closest(middles)
    headings = np.cross(corners[:, 0] - middles, at.normal)  # a corner lies along y
    poses = tile.fit(body, region, middles, headings)
    gap = spacing - tile.OUTLINE
    last = np.inf
    for _ in range(ROUNDS):
        if not len(poses):
            break
        pushed, pairs = poses, _beside(poses, gap + REACH)
        for _ in range(PUSHES):
            pushed = push(pushed, pairs, gap)
        pushed = tile.nearer(body, pushed)
        good = tile.fits(body, region, pushed)
        poses = np.where(good[:, None, None], pushed, poses)
        one, two = _beside(poses, 0.0)
        short = np.maximum(min(gap, CLEAR) - tile.apart(poses[one], poses[two])[0], 0.0)
        if not short.any():
            break
        if short.sum() < STILL * last:
            last = short.sum()
            continue
        last = np.inf
        load = np.bincount(np.concatenate([one, two]), np.tile(short, 2), len(poses))
        poses = np.delete(poses, _worst(poses, load), axis=0)
    return poses


def _triangles(sites: lattice.Lattice, side: float) -> Index:
    """Triples (k, 3) of sites, each tied to the two others."""
    one, two = lattice.ties(sites, lattice.REACH * side)
    beside: list[set[int]] = [set() for _ in range(len(sites))]
    for a, b in zip(one.tolist(), two.tolist(), strict=True):
        beside[a].add(b)
        beside[b].add(a)
    found = [
        (a, b, c)
        for a in range(len(sites))
        for b in sorted(beside[a])
        for c in sorted(beside[a] & beside[b])
        if a < b < c
    ]
    return np.array(found, dtype=np.intp).reshape(-1, 3)


def _beside(poses: Array, gap: float) -> tuple[Index, Index]:
    """Pairs of modules that may be nearer than a gap (m), and face the same way."""
    from scipy.spatial import KDTree

    reach = 2.0 * tile.OUTLINE + gap
    one, two = KDTree(poses[:, :3, 3]).query_pairs(reach, output_type="ndarray").T
    facing = np.einsum("ki,ki->k", poses[one, :3, 2], poses[two, :3, 2]) > 0.0
    return one[facing], two[facing]


def push(poses: Array, pairs: tuple[Index, Index], gap: float) -> Array:
    """Poses (m, 4, 4) moved and turned so that pairs nearer than a gap (m) part by half of it."""
    far, way, corner = tile.apart(poses[pairs[0]], poses[pairs[1]])
    near = np.flatnonzero(far < gap)
    ends = np.concatenate([pairs[0][near], pairs[1][near]])
    half = 0.25 * (gap - far[near, None]) * way[near]
    step = np.concatenate([-half, half])
    arm = np.tile(corner[near], (2, 1)) - poses[ends, :3, 3]
    lever = np.einsum("ki,ki->k", np.cross(arm, step), poses[ends, :3, 2])
    lever /= np.einsum("ki,ki->k", arm, arm) + slots.SIDE**2 / 12.0  # as of a plate
    count = len(poses)
    move = np.stack([np.bincount(ends, step[:, k], count) for k in range(3)], axis=1)
    turn = np.bincount(ends, lever, count)[:, None]
    x, y, z = (poses[:, :3, k] for k in range(3))
    return tile.posed(poses[:, :3, 3] + move, z, np.cos(turn) * x + np.sin(turn) * y)


def _worst(poses: Array, load: NDArray[Any]) -> Index:
    """The most crowded modules, by their load (m,): one of GONE, far apart from each other."""
    from scipy.spatial import KDTree

    tree = KDTree(poses[:, :3, 3])
    gone: list[int] = []
    beside = np.zeros(len(poses), dtype=bool)
    for k in np.argsort(-load, kind="stable").tolist():
        if load[k] <= 0.0 or len(gone) >= max(1, len(poses) // GONE):
            break
        if not beside[k]:
            gone.append(k)
            beside[tree.query_ball_point(poses[k, :3, 3], 4.0 * tile.OUTLINE)] = True
    return np.array(gone, dtype=np.intp)
