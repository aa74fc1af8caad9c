"""Geodesics of a surface, the parallel transport of tangents along them, and their lengths.

Libraries weighed: potpourri3d and pygeodesic have the geodesics of flat facets, without transport;
lanes and skins need those of the smooth surface, on which the contacts lie.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from scipy.sparse import csgraph

from ..core.arrays import Array, ranges
from ..core.se3 import perpendicular, shortest_rotation
from .body import Body
from .surface.closest_point import Closest
from .surface.surface import Surface

ALONG_NORMAL = 1e-6
"""Part of a vector's length below which its tangential part is rounding error: a vector that comes
from single-precision data is known to 1e-7."""
OPPOSITE = -0.999
"""Cosine between normals below which 1 + cosine loses three digits or more: the general rotation is
used there."""
BEND = 0.05
"""Largest angle, rad, by which the normal turns in one step of `march`: the length is then off by
less than BEND^2 / 3, 0.1 %."""

CUTS = 10
"""Edges of the cut faces along the radius that `within` looks at: the paths over the rim of a plate
were longer than the geodesics by 2 to 5 % on average, by 7 to 19 % at most."""
TOO_TIGHT = 2.0
"""Curvature of an arc between two points, relative to the largest one of the surface at its ends,
from which it may be a short cut through a wall: a ball and a tube have 1."""

QUARTERS = 0.5 * np.array(
    [
        [[2, 0, 0], [1, 1, 0], [1, 0, 1]],
        [[1, 1, 0], [0, 2, 0], [0, 1, 1]],
        [[1, 0, 1], [0, 1, 1], [0, 0, 2]],
        [[1, 1, 0], [0, 1, 1], [1, 0, 1]],
    ]
)
"""Barycentric coordinates of the corners of a triangle's four parts."""


def march(
    body: Body, at: Closest, heading: Array, carried: Array, length: float
) -> tuple[Closest, Array]:
    """Follow geodesics for a length (m) from n points along unit tangents `heading` (n, 3).

    Returns the end points, and the tangents `carried` (n, 3) transported there. Steps are straight,
    each followed by the closest point: the relative error of the length is (curvature * step)^2/3.
    """
    steps = int(np.clip(np.ceil(length * np.max(np.abs(at.curvature), initial=0.0) / BEND), 2, 10))
    for _ in range(steps):
        after = body.surface.nearest(at.point + length / steps * heading, face=at.face)
        heading, carried = (transport(v, at.normal, after.normal) for v in (heading, carried))
        at = after
    return at, carried


def geodesic(
    body: Body, start: Array, direction: Array, step: float
) -> Iterator[tuple[Closest, Array]]:
    """Points of geodesics from `start` (..., 3) in directions (..., 3), `step` m apart, for ever.

    Yields the surface points and the unit tangents (..., 3) ahead, the starts first. Geodesics that
    are followed together take little more time than one.
    """
    at, ahead = body.surface.nearest(np.atleast_2d(start)), direction
    while True:
        ahead = onto(ahead, at.normal.reshape(ahead.shape))
        yield at, ahead
        at = body.surface.nearest(at.point + step * ahead, face=at.face)


def transport(vectors: Array, before: Array, after: Array) -> Array:
    """Unit tangents (n, 3) by the shortest rotations from normals `before` to `after` (n, 3)."""
    cosine = np.sum(before * after, axis=1)
    opposite = cosine < OPPOSITE
    along = np.sum(vectors * after, axis=1) / np.where(opposite, 1.0, 1.0 + cosine)
    moved = vectors - along[:, None] * (before + after)
    if opposite.any():
        rotation = shortest_rotation(before[opposite], after[opposite])
        moved[opposite] = np.einsum("nij,nj->ni", rotation, vectors[opposite])
    return onto(moved, after)


def any_tangents(normals: Array) -> Array:
    """A unit tangent (..., 3) at each of unit normals (..., 3): the projection of the coordinate
    axis that is least aligned with the normal."""
    return onto(np.cross(normals, perpendicular(normals)), normals)


def transport_along(normals: Array) -> Array:
    """A tangent transported along the unit normals (k, 3) of a path: unit tangents (k, 3).

    The first is that of `any_tangents`. Each step projects onto the next tangent plane, which is
    parallel transport up to the square of the angle between the normals.
    """
    out = np.empty_like(normals)
    tangent = any_tangents(normals[0])
    for k, normal in enumerate(normals):
        tangent = onto(tangent, normal)
        out[k] = tangent
    return out


def onto(vectors: Array, normals: Array) -> Array:
    """Unit tangents (..., 3): the projections of vectors onto the planes of unit normals (..., 3).

    A vector along its normal becomes any tangent.
    """
    flat = vectors - np.sum(vectors * normals, axis=-1, keepdims=True) * normals
    length = np.linalg.norm(flat, axis=-1, keepdims=True)
    lost = length < ALONG_NORMAL * np.linalg.norm(vectors, axis=-1, keepdims=True)
    if lost.any():
        flat, length = np.where(lost, -perpendicular(normals), flat), np.where(lost, 1.0, length)
    return np.asarray(flat / length)


def rotate_about(normals: Array, tangents: Array, angle: ArrayLike) -> Array:
    """Tangents (..., 3) rotated about their unit normals (..., 3) by `angle` (...), rad."""
    cosine, sine = np.asarray(np.cos(angle))[..., None], np.asarray(np.sin(angle))[..., None]
    return np.asarray(cosine * tangents + sine * np.cross(normals, tangents))


