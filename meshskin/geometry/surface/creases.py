"""The curves of a mesh's creases, from the jets on both sides of them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import ranges
from ..mesh.triangles import face_normals
from . import patch
from .fans import Fans
from .heights import heights
from .jets import Jets

Array = NDArray[np.float64]
Index = NDArray[np.intp]

MAX_BOW = 0.2
"""largest distance of a crease's curve from its chord, relative to the chord; nor may it be farther
than the tangent planes at its ends"""
INNER = np.arange(1, patch.DEGREE) / patch.DEGREE
"""(4,) weights of an edge's head at its inner nodes"""


@dataclass(frozen=True)
class Creases:
    """The curves of the creases, once for each of their two faces, in the order of the faces."""

    face: Index
    """(e,)"""
    corner: Index
    """(e,) the corner opposite the crease"""
    curve: Array
    """(e, 4, 3) inner points, m, from the edge's tail to its head in this face"""

    def of(self, rows: Index) -> tuple[Index, Index, Array]:
        """Those of the sorted faces `rows` (k,): places in `rows`, corners, points."""
        low, high = np.searchsorted(self.face, rows), np.searchsorted(self.face, rows, side="right")
        count = high - low
        place = np.repeat(np.arange(len(rows)), count)
        pick = ranges(low, count)
        return place, self.corner[pick], self.curve[pick]


def crease_curves(
    jets: Jets, fans: Fans, beyond: Index, slot: Index, chords: NDArray[np.bool_]
) -> Creases:
    """The curves of the creases, from where the surfaces of both sides meet.

    Where those do not meet near the chord, and where `chords` (m, 3) says so, it is the chord.
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
        rise = np.max([_rise(jets, normals, fan, chord) for fan in ends], axis=0)
        meet = np.linalg.norm(np.cross(flat[: len(a)], flat[len(a) :]), axis=1)
        most = np.minimum(most, rise / np.maximum(meet, 0.3))
        for f, k in ((a, ka), (b, kb)):  # nor beyond the middle of the faces beside it
            tip = jets.origin[fans.corner[f, k]] - p
            most = np.minimum(most, 0.5 * np.linalg.norm(np.cross(along, tip), axis=1))
    most = most[:, None, None]
    curve = chord.copy()
    for _ in range(8):
        curve = chord + np.clip(curve + _towards(jets, sides, curve, along) - chord, -most, most)
    bow = np.linalg.norm(curve - chord, axis=2).max(axis=1)
    left = np.abs(_towards(jets, sides, curve, along)).max(axis=(1, 2))
    straight = ~((bow < most[:, 0, 0]) & (left < 1e-3 * length))
    straight |= chords[a, ka]
    curve[straight] = chord[straight]
    face, corner = np.concatenate([a, b]), np.concatenate([ka, kb])
    order = np.argsort(face, kind="stable")
    return Creases(face[order], corner[order], np.concatenate([curve, curve[:, ::-1]])[order])


def _rise(jets: Jets, normals: Array, fan: Index, points: Array) -> Array:
    """Largest distances (e,) of points (e, 4, 3) from the tangent planes of fans (e,)."""
    offset = points - jets.origin[fan][:, None]
    high = np.abs(np.einsum("etc,ec->et", offset, normals[fan])).max(axis=1)
    return np.where(jets.degree[fan] > 0, high, 0.0)


def _towards(
    jets: Jets, sides: tuple[tuple[Index, Index, Array], ...], points: Array, along: Array
) -> Array:
    """Moves (e, 4, 3), across the edges, of points towards the surfaces of both sides.

    Sides that are nearly tangent are met halfway (damped least squares).
    """
    normals, misses = [], []
    for tail, head, flat in sides:
        normal, miss = np.zeros_like(points), np.zeros(points.shape[:2])
        for fan, weight in ((tail, 1.0 - INNER), (head, INNER)):
            frame, scale = jets.frame[fan], jets.scale[fan]
            up = np.where((jets.degree[fan] > 0)[:, None], frame[:, 2], flat)
            offset = points - jets.origin[fan][:, None]
            local = offset @ np.swapaxes(frame, 1, 2)
            x, y = local[..., 0] / scale[:, :1], local[..., 1] / scale[:, 1:]
            height = heights(jets.coefficients[fan].T[:, :, None], x, y)
            height *= (jets.degree[fan] > 0)[:, None]
            miss += weight * (np.einsum("etc,ec->et", offset, up) - height)
            normal += weight[:, None] * up[:, None]
        normal -= np.einsum("etc,ec->et", normal, along)[..., None] * along[:, None]
        normals.append(normal)
        misses.append(miss)
    (one, two), (r1, r2) = normals, misses
    aa, ab, bb = (np.einsum("etc,etc->et", f, g) for f, g in ((one, one), (one, two), (two, two)))
    aa, bb = aa + 1e-3, bb + 1e-3
    det = aa * bb - ab * ab
    u, v = (ab * r2 - bb * r1) / det, (ab * r1 - aa * r2) / det
    return np.asarray(u[..., None] * one + v[..., None] * two)
