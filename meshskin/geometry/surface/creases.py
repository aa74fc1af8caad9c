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
    jets: Jets, fans: Fans, beyond: Index, slot: Index, chords: NDArray[np.bool_]
) -> Creases:
    """Curves of the creases, in which the surfaces of both sides intersect.

    Where those do not intersect near the chord, and where `chords` (m, 3) is true, the chord.
    """
    edge = np.flatnonzero(fans.sharp.ravel())
    face, k = np.divmod(edge, 3)
    there, s = beyond[face, k], slot[face, k]
    first = edge < 3 * there + s  # each edge once
    a, ka, b, kb = face[first], k[first], there[first], s[first]
    tail, head = fans.corner[a, (ka + 1) % 3], fans.corner[a, (ka + 2) % 3]
    p, q = jets.origin[tail], jets.origin[head]
    chord = p[:, None] + INNER[:, None] * (q - p)[:, None]
    flat = face_normals(jets.origin, fans.corner[np.concatenate([a, b])])
    sides = (
        (tail, head, flat[: len(a)]),
        (fans.corner[b, (kb + 2) % 3], fans.corner[b, (kb + 1) % 3], flat[len(a) :]),
    )
    length = np.linalg.norm(q - p, axis=1)
    along = (q - p) / np.maximum(length, 1e-300)[:, None]
    most = MAX_BOW * length
    if len(a):
        normals = jets.normals
        ends = (tail, head, sides[1][0], sides[1][1])
        bound = np.max([_tangent_distance(jets, normals, fan, chord) for fan in ends], axis=0)
        sine = np.linalg.norm(np.cross(flat[: len(a)], flat[len(a) :]), axis=1)
        most = np.minimum(most, bound / np.maximum(sine, 0.3))
        for f, k in ((a, ka), (b, kb)):  # and by half the height of the faces
            apex = jets.origin[fans.corner[f, k]] - p
            most = np.minimum(most, 0.5 * np.linalg.norm(np.cross(along, apex), axis=1))
    most = most[:, None, None]
    curve = chord.copy()
    for _ in range(ITERATIONS):
        curve = curve + _projection_step(jets, sides, curve, along)
        curve = chord + np.clip(curve - chord, -most, most)
    bow = np.linalg.norm(curve - chord, axis=2).max(axis=1)
    mismatch = np.abs(_projection_step(jets, sides, curve, along)).max(axis=(1, 2))
    straight = ~((bow < most[:, 0, 0]) & (mismatch < MISMATCH * length))
    straight |= chords[a, ka]
    curve[straight] = chord[straight]
    face, corner = np.concatenate([a, b]), np.concatenate([ka, kb])
    order = np.argsort(face, kind="stable")
    return Creases(face[order], corner[order], np.concatenate([curve, curve[:, ::-1]])[order])


def _tangent_distance(jets: Jets, normals: Array, fan: Index, points: Array) -> Array:
    """Largest distances (e,) of points (e, 4, 3) from the tangent planes at fans (e,)."""
    offset = points - jets.origin[fan][:, None]
    distance = np.abs(np.einsum("etc,ec->et", offset, normals[fan])).max(axis=1)
    return np.where(jets.degree[fan] > 0, distance, 0.0)


def _projection_step(
    jets: Jets, sides: tuple[tuple[Index, Index, Array], ...], points: Array, along: Array
) -> Array:
    """Steps (e, 4, 3), perpendicular to the edges, from points towards both surfaces.

    By damped least squares: of nearly tangent surfaces the step leads halfway.
    """
    normals, distances = [], []
    for tail, head, flat in sides:
        normal, distance = np.zeros_like(points), np.zeros(points.shape[:2])
        for fan, weight in ((tail, 1.0 - INNER), (head, INNER)):
            frame, scale = jets.frame[fan], jets.scale[fan]
            up = np.where((jets.degree[fan] > 0)[:, None], frame[:, 2], flat)
            offset = points - jets.origin[fan][:, None]
            local = offset @ np.swapaxes(frame, 1, 2)
            x, y = local[..., 0] / scale[:, :1], local[..., 1] / scale[:, 1:]
            height = heights(jets.coefficients[fan].T[:, :, None], x, y)
            height *= (jets.degree[fan] > 0)[:, None]
            distance += weight * (np.einsum("etc,ec->et", offset, up) - height)
            normal += weight[:, None] * up[:, None]
        normal -= np.einsum("etc,ec->et", normal, along)[..., None] * along[:, None]
        normals.append(normal)
        distances.append(distance)
    (one, two), (r1, r2) = normals, distances
    aa, ab, bb = (np.einsum("etc,etc->et", f, g) for f, g in ((one, one), (one, two), (two, two)))
    aa, bb = aa + 1e-3, bb + 1e-3
    det = aa * bb - ab * ab
    u, v = (ab * r2 - bb * r1) / det, (ab * r1 - aa * r2) / det
    return np.asarray(u[..., None] * one + v[..., None] * two)
