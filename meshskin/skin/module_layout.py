"""Layouts of triangular modules of the kind that covers iCub, side by side over a body.

A module is rigid: its taxels keep their offsets, and its pose is the least-squares fit of its
taxels to the surface; on a curved surface they lie a little above and below it
(`modules.skin.onto(body)` moves them onto it). Modules grow from the region's centre, each across
the sides of those laid before. On a curved surface the rows do not close, and where a module would
overlap another there is a gap. So a whole region is also laid out by packing, and the layout with
more modules is taken.

Packing places modules on the triangles of a relaxed lattice, which distributes the excess over the
whole surface: modules overlap a little everywhere, and pushing each pair apart removes nearly all
overlaps. If some remain when the layout no longer improves, the most crowded modules are removed.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from ..core.arguments import check_integer, check_real
from ..core.arrays import Array, Index, far_apart, ranges, sums_by_group
from ..core.errors import SkinError
from ..core.provenance import random_stream
from ..geometry import region as regions
from ..geometry.body import Body
from ..geometry.geodesics import arc_length, march, onto, rotate_about
from . import lattice, module_pose, slots
from .module_pose import CIRCUMRADIUS

SPACING = 18.3e-3
"""Default distance between the centres of neighbours, m: triangles with sides of 30 mm, 1 mm apart,
as on iCub."""
MAX_MODULES = 20_000
"""Largest number of modules of one layout: more are a wrong unit."""

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


def module_poses(
    body: Body, count: int | None, spacing: float, region: regions.Region, seed: int
) -> Array:
    """Poses (m, 4, 4) T_b_module of the modules of `Skin.modules`; arguments as there. Raises
    SkinError."""
    least = slots.SIDE / np.sqrt(3.0)
    check_real("spacing of modules", spacing, "m", least=least, error=SkinError)
    if count is not None:
        check_integer("number of modules", count, least=1, most=MAX_MODULES, error=SkinError)
    first = lattice.first_site(body, region, spacing, random_stream(seed, "module layout"))
    poses = _grow(body, region, first, spacing, count)
    if count is None or len(poses) < count:
        layouts = poses, pack(body, region, first, spacing)
        poses = max((_fill(body, region, first, spacing, p) for p in layouts), key=len)
    if len(poses) < (count or 1):
        raise SkinError(
            "the modules do not fit the region",
            value=f"{count or 1} modules",
            limit=f"{len(poses)} fit",
            remedy="give fewer modules, or a region that is larger or less curved",
        )
    distance = arc_length(region.centre(body), body.closest(poses[:, :3, 3]))
    return np.asarray(poses[np.argsort(distance, kind="stable")[:count]])


def _grow(
    body: Body, region: regions.Region, first: lattice.Lattice, spacing: float, count: int | None
) -> Array:
    """Poses (m, 4, 4) grown from a site ring by ring, to one ring more than `count` modules."""
    enough = MAX_MODULES if count is None else count + 6 * round(np.sqrt(count)) + 6  # a ring more
    layout = _Layout()
    front = layout.add(module_pose.fit(body, region, first.at.point, first.tangent))
    while len(front) and len(layout.poses) < enough:
        front = layout.add(module_pose.fit(body, region, *_neighbours(body, front, spacing)))
    return np.array(layout.poses).reshape(-1, 4, 4)


def _fill(
    body: Body, region: regions.Region, first: lattice.Lattice, spacing: float, poses: Array
) -> Array:
    """The poses (m, 4, 4), and more wherever there is room left."""
    layout = _Layout()
    layout.add(poses)
    sites = lattice.fill(body, region, 0.5 * spacing, first)
    for angle in np.radians([0.0, 60.0, 30.0, 90.0]):  # a third of a turn gives the same triangle
        heading = rotate_about(sites.at.normal, sites.tangent, angle)
        free = layout.free(sites.at.point)
        layout.add(module_pose.fit(body, region, sites.at.point[free], heading[free]))
    return np.array(layout.poses).reshape(-1, 4, 4)


class _Layout:
    """Modules that do not overlap, and their bounding boxes in an R-tree."""

    def __init__(self) -> None:
        from rtree import index as rtree

        self.poses: list[Array] = []
        self._boxes = rtree.Index(properties=rtree.Property(dimension=3))

    def add(self, poses: Array) -> Array:
        """Add those of the poses (k, 4, 4), in their order, that overlap none added before."""
        added = []
        for pose in poses:
            # triangles overlap only where their centres are within two circumradii
            box = np.concatenate([pose[:3, 3] - CIRCUMRADIUS, pose[:3, 3] + CIRCUMRADIUS])
            near = [self.poses[k] for k in self._boxes.intersection(box)]
            if near and module_pose.overlapping(pose, np.array(near)).any():
                continue
            self._boxes.insert(len(self.poses), box)
            self.poses.append(pose)
            added.append(pose)
            if len(self.poses) > MAX_MODULES:
                raise SkinError("too many modules", value=len(self.poses), limit=MAX_MODULES)
        return np.array(added).reshape(-1, 4, 4)

    def free(self, points: Array) -> Index:
        """Rows of the points (n, 3) that are a circumradius or more from every module's centre."""
        if not self.poses:
            return np.arange(len(points))
        centres = np.array(self.poses)[:, :3, 3]
        return np.flatnonzero(KDTree(centres).query(points)[0] >= CIRCUMRADIUS)


def _neighbours(body: Body, poses: Array, spacing: float) -> tuple[Array, Array]:
    """Centres and headings, (3 k, 3) each, of the neighbours across the sides of k modules."""
    middles = slots.CORNERS + np.roll(slots.CORNERS, -1, axis=0)
    outward = middles / np.linalg.norm(middles, axis=1, keepdims=True)
    heading = (outward @ np.swapaxes(poses[:, :3, :3], 1, 2)).reshape(-1, 3)
    at = body.closest(np.repeat(poses[:, :3, 3], 3, axis=0))
    heading, x = (onto(v, at.normal) for v in (heading, np.repeat(poses[:, :3, 0], 3, 0)))
    end, carried = march(body, at, heading, x, spacing)
    return end.point, -carried


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
        pushed, pairs = poses, _near(poses, gap + REACH)
        for _ in range(PUSHES):
            pushed = push(pushed, pairs, gap)
        pushed = module_pose.fit_to_surface(body, pushed)
        valid = module_pose.is_valid(body, region, pushed)
        poses = np.where(valid[:, None, None], pushed, poses)
        one, two = _near(poses, 0.0)
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
    one, two = sites.pairs(lattice.SPRING_REACH * side)
    order = np.lexsort((two, one))
    a, b, n = one[order], two[order], len(sites)
    first, last = (np.searchsorted(a, b, end) for end in ("left", "right"))
    row, c = np.repeat(np.arange(len(a)), last - first), b[ranges(first, last - first)]
    closed = np.isin(n * a[row] + c, n * a + b)
    return np.stack([a[row], b[row], c], axis=1)[closed]


def _near(poses: Array, gap: float) -> tuple[Index, Index]:
    """Pairs of modules whose circumcircles are nearer than a gap (m), normals within 90 degrees."""
    return lattice.facing_pairs(poses[:, :3, 3], poses[:, :3, 2], 2.0 * CIRCUMRADIUS + gap)


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
