"""Hexagonal lattices on a curved surface: grown along geodesics, relaxed where they do not close.

A site carries a tangent frame; its six neighbours lie one spacing away along geodesics at 60
degrees. Growth goes ring by ring; sites that several neighbours propose take the mean. Large
lattices are grown coarse, and then halved: every tie of two neighbours gets a site in its middle.
Where curvature leaves no room for the perfect lattice, sites settle under springs of the spacing's
length, gaps are filled and crowded sites removed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.errors import SkinError
from ..core.se3 import orthonormal_basis
from ..geometry import region as regions
from ..geometry.body import Body
from ..geometry.geodesics import march, onto
from ..geometry.surface.closest_point import Closest

Array = NDArray[np.float64]

ROW = np.sqrt(3.0) / 2.0
"""distance of the rows of a hexagonal lattice, in spacings"""
CROWDED, GAP = 0.7, 0.85
"""in spacings: nearer sites are the same or too many; a site this far from all others fits in"""
REACH = 1.35
"""in spacings: up to where a spring ties two sites"""
ROUNDS, SETTLINGS, MOVES = 4, 4, 12
"""of relaxing: rounds of settling, between which gaps are filled; settlings a round, each with so
many moves under the same springs before the sites are put back on the surface"""
MOST = 1_000_000
"""most sites of one lattice"""


@dataclass(frozen=True)
class Lattice:
    """Sites on a surface."""

    at: Closest
    """n surface points"""
    tangent: Array
    """(n, 3) unit tangents, transported from the first site"""
    way: Array
    """(n,) way over the surface from the first site in m"""

    def __len__(self) -> int:
        return len(self.way)

    def take(self, rows: Any) -> Lattice:
        """The sites of some rows."""
        return Lattice(self.at.take(rows), self.tangent[rows], self.way[rows])

    def spacing(self) -> tuple[float, float]:
        """Mean distance of nearest neighbours in m, and its scatter relative to the mean."""
        if len(self) < 2:
            return float("nan"), 0.0
        near = _tree(self.at.point).query(self.at.point, k=2)[0][:, 1]
        return float(near.mean()), float(near.std() / near.mean())


def first_site(
    body: Body, region: regions.Region, spacing: float, rng: np.random.Generator
) -> Lattice:
    """The site to grow from: at the region's centre, shifted within a cell, with a random turn.

    Raises SkinError where the region does not hold its own centre.
    """
    centre = region.centre(body)
    if not region.contains(body, centre)[0]:
        raise SkinError("a region without surface", value=region, remedy="move or widen it")
    tangent, side, _ = np.moveaxis(orthonormal_basis(centre.normal), 2, 0)
    a, b = rng.uniform(-0.5, 0.5, size=2)
    turn = rng.uniform(0.0, np.pi / 3.0)
    shift = spacing * ((a + 0.5 * b) * tangent + ROW * b * side)
    at = body.closest(centre.point + shift, face=centre.face)
    if not region.contains(body, at)[0]:
        at = centre
    heading = onto(np.cos(turn) * tangent + np.sin(turn) * side, at.normal)
    return Lattice(at, heading, np.zeros(1))


def fill(
    body: Body, region: regions.Region, spacing: float, first: Lattice, halvings: int = 0
) -> Lattice:
    """The lattice (spacing in m) all over a region, grown anew in each part that is apart.

    With `halvings`, it is grown at 2^halvings times the spacing, and relaxed and halved as often.
    """
    if halvings:
        coarse = fill(body, region, 2.0 * spacing, first, halvings - 1)
        coarse = relax(body, region, coarse, 2.0 * spacing)
        return _halve(body, region, coarse, spacing)
    sites = grow(body, region, spacing, first)
    faces = regions.face_points(body, np.arange(len(body.surface.faces)), 1)
    faces = faces.take(region.contains(body, faces))
    while len(faces.face):
        gap = _tree(sites.at.point).query(faces.point)[0]
        bare = gap > 1.5 * spacing
        if not bare.any():
            break
        at = faces.take([int(np.argmax(gap))])
        island = Lattice(at, orthonormal_basis(at.normal)[:, :, 0], np.zeros(1))
        sites = _join(sites, grow(body, region, spacing, island, taken=sites.at.point))
        faces = faces.take(bare)
    return sites


def grow(
    body: Body,
    region: regions.Region,
    spacing: float,
    first: Lattice,
    count: int | None = None,
    taken: Array | None = None,
) -> Lattice:
    """The lattice (spacing in m) around a first site, as far as the region is connected.

    With `count`, growth stops once the `count` sites nearest to the first are complete. Sites keep
    clear of the points `taken` (k, 3).
    """
    others = np.zeros((0, 3)) if taken is None else taken
    sites = front = first
    ring = 0
    while len(front):
        ring += 1
        full = np.concatenate([others, sites.at.point])
        fresh = _propose(body, front, full, spacing, CROWDED * spacing)
        fresh = fresh.take(region.contains(body, fresh.at))
        least = (ring - 0.01) * ROW * spacing  # a ring of hexagons is at least so far out
        front = replace(fresh, way=np.maximum(regions.arc_length(first.at, fresh.at), least))
        sites = _join(sites, front)
        if len(sites) > MOST:
            raise SkinError("sites of a lattice", value=len(sites), limit=MOST)
        if count is not None and len(sites) >= count:
            kth = np.partition(sites.way, count - 1)[count - 1]
            if kth < least + ROW * spacing:
                break
    return sites


def relax(body: Body, region: regions.Region, sites: Lattice, spacing: float) -> Lattice:
    """Let the sites settle at the spacing (m): fill gaps, thin crowds, relax the springs."""
    for rounds in range(ROUNDS):
        for _ in range(SETTLINGS):
            sites = _settle(body, region, sites, spacing)
        if rounds < ROUNDS - 1:
            sites = sites.take(_uncrowded(sites.at.point, CROWDED * spacing))
            sites = _fill_gaps(body, region, sites, spacing)
    return sites


def thin(body: Body, region: regions.Region, sites: Lattice, count: int) -> Lattice:
    """`count` of the sites: the most crowded ones go, far apart, and the others close up."""
    spacing = sites.spacing()[0] * float(np.sqrt(len(sites) / count))
    while len(sites) > count:
        tree = _tree(sites.at.point)
        crowd = tree.query(sites.at.point, k=3)[0][:, 1:].sum(axis=1)
        gone: list[int] = []
        near_gone = np.zeros(len(sites), dtype=bool)
        for k in np.argsort(crowd, kind="stable").tolist():
            if len(gone) == len(sites) - count:
                break
            if not near_gone[k]:
                gone.append(k)
                near_gone[tree.query_ball_point(sites.at.point[k], 2.5 * spacing)] = True
        sites = sites.take(np.delete(np.arange(len(sites)), gone))
        for _ in range(SETTLINGS):
            sites = _settle(body, region, sites, spacing)
    return sites


def _halve(body: Body, region: regions.Region, coarse: Lattice, spacing: float) -> Lattice:
    """The lattice of a spacing (m) from that of twice the spacing."""
    one, two = ties(coarse, 2.0 * REACH * spacing)
    at = body.closest(0.5 * (coarse.at.point[one] + coarse.at.point[two]), face=coarse.at.face[one])
    tangent = onto(coarse.tangent[one], at.normal)
    way = 0.5 * (coarse.way[one] + coarse.way[two])
    inside = region.contains(body, at)
    sites = _join(coarse, Lattice(at, tangent, way).take(inside))
    if len(sites) > MOST:
        raise SkinError("sites of a lattice", value=len(sites), limit=MOST)
    sites = sites.take(_uncrowded(sites.at.point, CROWDED * spacing))
    return _fill_gaps(body, region, sites, spacing)


def _fill_gaps(body: Body, region: regions.Region, sites: Lattice, spacing: float) -> Lattice:
    """Sites added wherever one fits beside a site that has fewer than six neighbours."""
    ends = np.concatenate(ties(sites, REACH * spacing))
    lacking = np.flatnonzero(np.bincount(ends, minlength=len(sites)) < 6)
    extra = _propose(body, sites.take(lacking), sites.at.point, spacing, GAP * spacing)
    return _join(sites, extra.take(region.contains(body, extra.at)))


def ties(sites: Lattice, reach: float) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Pairs of sites within reach (m) of each other and on the same side of the body."""
    one, two = _tree(sites.at.point).query_pairs(reach, output_type="ndarray").T
    facing = np.einsum("ij,ij->i", sites.at.normal[one], sites.at.normal[two]) > 0.0
    return one[facing], two[facing]


