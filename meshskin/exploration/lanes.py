"""Lanes over any region of a surface: geodesic parallels at a constant distance.

A geodesic through the region's middle is the first lane; each next lane is offset sideways from the
last along the surface. On a sphere these are the parallels of a great circle. Lanes are cut to the
region; where they fold or end before it is covered (behind a tube, on an island), a new geodesic
starts in the remainder.

Source: do Carmo, "Differential Geometry of Curves and Surfaces", section 4.6 (Fermi coordinates).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import Array, runs
from ..geometry.body import Body
from ..geometry.geodesics import geodesic, onto
from ..geometry.surface.closest_point import Closest

MIN_ADVANCE = 0.3
"""Least advance of a trace or an offset, relative to its step: below it a border or an edge holds
the closest point back."""
DUPLICATE = 0.6
"""Distance from earlier lanes, relative to the spacing, within which a sample is covered."""
ENCIRCLING = 0.8
"""Width of a region, relative to the body's, from which lanes may go round the body."""
OVERLAP = 0.5
"""Distance from the other lanes of one family, relative to the spacing, at which a lane ends."""
EMPTY_LANES = 4
"""Consecutive lanes outside the region after which a side is finished."""
MAX_SPACING = 0.75
"""Largest spacing of lanes, relative to the sensing radius. With wider ones some taxels get only
the rims of contacts: for the same mean error they need 1.1 times the contacts of close lanes at
0.75, 1.2 to 1.5 times at 0.85, 2 to 3 times at 0.9 (ellipsoid and capsule, by
`estimation.contact_design.expected_error`)."""
MAX_FAMILIES = 40
"""Most geodesics that are started in one region: a bound on the time; the studies' bodies need at
most a dozen."""


def spacing_for(radius: float, contacts: float, step: float) -> float:
    """Spacing of lanes, m, at which a taxel gets about `contacts` contacts, from two lanes or more.

    radius: the sensing radius, m; step: between contacts along a lane, m. A taxel feels contacts on
    an area pi radius^2.
    """
    return float(min(MAX_SPACING * radius, np.pi * radius**2 / (contacts * step)))


def cover(body: Body, sites: Array, spacing: float, radius: float, step: float) -> list[Closest]:
    """Pieces of lanes that pass all `sites` (n, 3) on the surface, side by side.

    spacing: of the lanes, m; radius: the region is within this distance, m, of a site; step:
    between samples, m.
    """
    from scipy.spatial import cKDTree

    coverage = _Coverage(sites, radius, DUPLICATE * spacing)
    remaining = np.ones(len(sites), dtype=bool)
    pieces: list[Closest] = []
    for _ in range(MAX_FAMILIES):
        if not remaining.any():
            break
        start, directions = _start(body, sites[remaining])
        pieces += _family(body, start, directions, spacing, step, coverage)
        covered = cKDTree(np.concatenate([coverage.samples, start[None]])).query(sites)[0]
        distance = np.linalg.norm(sites - start, axis=1)
        remaining &= (covered > spacing) & (distance > distance[remaining].min())
    return pieces


class _Coverage:
    """The region that is to be covered, and the lanes so far."""

    def __init__(self, sites: Array, radius: float, duplicate: float) -> None:
        from scipy.spatial import cKDTree

        self._sites, self._radius, self._duplicate = cKDTree(sites), radius, duplicate
        self.width = float(np.linalg.norm(np.ptp(sites, axis=0))) + 2.0 * radius
        """Diagonal of the region's bounding box, m."""
        self.samples = np.zeros((0, 3))
        """Samples (k, 3) of the lanes so far."""

    def contains(self, points: Array) -> NDArray[np.bool_]:
        """Which points (k, 3) are in the region."""
        return np.asarray(self._sites.query(points)[0] <= self._radius)

    def add(self, lane: list[Closest], step: float) -> list[NDArray[np.bool_]]:
        """Add a lane; which samples of its chains are in the region and not covered before."""
        from scipy.spatial import cKDTree

        if not lane:
            return []
        points = np.concatenate([chain.point for chain in lane])
        new = self.contains(points)
        if len(self.samples):
            new &= cKDTree(self.samples).query(points)[0] > self._duplicate
        # of a lane that returns to itself the earlier samples count
        pairs = cKDTree(points).query_pairs(self._duplicate, output_type="ndarray")
        back = pairs[pairs[:, 1] - pairs[:, 0] > 3.0 * self._duplicate / step]
        for early, late in back[np.argsort(back[:, 0], kind="stable")]:
            if new[early]:
                new[late] = False
        self.samples = np.concatenate([self.samples, points[new]])
        return np.split(new, np.cumsum([len(chain.point) for chain in lane])[:-1])


def _start(body: Body, sites: Array) -> tuple[Array, list[Array]]:
    """The site nearest to the middle, and tangents there: along the sites' longest extent, and
    along the two principal curvatures.
    """
    middle = sites.mean(axis=0)
    start = sites[np.argmin(np.linalg.norm(sites - middle, axis=1))]
    hit = body.closest(start[None])
    normal = hit.normal[0]
    principal = onto(hit.direction[0], normal)
    longest = principal
    if len(sites) > 2:
        longest = onto(np.linalg.svd(sites - middle, full_matrices=False)[2][0], normal)
    return start, [longest, principal, np.cross(normal, principal)]