def arc_length(start: Closest, end: Closest) -> Array:
    """Arc lengths (n,) in m from one surface point to n others, as of circular arcs.

    A chord c between normals that differ by theta spans an arc c (theta / 2) / sin(theta / 2):
    exact on a sphere and a plane.
    """
    return _arcs(start, end)[0]


def _arcs(start: Closest, end: Closest) -> tuple[Array, Array]:
    """`arc_length`, and the angles theta (n,), rad."""
    chord = np.linalg.norm(end.point - start.point, axis=1)
    sine = np.linalg.norm(np.cross(start.normal, end.normal), axis=1)
    angle = np.arctan2(sine, np.sum(start.normal * end.normal, axis=1))
    return np.asarray(chord / np.sinc(0.5 * angle / np.pi)), angle


def within(body: Body, middle: Closest, at: Closest, radius: float) -> NDArray[np.bool_]:
    """Which (n,) of the surface points are within a geodesic distance, m, of one of them.

    By `arc_length`; where an arc bends far more than the surface at its ends, as one from a side of
    a thin wall to the other, by the shortest way from face to face.
    """
    arc, angle = _arcs(middle, at)
    found = np.asarray(arc <= radius)
    bend = np.maximum(at.curvature[:, 0], middle.curvature[0, 0])
    tight = (angle > np.pi / 2) & (angle > TOO_TIGHT * arc * bend)
    near = np.linalg.norm(at.point - middle.point, axis=1) <= radius
    found[tight] = False
    if len(short := np.flatnonzero(tight & near)):
        found[short] = _path_lengths(body, middle, at.take(short), radius) <= radius
    return found


def _path_lengths(body: Body, start: Closest, end: Closest, radius: float) -> Array:
    """Lengths (n,), m, of the shortest paths from one surface point to n others along the edges of
    the faces, cut to a part of the radius, m; inf beyond it."""
    nodes, face, node, length = _node_paths(
        body.surface, int(start.face[0]), tuple(start.point[0].tolist()), radius
    )
    first, after = (np.searchsorted(face, end.face, side) for side in ("left", "right"))
    row, last = np.repeat(np.arange(len(first)), after - first), node[ranges(first, after - first)]
    out = np.full(len(first), np.inf)
    np.minimum.at(out, row, length[last] + np.linalg.norm(nodes[last] - end.point[row], axis=1))
    return out


@lru_cache(maxsize=1)  # a lattice asks for every ring about the same point
def _node_paths(
    surface: Surface, start_face: int, start: tuple[float, ...], radius: float
) -> tuple[Array, Array, Array, Array]:
    """Nodes (k, 3), m, of the faces near a point of one of them; pairs of a face and one of its
    nodes (p,), (p,), sorted; and the lengths of the paths (k,), m, to the nodes."""
    corners = surface.vertices[surface.faces]
    faces = np.arange(len(corners))
    while True:
        middle = corners.mean(axis=1)
        size = np.linalg.norm(corners - middle[:, None], axis=2).max(axis=1)
        near = np.linalg.norm(middle - start, axis=1) <= radius + size
        corners, faces = corners[near], faces[near]
        edges = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2)
        long = edges.max(axis=1, initial=0.0) > radius / CUTS
        if not long.any():
            break
        parts = QUARTERS @ corners[long, None]
        corners = np.concatenate([corners[~long], parts.reshape(-1, 3, 3)])
        faces = np.concatenate([faces[~long], np.repeat(faces[long], 4)])
    nodes, number = np.unique(corners.reshape(-1, 3), axis=0, return_inverse=True)
    number, n = number.reshape(-1, 3), len(nodes)
    face, node = np.unique([np.repeat(faces, 3), number.ravel()], axis=1)
    own = node[face == start_face]
    ends, length = _links(nodes, number)
    ends = np.hstack([ends, [np.full(len(own), n), own]])
    length = np.append(length, np.linalg.norm(nodes[own] - start, axis=1))
    ends, first = np.unique(ends, axis=1, return_index=True)
    graph = sparse.csr_array((length[first], tuple(ends)), shape=(n + 1, n + 1))
    lengths = csgraph.dijkstra(graph, directed=False, indices=n, limit=radius)
    return nodes, face, node, lengths


def _links(nodes: Array, faces: NDArray[np.intp]) -> tuple[NDArray[np.intp], Array]:
    """Pairs (2, l) of nodes (k, 3), m, of faces (m, 3), and their distances (l,), m: the ends of
    edges, and the corners that face each other over an edge, unfolded, where the straight line
    crosses it."""
    ends = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2).reshape(-1, 2), axis=1)
    order = np.lexsort(ends.T)
    ends, apex = ends[order], np.roll(faces, -2, axis=1).ravel()[order]
    twice = np.flatnonzero((ends[1:] == ends[:-1]).all(axis=1))
    one, other = nodes[np.moveaxis(ends[twice], 1, 0)]
    base = np.linalg.norm(other - one, axis=1)
    along, height = np.empty((2, 2, len(twice)))
    for k, corner in enumerate((apex[twice], apex[twice + 1])):
        off = nodes[corner] - one
        along[k] = np.einsum("ei,ei->e", off, other - one) / base
        height[k] = np.sqrt(np.maximum(np.einsum("ei,ei->e", off, off) - along[k] ** 2, 0.0))
    total = height.sum(axis=0)
    meets = along[0] * height[1] + along[1] * height[0]
    crosses = (meets >= 0) & (meets <= base * total)
    over = np.stack([apex[twice], apex[twice + 1]])[:, crosses]
    length = np.linalg.norm(nodes[ends[:, 0]] - nodes[ends[:, 1]], axis=1)
    return np.hstack([ends.T, over]), np.append(
        length, np.hypot(along[0] - along[1], total)[crosses]
    )
