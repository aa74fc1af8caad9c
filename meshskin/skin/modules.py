"""Triangular modules of the kind that covers iCub, laid side by side over a body.

A module is rigid: its taxels keep their offsets exactly, and its pose is the one whose taxels are
nearest to the surface, in the mean of squares; on a curved surface they lie a little above and
below it (`modules.skin.onto(body)` bends them onto it). Modules grow from the region's centre, each
across the sides of those laid before; on a curved surface the rows do not close, and where a module
would overlap another, there is a gap. So a whole region is also laid another way (packing.py), and
of the two layouts the one with more modules is taken.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..core import se3
from ..core.errors import SkinError
from ..core.provenance import random_stream
from ..geometry import region as regions
from ..geometry.body import Body
from ..geometry.geodesics import march, onto
from . import lattice, packing, slots, tile
from .tile import MIDDLES, OUTLINE, overlapping

if TYPE_CHECKING:
    from .skin import Skin

Array = NDArray[np.float64]

SPACING = 18.3e-3
"""m, between the middles of neighbours: a triangle of 30 mm, and 1 mm between two"""
MOST = 20_000
"""most modules of one layout"""


@dataclass(frozen=True, eq=False)
class Modules:
    """m triangular modules in the body frame."""

    poses: Array
    """(m, 4, 4) T_b_module: origin in the middle of the triangle (slot 3), z outward"""
    numbers: NDArray[np.int64]
    """(m,) a taxel's id is 12 * number + slot"""
    disc_radius: float = 2e-3
    """radius in m of the disc over which a taxel averages pressure"""

    def __len__(self) -> int:
        return len(self.numbers)

    @cached_property
    def skin(self) -> Skin:
        """The taxels, ten a module, in their modules' frames."""
        from .skin import Skin

        offsets = se3.transform(np.eye(3), MIDDLES)
        poses = (self.poses[:, None] @ offsets).reshape(-1, 4, 4)
        ids = np.add.outer(slots.PER_MODULE * self.numbers, slots.TAXELS).ravel()
        return Skin(poses, ids, self.disc_radius)

    @property
    def corners(self) -> Array:
        """(m, 3, 3) corners of the triangles in m, counter-clockwise seen from outside."""
        return tile.corners(self.poses)

    @classmethod
    def of(cls, skin: Skin, most_off: float = 1e-3) -> Modules:
        """The poses of a skin's modules, found from the positions of their ten taxels.

        Normals are not used: a skin whose file has none, or wrong ones, gets those of its modules.
        Raises SkinError where a module is not whole, or a taxel is more than `most_off` (m) off.
        """
        numbers = np.unique(slots.module(skin.ids))
        if not slots.is_modular(skin.ids):
            raise SkinError(
                "a skin that is not of modules with ten taxels", limit="12 * module + slot"
            )
        order = np.argsort(skin.ids)
        points = skin.positions[order].reshape(len(numbers), len(slots.TAXELS), 3)
        poses = np.array([se3.align(MIDDLES, own) for own in points])
        modules = cls(poses, numbers, skin.disc_radius)
        off = np.linalg.norm(modules.skin.positions.reshape(points.shape) - points, axis=2)
        worst = int(np.argmax(off.max(axis=1)))
        if off[worst].max() > most_off:
            raise SkinError(
                f"taxels of module {numbers[worst]}, off those of a module by",
                value=f"{1e3 * off[worst].max():.2g} mm",
                limit=f"{1e3 * most_off:g} mm",
            )
        return modules


