"""Lanes over any region of a surface: geodesic parallels at a constant distance.

A geodesic through the middle of the region is the first lane; each next lane is offset sideways
from the last along the surface. On a sphere these are the parallels of a great circle. Lanes are
cut to the region; where they fold or end before it is covered (behind a tube, on an island), a new
geodesic starts in the remainder.

Source: do Carmo, "Differential Geometry of Curves and Surfaces", section 4.6 (Fermi coordinates).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import Array, Index
from ..geometry.body import Body
from ..geometry.geodesics import geodesic, onto
from ..geometry.mesh.topology import connected_components
from ..geometry.surface.closest_point import Closest
from .chains import (
    chain_runs,
    crosses_gap,
    evenly,
    gaps_along,
    gradient,
    joined_runs,
    lengths_along,
)

MIN_ADVANCE = 0.3
"""Least advance of a trace or an offset, relative to its step: below it a border or an edge holds
the closest point back."""
DUPLICATE = 0.6
"""Distance from earlier lanes, relative to the spacing, within which a sample is covered."""
ENCIRCLING = 0.8
"""Width of a region, relative to the body's, from which lanes may go round the body."""
OVERLAP = 0.5
"""Distance from the other lanes of one family, relative to the spacing, at which a lane ends."""
OPPOSITE = -0.5
"""Cosine between the normals of two places below which they are on opposite sides: no contact
presses both (`contact.reading.same_sheet`)."""
EMPTY_LANES = 4
"""Consecutive lanes outside the region after which a side is finished."""
LOOK = 16
"""Steps of a geodesic between the looks whether it has left the region."""
MAX_FAMILIES = 200
"""Most geodesics that are started in one region: a bound on the time. A link with many recesses
(Talos torso_2, 200 taxels) needs 55."""


class PointCloud:
    """A set of points that grows, with distances to the nearest of them.

    The points are in trees of growing sizes, so that adding all of n points costs n log(n)^2 in
    total. Source: Bentley and Saxe, "Decomposable searching problems", J. Algorithms 1 (1980).
    """

    def __init__(self, points: Array | None = None) -> None:
        self._trees: list[Any] = []
        if points is not None:
            self.add(points)

    def add(self, points: Array) -> None:
        """Add points (k, 3)."""
        from scipy.spatial import cKDTree

        if not len(points):
            return
        while self._trees and self._trees[-1].n <= 2 * len(points):
            points = np.concatenate([self._trees.pop().data, points])
        self._trees.append(cKDTree(points, balanced_tree=False, compact_nodes=False))

    def distance(self, points: Array, most: float = np.inf) -> Array:
        """Distances (k,) of points (k, 3) to the nearest point; inf beyond `most`."""
        out = np.full(len(points), np.inf)
        for tree in self._trees:
            out = np.minimum(out, tree.query(points, distance_upper_bound=most)[0])
        return out

    def pairs(self, distance: float) -> Index:
        """Pairs (k, 2), the smaller row first, of points at most `distance` apart.

        Rows are those of points that were added at once.
        """
        (tree,) = self._trees
        return np.asarray(tree.query_pairs(distance, output_type="ndarray"), dtype=np.intp)


class Coverage:
    """The region that is to be covered, and the lanes so far."""

    def __init__(self, sites: Closest, radius: float, duplicate: float) -> None:
        """The region is within `radius`, m, of the sites; samples of lanes less than `duplicate`,
        m, from earlier ones are duplicates.
        """
        self._side = radius if _has_two_sides(sites, radius) else 0.0
        self._radius, self._duplicate = radius, duplicate
        self._sites = PointCloud(self.places(sites))
        self.look_for(sites.point)
        self.samples = PointCloud()
        """Samples of the lanes so far."""

    def look_for(self, sites: Array) -> None:
        """Cover sites (k, 3), m, next: geodesics cross gaps as wide as these are apart."""
        self.width = float(np.linalg.norm(np.ptp(sites, axis=0))) + 2.0 * self._radius
        """Diagonal of the bounding box of the region about the sites that are looked for, m."""

    def places(self, at: Closest) -> Array:
        """Points (k, 3), m, whose distances count; where the region has two sides, (k, 6), with
        normals so long that those on the other side of a plate are not near."""
        return np.hstack([at.point, self._side * at.normal]) if self._side else at.point

    def lacks(self, at: Closest) -> NDArray[np.bool_]:
        """Which points (k,) are in the region and on none of the lanes so far."""
        points = self.places(at)
        return (self._sites.distance(points) <= self._radius) & (
            self.samples.distance(points, 2.0 * self._duplicate) > self._duplicate
        )

    def add(self, lane: list[Closest], step: float, gap: int) -> list[Closest]:
        """Add the pieces of a lane in the region that were not covered before, joined over gaps of
        up to `gap` samples, and longer."""
        if not lane:
            return []
        whole = Closest.concatenate(lane)
        points, new = self.places(whole), self.lacks(whole)
        # of a lane that returns to itself the earlier samples count
        pairs = PointCloud(points).pairs(self._duplicate)
        back = pairs[pairs[:, 1] - pairs[:, 0] > 3.0 * self._duplicate / step]
        for early, late in back[np.argsort(back[:, 0], kind="stable")]:
            if new[early]:
                new[late] = False
        ends = np.cumsum([len(chain.point) for chain in lane])
        pieces = []
        for first, end in zip((0, *ends), ends, strict=False):
            for run in joined_runs(new[first:end], gap):
                if run.stop - run.start > gap:
                    rows = np.arange(first + run.start, first + run.stop)
                    self.samples.add(points[rows[new[rows]]])
                    pieces.append(whole.take(rows))
        return pieces


