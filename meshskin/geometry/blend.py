"""Patches of a mesh from its jets: the barycentric blend of the jets at a face's corners.

S = sum_i w_i P_i, where P_i lifts the base point of the face along jet i's normal to jet i. The
base is the flat face; beside a crease it is moved within the surface, so that the patches of both
sides end on one curve, where the two sides' surfaces meet.
"""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from math import comb

import numpy as np
from numpy.typing import NDArray

from . import patch
from .fans import Fans, face_normals
from .heights import heights
from .jets import FAITHFUL, Jets

Array = NDArray[np.float64]
Index = NDArray[np.intp]

BULGE = 3e-3
"""lift of a patch from its face, over the shortest side, beyond what its tangents account for"""
LEAN, SHARE = np.radians(1.0), 0.4
"""angle of a jet's normal from its face's, beyond the turn to the next faces (on a circle it
is half of it), or 3/4 of this share of the largest turn at the vertex"""
FINE = np.radians(6.0)
"""the same for faithful jets: twice the largest turn at the vertex, but no more than this"""
BOW = 0.2
"""largest distance of a crease's curve from its chord, relative to the chord; nor may it be farther
than the tangent planes at its ends"""
FOLD, ROUNDS = 0.5, 6
"""cosine of the angle to its face from which a patch folds; rounds of unfolding"""
CHUNK = 1024
"""faces blended at once: bounds the memory"""
WORKERS = min(os.cpu_count() or 1, 4)
"""threads that blend; the result does not depend on their number"""
NODES = np.array(patch.POWERS) / patch.DEGREE
"""(21, 2) u, v of the points that fix a quintic"""
WEIGHTS = np.column_stack([1.0 - NODES.sum(axis=1), NODES])
"""(21, 3) their barycentric weights"""
BASIS = patch.monomials(NODES[:, 0], NODES[:, 1])
"""(21, 21) from coefficients to values at the nodes"""
INVERSE = np.linalg.inv(BASIS)
"""(21, 21) from values at the nodes to coefficients"""
SLOPE_U, SLOPE_V = patch.slopes(NODES[:, 0], NODES[:, 1])
"""(21, 21) each, from coefficients to derivatives in u and v at the nodes"""
INNER = np.arange(1, patch.DEGREE) / patch.DEGREE
"""(4,) weights of an edge's head at its inner nodes"""


def _edge_tables() -> tuple[Index, Array]:
    """The inner nodes (3, 4) of the edges opposite the corners, and how they move all (3, 21, 4).

    A move of an edge's curve, as a quintic in Bernstein form, extends to the face by the Bernstein
    polynomials of the same control points.
    """
    d = patch.DEGREE
    bernstein = [[comb(d, j) * t**j * (1 - t) ** (d - j) for j in range(1, d)] for t in INNER]
    control = np.linalg.inv(np.array(bernstein))
    nodes, spread = np.zeros((3, d - 1), dtype=np.intp), np.zeros((3, len(NODES), d - 1))
    for k in range(3):
        tail, head = WEIGHTS[:, (k + 1) % 3], WEIGHTS[:, (k + 2) % 3]
        powers = [comb(d, j) * head**j * tail ** (d - j) for j in range(1, d)]
        spread[k] = np.stack(powers, axis=1) @ control
        on = np.flatnonzero(np.abs(WEIGHTS[:, k]) < 1e-12)
        on = on[np.argsort(head[on])]
        nodes[k] = on[1:-1]
    return nodes, spread


EDGE_NODES, SPREAD = _edge_tables()


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
        pick = np.repeat(low - np.cumsum(count) + count, count) + np.arange(count.sum())
        return place, self.corner[pick], self.curve[pick]


def settle(jets: Jets, fans: Fans, beyond: Index, slot: Index) -> tuple[Jets, Creases]:
    """Jets and curves of creases without bulges and folds; `beyond`, `slot`: as of walk.neighbours.

    Where a patch would fold, its creases become straight; where it still does, its jets flat.
    """
    jets = flatten_bulges(jets, fans)
    straight = np.zeros(fans.corner.shape, dtype=bool)
    creases = crease_curves(jets, fans, beyond, slot, straight)
    doubtful = np.any(jets.miss[fans.corner] >= FAITHFUL, axis=1)
    doubtful[creases.face] = True
    suspect = np.flatnonzero(doubtful)
    for trial in range(ROUNDS):
        folded = [
            rows[folds(jets, fans.corner[rows], creases.of(rows))]
            for rows in np.split(suspect, range(CHUNK, len(suspect), CHUNK))
        ]
        bad = np.concatenate(folded)
        if not len(bad):
            break
        here = np.zeros_like(straight)
        here[bad] = fans.sharp[bad]
        face, k = np.nonzero(here & ~straight)
        straight[face, k] = straight[beyond[face, k], slot[face, k]] = True
        if trial or not len(face):
            degree = jets.degree.copy()
            degree[fans.corner[bad]] = 0
            jets = replace(jets, degree=degree)
        creases = crease_curves(jets, fans, beyond, slot, straight)
    return jets, creases


