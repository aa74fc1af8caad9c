"""Packing of modules on a surface: placed on the triangles of a relaxed lattice, and pushed apart.

Rows of triangles do not close on a curved surface. A relaxed lattice distributes the excess over
the whole surface: modules on its triangles overlap a little everywhere, and pushing each pair apart
settles nearly all. Where some overlap when the layout no longer improves, the most crowded are
removed.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from ..core.arrays import Array, Index, far_apart, sums_by_group
from ..geometry import region as regions
from ..geometry.body import Body
from . import lattice, module_pose, slots
from .module_pose import CIRCUMRADIUS

SITE_SPACING = 0.985
"""Spacing of the lattice relative to that of the modules: a few modules too many settle into a
denser layout than a few too few."""
CLEARANCE = 0.2e-3
"""Least gap between settled modules, m: a fifth of the gap of 1 mm between iCub's modules."""
ROUNDS, PUSHES = 80, 12
"""Largest number of rounds, and pushes in each between two fits to the surface."""
REACH = 5e-3
"""Distance by which two modules may approach each other in a round and still be considered, m."""
PROGRESS = 0.9
"""The most crowded modules are removed when a round leaves more than this part of the overlap."""
REMOVED = 80
"""One of so many modules is removed at a time, at least one."""


def pack(body: Body, region: regions.Region, first: lattice.Lattice, spacing: float) -> Array:
    """Poses (m, 4, 4) of modules over a region that do not overlap, about `spacing` (m) apart."""
    side = SITE_SPACING * spacing * np.sqrt(3.0)
    sites = lattice.relax(body, region, lattice.fill(body, region, side, first), side)
    corners = sites.at.point[_triangles(sites, side)]
    centres = corners.mean(axis=1)
    at = body.closest(centres)
    headings = np.cross(corners[:, 0] - centres, at.normal)  # a corner lies along y
    poses = module_pose.fit(body, region, centres, headings)
    gap = spacing - CIRCUMRADIUS
    last = np.inf
    for _ in range(ROUNDS):
        if not len(poses):
            break
        pushed, pairs = poses, _neighbours(poses, gap + REACH)
        for _ in range(PUSHES):
            pushed = push(pushed, pairs, gap)
        pushed = module_pose.fit_to_surface(body, pushed)
        valid = module_pose.is_valid(body, region, pushed)
        poses = np.where(valid[:, None, None], pushed, poses)
        one, two = _neighbours(poses, 0.0)
        separation = module_pose.separation(poses[one], poses[two])[0]
        overlap = np.maximum(min(gap, CLEARANCE) - separation, 0.0)
        if not overlap.any():
            break
        if overlap.sum() < PROGRESS * last:
            last = overlap.sum()
            continue
        last = np.inf
        load = np.bincount(np.concatenate([one, two]), np.tile(overlap, 2), len(poses))
        order = np.argsort(-load, kind="stable")[: np.count_nonzero(load)]
        count = max(1, len(poses) // REMOVED)
        removed = far_apart(poses[:, :3, 3], order, 4.0 * CIRCUMRADIUS, count)
        poses = np.delete(poses, removed, axis=0)
    return poses


def _triangles(sites: lattice.Lattice, side: float) -> Index:
    """Triples (k, 3) of sites that are neighbours of each other."""
    one, two = lattice.neighbour_pairs(sites, lattice.SPRING_REACH * side)
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


def _neighbours(poses: Array, gap: float) -> tuple[Index, Index]:
    """Pairs of modules whose circumcircles are nearer than a gap (m), normals within 90 degrees."""
    reach = 2.0 * CIRCUMRADIUS + gap
    one, two = KDTree(poses[:, :3, 3]).query_pairs(reach, output_type="ndarray").T
    facing = np.einsum("ki,ki->k", poses[one, :3, 2], poses[two, :3, 2]) > 0.0
    return one[facing], two[facing]


def push(poses: Array, pairs: tuple[Index, Index], gap: float) -> Array:
    """Poses (m, 4, 4) moved and rotated to halve what pairs lack to a gap (m).

    Each pair is pushed apart at its nearest corner, as two plates by a force.
    """
    distance, direction, corner = module_pose.separation(poses[pairs[0]], poses[pairs[1]])
    near = np.flatnonzero(distance < gap)
    ends = np.concatenate([pairs[0][near], pairs[1][near]])
    half = 0.25 * (gap - distance[near, None]) * direction[near]
    step = np.concatenate([-half, half])
    arm = np.tile(corner[near], (2, 1)) - poses[ends, :3, 3]
    lever = np.einsum("ki,ki->k", np.cross(arm, step), poses[ends, :3, 2])
    lever /= (
        np.einsum("ki,ki->k", arm, arm) + slots.SIDE**2 / 12.0
    )  # moment of inertia of a plate about the corner
    count = len(poses)
    move = sums_by_group(step, ends, count)
    angle = np.bincount(ends, lever, count)[:, None]
    x, y, z = (poses[:, :3, k] for k in range(3))
    return module_pose.upright(poses[:, :3, 3] + move, z, np.cos(angle) * x + np.sin(angle) * y)
