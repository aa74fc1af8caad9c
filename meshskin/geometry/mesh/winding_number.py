"""Winding numbers of points about a mesh.

Every loop of border edges is closed, so that winding numbers are integers, 1 inside and 0 outside:
that of a mesh that encloses a volume by triangles about the mean of the loop, that of a sheet at
infinity, extruded along a ray against the area that it bounds. (Extruded, the border of one panel
of a link ran through the other panels, whose fronts were then inside.) Borders can also be left
open: the sum of the solid angles is then rounded, to 0 or more. A mesh whose normals point inward
counts as if it were inverted.

Source: Barill, Dickson, Schmidt, Levin, Jacobson, "Fast winding numbers for soups and clouds", ACM
Trans. Graphics 37 (2018). libigl has it, in C++; it takes triangle soups without closing borders.
"""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...core import codegen
from ...core.arrays import Array, Index, means_by_group, sums_by_group
from .topology import connected_components, edge_keys
from .triangles import morton_order

LEAF = 8
"""triangles in a leaf of the tree: affects the speed alone"""
FAR_RADII = 3.0
"""distance, in radii of a cluster, from which its vector area stands for it: the sum over clusters
is then within 0.02 of the integer (tests/geometry/mesh/test_inside_outside.py)"""
INTEGER_TOLERANCE = 0.2
"""distance of that sum from an integer beyond which all triangles are summed instead"""
OPEN_TOLERANCE = 0.48
"""the same where borders are left open, and the sum need not be near an integer: the error of the
clusters below a half"""
SHEET_VOLUME = 0.02
"""volume over area^1.5 up to which a mesh with borders is a sheet, which encloses nothing and keeps
its orientation; that of a ball is 0.094"""


