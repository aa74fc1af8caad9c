"""Patches of a mesh: barycentric blends of the jets at the corners of each face.

S = sum_i w_i P_i, where P_i projects a point of the base along the normal of jet i onto jet i. The
base is the flat face; at a crease its edge is moved to the curve in which the surfaces of both
sides intersect, so that the patches of both faces end on it.
"""

from __future__ import annotations

from dataclasses import replace
from math import comb

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import Array, Index
from ..mesh.triangles import face_normals
from . import patch
from .creases import INNER, Creases, crease_curves
from .fans import Fans
from .heights import DEGREE, heights
from .jets import TRUSTED_RESIDUAL, Jets

BULGE_MARGIN = 3e-3
"""largest height of a patch over its face, beyond that of the tangent planes at its corners,
relative to the shortest side of the face"""
TILT_MARGIN, TILT_SHARE = np.radians(1.0), 0.4
"""margin of the angle between the normals of a jet and of its face over the largest angle between
the face and its neighbours (on a circle it is half of that), or over 3/4 of this share of the
largest such angle at the vertex"""
MAX_TRUSTED_TILT = np.radians(6.0)
"""for jets of a small residual, twice the largest such angle at the vertex, up to this limit"""
FOLD_COSINE, MAX_ROUNDS = 0.5, 6
"""cosine of the angle to its face from which a patch is folded; most rounds of regularization"""
CHUNK = 1024
"""faces blended at once: bounds the memory, and keeps products too small for BLAS to use threads,
which cost more than they save"""
NODES = np.array(patch.POWERS) / patch.DEGREE
"""(21, 2) u, v of the nodes that determine a quintic"""
WEIGHTS = np.column_stack([1.0 - NODES.sum(axis=1), NODES])
"""(21, 3) their barycentric weights"""
BASIS = patch.monomials(NODES[:, 0], NODES[:, 1])
"""(21, 21) from coefficients to values at the nodes"""
INVERSE = np.linalg.inv(BASIS)
"""(21, 21) from values at the nodes to coefficients"""
DERIVATIVE_U, DERIVATIVE_V = patch.slopes(NODES[:, 0], NODES[:, 1])
"""(21, 21) each, from coefficients to derivatives in u and v at the nodes"""


