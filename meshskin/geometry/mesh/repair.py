"""Safe repairs of a triangle mesh: none of them moves a point of its surface."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import Array, Index
from .rays import exposure
from .topology import NEXT, PREVIOUS, connected_components, edge_keys, edge_pairs, neighbours
from .winding_number import WindingNumber

MERGE_TOLERANCE = 1e-7
"""distance between vertices that are merged, relative to the extent: the rounding of the single
precision in which STL files are written is 6e-8 of the largest coordinate"""
SAMPLES = 24
"""vertices of a part, all of which are within the part that encloses it: parts that intersect have
some outside; and faces of a part whose sides are looked at"""
TURNED = 4.0, 0.3
"""a part with borders is turned inward where its back is that many times as open to the outside as
its front, and that open itself: a sheet is as open on both sides, the inside of a half ball half
as open as the outside and may be meant"""


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


def orient_outward(
    edit: MeshEdit, across: Index, component: Index, open: bool
) -> tuple[bool, Index]:
    """Invert the closed parts whose normals point into the solid, and the parts with borders whose
    backs are open to the outside rather than their fronts.

    `across` (m, 3): neighbours, -1 for none; `component` (m,): connected components. A closed part
    has a positive volume, unless it lies wholly within a solid part of the other orientation: then
    it bounds a cavity. With `open`, a mesh whose outer closed parts all point inward is left as it
    is: it may be meant so; a mesh of parts with borders alone, too. Also returned is whether any
    part was inverted, and a face (k,) of each solid part that lies within another one.
    """
    count = int(component.max(initial=-1)) + 1
    corners = edit.vertices[edit.faces]
    corners = corners - corners.reshape(-1, 3).mean(axis=0)
    volume = np.einsum("mc,mc->m", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    size = np.asarray(np.bincount(component, volume, minlength=count), dtype=float)
    closed = _closed_parts(edit.faces, across, component, count)
    parent = _enclosing_parts(edit, component, size, closed)
    outer = closed & (parent < 0)
    turned = _turned_inward(edit, component, closed)
    if open and np.all(size[outer] < 0.0) and (outer.any() or np.all(turned[~closed])):
        return False, np.zeros(0, dtype=np.intp)
    target = np.where(closed, 1, np.where(size < 0.0, -1, 1))
    for k in np.flatnonzero(parent >= 0)[np.argsort(-np.abs(size[parent >= 0]))]:
        solid = target[parent[k]] > 0
        if solid and (size[k] < 0.0) != (size[parent[k]] < 0.0):
            target[k] = -1
    wrong = turned | (closed & ((size < 0.0) != (target < 0)))
    inverted = wrong[component]
    if inverted.any():
        which = "" if count == 1 else f" of {int(wrong.sum())} of {count} parts"
        edit.note(f"orientation{which} inverted: normals pointed inward", edit.centroids(inverted))
        edit.faces = np.where(inverted[:, None], edit.faces[:, ::-1], edit.faces)
    nested = np.flatnonzero((parent >= 0) & (target > 0) & (target[parent] > 0))
    first = np.unique(component, return_index=True)[1]
    return bool(inverted.any()), first[nested]


def _turned_inward(
    edit: MeshEdit, component: Index, closed: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Which parts (k,) with borders are TURNED: their backs are open to the outside, not their
    fronts.
    """
    count = len(closed)
    if closed.all():
        return np.zeros(count, dtype=bool)
    faces = np.flatnonzero(~closed[component])
    faces = faces[np.argsort(component[faces], kind="stable")]
    a, b, c = np.moveaxis(edit.vertices[edit.faces[faces]], 1, 0)
    normals = np.cross(b - a, c - a)
    area = np.linalg.norm(normals, axis=1)
    size = np.bincount(component[faces], area, count)[~closed]
    places = (np.arange(SAMPLES) + 0.5) / SAMPLES  # evenly by area
    sought = (np.cumsum(size) - size)[:, None] + size[:, None] * places
    rows = np.minimum(np.searchsorted(np.cumsum(area), sought.ravel()), len(faces) - 1)
    rows, times = np.unique(rows, return_counts=True)  # a part may have fewer faces
    points, part = edit.centroids(faces[rows]), component[faces[rows]]
    unit = normals[rows] / np.maximum(area[rows], 1e-300)[:, None]

    def openness(side: float) -> Array:
        seen = exposure(edit.vertices, edit.faces, points, side * unit)
        return np.asarray(np.bincount(part, times * seen, count) / SAMPLES)

    front, back = openness(1.0), openness(-1.0)
    return np.asarray((back > TURNED[0] * front) & (back > TURNED[1]))


def _closed_parts(faces: Index, across: Index, component: Index, count: int) -> NDArray[np.bool_]:
    """Which of `count` parts (k,) have no border: each edge has as many half-edges either way."""
    face, corner = np.nonzero(across < 0)
    tail, head = faces[face, NEXT[corner]], faces[face, PREVIOUS[corner]]
    edges = int(faces.max(initial=-1)) + 1
    key = component[face] * edges**2 + edge_keys(tail, head, edges)
    unique, place = np.unique(key, return_inverse=True)
    excess = np.bincount(place.ravel(), np.where(tail < head, 1, -1), minlength=len(unique))
    closed = np.ones(count, dtype=bool)
    closed[unique[excess != 0] // edges**2] = False
    return closed


def _enclosing_parts(
    edit: MeshEdit, component: Index, size: Array, closed: NDArray[np.bool_]
) -> Index:
    """The smallest closed part (k,) that each closed part lies wholly within; -1: none.

    `component` (m,): the part of each face; `size` (k,): volumes; `closed` (k,).
    """
    parent = np.full(len(size), -1)
    if len(size) < 2:
        return parent
    order = np.argsort(component, kind="stable")
    rows = np.split(order, np.cumsum(np.bincount(component))[:-1])
    low, high = (
        np.array([edge(edit.vertices[edit.faces[r]], axis=(0, 1)) for r in rows])
        for edge in (np.min, np.max)
    )
    for k in np.flatnonzero(closed)[np.argsort(-np.abs(size[closed]))]:  # the largest first
        boxed = closed & np.all(low > low[k], axis=1) & np.all(high < high[k], axis=1)
        within = np.flatnonzero(boxed)
        if not len(within):
            continue
        picked = [rows[j][np.linspace(0, len(rows[j]) - 1, SAMPLES).astype(int)] for j in within]
        points = edit.vertices[edit.faces[np.array(picked)]][:, :, 0]
        number = WindingNumber(edit.vertices, edit.faces[rows[k]]).at(points.reshape(-1, 3))
        parent[within[np.all(number.reshape(points.shape[:2]) > 0, axis=1)]] = k
    return parent


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