class WindingNumber:
    """Winding numbers of points about a mesh (vertices (n, 3) m, faces (m, 3)).

    close: whether loops of border edges are closed.
    """

    def __init__(self, vertices: Array, faces: Index, close: bool = True) -> None:
        self.border, self.direction, caps, self._loops, self._first = _border(vertices, faces)
        self.closed = not len(self.border)
        """whether there is no border"""
        triangles = np.concatenate([vertices[faces], caps])
        a, b, c = np.swapaxes(triangles - triangles.reshape(-1, 3).mean(axis=0), 0, 1)
        volume = np.einsum("mc,mc->", a, np.cross(b, c)) / 6.0
        area = 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum()
        least = 0.0 if self.closed else SHEET_VOLUME * area**1.5
        self.outward = -1 if volume < -least else 1
        """-1 where the normals of the mesh point inward"""
        self._tolerance = INTEGER_TOLERANCE if close else OPEN_TOLERANCE
        self._least = -np.inf if close else 0.0
        if abs(volume) > least or not close:
            self.border, self.direction = np.zeros((0, 2, 3)), np.zeros((0, 3))
            self._loops = self._loops[:0]
        if abs(volume) <= least or not close:
            triangles = vertices[faces]
        self.corners = np.ascontiguousarray(triangles[:, :: self.outward])
        self._nodes, self._leaves = _tree(self.corners)

    def at(self, points: Array) -> NDArray[np.int64]:
        """The winding numbers (n,) of points (n, 3), m."""
        built = library()
        if built is None:
            total = self._exact(points)
        else:
            total = self._by_clusters(built, points)
            unsure = np.flatnonzero(np.abs(total - np.round(total)) > self._tolerance)
            total[unsure] = self._exact(points[unsure])
        return np.asarray(np.maximum(np.round(total), self._least), dtype=np.int64)

    def _by_clusters(self, built: ctypes.CDLL, points: Array) -> Array:
        p, out = np.ascontiguousarray(points, dtype=float), np.empty(len(points))
        leaves = len(self._nodes) // 2
        counts = (leaves, len(self._leaves) // leaves, len(self._loops), len(p))
        leaves_, size, count, n = (ctypes.c_int64(c) for c in counts)
        arrays = (self._nodes, self._leaves, self._loops, self._first, self.border, p, out)
        nodes, triangles, loops, first, border, at, total = (
            ctypes.c_void_p(a.ctypes.data) for a in arrays
        )
        built.winding(leaves_, size, nodes, triangles, n, at, total)
        built.extruded(count, loops, first, border, n, at, total)
        return out

    def _exact(self, points: Array) -> Array:
        sums = (winding_number(self.corners, p) + self._extruded(p) for p in points)
        return np.fromiter(sums, dtype=float, count=len(points))

    def _extruded(self, point: Array) -> float:
        """The part of the winding number of a point (3,) due to the extruded border."""
        d, (a, b) = self.direction, (self.border[:, k] - point for k in (1, 0))  # against the mesh
        la, lb = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
        top = np.einsum("kc,kc->k", np.cross(a, b), d)
        ab, ad, bd = (np.einsum("kc,kc->k", x, y) for x, y in ((a, b), (a, d), (b, d)))
        return float(np.arctan2(top, la * lb + ab + bd * la + ad * lb).sum() / (2 * np.pi))


def winding_number(corners: Array, point: Array) -> float:
    """Winding number of a point (3,) about a closed surface of triangles (m, 3, 3).

    Source: Van Oosterom and Strackee, "The Solid Angle of a Plane Triangle" (1983).
    """
    a, b, c = (corners[:, k] - point for k in range(3))
    la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
    top = np.einsum("mc,mc->m", a, np.cross(b, c))
    ab, bc, ca = (np.einsum("mc,mc->m", x, y) for x, y in ((a, b), (b, c), (c, a)))
    return float(np.sum(np.arctan2(top, la * lb * lc + ab * lc + bc * la + ca * lb)) / (2 * np.pi))


@cache
def library() -> ctypes.CDLL | None:
    """The compiled sum over clusters; None, and one warning, without a C compiler."""
    text = Path(__file__).with_name("winding_number.c").read_text(encoding="utf-8")
    return codegen.compile_library("winding numbers", text)


def _border(vertices: Array, faces: Index) -> tuple[Array, Array, Array, Array, Index]:
    """Ends (k, 2, 3), m, of border half-edges, directions (k, 3) of extrusion, caps (k, 3, 3), and
    the loops (l, 10) that the edges form: loop j has those from `first[j]` to `first[j + 1]`.

    An edge with more half-edges one way than the other is there as often as that. The caps are
    triangles that close each loop from the mean of its vertices. Of a loop: that mean, the vector
    area of its caps, the direction, and the distance that counts as far.
    """
    n = len(vertices)
    tail, head = faces.ravel(), faces[:, [1, 2, 0]].ravel()
    edge, place = np.unique(edge_keys(tail, head, n), return_inverse=True)
    excess = np.bincount(place.ravel(), np.where(tail < head, 1, -1), minlength=len(edge))
    excess = excess.astype(np.intp)
    ends = np.stack([edge // n, edge % n], axis=1)
    ends = np.where(excess[:, None] < 0, ends[:, ::-1], ends)
    ends = np.repeat(ends, np.abs(excess), axis=0)
    if not len(ends):
        none = np.zeros((0, 10)), np.zeros(1, dtype=np.intp)
        return np.zeros((0, 2, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3)), *none
    loop = connected_components(ends[:, 0], ends[:, 1], n)[ends[:, 0]]
    _, loop = np.unique(loop, return_inverse=True)
    order = np.argsort(loop, kind="stable")
    loop, along = loop[order], vertices[ends[order]]
    middle = means_by_group(along[:, 0], loop)
    spokes = along - middle[loop][:, None]
    swept = np.cross(spokes[:, 0], spokes[:, 1])
    area = sums_by_group(swept, loop)
    size = np.linalg.norm(area, axis=1, keepdims=True)
    direction = np.where(size > 0.0, -area / np.maximum(size, 1e-300), [0.0, 0.0, 1.0])
    caps = np.stack([along[:, 1], along[:, 0], middle[loop]], axis=1)
    first = np.concatenate([np.flatnonzero(np.diff(loop, prepend=-1)), [len(loop)]])
    reach = FAR_RADII * np.maximum.reduceat(np.linalg.norm(spokes, axis=2).max(axis=1), first[:-1])
    loops = np.concatenate([middle, -0.5 * area, direction, reach[:, None]], axis=1)
    return along, np.ascontiguousarray(direction[loop]), caps, loops, first


def _tree(corners: Array) -> tuple[Array, Array]:
    """Clusters (2 leaves, 7) of triangles (m, 3, 3), and the triangles leaf by leaf.

    Of a cluster: the mean weighted by area, the vector area, and the distance that counts as far.
    """
    m = len(corners)
    leaves = 1 << max(0, int(np.ceil(np.log2(m / LEAF))))
    size = -(-m // leaves)
    sorted_ = corners[morton_order(corners.mean(axis=1))]
    place = np.arange(leaves * size) * m // (leaves * size)
    leaf = sorted_[place]
    padding = np.flatnonzero(place[1:] == place[:-1]) + 1
    leaf[padding] = leaf[padding, :1]  # triangles without area
    area = 0.5 * np.cross(leaf[:, 1] - leaf[:, 0], leaf[:, 2] - leaf[:, 0])
    weight = np.maximum(np.linalg.norm(area, axis=1), 1e-300)
    node = np.zeros((2 * leaves, 7))
    blocks = leaves
    while blocks:
        parts = leaf.reshape(blocks, -1, 3)
        share = weight.reshape(blocks, -1)
        middle = np.einsum("bt,btc->bc", share, leaf.mean(axis=1).reshape(blocks, -1, 3))
        middle /= share.sum(axis=1)[:, None]
        node[blocks : 2 * blocks, :3] = middle
        node[blocks : 2 * blocks, 3:6] = area.reshape(blocks, -1, 3).sum(axis=1)
        radius = np.linalg.norm(parts - middle[:, None], axis=2).max(axis=1)
        node[blocks : 2 * blocks, 6] = FAR_RADII * radius
        blocks //= 2
    return node, np.ascontiguousarray(leaf)
