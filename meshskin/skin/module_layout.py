"""Layouts of triangular modules of the kind that covers iCub, side by side over a body.

A module is rigid: its taxels keep their offsets, and its pose is the least-squares fit of its
taxels to the surface; on a curved surface they lie a little above and below it
(`modules.skin.onto(body)` moves them onto it). Modules grow from the region's centre, each across
the sides of those laid before. On a curved surface the rows do not close, and where a module would
overlap another there is a gap. So a whole region is also laid out by packing (packing.py), and the
layout with more modules is taken.
"""

from __future__ import annotations

import numpy as np
from rtree.index import Index as BoxIndex
from rtree.index import Property
from scipy.spatial import KDTree

from ..core.arguments import check_integer, check_real
from ..core.arrays import Array, Index
from ..core.errors import SkinError
from ..core.provenance import random_stream
from ..geometry import region as regions
from ..geometry.body import Body
from ..geometry.geodesics import march, onto, rotate_about
from . import lattice, module_pose, packing, slots
from .module_pose import CIRCUMRADIUS

SPACING = 18.3e-3
"""Default distance between the centres of neighbours, m: triangles with sides of 30 mm, 1 mm apart,
as on iCub."""
MAX_MODULES = 20_000
"""Largest number of modules of one layout: more are a wrong unit."""


def module_poses(
    body: Body, count: int | None, spacing: float, region: regions.Region, seed: int
) -> Array:
    """Poses (m, 4, 4) T_b_module of `Skin.modules`, which see. Raises SkinError."""
    least = slots.SIDE / np.sqrt(3.0)
    check_real("spacing of modules", spacing, "m", least=least, error=SkinError)
    if count is not None:
        check_integer("number of modules", count, least=1, most=MAX_MODULES, error=SkinError)
    first = lattice.first_site(body, region, spacing, random_stream(seed, "module layout"))
    poses = _grow(body, region, first, spacing, count)
    if count is None or len(poses) < count:
        layouts = poses, packing.pack(body, region, first, spacing)
        poses = max((_fill(body, region, first, spacing, p) for p in layouts), key=len)
    if len(poses) < (count or 1):
        raise SkinError(
            "number of modules",
            value=count or 1,
            limit=f"the {len(poses)} that fit the region",
            remedy="a larger region, or one that is less curved",
        )
    distance = regions.arc_length(region.centre(body), body.closest(poses[:, :3, 3]))
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
        self.poses: list[Array] = []
        self._boxes = BoxIndex(properties=Property(dimension=3))

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
                raise SkinError("number of modules", value=len(self.poses), limit=MAX_MODULES)
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