def folds(jets: Jets, corner: Index, curved: tuple[Index, Index, Array]) -> NDArray[np.bool_]:
    """Whether the patches of faces with the fans `corner` (m, 3) turn from their faces anywhere."""
    values, _ = node_values(jets, corner, curved)
    coefficients = INVERSE @ values
    normal = np.cross(SLOPE_U @ coefficients, SLOPE_V @ coefficients)
    size = np.linalg.norm(normal, axis=2)
    flat = face_normals(jets.origin, corner)
    along = np.einsum("mnc,mc->mn", normal, flat)
    return np.asarray(np.any(along < FOLD * size, axis=1) & flat.any(axis=1))


def blend(jets: Jets, fans: Fans, creases: Creases, triangles: Array) -> tuple[Array, Array]:
    """Patches (m, 21, 3) of the faces, and their largest distances (m,) from `triangles`, m.

    Two faces share the jets of a smooth edge and the curve of a crease: their patches meet exactly.
    `triangles` (m, 3, 3): the flat faces; the distances are those at the nodes.
    """
    m = len(fans.corner)
    out, lift2 = np.empty((m, len(NODES), 3)), np.empty(m)

    def fill(start: int) -> None:
        rows = np.arange(start, min(start + CHUNK, m))
        corner = fans.corner[rows]
        values, _ = node_values(jets, corner, creases.of(rows))
        out[start : start + CHUNK] = INVERSE @ values
        values -= WEIGHTS @ triangles[rows]
        lift2[start : start + CHUNK] = np.einsum("mnc,mnc->mn", values, values).max(axis=1)

    with ThreadPoolExecutor(WORKERS) as pool:  # NumPy lets go of the interpreter meanwhile
        list(pool.map(fill, range(0, m, CHUNK)))
    return out, np.sqrt(lift2)


def node_values(
    jets: Jets, corner: Index, curved: tuple[Index, Index, Array] | None = None
) -> tuple[Array, Array]:
    """The surface (m, 21, 3) at the nodes of faces with the fans `corner` (m, 3), and its base.

    `curved`: faces, the corners opposite their creases, and the creases' inner points (e, 4, 3).
    """
    places = jets.origin[corner]  # (m, 3, 3)
    base = WEIGHTS @ places
    if curved is not None and len(curved[0]):
        face, k, curve = curved
        nodes = EDGE_NODES[k]
        move = curve - base[face[:, None], nodes]
        np.add.at(base, face, SPREAD[k] @ move)
    values, most = base.copy(), int(jets.degree[corner].max(initial=0))
    for j in range(3):
        fan = corner[:, j]
        frame, scale = jets.frame[fan], jets.scale[fan]
        local = (base - places[:, [j]]) @ np.swapaxes(frame, 1, 2)
        x, y = local[..., 0] / scale[:, :1], local[..., 1] / scale[:, 1:]
        lift = heights(jets.coefficients[fan], x, y, most) - local[..., 2]
        lift *= WEIGHTS[:, j] * (jets.degree[fan] > 0)[:, None]
        values += lift[..., None] * frame[:, None, 2]
    if curved is not None and len(curved[0]):
        values[face[:, None], nodes] = curve
    return values, base


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
    most = BOW * length
    if len(a):
        normals = tangents(jets)
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


def tangents(jets: Jets) -> Array:
    """Unit normals (j, 3) of the jets."""
    slope = jets.coefficients[:, :2] / jets.scale
    normals = jets.frame[:, 2] - np.einsum("jk,jkc->jc", slope, jets.frame[:, :2])
    return np.asarray(normals / np.linalg.norm(normals, axis=1, keepdims=True))


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
            height = heights(jets.coefficients[fan], x, y) * (jets.degree[fan] > 0)[:, None]
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


def flatten_bulges(jets: Jets, fans: Fans) -> Jets:
    """The jets, but flat at the fans of faces whose patches bulge beyond belief.

    Between two points of an arc, the arc is half as high over the chord as its tangents are; no
    patch may be higher than the highest of the tangent planes at its corners, and no tangent plane
    lean more than the next faces do.
    """
    degree = jets.degree.copy()
    turn = np.zeros(len(degree))
    for k in range(3):
        np.maximum.at(turn, fans.corner[:, k], fans.turn)
    normals = tangents(jets)
    suspect = np.flatnonzero(np.any(jets.miss[fans.corner] >= FAITHFUL, axis=1))
    for start in range(0, len(suspect), CHUNK):
        rows = suspect[start : start + CHUNK]
        corner = fans.corner[rows]
        places = jets.origin[corner]
        side = np.linalg.norm(places - places[:, [1, 2, 0]], axis=2).min(axis=1)
        values, base = node_values(jets, corner)
        flat = face_normals(jets.origin, corner)
        lean = np.arccos(np.clip(np.einsum("mkc,mc->mk", normals[corner], flat), -1.0, 1.0))
        near = np.where(jets.miss[corner] < FAITHFUL, np.minimum(2.0 * turn, FINE)[corner], 0.0)
        near = np.maximum(near, SHARE * turn[corner])
        leaning = lean > np.maximum(fans.turn[rows, None], 0.75 * near) + LEAN
        degree[corner[leaning]] = 0
        lift = np.linalg.norm(values - base, axis=2)
        offset = base[:, None] - places[:, :, None]
        tangent = np.abs(np.einsum("mknc,mkc->mkn", offset, normals[corner])).max(axis=1)
        bulging = np.any(lift > tangent + BULGE * side[:, None], axis=1)
        degree[corner[bulging]] = 0
    return replace(jets, degree=degree)