def both_ways(
    body: Body, start: Array, direction: Array, step: float, coverage: _Coverage | None = None
) -> Array:
    """Points (k, 3) of the geodesic through `start` in both directions.

    It ends where it closes, meets a border, has been outside the region for longer than its width,
    or is four times as long as the body.
    """
    ahead, closed = _trace(body, start, direction, step, coverage)
    if closed:  # cut at the point farthest from the region
        return np.roll(ahead, len(ahead) // 2, axis=0)
    return np.concatenate([_trace(body, start, -direction, step, coverage)[0][:0:-1], ahead])


def _trace(
    body: Body, start: Array, direction: Array, step: float, coverage: _Coverage | None
) -> tuple[Array, bool]:
    """The geodesic one way from `start`, and whether it returned there."""
    trace = geodesic(body, start, direction, step)
    points, outside = [next(trace)[0].point[0]], 0
    for k in range(int(4.0 * body.surface.scale / step)):
        point = next(trace)[0].point[0]
        if np.linalg.norm(point - points[-1]) < MIN_ADVANCE * step:
            break
        points.append(point)
        if k > 3 and np.linalg.norm(point - points[0]) < 0.75 * step:
            return np.array(points), True
        if coverage is not None:
            outside = 0 if coverage.contains(point[None])[0] else outside + 1
            if outside * step > coverage.width:
                break
    return np.array(points), False


def _first_lane(
    body: Body, start: Array, directions: list[Array], step: float, coverage: _Coverage
) -> Array:
    """The geodesic in the first direction; for a region that may encircle the body the first
    geodesic that closes, as others would wind round the body.
    """
    if coverage.width > ENCIRCLING * body.surface.scale:
        for direction in directions:
            points = both_ways(body, start, direction, step, coverage)
            if np.linalg.norm(points[-1] - points[0]) < 1.5 * step:
                return points
    return both_ways(body, start, directions[0], step, coverage)


def _family(
    body: Body, start: Array, directions: list[Array], spacing: float, step: float,
    coverage: _Coverage,
) -> list[Closest]:  # fmt: skip
    """Pieces of the lanes beside one geodesic, from one end of the region to the other."""
    first = [body.closest(_first_lane(body, start, directions, step, coverage))]
    gap, most = round(spacing / step), int(np.ceil(2.0 * body.surface.scale / spacing))

    def pieces(lane: list[Closest]) -> list[Closest]:
        new = coverage.add(lane, step)
        cut = [chain.take(run) for chain, n in zip(lane, new, strict=True) for run in _runs(n, gap)]
        return [piece for piece in cut if len(piece.point) > gap]

    found = {0: pieces(first)}
    earlier = [chain.point for chain in first]
    for side in (-1, 1):
        lane, empty = first, 0
        for k in range(1, most):
            lane = [c for chain in lane for c in _offset(body, chain, side * spacing, step)]
            lane = _without_overlap(lane, earlier, OVERLAP * spacing)
            found[side * k] = pieces(lane)
            empty = 0 if found[side * k] else empty + 1
            if not lane or empty == EMPTY_LANES:
                break
    return [piece for k in sorted(found) for piece in found[k]]


def _without_overlap(lane: list[Closest], earlier: list[Array], distance: float) -> list[Closest]:
    """A lane without the samples less than `distance`, m, from the chains in `earlier`, to which
    its own are added: chains that fold over a crease would else multiply.
    """
    from scipy.spatial import cKDTree

    out = []
    for chain in lane:
        near = cKDTree(np.concatenate(earlier)).query(chain.point)[0] < distance
        out += [chain.take(run) for run in runs(~near) if run.stop - run.start > 2]
        earlier.append(chain.point)
    return out


def _offset(body: Body, chain: Closest, shift: float, step: float) -> list[Closest]:
    """The chain shifted to its left by `shift`, m, without folds, resampled evenly."""
    along = np.gradient(chain.point, axis=0)
    left = np.cross(chain.normal, along)
    length = np.linalg.norm(left, axis=1, keepdims=True)  # zero where a lane folds at a crease
    left /= np.where(length > 0.0, length, np.inf)
    hit = body.closest(chain.point + shift * left, chain.face)
    moved = np.linalg.norm(hit.point - chain.point, axis=1)
    ahead = np.gradient(hit.point, axis=0)
    forward = np.einsum("ij,ij->i", ahead, along) > 0.05 * np.einsum("ij,ij->i", along, along)
    out = []
    for run in runs(forward & (moved > MIN_ADVANCE * abs(shift))):
        points = hit.point[run]
        s = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
        if s[-1] >= 2 * step:
            even = np.linspace(0.0, s[-1], max(round(s[-1] / step), 2) + 1)
            resampled = np.stack([np.interp(even, s, x) for x in points.T], axis=1)
            out.append(body.closest(resampled))
    return out


def _runs(mask: NDArray[np.bool_], gap: int) -> list[slice]:
    """The runs of True values, joined over gaps of up to `gap` samples."""
    filled = mask.copy()
    for run in runs(~mask):
        if run.start > 0 and run.stop < len(mask) and run.stop - run.start <= gap:
            filled[run] = True
    return runs(filled)