def _has_two_sides(sites: Closest, radius: float) -> bool:
    """Whether sites that are at most `radius`, m, apart face opposite sides, as on a thin plate."""
    one, two = PointCloud(sites.point).pairs(radius).T
    return bool(np.any(np.einsum("ki,ki->k", sites.normal[one], sites.normal[two]) < OPPOSITE))


def cover(body: Body, sites: Array, spacing: float, radius: float, step: float) -> list[Closest]:
    """Pieces of lanes that pass all `sites` (n, 3) on the surface, side by side.

    spacing: of the lanes, m; radius: the region is within this distance, m, of a site; step:
    between samples, m.
    """
    at = body.surface.nearest(sites)
    coverage = Coverage(at, radius, DUPLICATE * spacing)
    remaining, places = np.ones(len(sites), dtype=bool), coverage.places(at)
    pieces: list[Closest] = []
    for _ in range(MAX_FAMILIES):
        if not remaining.any():
            break
        start, directions = _start(body, sites[remaining])
        if len(pieces):
            coverage.look_for(_connected(sites[remaining], start, 2.0 * radius))
        pieces += _family(body, start, directions, spacing, step, coverage)
        begin = coverage.places(body.surface.nearest(start[None]))
        distance = np.linalg.norm(places - begin, axis=1)
        covered = np.minimum(coverage.samples.distance(places), distance)
        remaining &= (covered > spacing) & (distance > distance[remaining].min())
    return pieces


def _connected(sites: Array, start: Array, distance: float) -> Array:
    """The sites (n, 3) that are linked to the one at `start` by steps of at most `distance`, m."""
    one, two = PointCloud(sites).pairs(distance).T
    label = connected_components(one, two, len(sites))
    return sites[label == label[np.argmin(np.linalg.norm(sites - start, axis=1))]]


def _start(body: Body, sites: Array) -> tuple[Array, list[Array]]:
    """The site nearest to the middle, and tangents there: along the sites' longest extent, and
    along the two principal curvatures.
    """
    middle = sites.mean(axis=0)
    start = sites[np.argmin(np.linalg.norm(sites - middle, axis=1))]
    hit = body.surface.nearest(start[None])
    normal = hit.normal[0]
    principal = onto(hit.direction[0], normal)
    longest = principal
    if len(sites) > 2:
        longest = onto(np.linalg.svd(sites - middle, full_matrices=False)[2][0], normal)
    return start, [longest, principal, np.cross(normal, principal)]


