"""Patches of a mesh from its jets: the barycentric blend of the jets at a face's corners.

S = sum_i w_i P_i, where P_i lifts the base point of the face along jet i's normal to jet i. The
base is the flat face; beside a crease it is moved within the surface, so that the patches of both
sides end on one curve, where the two sides' surfaces meet.
"""

from __future__ import annotations

from dataclasses import replace
from math import comb

import numpy as np
from numpy.typing import NDArray

from ..mesh.triangles import face_normals
from . import patch
from .creases import INNER, Creases, crease_curves
from .fans import Fans
from .heights import DEGREE, heights
from .jets import TRUSTED_RESIDUAL, Jets

Array = NDArray[np.float64]
Index = NDArray[np.intp]

BULGE_MARGIN = 3e-3
"""lift of a patch from its face, over the shortest side, beyond what its tangents account for"""
TILT_MARGIN, TILT_SHARE = np.radians(1.0), 0.4
"""angle of a jet's normal from its face's, beyond the turn to the next faces (on a circle it
is half of it), or 3/4 of this share of the largest turn at the vertex"""
MAX_TRUSTED_TILT = np.radians(6.0)
"""the same for faithful jets: twice the largest turn at the vertex, but no more than this"""
FOLD_COSINE, MAX_ROUNDS = 0.5, 6
"""cosine of the angle to its face from which a patch folds; rounds of unfolding"""
CHUNK = 1024
"""faces blended at once: bounds the memory; products of more would wake BLAS's threads, which cost
more than they save"""
NODES = np.array(patch.POWERS) / patch.DEGREE
"""(21, 2) u, v of the points that fix a quintic"""
WEIGHTS = np.column_stack([1.0 - NODES.sum(axis=1), NODES])
"""(21, 3) their barycentric weights"""
BASIS = patch.monomials(NODES[:, 0], NODES[:, 1])
"""(21, 21) from coefficients to values at the nodes"""
INVERSE = np.linalg.inv(BASIS)
"""(21, 21) from values at the nodes to coefficients"""
DERIVATIVE_U, DERIVATIVE_V = patch.slopes(NODES[:, 0], NODES[:, 1])
"""(21, 21) each, from coefficients to derivatives in u and v at the nodes"""


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


EDGE_NODES, EDGE_EXTENSION = _edge_tables()