def _propose(body: Body, sites: Lattice, taken: Array, spacing: float, clearance: float) -> Lattice:
    """New sites around `sites` (way unset) farther than the clearance (m) from those taken."""
    angle = np.arange(6) * np.pi / 3.0
    side = np.cross(sites.at.normal, sites.tangent)
    heading = np.cos(angle)[:, None] * sites.tangent[:, None]
    heading = (heading + np.sin(angle)[:, None] * side[:, None]).reshape(-1, 3)
    parent = np.repeat(np.arange(len(sites)), 6)
    tree = _tree(taken)
    flat = sites.at.point[parent] + spacing * heading
    maybe = np.flatnonzero(tree.query(flat)[0] > 0.5 * clearance)
    parent = parent[maybe]
    at, tangent = march(body, sites.at.take(parent), heading[maybe], sites.tangent[parent], spacing)
    free = np.flatnonzero(tree.query(at.point)[0] > clearance) if len(maybe) else maybe
    at, tangent = at.take(free), tangent[free]
    if not len(free):
        return Lattice(at, tangent, np.zeros(0))
    leader = _leaders(at.point, clearance)
    chosen, group = np.unique(leader, return_inverse=True)
    total = np.stack([np.bincount(group, at.point[:, k]) for k in range(3)], axis=1)
    mean = total / np.bincount(group)[:, None]
    merged = body.closest(mean, face=at.face[chosen])
    new = Lattice(merged, onto(tangent[chosen], merged.normal), np.zeros(len(chosen)))
    apart = _tree(taken).query(merged.point)[0] > clearance
    keep = np.flatnonzero(apart)
    return new.take(keep[_uncrowded(merged.point[keep], clearance)])


