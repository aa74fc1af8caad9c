"""Lanes over any region of a surface: geodesic parallels at one distance from the next.

A geodesic through the region's middle is the first lane; each next one lies a step to the side of
the last, square to it along the surface. On a sphere these are the parallels of a great circle.
Lanes are cut to the region; where they fold or end before all is covered (behind a tube, on an
island), a new geodesic starts in what is left.

Source: do Carmo, "Differential Geometry of Curves and Surfaces", section 4.6 (Fermi coordinates).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.se3 import Array
from ..geometry.body import Body
from ..geometry.geodesics import geodesic, onto
from ..geometry.surface.closest_point import Closest

STUCK = 0.3
"""Part of a step below which a trace has run against a border or an edge."""
APART = 0.6
"""Part of the spacing within which a lane of another geodesic counts as the same one."""
ROUND = 0.8
"""Width of a region, in widths of the body, from which it may go round it."""
OVERLAP = 0.5
"""Distance between lanes, in spacings, below which the later one ends."""
BARREN = 4
"""Lanes without any part in the region after which a side is left."""
WIDEST = 0.75
"""Widest spacing of lanes that is chosen, in distances at which a contact is felt. Wider ones leave
taxels that only the rims of contacts touch: for the same mean error they take 1.1 times the
contacts of close lanes at 0.75, 1.2 to 1.5 at 0.85, 2 to 3 at 0.9 (ellipsoid and capsule, by
`estimation.design.expected_error`)."""
BASES = 40
"""Most geodesics started in one region."""


@dataclass(frozen=True)
class Piece:
    """A part of a lane within the region: k samples."""

    points: Array
    """(k, 3), body frame, m."""
    normals: Array
    """Outward (k, 3)."""

    @property
    def reverse(self) -> Piece:
        """The same part, run the other way."""
        return Piece(self.points[::-1], self.normals[::-1])

    def __len__(self) -> int:
        return len(self.points)

    def __getitem__(self, rows: slice) -> Piece:
        return Piece(self.points[rows], self.normals[rows])


def spacing_for(reach: float, contacts: float, step: float) -> float:
    """Spacing of lanes, m, that gives a taxel about `contacts` contacts, and two lanes that tell.

    reach: distance up to which a contact is felt, m; step: between contacts along a lane, m. A
    taxel feels what lies on pi reach^2.
    """
    return float(min(WIDEST * reach, np.pi * reach**2 / (contacts * step)))


def cover(body: Body, sites: Array, spacing: float, keep: float, step: float) -> list[Piece]:
    """Pieces of lanes that pass every one of the `sites` (n, 3) on the surface, side by side.

    spacing of the lanes, m; keep: the region is what lies within this distance, m, of a site;
    step: between samples, m.
    """
    from scipy.spatial import cKDTree

    region, open_ = Region(sites, keep, APART * spacing), np.ones(len(sites), dtype=bool)
    pieces: list[Piece] = []
    for _ in range(BASES):
        if not open_.any():
            break
        start, directions = _middle(body, sites[open_])
        pieces += _sweep(body, start, directions, spacing, step, region)
        seen = cKDTree(np.concatenate([region.drawn, start[None]])).query(sites)[0] <= spacing
        nearest = np.linalg.norm(sites - start, axis=1)
        open_ &= ~seen & (nearest > nearest[open_].min())
    return pieces


class Region:
    """What is to be covered, and what of it is."""

    def __init__(self, sites: Array, keep: float, apart: float) -> None:
        from scipy.spatial import cKDTree

        self._sites, self._keep, self._apart = cKDTree(sites), keep, apart
        self.width = float(np.linalg.norm(np.ptp(sites, axis=0))) + 2.0 * keep
        """Diagonal of the box about it, m."""
        self.drawn = np.zeros((0, 3))
        """Samples (k, 3) of the lanes so far."""

    def holds(self, points: Array) -> NDArray[np.bool_]:
        """Which points (k, 3) are in it."""
        return np.asarray(self._sites.query(points)[0] <= self._keep)

    def add(self, lane: list[Closest], step: float) -> list[NDArray[np.bool_]]:
        """Draw a lane, in chains; which samples of each chain are in the region and on no other."""
        from scipy.spatial import cKDTree

        if not lane:
            return []
        points = np.concatenate([chain.point for chain in lane])
        inside = self.holds(points)
        if len(self.drawn):
            inside &= cKDTree(self.drawn).query(points)[0] > self._apart
        # a lane that comes back on itself: the earlier samples count
        pairs = cKDTree(points).query_pairs(self._apart, output_type="ndarray")
        back = pairs[pairs[:, 1] - pairs[:, 0] > 3.0 * self._apart / step]
        for early, late in back[np.argsort(back[:, 0], kind="stable")]:
            if inside[early]:
                inside[late] = False
        self.drawn = np.concatenate([self.drawn, points[inside]])
        return np.split(inside, np.cumsum([len(chain.point) for chain in lane])[:-1])


def _middle(body: Body, sites: Array) -> tuple[Array, list[Array]]:
    """The site nearest to the middle, and tangents there: that in which the sites stretch farthest,
    and the two in which the body is curved most and least.
    """
    middle = sites.mean(axis=0)
    at = sites[np.argmin(np.linalg.norm(sites - middle, axis=1))]
    spread = np.linalg.svd(sites - middle, full_matrices=False)[2][0] if len(sites) > 2 else None
    hit = body.closest(at[None])
    normal = hit.normal[0]
    curved = onto(hit.direction[0], normal)
    along = curved if spread is None else onto(spread, normal)
    return at, [along, curved, np.cross(normal, curved)]


def both_ways(
    body: Body, start: Array, direction: Array, step: float, region: Region | None = None
) -> Array:
    """Points (k, 3) of the geodesic through `start` both ways: until it closes, meets a border,
    has left the region for longer than that is wide, or is several times as long as the body.
    """
    ahead, closed = _trace(body, start, direction, step, region)
    if closed:  # cut where it is farthest from the region
        return np.roll(ahead, len(ahead) // 2, axis=0)
    return np.concatenate([_trace(body, start, -direction, step, region)[0][:0:-1], ahead])


def _base(body: Body, start: Array, directions: list[Array], step: float, region: Region) -> Array:
    """The geodesic to begin with: the first; round a body that the region goes round, the first
    that closes, as the others would wind about it.
    """
    if region.width > ROUND * body.surface.scale:
        for direction in directions:
            way = both_ways(body, start, direction, step, region)
            if np.linalg.norm(way[-1] - way[0]) < 1.5 * step:
                return way
    return both_ways(body, start, directions[0], step, region)


def _trace(
    body: Body, start: Array, direction: Array, step: float, region: Region | None
) -> tuple[Array, bool]:
    """The geodesic one way from `start`, and whether it came back there."""
    trace = geodesic(body, start, direction, step)
    points, astray = [next(trace)[0].point[0]], 0
    for k in range(int(4.0 * body.surface.scale / step)):
        point = next(trace)[0].point[0]
        if np.linalg.norm(point - points[-1]) < STUCK * step:
            break
        points.append(point)
        if k > 3 and np.linalg.norm(point - points[0]) < 0.75 * step:
            return np.array(points), True
        if region is not None:
            astray = 0 if region.holds(point[None])[0] else astray + 1
            if astray * step > region.width:
                break
    return np.array(points), False


def _sweep(
    body: Body, start: Array, directions: list[Array], spacing: float, step: float, region: Region
) -> list[Piece]:
    """Pieces of the lanes beside one geodesic, from one end of the region to the other."""
    base = [body.closest(_base(body, start, directions, step, region))]
    gap, most = round(spacing / step), int(np.ceil(2.0 * body.surface.scale / spacing))

    def pieces(lane: list[Closest]) -> list[Piece]:
        inside = region.add(lane, step)
        cut = [_cut(c, _closed(i, gap)) for c, i in zip(lane, inside, strict=True)]
        return [piece for chain in cut for piece in chain if len(piece) > gap]

    found = {0: pieces(base)}
    passed = [chain.point for chain in base]
    for side in (-1, 1):
        lane, barren = base, 0
        for k in range(1, most):
            lane = [c for chain in lane for c in _beside(body, chain, side * spacing, step)]
            lane = _fresh(lane, passed, OVERLAP * spacing)
            found[side * k] = pieces(lane)
            barren = 0 if found[side * k] else barren + 1
            if not lane or barren == BARREN:
                break
    return [piece for k in sorted(found) for piece in found[k]]


def _fresh(lane: list[Closest], passed: list[Array], apart: float) -> list[Closest]:
    """A lane without what is less than `apart`, m, from lanes or chains before it, in `passed`.

    Where lanes fold over creases their chains would else run over one another, more every time.
    """
    from scipy.spatial import cKDTree

    out = []
    for chain in lane:
        near = cKDTree(np.concatenate(passed)).query(chain.point)[0] < apart
        for run in runs(~near):
            if run.stop - run.start > 2:
                out.append(chain.take(run))
        passed.append(chain.point)
    return out


def _beside(body: Body, chain: Closest, shift: float, step: float) -> list[Closest]:
    """The chain `shift` to its left, m, without what folded, sampled evenly again."""
    along = np.gradient(chain.point, axis=0)
    left = np.cross(chain.normal, along)
    length = np.linalg.norm(left, axis=1, keepdims=True)  # zero where a lane folds at a crease
    left /= np.where(length > 0.0, length, np.inf)
    hit = body.closest(chain.point + shift * left, chain.face)
    moved = np.linalg.norm(hit.point - chain.point, axis=1)
    ahead = np.gradient(hit.point, axis=0)
    forward = np.einsum("ij,ij->i", ahead, along) > 0.05 * np.einsum("ij,ij->i", along, along)
    good = forward & (moved > STUCK * abs(shift))
    out = []
    for piece in _cut(hit, good):
        way = np.concatenate(
            [[0], np.cumsum(np.linalg.norm(np.diff(piece.points, axis=0), axis=1))]
        )
        count = max(round(way[-1] / step), 2) + 1
        if way[-1] < 2 * step:
            continue
        even = np.linspace(0.0, way[-1], count)
        points = np.stack([np.interp(even, way, x) for x in piece.points.T], axis=1)
        out.append(body.closest(points))
    return out


def _cut(chain: Closest, inside: NDArray[np.bool_]) -> list[Piece]:
    """The runs of samples that are inside."""
    return [Piece(chain.point[run], chain.normal[run]) for run in runs(inside)]


def runs(inside: NDArray[np.bool_]) -> list[slice]:
    """The runs of consecutive True."""
    change = np.flatnonzero(np.diff(np.concatenate([[False], inside, [False]]).astype(int)))
    return [slice(int(a), int(b)) for a, b in change.reshape(-1, 2)]


def _closed(inside: NDArray[np.bool_], gap: int) -> NDArray[np.bool_]:
    """`inside` with gaps of up to `gap` samples filled: not worth leaving the lane for."""
    filled = inside.copy()
    for run in runs(~inside):
        if run.start > 0 and run.stop < len(inside) and run.stop - run.start <= gap:
            filled[run] = True
    return filled