def geodesics_through(
    body: Body, start: Array, directions: list[Array], step: float, coverage: Coverage | None = None
) -> list[Array]:
    """Points (k, 3) of the geodesics through `start` in each direction and against it.

    One ends where it closes, meets a border, has been outside the region, or on earlier lanes, for
    longer than the region's width, or is four times as long as the body. They are followed
    together.
    """
    senses = np.concatenate([directions, np.negative(directions)])
    traces = _traces(body, start, senses, step, coverage)
    out = []
    for (ahead, closed), (back, _) in zip(
        traces[: len(directions)], traces[len(directions) :], strict=True
    ):
        if closed:  # cut at the point farthest from the region
            out.append(np.roll(ahead, len(ahead) // 2, axis=0))
        else:
            out.append(np.concatenate([back[:0:-1], ahead]))
    return out


def _traces(
    body: Body, start: Array, directions: Array, step: float, coverage: Coverage | None
) -> list[tuple[Array, bool]]:
    """The geodesics from `start` in one sense, and whether each returned there."""
    count = len(directions)
    trace = geodesic(body, np.repeat(start[None], count, axis=0), directions, step)
    at = next(trace)[0]
    points, outside = [at.point], np.zeros(count, dtype=int)
    recent: list[Closest] = []
    length = np.ones(count, dtype=int)
    going, closed = np.ones(count, dtype=bool), np.zeros(count, dtype=bool)
    for k in range(int(4.0 * body.surface.scale / step)):
        last, at = at, next(trace)[0]
        point = at.point
        going &= np.linalg.norm(point - points[-1], axis=1) >= MIN_ADVANCE * step
        going &= ~crosses_gap(body.surface, last, at)
        points.append(point)
        length[going] += 1
        if k > 3:
            closed |= going & (np.linalg.norm(point - points[0], axis=1) < 0.75 * step)
            going &= ~closed
        recent.append(at)
        if coverage is not None and len(recent) == LOOK:
            lacks = coverage.lacks(Closest.concatenate(recent)).reshape(LOOK, count)
            outside = np.where(lacks.any(axis=0), np.argmax(lacks[::-1], axis=0), outside + LOOK)
            going &= outside * step <= coverage.width
            recent = []
        if not going.any():
            break
    together = np.stack(points, axis=1)
    return [(together[k, : length[k]], bool(closed[k])) for k in range(count)]


def _first_lane(
    body: Body, start: Array, directions: list[Array], step: float, coverage: Coverage
) -> Array:
    """The geodesic in the first direction; for a region that may encircle the body the first
    geodesic that closes, as others would wind round the body.
    """
    if coverage.width <= ENCIRCLING * body.surface.scale:
        return geodesics_through(body, start, directions[:1], step, coverage)[0]
    lines = geodesics_through(body, start, directions, step, coverage)
    closing = (p for p in lines if np.linalg.norm(p[-1] - p[0]) < 1.5 * step)
    return next(closing, lines[0])


def _family(
    body: Body, start: Array, directions: list[Array], spacing: float, step: float,
    coverage: Coverage,
) -> list[Closest]:  # fmt: skip
    """Pieces of the lanes beside one geodesic, from one end of the region to the other."""
    first = [body.surface.nearest(_first_lane(body, start, directions, step, coverage))]
    gap, most = round(spacing / step), int(np.ceil(2.0 * body.surface.scale / spacing))

    found = {0: coverage.add(first, step, gap)}
    earlier = PointCloud(coverage.places(first[0]))
    for side in (-1, 1):
        lane, empty = first, 0
        for k in range(1, most):
            lane = _offset(body, lane, side * spacing, step)
            lane = _without_overlap(lane, coverage, earlier, OVERLAP * spacing)
            found[side * k] = coverage.add(lane, step, gap)
            empty = 0 if found[side * k] else empty + 1
            if not lane or empty == EMPTY_LANES:
                break
    return [piece for k in sorted(found) for piece in found[k]]


def _without_overlap(
    lane: list[Closest], coverage: Coverage, earlier: PointCloud, distance: float
) -> list[Closest]:
    """A lane without the samples less than `distance`, m, from the chains in `earlier`, to which
    its own are added: chains that fold over a crease would else multiply.
    """
    if not lane:
        return []
    whole = Closest.concatenate(lane)
    points = coverage.places(whole)
    ends = np.cumsum([len(chain.point) for chain in lane])
    chain_of = np.repeat(np.arange(len(lane)), np.diff(ends, prepend=0))
    near = earlier.distance(points, distance) < distance
    early, late = PointCloud(points).pairs(distance).T
    near[late[chain_of[early] < chain_of[late]]] = True
    earlier.add(points)
    return [whole.take(run) for run in chain_runs(~near, ends) if run.stop - run.start > 2]


def _offset(body: Body, lane: list[Closest], shift: float, step: float) -> list[Closest]:
    """The chains of a lane shifted to their left by `shift`, m, resampled evenly, without folds and
    what is across a gap of the surface."""
    lane = [chain for chain in lane if len(chain.point) > 1]  # one point has no direction
    if not lane:
        return []
    whole, ends = Closest.concatenate(lane), np.cumsum([len(chain.point) for chain in lane])
    along = gradient(whole.point, ends)
    left = np.cross(whole.normal, along)
    length = np.linalg.norm(left, axis=1, keepdims=True)  # zero where a lane folds at a crease
    left /= np.where(length > 0.0, length, np.inf)
    hit = body.surface.nearest(whole.point + shift * left, whole.face)
    moved = np.linalg.norm(hit.point - whole.point, axis=1)
    forward = np.einsum("ij,ij->i", gradient(hit.point, ends), along)
    forward = forward > 0.05 * np.einsum("ij,ij->i", along, along)
    forward &= ~crosses_gap(body.surface, whole, hit) & ~gaps_along(body.surface, hit)
    s = lengths_along(hit.point)
    resampled = [
        evenly(hit.point[run], step, 2)
        for run in chain_runs(forward & (moved > MIN_ADVANCE * abs(shift)), ends)
        if s[run.stop - 1] - s[run.start] >= 2 * step
    ]
    if not resampled:
        return []
    at = body.surface.nearest(np.concatenate(resampled))
    return at.split([len(points) for points in resampled])