def _edge_tables() -> tuple[Index, Array]:
    """Inner nodes (3, 4) of the edges opposite the corners, and their effect (3, 21, 4) on all.

    A displacement of an edge, a quintic in Bernstein form, extends to the face by the Bernstein
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


EDGE_NODES, EDGE_EXTENSION = _edge_tables()


def _lift_tables() -> dict[int, tuple[Array, Array]]:
    """For heights of each degree: nodes (q, 2), and patches (3, r, q) from the heights there.

    The nodes are the weights of the two corners after the jet's own; the patches, of one degree
    more, are the heights times the weight of the jet's corner.
    """
    tables = {}
    for degree in range(1, DEGREE + 1):
        q, r = ((d + 1) * (d + 2) // 2 for d in (degree, degree + 1))
        nodes = np.array(patch.POWERS[:q]) / degree
        fixed = np.linalg.inv(patch.monomials(*nodes.T)[:, :q])
        values = [
            WEIGHTS[:, [k]] * (patch.monomials(WEIGHTS[:, k - 2], WEIGHTS[:, k - 1])[:, :q] @ fixed)
            for k in range(3)
        ]
        tables[degree] = nodes, (INVERSE @ np.array(values))[:, :r]
    return tables


LIFTS = _lift_tables()


def regularize(jets: Jets, fans: Fans, beyond: Index, slot: Index) -> tuple[Jets, Creases]:
    """Jets and crease curves without bulges and folds; `beyond`, `slot`: topology.neighbours.

    Creases of a folded patch become straight; where it remains folded, its jets become flat.
    """
    jets = flatten_bulges(jets, fans)
    straight = np.zeros(fans.corner.shape, dtype=bool)
    creases = crease_curves(jets, fans, beyond, slot, straight)
    doubtful = np.any(jets.residual[fans.corner] >= TRUSTED_RESIDUAL, axis=1)
    doubtful[creases.face] = True
    folded, stale = np.zeros(len(fans.corner), dtype=bool), doubtful
    for trial in range(MAX_ROUNDS):
        again = np.flatnonzero(stale)
        for rows in np.split(again, range(CHUNK, len(again), CHUNK)):
            folded[rows] = is_folded(jets, fans.corner[rows], creases.of(rows))
        bad = np.flatnonzero(folded)
        if not len(bad):
            break
        here = np.zeros_like(straight)
        here[bad] = fans.sharp[bad]
        face, k = np.nonzero(here & ~straight)
        changed = np.zeros(len(folded), dtype=bool)  # the faces that need another patch
        changed[face] = changed[beyond[face, k]] = True
        straight[face, k] = straight[beyond[face, k], slot[face, k]] = True
        if trial or not len(face):
            degree = jets.degree.copy()
            degree[fans.corner[bad]] = 0
            changed |= (degree != jets.degree)[fans.corner].any(axis=1)
            jets = replace(jets, degree=degree)
        creases = crease_curves(jets, fans, beyond, slot, straight, (creases, changed))
        stale = doubtful & (changed | (fans.sharp & changed[beyond]).any(axis=1))
    return jets, creases


def is_folded(jets: Jets, corner: Index, curved: tuple[Index, Index, Array]) -> NDArray[np.bool_]:
    """Whether patches of faces with the fans `corner` (m, 3) turn away from their faces."""
    values, _ = node_values(jets, corner, curved)
    coefficients = INVERSE @ values
    normal = np.cross(DERIVATIVE_U @ coefficients, DERIVATIVE_V @ coefficients)
    size = np.linalg.norm(normal, axis=2)
    flat = face_normals(jets.origin, corner)
    along = np.einsum("mnc,mc->mn", normal, flat)
    return np.asarray(np.any(along < FOLD_COSINE * size, axis=1) & flat.any(axis=1))


def blend_patches(
    jets: Jets, fans: Fans, creases: Creases, triangles: Array
) -> tuple[Array, Array]:
    """Patches (m, 21, 3) of the faces, and their largest distances (m,), m, from `triangles`.

    Neighbouring faces share the jets of a smooth edge, or the curve of a crease: their patches meet
    exactly. `triangles` (m, 3, 3), m: the flat faces; the distances are those at the nodes.
    """
    m = len(fans.corner)
    out, height2 = np.zeros((m, len(NODES), 3)), np.empty(m)
    for start in range(0, m, CHUNK):
        some = slice(start, start + CHUNK)
        flat, offset = _flat_based(jets, fans.corner[some], triangles[some])
        for axis, values in enumerate(flat):
            out[some, : len(values), axis] = values.T
        height2[some] = np.einsum("ckm,ckm->km", offset, offset).max(axis=0)
        place, k, curve = creases.of(np.arange(start, min(start + CHUNK, m)))
        if len(place):
            curved, owner = np.unique(place, return_inverse=True)
            rows = start + curved
            values, _ = node_values(jets, fans.corner[rows], (owner, k, curve))
            out[rows] = INVERSE @ values
            values -= WEIGHTS @ triangles[rows]
            height2[rows] = np.einsum("mnc,mnc->mn", values, values).max(axis=1)
    return out, np.sqrt(height2)


def _flat_based(jets: Jets, corner: Index, triangles: Array) -> tuple[Array, Array]:
    """Patches (3, r, m) of faces with straight edges, and offsets of nodes from `triangles`.

    The base point is linear in u and v: a height is a polynomial of the degree of its jet, and
    determined by few nodes; coefficients beyond the first r are zero. The last axis is that of the
    faces, for NumPy's speed.
    """
    degree = jets.degree[corner]
    most = max(1, int(degree.max(initial=0)))
    nodes, to_patch = LIFTS[most]
    origins = np.moveaxis(jets.origin[corner], 0, 2)  # (corner, xyz, m)
    out = np.zeros((3, to_patch.shape[1], len(corner)))
    for k in range(3):
        fan = corner[:, k]
        frame, scale = np.moveaxis(jets.frame[fan], 0, 2).copy(), jets.scale[fan].T
        sides = origins[[k - 2, k - 1]] - origins[k]
        x, y, z = np.einsum("scm,acm->asm", sides, frame)
        coefficients = jets.coefficients[fan].T.copy()
        lift = heights(coefficients, nodes @ (x / scale[0]), nodes @ (y / scale[1]), most)
        lift -= nodes @ z
        lift *= degree[:, k] > 0
        out += (to_patch[k] @ lift) * frame[2][:, None]
    flat = np.moveaxis(triangles, 0, 2)
    out[:, :3] += _linear(origins - flat)  # the origin of a jet may differ from its vertex
    offset = BASIS[:, : out.shape[1]] @ out
    out[:, :3] += _linear(flat)
    return out, offset


def _linear(corners: Array) -> Array:
    """The linear coefficients (3, 3, m) of flat faces with `corners` (corner, 3, m)."""
    return np.stack([corners[0], corners[1] - corners[0], corners[2] - corners[0]], axis=1)


def node_values(
    jets: Jets, corner: Index, curved: tuple[Index, Index, Array] | None = None
) -> tuple[Array, Array]:
    """Patches (m, 21, 3) at the nodes of faces with the fans `corner` (m, 3), and their base.

    `curved`: faces, the corners opposite their creases, and inner points of these (e, 4, 3).
    """
    origins = jets.origin[corner]  # (m, 3, 3)
    base = WEIGHTS @ origins
    if curved is not None and len(curved[0]):
        face, k, curve = curved
        nodes = EDGE_NODES[k]
        move = curve - base[face[:, None], nodes]
        np.add.at(base, face, EDGE_EXTENSION[k] @ move)
    values, most = base.copy(), int(jets.degree[corner].max(initial=0))
    for j in range(3):
        fan = corner[:, j]
        frame, scale = jets.frame[fan], jets.scale[fan]
        local = (base - origins[:, [j]]) @ np.swapaxes(frame, 1, 2)
        x, y = local[..., 0] / scale[:, :1], local[..., 1] / scale[:, 1:]
        lift = heights(jets.coefficients[fan].T[:, :, None], x, y, most) - local[..., 2]
        lift *= WEIGHTS[:, j] * (jets.degree[fan] > 0)[:, None]
        values += lift[..., None] * frame[:, None, 2]
    if curved is not None and len(curved[0]):
        values[face[:, None], nodes] = curve
    return values, base


def flatten_bulges(jets: Jets, fans: Fans) -> Jets:
    """The jets, made flat at the fans of faces whose patches bulge.

    An arc is half as high over its chord as its end tangents are: no patch may be higher than the
    highest of the tangent planes at its corners, and no tangent plane may be inclined to its face
    by more than the neighbouring faces are.
    """
    degree = jets.degree.copy()
    largest = np.zeros(len(degree))
    for k in range(3):
        np.maximum.at(largest, fans.corner[:, k], fans.angle)
    normals = jets.normals
    suspect = np.flatnonzero(np.any(jets.residual[fans.corner] >= TRUSTED_RESIDUAL, axis=1))
    for start in range(0, len(suspect), CHUNK):
        rows = suspect[start : start + CHUNK]
        corner = fans.corner[rows]
        origins = jets.origin[corner]
        side = np.linalg.norm(origins - origins[:, [1, 2, 0]], axis=2).min(axis=1)
        values, base = node_values(jets, corner)
        flat = face_normals(jets.origin, corner)
        tilt = np.arccos(np.clip(np.einsum("mkc,mc->mk", normals[corner], flat), -1.0, 1.0))
        allowed = np.where(
            jets.residual[corner] < TRUSTED_RESIDUAL,
            np.minimum(2.0 * largest, MAX_TRUSTED_TILT)[corner],
            0.0,
        )
        allowed = np.maximum(allowed, TILT_SHARE * largest[corner])
        tilted = tilt > np.maximum(fans.angle[rows, None], 0.75 * allowed) + TILT_MARGIN
        degree[corner[tilted]] = 0
        lift = np.linalg.norm(values - base, axis=2)
        offset = base[:, None] - origins[:, :, None]
        tangent = np.abs(np.einsum("mknc,mkc->mkn", offset, normals[corner])).max(axis=1)
        bulging = np.any(lift > tangent + BULGE_MARGIN * side[:, None], axis=1)
        degree[corner[bulging]] = 0
    return replace(jets, degree=degree)