def _lift_tables() -> dict[int, tuple[Array, Array]]:
    """For lifts of a degree: nodes (q, 2) that fix them, and patches (3, r, q) from values there.

    The nodes are the weights of the corners after the lift's own; the patches, of a degree more,
    are lifts times the weight of their corner.
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

    Where a patch would fold, its creases become straight; where it still does, its jets flat.
    """
    jets = flatten_bulges(jets, fans)
    straight = np.zeros(fans.corner.shape, dtype=bool)
    creases = crease_curves(jets, fans, beyond, slot, straight)
    doubtful = np.any(jets.residual[fans.corner] >= TRUSTED_RESIDUAL, axis=1)
    doubtful[creases.face] = True
    suspect = np.flatnonzero(doubtful)
    for trial in range(MAX_ROUNDS):
        folded = [
            rows[is_folded(jets, fans.corner[rows], creases.of(rows))]
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


def is_folded(jets: Jets, corner: Index, curved: tuple[Index, Index, Array]) -> NDArray[np.bool_]:
    """Whether the patches of faces with the fans `corner` (m, 3) turn from their faces anywhere."""
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
    """Patches (m, 21, 3) of the faces, and their largest distances (m,) from `triangles`, m.

    Two faces share the jets of a smooth edge and the curve of a crease: their patches meet exactly.
    `triangles` (m, 3, 3): the flat faces; the distances are those at the nodes.
    """
    m = len(fans.corner)
    out, lift2 = np.zeros((m, len(NODES), 3)), np.empty(m)
    for start in range(0, m, CHUNK):
        some = slice(start, start + CHUNK)
        flat, over = _flat_based(jets, fans.corner[some], triangles[some])
        for axis, values in enumerate(flat):
            out[some, : len(values), axis] = values.T
        lift2[some] = np.einsum("ckm,ckm->km", over, over).max(axis=0)
        place, k, curve = creases.of(np.arange(start, min(start + CHUNK, m)))
        if len(place):
            curved, owner = np.unique(place, return_inverse=True)
            rows = start + curved
            values, _ = node_values(jets, fans.corner[rows], (owner, k, curve))
            out[rows] = INVERSE @ values
            values -= WEIGHTS @ triangles[rows]
            lift2[rows] = np.einsum("mnc,mnc->mn", values, values).max(axis=1)
    return out, np.sqrt(lift2)


def _flat_based(jets: Jets, corner: Index, triangles: Array) -> tuple[Array, Array]:
    """Patches (3, r, m) of faces with straight edges, and their nodes' offsets from `triangles`.

    The place over a flat base is linear in u and v: a lift is a polynomial of its jet's degree, and
    fixed by few of the nodes; coefficients beyond the first r are zero. The last axis is that of
    the faces, in which NumPy is fast.
    """
    degree = jets.degree[corner]
    most = max(1, int(degree.max(initial=0)))
    nodes, to_patch = LIFTS[most]
    places = np.moveaxis(jets.origin[corner], 0, 2)  # (corner, xyz, m)
    out = np.zeros((3, to_patch.shape[1], len(corner)))
    for k in range(3):
        fan = corner[:, k]
        frame, scale = np.moveaxis(jets.frame[fan], 0, 2).copy(), jets.scale[fan].T
        sides = places[[k - 2, k - 1]] - places[k]
        x, y, z = np.einsum("scm,acm->asm", sides, frame)
        coefficients = jets.coefficients[fan].T.copy()
        lift = heights(coefficients, nodes @ (x / scale[0]), nodes @ (y / scale[1]), most)
        lift -= nodes @ z
        lift *= degree[:, k] > 0
        out += (to_patch[k] @ lift) * frame[2][:, None]
    flat = np.moveaxis(triangles, 0, 2)
    out[:, :3] += _linear(places - flat)  # an averaged jet does not start at its vertex
    over = BASIS[:, : out.shape[1]] @ out
    out[:, :3] += _linear(flat)
    return out, over


def _linear(corners: Array) -> Array:
    """The first coefficients (3, 3, m) of flat faces with `corners` (corner, 3, m)."""
    return np.stack([corners[0], corners[1] - corners[0], corners[2] - corners[0]], axis=1)


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
        np.add.at(base, face, EDGE_EXTENSION[k] @ move)
    values, most = base.copy(), int(jets.degree[corner].max(initial=0))
    for j in range(3):
        fan = corner[:, j]
        frame, scale = jets.frame[fan], jets.scale[fan]
        local = (base - places[:, [j]]) @ np.swapaxes(frame, 1, 2)
        x, y = local[..., 0] / scale[:, :1], local[..., 1] / scale[:, 1:]
        lift = heights(jets.coefficients[fan].T[:, :, None], x, y, most) - local[..., 2]
        lift *= WEIGHTS[:, j] * (jets.degree[fan] > 0)[:, None]
        values += lift[..., None] * frame[:, None, 2]
    if curved is not None and len(curved[0]):
        values[face[:, None], nodes] = curve
    return values, base


def flatten_bulges(jets: Jets, fans: Fans) -> Jets:
    """The jets, but flat at the fans of faces whose patches bulge beyond belief.

    Between two points of an arc, the arc is half as high over the chord as its tangents are; no
    patch may be higher than the highest of the tangent planes at its corners, and no tangent plane
    lean more than the next faces do.
    """
    degree = jets.degree.copy()
    turn = np.zeros(len(degree))
    for k in range(3):
        np.maximum.at(turn, fans.corner[:, k], fans.angle)
    normals = jets.normals
    suspect = np.flatnonzero(np.any(jets.residual[fans.corner] >= TRUSTED_RESIDUAL, axis=1))
    for start in range(0, len(suspect), CHUNK):
        rows = suspect[start : start + CHUNK]
        corner = fans.corner[rows]
        places = jets.origin[corner]
        side = np.linalg.norm(places - places[:, [1, 2, 0]], axis=2).min(axis=1)
        values, base = node_values(jets, corner)
        flat = face_normals(jets.origin, corner)
        lean = np.arccos(np.clip(np.einsum("mkc,mc->mk", normals[corner], flat), -1.0, 1.0))
        near = np.where(
            jets.residual[corner] < TRUSTED_RESIDUAL,
            np.minimum(2.0 * turn, MAX_TRUSTED_TILT)[corner],
            0.0,
        )
        near = np.maximum(near, TILT_SHARE * turn[corner])
        leaning = lean > np.maximum(fans.angle[rows, None], 0.75 * near) + TILT_MARGIN
        degree[corner[leaning]] = 0
        lift = np.linalg.norm(values - base, axis=2)
        offset = base[:, None] - places[:, :, None]
        tangent = np.abs(np.einsum("mknc,mkc->mkn", offset, normals[corner])).max(axis=1)
        bulging = np.any(lift > tangent + BULGE_MARGIN * side[:, None], axis=1)
        degree[corner[bulging]] = 0
    return replace(jets, degree=degree)
