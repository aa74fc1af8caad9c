"""Hexagonal lattices on a curved surface: grown along geodesics, relaxed where they do not close.

A site carries a tangent frame; its six neighbours lie one spacing away along geodesics at 60
degrees. A lattice grows ring by ring; sites that several neighbours propose are merged into their
mean. Large lattices are grown coarse and then refined: a site is added halfway between each two
neighbours. Where curvature leaves no room for the perfect lattice, sites are relaxed under springs
of the spacing's length, gaps are filled and crowded sites removed.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ..core.arrays import Array, Index, far_apart, means_by_group, sums_by_group
from ..core.errors import SkinError
from ..core.progress import Stage
from ..core.se3 import orthonormal_basis
from ..geometry import region as regions
from ..geometry.body import Body
from ..geometry.geodesics import arc_length, march, onto, rotate_about
from ..geometry.surface.closest_point import Closest

ROW = np.sqrt(3.0) / 2.0
"""Distance between the rows of a hexagonal lattice, in spacings."""
MERGE, GAP = 0.7, 0.85
"""Distances in spacings: closer sites are merged; a new site fits this far from all others. MERGE
lies between the error of a closing ring (0) and the distance of true neighbours (1); GAP is above
it, so that filled gaps are not merged again."""
SPRING_REACH = 1.35
"""Largest distance of two sites tied by a spring, in spacings: between that of nearest (1) and of
second neighbours (1.73)."""
ROUNDS, SETTLINGS, STEPS = 4, 4, 12
"""Of relaxing: rounds, after each but the last of which gaps are filled; projections onto the
surface in a round; steps under the same springs before a projection."""
OPPOSITE = -0.99
"""Cosine between the normals of two sites below which they lie on opposite sides of a plate, and
keep no distance through it: its sides are parallel to 8 degrees. Those of wedges and cones are not,
and meet at an edge or a tip, round which the sites are near each other."""
NEAREST = 16
"""Sites among which one on the own side of a plate is sought: two rings of a lattice on the
opposite side have 12 about a point between three sites."""
MAX_SITES = 1_000_000
"""Largest number of sites of one lattice: more are a wrong unit, and exhaust the memory."""
_SILENT = Stage()


@dataclass(frozen=True)
class Lattice:
    """n sites on a surface."""

    at: Closest
    """n surface points"""
    tangent: Array
    """(n, 3) unit tangents, transported from the first site"""
    arc_length: Array
    """(n,) distance over the surface from the first site, m"""

    def __len__(self) -> int:
        return len(self.arc_length)

    def take(self, rows: Index | NDArray[np.bool_]) -> Lattice:
        """The sites of some rows (indices or a mask)."""
        return Lattice(self.at.take(rows), self.tangent[rows], self.arc_length[rows])

    def joined(self, other: Lattice) -> Lattice:
        """These sites and those of another lattice. Raises SkinError for too many."""
        if len(self) + len(other) > MAX_SITES:
            raise SkinError("too many taxels", value=len(self) + len(other), limit=MAX_SITES)
        return Lattice(
            Closest.concatenate([self.at, other.at]),
            np.concatenate([self.tangent, other.tangent]),
            np.concatenate([self.arc_length, other.arc_length]),
        )

    def pairs(self, reach: float) -> tuple[Index, Index]:
        """The pairs of sites of `facing_pairs`."""
        return facing_pairs(self.at.point, self.at.normal, reach)

    def spacing(self) -> tuple[float, float]:
        """Mean distance of nearest neighbours, m, and its relative standard deviation."""
        if len(self) < 2:
            return float("nan"), 0.0
        near = _gaps(self.at, self.at.point, self.at.normal, own=True)
        near = near[np.isfinite(near)]
        return float(near.mean()), float(near.std() / near.mean())


def first_site(
    body: Body, region: regions.Region, spacing: float, rng: np.random.Generator
) -> Lattice:
    """A random site to grow from: near the region's centre, within one cell of the lattice.

    Raises SkinError where the region does not contain its own centre.
    """
    centre = region.centre(body)
    if not region.contains(body, centre)[0]:
        raise SkinError(
            "the region contains no exposed surface",
            value=getattr(region, "region", region),
            remedy="move or widen it; another part of the body may cover it",
        )
    tangent, side, _ = np.moveaxis(orthonormal_basis(centre.normal), 2, 0)
    a, b = rng.uniform(-0.5, 0.5, size=2)
    angle = rng.uniform(0.0, np.pi / 3.0)
    shift = spacing * ((a + 0.5 * b) * tangent + ROW * b * side)
    at = body.closest(centre.point + shift, face=centre.face)
    if not region.contains(body, at)[0]:
        at = centre
    heading = onto(np.cos(angle) * tangent + np.sin(angle) * side, at.normal)
    return Lattice(at, heading, np.zeros(1))


def fill(
    body: Body,
    region: regions.Region,
    spacing: float,
    first: Lattice,
    refinements: int = 0,
    stage: Stage = _SILENT,
) -> Lattice:
    """The lattice (spacing in m) all over a region, grown anew in each connected part.

    With `refinements`, it is grown at 2^refinements times the spacing, and relaxed and refined so
    many times. stage: its steps are rings of the lattice, and those of `relax`.
    """
    if refinements:
        coarse = fill(body, region, 2.0 * spacing, first, refinements - 1, stage)
        coarse = relax(body, region, coarse, 2.0 * spacing, stage)
        return _refine(body, region, coarse, spacing)
    sites = grow(body, region, spacing, first, stage=stage)
    faces = regions.face_points(body, np.arange(len(body.surface.faces)), 1)
    faces = faces.take(region.contains(body, faces))
    while len(faces.face):
        gap = _gaps(sites.at, faces.point, faces.normal)
        uncovered = gap > 1.5 * spacing
        if not uncovered.any():
            break
        at = faces.take([int(np.argmax(gap))])
        island = Lattice(at, orthonormal_basis(at.normal)[:, :, 0], np.zeros(1))
        sites = sites.joined(grow(body, region, spacing, island, None, sites.at, stage))
        faces = faces.take(uncovered)
    return sites


def grow(
    body: Body,
    region: regions.Region,
    spacing: float,
    first: Lattice,
    count: int | None = None,
    occupied: Closest | None = None,
    stage: Stage = _SILENT,
) -> Lattice:
    """The lattice (spacing in m) around a first site, as far as the region is connected.

    With `count`, growth stops once the `count` sites nearest to the first are complete. New sites
    keep their distance from the points `occupied`. stage: its steps are the rings.
    """
    others = [] if occupied is None else [occupied]
    sites = front = first
    ring = 0
    while len(front):
        ring += 1
        stage.step()
        full = Closest.concatenate([*others, sites.at])
        fresh = _propose(body, front, full, spacing, MERGE * spacing)
        fresh = fresh.take(region.contains(body, fresh.at))
        least = (ring - 0.01) * ROW * spacing  # a ring of hexagons is at least so far out
        front = replace(fresh, arc_length=np.maximum(arc_length(first.at, fresh.at), least))
        sites = sites.joined(front)
        if count is not None and len(sites) >= count:
            kth = np.partition(sites.arc_length, count - 1)[count - 1]
            if kth < least + ROW * spacing:
                break
    return sites


def relax(
    body: Body, region: regions.Region, sites: Lattice, spacing: float, stage: Stage = _SILENT
) -> Lattice:
    """Sites relaxed under springs of length `spacing` (m), with gaps filled and crowds thinned.

    stage: its steps are the projections onto the surface."""
    stage.expect(ROUNDS * SETTLINGS)
    for k in range(ROUNDS):
        for _ in range(SETTLINGS):
            sites = _relax_springs(body, region, sites, spacing)
            stage.step()
        if k < ROUNDS - 1:
            sites = sites.take(_separated(sites.at, MERGE * spacing))
            sites = _fill_gaps(body, region, sites, spacing)
    return sites


def decimate(
    body: Body, region: regions.Region, sites: Lattice, count: int, stage: Stage = _SILENT
) -> Lattice:
    """`count` of the sites: the most crowded are removed, far apart, and the others relaxed."""
    spacing = sites.spacing()[0] * float(np.sqrt(len(sites) / count))
    while len(sites) > count:
        crowding = KDTree(sites.at.point).query(sites.at.point, k=3)[0][:, 1:].sum(axis=1)
        order = np.argsort(crowding, kind="stable")
        removed = far_apart(sites.at.point, order, 2.5 * spacing, len(sites) - count)
        sites = sites.take(np.delete(np.arange(len(sites)), removed))
        for _ in range(SETTLINGS):
            sites = _relax_springs(body, region, sites, spacing)
            stage.step()
    return sites


def _refine(body: Body, region: regions.Region, coarse: Lattice, spacing: float) -> Lattice:
    """The lattice of a spacing (m) from that of twice the spacing."""
    one, two = coarse.pairs(2.0 * SPRING_REACH * spacing)
    at = body.closest(0.5 * (coarse.at.point[one] + coarse.at.point[two]), face=coarse.at.face[one])
    tangent = onto(coarse.tangent[one], at.normal)
    arc_length = 0.5 * (coarse.arc_length[one] + coarse.arc_length[two])
    inside = region.contains(body, at)
    sites = coarse.joined(Lattice(at, tangent, arc_length).take(inside))
    sites = sites.take(_separated(sites.at, MERGE * spacing))
    return _fill_gaps(body, region, sites, spacing)


def _fill_gaps(body: Body, region: regions.Region, sites: Lattice, spacing: float) -> Lattice:
    """The sites, and new ones beside those with fewer than six neighbours, where they fit."""
    ends = np.concatenate(sites.pairs(SPRING_REACH * spacing))
    incomplete = np.flatnonzero(np.bincount(ends, minlength=len(sites)) < 6)
    extra = _propose(body, sites.take(incomplete), sites.at, spacing, GAP * spacing)
    return sites.joined(extra.take(region.contains(body, extra.at)))


def facing_pairs(points: Array, normals: Array, reach: float) -> tuple[Index, Index]:
    """Pairs of points (n, 3) within `reach` (m), with normals (n, 3) less than 90 deg apart."""
    one, two = KDTree(points).query_pairs(reach, output_type="ndarray").T
    facing = np.einsum("ij,ij->i", normals[one], normals[two]) > 0.0
    return one[facing], two[facing]


def _propose(
    body: Body, sites: Lattice, occupied: Closest, spacing: float, clearance: float
) -> Lattice:
    """New sites around `sites`, farther than the clearance (m) from the points `occupied`.

    Their arc length is not set.
    """
    normal, tangent = sites.at.normal[:, None], sites.tangent[:, None]
    heading = rotate_about(normal, tangent, np.arange(6) * np.pi / 3.0).reshape(-1, 3)
    parent = np.repeat(np.arange(len(sites)), 6)
    flat = sites.at.point[parent] + spacing * heading
    gaps = _gaps(occupied, flat, sites.at.normal[parent])
    candidates = np.flatnonzero(gaps > 0.5 * clearance)
    parent, heading = parent[candidates], heading[candidates]
    at, tangent = march(body, sites.at.take(parent), heading, sites.tangent[parent], spacing)
    free = np.flatnonzero(_gaps(occupied, at.point, at.normal) > clearance)
    at, tangent = at.take(free), tangent[free]
    if not len(free):
        return Lattice(at, tangent, np.zeros(0))
    chosen, group = np.unique(_clusters(at, clearance), return_inverse=True)
    merged = body.closest(means_by_group(at.point, group), face=at.face[chosen])
    new = Lattice(merged, onto(tangent[chosen], merged.normal), np.zeros(len(chosen)))
    new = new.take(_gaps(occupied, merged.point, merged.normal) > clearance)
    return new.take(_separated(new.at, clearance))


def _relax_springs(body: Body, region: regions.Region, sites: Lattice, spacing: float) -> Lattice:
    """Sites moved under springs of length `spacing` (m) between neighbours, within the region."""
    point, normal = sites.at.point, sites.at.normal
    one, two = sites.pairs(SPRING_REACH * spacing)
    if not len(one):
        return sites
    ends = np.concatenate([one, two])
    moved = point
    for _ in range(STEPS):
        between = moved[two] - moved[one]
        length = np.sqrt(np.einsum("ij,ij->i", between, between))
        strain = 1.0 - spacing / np.maximum(length, 1e-6 * spacing)
        strain[strain > 0] *= 0.5  # tension is half as stiff as compression
        pull = strain[:, None] * between
        force = sums_by_group(np.concatenate([pull, -pull]), ends, len(point))
        force -= np.einsum("ij,ij->i", force, normal)[:, None] * normal
        moved = moved + 0.25 * force
    after = body.closest(moved, face=sites.at.face)
    outside = ~region.contains(body, after)
    if outside.any():
        after = body.closest(np.where(outside[:, None], point, after.point), face=sites.at.face)
    return Lattice(after, onto(sites.tangent, after.normal), sites.arc_length)


def _opposite(one: Array, two: Array) -> NDArray[np.bool_]:
    """Whether (...) sites with unit normals (..., 3) lie on opposite sides of a plate."""
    return np.asarray(np.sum(one * two, axis=-1) < OPPOSITE)


def _gaps(sites: Closest, points: Array, normals: Array, own: bool = False) -> Array:
    """Distance (n,), m, from points (n, 3) to the nearest site on the same side of a plate.

    inf where there is none among the NEAREST. normals (n, 3): outward, at the points; own: the
    points are the sites, and another one is meant.
    """
    if not len(points):
        return np.zeros(0)
    tree = KDTree(sites.point)
    gap, nearest = (x[:, -1] for x in tree.query(points, k=[1 + own]))
    rows = np.flatnonzero(_opposite(normals, sites.normal[nearest]))
    if len(rows):
        gaps, near = tree.query(points[rows], k=range(1 + own, min(NEAREST, len(sites.point)) + 1))
        gaps[_opposite(normals[rows, None], sites.normal[near])] = np.inf
        gap[rows] = gaps.min(axis=1)
    return np.asarray(gap)


def _clusters(at: Closest, radius: float) -> Index:
    """For each point the first one within the radius that is its own cluster's first."""
    leader = np.arange(len(at.point))
    pairs = KDTree(at.point).query_pairs(radius, output_type="ndarray")
    pairs = pairs[~_opposite(*(at.normal[end] for end in pairs.T))]
    for a, b in pairs[np.lexsort((pairs[:, 1], pairs[:, 0]))].tolist():
        if leader[a] == a and leader[b] == b:
            leader[b] = a
    return leader


def _separated(at: Closest, radius: float) -> Index:
    """Rows, in order, of the points farther than the radius (m) from every row before."""
    return np.flatnonzero(_clusters(at, radius) == np.arange(len(at.point)))