def lay(
    body: Body,
    count: int | None = None,
    spacing: float = SPACING,
    region: regions.Region | str | None = None,
    seed: int = 0,
    disc_radius: float = 2e-3,
) -> Modules:
    """Modules on a body: as many as fit the region, or the `count` nearest to its centre.

    `spacing` (m) is the distance of the middles of neighbours. A module belongs to a region (of
    region.py, or a patch's name) that holds all its taxels' closest points. `seed` turns and shifts
    the layout. Raises SkinError where modules would overlap on a plane, or where too few fit.
    """
    least = slots.SIDE / np.sqrt(3.0)
    if not spacing >= least:
        raise SkinError(
            "spacing of modules", value=f"{1e3 * spacing:g} mm", limit=f">= {1e3 * least:.4g} mm"
        )
    if count is not None and count < 1:
        raise SkinError("number of modules", value=count, limit=">= 1")
    region = regions.of(region)
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
    away = regions.arc_length(region.centre(body), body.closest(poses[:, :3, 3]))
    nearest = np.argsort(away, kind="stable")[: len(poses) if count is None else count]
    return Modules(poses[nearest], np.arange(len(nearest)), disc_radius)


def _grow(
    body: Body, region: regions.Region, first: lattice.Lattice, spacing: float, count: int | None
) -> Array:
    """Poses (m, 4, 4) grown from a site ring by ring, to a ring more than `count`."""
    enough = MOST if count is None else count + 6 * round(np.sqrt(count)) + 6  # a ring more
    laid = _Laid()
    front = laid.add(tile.fit(body, region, first.at.point, first.tangent))
    while len(front) and len(laid.poses) < enough:
        front = laid.add(tile.fit(body, region, *_across(body, front, spacing)))
    return np.array(laid.poses).reshape(-1, 4, 4)


def _fill(
    body: Body, region: regions.Region, first: lattice.Lattice, spacing: float, poses: Array
) -> Array:
    """The poses (m, 4, 4), and one more wherever there is room left."""
    laid = _Laid()
    laid.add(poses)
    sites = lattice.fill(body, region, 0.5 * spacing, first)
    side = np.cross(sites.at.normal, sites.tangent)
    for turn in np.radians([0.0, 60.0, 30.0, 90.0]):  # a third of a turn is the same triangle
        heading = np.cos(turn) * sites.tangent + np.sin(turn) * side
        room = laid.room(sites.at.point)
        laid.add(tile.fit(body, region, sites.at.point[room], heading[room]))
    return np.array(laid.poses).reshape(-1, 4, 4)


class _Laid:
    """The modules laid so far."""

    def __init__(self) -> None:
        self.poses: list[Array] = []

    def add(self, poses: Array) -> Array:
        """Take those of the poses (k, 4, 4), in their order, that overlap none taken before."""
        fresh = []
        for pose in poses:
            if not self.poses or not overlapping(pose, np.array(self.poses)).any():
                self.poses.append(pose)
                fresh.append(pose)
            if len(self.poses) > MOST:
                raise SkinError("number of modules", value=len(self.poses), limit=MOST)
        return np.array(fresh).reshape(-1, 4, 4)

    def room(self, points: Array) -> NDArray[np.intp]:
        """Which of the points (n, 3) keep two inner radii from every middle."""
        from scipy.spatial import KDTree

        if not self.poses:
            return np.arange(len(points))
        middles = np.array(self.poses)[:, :3, 3]
        return np.flatnonzero(KDTree(middles).query(points)[0] >= OUTLINE)


def _across(body: Body, poses: Array, spacing: float) -> tuple[Array, Array]:
    """Middles and headings, (3 k, 3) each, of the neighbours across the sides of k modules."""
    middles = slots.CORNERS + np.roll(slots.CORNERS, -1, axis=0)
    out = middles / np.linalg.norm(middles, axis=1, keepdims=True)
    heading = (out @ np.swapaxes(poses[:, :3, :3], 1, 2)).reshape(-1, 3)
    at = body.closest(np.repeat(poses[:, :3, 3], 3, axis=0))
    heading, x = (onto(v, at.normal) for v in (heading, np.repeat(poses[:, :3, 0], 3, 0)))
    end, carried = march(body, at, heading, x, spacing)
    return end.point, -carried