def _settle(body: Body, region: regions.Region, sites: Lattice, spacing: float) -> Lattice:
    """Moves under springs of the spacing's length between near sites; none leaves the region."""
    point, normal = sites.at.point, sites.at.normal
    one, two = ties(sites, REACH * spacing)
    if not len(one):
        return sites
    ends = np.concatenate([one, two])
    moved = point
    for _ in range(MOVES):
        between = moved[two] - moved[one]
        length = np.sqrt(np.einsum("ij,ij->i", between, between))
        stretch = 1.0 - spacing / length
        stretch[stretch > 0] *= 0.5  # pushing apart comes first
        pull = stretch[:, None] * between
        pull = np.concatenate([pull, -pull])
        force = np.stack([np.bincount(ends, p, minlength=len(point)) for p in pull.T], axis=1)
        force -= np.einsum("ij,ij->i", force, normal)[:, None] * normal
        moved = moved + 0.25 * force
    after = body.closest(moved, face=sites.at.face)
    left = ~region.contains(body, after)
    if left.any():
        after = body.closest(np.where(left[:, None], point, after.point), face=sites.at.face)
    return Lattice(after, onto(sites.tangent, after.normal), sites.way)


def _leaders(points: Array, radius: float) -> NDArray[np.intp]:
    """For each point (n, 3) the first point within the radius that has no leader but itself."""
    leader = np.arange(len(points))
    pairs = _tree(points).query_pairs(radius, output_type="ndarray")
    for a, b in pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))].tolist():
        if leader[a] == a and leader[b] == b:
            leader[b] = a
    return leader


def _uncrowded(points: Array, radius: float) -> NDArray[np.intp]:
    """Rows, in order, of the points that keep the radius (m) from every point kept before."""
    if not len(points):
        return np.zeros(0, dtype=np.intp)
    leader = _leaders(points, radius)
    return np.flatnonzero(leader == np.arange(len(points)))


def _tree(points: Array) -> Any:
    from scipy.spatial import KDTree

    return KDTree(points)


def _join(a: Lattice, b: Lattice) -> Lattice:
    return Lattice(
        Closest.joined([a.at, b.at]),
        np.concatenate([a.tangent, b.tangent]),
        np.concatenate([a.way, b.way]),
    )
