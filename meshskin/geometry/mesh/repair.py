"""Safe repairs of a triangle mesh: none of them moves a point of its surface."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from .topology import connected_components, edge_keys, edge_pairs, neighbours
from .winding_number import winding_number

Array = NDArray[np.float64]
Index = NDArray[np.intp]

MERGE_TOLERANCE = 1e-7
"""distance between vertices that are merged, relative to the extent: the rounding of the single
precision in which STL files are written is 6e-8 of the largest coordinate"""


@dataclass
class MeshEdit:
    """A mesh under repair."""

    vertices: Array
    """(n, 3) m"""
    faces: Index
    """(m, 3)"""
    number: Index
    """(m,) the numbers of the faces in the file"""
    twins: Index = field(default_factory=lambda: np.zeros((0, 2), dtype=np.intp))
    """(k, 2) numbers of duplicate faces that were dropped, and of those that were kept"""
    repairs: list[tuple[str, Array]] = field(default_factory=list)
    """descriptions of the repairs, and the points (k, 3), m, where"""

    def note(self, description: str, points: Array) -> None:
        """Add a repair at `points` (k, 3), m, to the list."""
        self.repairs.append((description, np.array(points, dtype=float).reshape(-1, 3)))

    def keep(self, rows: NDArray[np.bool_]) -> None:
        """Keep the faces `rows` (m,) alone."""
        self.faces, self.number = self.faces[rows], self.number[rows]

    def centroids(self, rows: NDArray[np.bool_] | Index) -> Array:
        """Centroids (k, 3), m, of faces."""
        return np.asarray(self.vertices[self.faces[rows]].mean(axis=1))


def drop_unreferenced(edit: MeshEdit) -> None:
    """Drop vertices that belong to no face."""
    used = np.zeros(len(edit.vertices), dtype=bool)
    used[edit.faces] = True
    if used.all():
        return
    lost = edit.vertices[~used]
    edit.note(f"{len(lost)} unreferenced vertices dropped", lost[np.isfinite(lost).all(axis=1)])
    edit.vertices, edit.faces = edit.vertices[used], (np.cumsum(used) - 1)[edit.faces]


def merge_vertices(edit: MeshEdit) -> None:
    """Merge vertices within MERGE_TOLERANCE of the extent of each other."""
    vertices = edit.vertices
    extent = float(np.max(np.ptp(vertices, axis=0)))
    grid = np.round((vertices - vertices.min(axis=0)) / (MERGE_TOLERANCE * extent)).astype(np.int64)
    factors = np.array([0x1F123BB5, 0x3C6EF372FE94F82B, 0x5851F42D4C957F2D], dtype=np.int64)
    key = (grid * factors).sum(axis=1)  # wraps around: a hash
    _, first, place = np.unique(key, return_index=True, return_inverse=True)
    if not np.array_equal(grid[first][place], grid):  # a hash collision
        _, first, place = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    if len(first) == len(vertices):
        return
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    double = np.ones(len(vertices), dtype=bool)
    double[first] = False
    edit.note(f"{len(vertices) - len(first)} duplicate vertices merged", vertices[double])
    edit.vertices, edit.faces = vertices[first[order]], rank[place.ravel()][edit.faces]


def drop_degenerate_faces(edit: MeshEdit) -> None:
    """Drop faces that have a vertex twice."""
    a, b, c = edit.faces.T
    degenerate = (a == b) | (b == c) | (c == a)
    if degenerate.any():
        edit.note(f"{int(degenerate.sum())} faces without area dropped", edit.centroids(degenerate))
        edit.keep(~degenerate)


def drop_duplicate_faces(edit: MeshEdit) -> None:
    """Drop all but the first of faces with the same vertices."""
    a, b, c = np.sort(edit.faces, axis=1).T
    order = np.lexsort((c, b, a))
    same = (np.diff(a[order]) == 0) & (np.diff(b[order]) == 0) & (np.diff(c[order]) == 0)
    double = np.zeros(len(a), dtype=bool)
    double[order[1:][same]] = True
    if double.any():
        edit.note(f"{int(double.sum())} duplicate faces dropped", edit.centroids(double))
        first = order[np.maximum.accumulate(np.where(double[order], 0, np.arange(len(a))))]
        stays = np.empty_like(first)
        stays[order] = first
        edit.twins = edit.number[np.stack([np.flatnonzero(double), stays[double]], axis=1)]
        edit.keep(~double)


def make_winding_consistent(edit: MeshEdit) -> Index:
    """Wind each connected component like most of its faces. Returns the neighbours (m, 3)."""
    across = neighbours(edit.faces)[0]
    if np.all(across >= 0):
        return across
    flip = inconsistent_faces(edit.faces)
    if flip.any():
        edit.note(f"{int(flip.sum())} faces wound like the others", edit.centroids(flip))
        edit.faces = np.where(flip[:, None], edit.faces[:, ::-1], edit.faces)
        across = neighbours(edit.faces)[0]
    return across


def orient_outward(edit: MeshEdit, part: Index) -> bool:
    """Invert closed components `part` (m,) whose normals point into the solid; whether any do.

    A component within an odd number of others bounds a cavity: its normals point into the cavity.
    """
    count = int(part.max()) + 1 if len(part) else 0
    corners = edit.vertices[edit.faces]
    corners = corners - corners.reshape(-1, 3).mean(axis=0)
    volume = np.einsum("mc,mc->m", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    inward = np.bincount(part, volume, minlength=count) < 0.0
    if count > 1:
        first = np.array([np.argmax(part == k) for k in range(count)])
        for k in range(count):
            within = sum(
                abs(winding_number(corners[part == j], corners[first[k], 0])) > 0.5
                for j in range(count)
                if j != k
            )
            inward[k] ^= bool(within % 2)
    inverted = inward[part]
    if inverted.any():
        which = "" if count == 1 else f" of {int(inward.sum())} of {count} parts"
        edit.note(f"orientation{which} inverted: normals pointed inward", edit.centroids(inverted))
        edit.faces = np.where(inverted[:, None], edit.faces[:, ::-1], edit.faces)
    return bool(inverted.any())


def inconsistent_faces(faces: Index) -> NDArray[np.bool_]:
    """Which faces (m,) are wound against most faces of their connected component.

    Each face stands twice in a graph, as it is and inverted; links join what is wound alike. None
    of a component that cannot be oriented.
    """
    m, tail, head = len(faces), faces.ravel(), faces[:, [1, 2, 0]].ravel()
    one, two = edge_pairs(edge_keys(tail, head, int(faces.max(initial=-1)) + 1))
    opposed = tail[one] == tail[two]  # both half-edges have one direction
    face, other = one // 3, two // 3 + m * opposed
    label = connected_components(
        np.concatenate([face, face + m]), np.concatenate([other, (other + m) % (2 * m)]), 2 * m
    )
    component = np.minimum(label[:m], label[m:])
    inverted = label[:m] != component
    majority = np.bincount(component, inverted) > 0.5 * np.bincount(component)
    return np.asarray(inverted ^ majority[component])
