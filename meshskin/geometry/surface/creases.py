"""Curves of the creases of a mesh, in which the jets of both sides intersect."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import Array, Index, ranges
from ..mesh.triangles import face_normals
from . import patch
from .fans import Fans
from .heights import heights
from .jets import Jets

MAX_BOW = 0.2
"""largest distance of a crease's curve from its chord, relative to the chord: an arc of 87 deg; the
tangent planes at the ends bound it too"""
ITERATIONS = 8
"""steps of the projection on both sides; MISMATCH checks the result"""
MISMATCH = 1e-3
"""largest distance of a curve from both sides, relative to the chord, after the iterations"""
INNER = np.arange(1, patch.DEGREE) / patch.DEGREE
"""(4,) weights of the head of an edge at its inner nodes"""


@dataclass(frozen=True)
class Creases:
    """Curves of the creases, one for each of their two faces, sorted by face."""

    face: Index
    """(e,)"""
    corner: Index
    """(e,) the corner opposite the crease"""
    curve: Array
    """(e, 4, 3) inner points, m, from the tail to the head of the half-edge of this face"""

    def of(self, rows: Index) -> tuple[Index, Index, Array]:
        """Creases of the sorted faces `rows` (k,): positions in `rows`, corners, inner points."""
        low, end = (np.searchsorted(self.face, rows, side=side) for side in ("left", "right"))
        count = end - low
        place = np.repeat(np.arange(len(rows)), count)
        pick = ranges(low, count)
        return place, self.corner[pick], self.curve[pick]


def crease_curves(
    jets: Jets,
    fans: Fans,
    beyond: Index,
    slot: Index,
    chords: NDArray[np.bool_],
    former: tuple[Creases, NDArray[np.bool_]] | None = None,
) -> Creases:
    """Curves of the creases, in which the surfaces of both sides intersect.

    Where those do not intersect near the chord, and where `chords` (m, 3) is true, the chord.
    former: the curves of other jets or chords, and which faces (m,) have other ones now.
    """
    edge = np.flatnonzero(fans.sharp.ravel())
    face, k = np.divmod(edge, 3)
    there, s = beyond[face, k], slot[face, k]
    first = edge < 3 * there + s  # each edge once
    a, ka, b, kb = face[first], k[first], there[first], s[first]
    face, corner = np.concatenate([a, b]), np.concatenate([ka, kb])
    order = np.argsort(face, kind="stable")
    curve, new = np.empty((len(face), len(INNER), 3)), np.ones(len(a), dtype=bool)
    if former is not None:
        curve[order], new = former[0].curve, former[1][a] | former[1][b]
    found = _intersections(jets, fans, (a[new], ka[new], b[new], kb[new]), chords)
    both = np.concatenate([new, new])
    curve[both] = np.concatenate([found, found[:, ::-1]])
    return Creases(face[order], corner[order], curve[order])


def _intersections(
    jets: Jets, fans: Fans, edges: tuple[Index, ...], chords: NDArray[np.bool_]
) -> Array:
    """Inner points (e, 4, 3), m, of the curves of edges: their faces (e,) and corners (e,), and
    those across."""
    a, ka, b, kb = edges
    tail, head = fans.corner[a, (ka + 1) % 3], fans.corner[a, (ka + 2) % 3]
    p, q = jets.origin[tail], jets.origin[head]
    chord = p[:, None] + INNER[:, None] * (q - p)[:, None]
    if not len(a):
        return chord
    flat = face_normals(jets.origin, fans.corner[np.concatenate([a, b])])
    one, two = flat[: len(a)], flat[len(a) :]
    ends = tail, head, fans.corner[b, (kb + 2) % 3], fans.corner[b, (kb + 1) % 3]
    length = np.linalg.norm(q - p, axis=1)
    along = (q - p) / np.maximum(length, 1e-300)[:, None]
    normals = jets.normals
    bound = np.max([_tangent_distance(jets, normals, fan, chord) for fan in ends], axis=0)
    sine = np.linalg.norm(np.cross(one, two), axis=1)
    most = np.minimum(MAX_BOW * length, bound / np.maximum(sine, 0.3))
    for f, k in ((a, ka), (b, kb)):  # and by half the height of the faces
        apex = jets.origin[fans.corner[f, k]] - p
        most = np.minimum(most, 0.5 * np.linalg.norm(np.cross(along, apex), axis=1))
    sides = _Side(jets, ends[:2], one, along), _Side(jets, ends[2:], two, along)
    steps = _step_lengths(*(side.normal for side in sides))
    start, limit = np.moveaxis(chord, 0, 2), most[None, None]
    curve = start.copy()
    for _ in range(ITERATIONS + 1):
        one, two = (
            f * side.distances(curve)[:, None] for f, side in zip(steps, sides, strict=True)
        )
        step = one + two
        last, curve = curve, start + np.clip(curve + step - start, -limit, limit)
    bow = np.linalg.norm(last - start, axis=1).max(axis=0)
    mismatch = np.abs(step).max(axis=(0, 1))
    straight = ~((bow < most) & (mismatch < MISMATCH * length)) | chords[a, ka]
    return np.where(straight[:, None, None], chord, np.moveaxis(last, 2, 0))


def _tangent_distance(jets: Jets, normals: Array, fan: Index, points: Array) -> Array:
    """Largest distances (e,) of points (e, 4, 3) from the tangent planes at fans (e,)."""
    offset = points - jets.origin[fan][:, None]
    distance = np.abs(np.einsum("etc,ec->et", offset, normals[fan])).max(axis=1)
    return np.where(jets.degree[fan] > 0, distance, 0.0)


class _Side:
    """One side of e edges: the blend of the jets at both ends. Arrays end with the axis of the
    edges, for NumPy's speed."""

    def __init__(self, jets: Jets, ends: tuple[Index, ...], flat: Array, along: Array) -> None:
        """flat (e, 3): normals of the faces, for jets that are flat; along (e, 3): directions."""
        self._fitted: list[tuple[Array, Array, Array, Array]] = []
        self.normal = np.zeros((len(INNER), *flat.T.shape))
        """(4, 3, e) normals at the inner points, perpendicular to the edges"""
        self._degree = int(max((jets.degree[fan].max(initial=0) for fan in ends), default=0))
        for fan, weight in zip(ends, (1.0 - INNER, INNER), strict=True):
            curved = jets.degree[fan] > 0
            up = np.where(curved[:, None], jets.frame[fan, 2], flat).T
            rows = np.moveaxis(jets.frame[fan, :2] / jets.scale[fan][:, :, None], 0, 2)
            rows = np.concatenate([rows, up[None]])
            coefficients = np.where(curved, jets.coefficients[fan].T, 0.0)
            self._fitted.append((jets.origin[fan].T, rows, coefficients, weight[:, None]))
            self.normal += weight[:, None, None] * up
        self.normal -= np.einsum("tce,ec->te", self.normal, along)[:, None] * along.T

    def distances(self, points: Array) -> Array:
        """Distances (4, e), m, of points (4, 3, e), m, along the normals."""
        total = np.zeros((len(points), points.shape[2]))
        for origin, rows, coefficients, weight in self._fitted:
            x, y, z = np.einsum("kce,tce->kte", rows, points - origin)
            total += weight * (z - heights(coefficients, x, y, self._degree))
        return total


def _step_lengths(one: Array, two: Array) -> tuple[Array, Array]:
    """Steps (4, 3, e) per distance from either side, with normals (4, 3, e), perpendicular to the
    edges. By damped least squares: of nearly tangent surfaces they lead halfway."""
    aa, ab, bb = (np.einsum("tce,tce->te", f, g) for f, g in ((one, one), (one, two), (two, two)))
    aa, bb = aa + 1e-3, bb + 1e-3
    det = aa * bb - ab * ab
    to_one = (ab[:, None] * two - bb[:, None] * one) / det[:, None]
    to_two = (ab[:, None] * one - aa[:, None] * two) / det[:, None]
    return to_one, to_two
