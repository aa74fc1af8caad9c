"""How often a mesh winds about a point: a whole number, once its holes are closed far away.

Every loop of border edges is drawn out to infinity against the area that it bounds: a hole in a
body becomes a chimney, a sheet the lid of a well. So closed, a mesh winds once about its inside.
A mesh wound inside out counts as if it were turned.
"""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...core import codegen
from .topology import connected_components, edge_keys
from .triangles import morton_order

Array = NDArray[np.float64]
Index = NDArray[np.intp]

LEAF = 8
"""triangles in a leaf of the tree"""
FAR = 3.0
"""in radii of a cluster: the distance from which its area stands for it"""
WHOLE = 0.2
"""how far from a whole number the sum over clusters may be before all triangles are summed"""
SHEET = 0.02
"""volume over area^1.5 up to which a mesh with borders is a sheet, of which neither side is within;
that of a ball is 0.094"""
BLOCK = 1_000_000
"""solid angles taken at once"""


class Winding:
    """The turns of a mesh (vertices (n, 3) m, faces (m, 3)) about points."""

    def __init__(self, vertices: Array, faces: Index) -> None:
        self.border, self.way, capped = _border(vertices, faces)
        self.closed = not len(self.border)
        """whether no edge is run more often one way than the other"""
        bulk, area = _bulk(np.concatenate([vertices[faces], capped]))
        self.outward = -1 if bulk < (0.0 if self.closed else -SHEET * area**1.5) else 1
        """-1 where the mesh is wound inside out"""
        if self.outward < 0:
            faces = faces[:, ::-1]
            self.border, self.way, _ = _border(vertices, faces)
        self.corners = np.ascontiguousarray(vertices[faces])
        self._nodes, self._leaves = _tree(self.corners)

    def about(self, points: Array) -> NDArray[np.int64]:
        """The whole turns (n,) about points (n, 3), m."""
        beyond = self._chimneys(points)
        built = library()
        if built is None:
            return np.asarray(np.round(self._exact(points) + beyond), dtype=np.int64)
        total = self._clustered(built, points) + beyond
        unsure = np.flatnonzero(np.abs(total - np.round(total)) > WHOLE)
        total[unsure] = self._exact(points[unsure]) + beyond[unsure]
        return np.asarray(np.round(total), dtype=np.int64)

    def _clustered(self, built: ctypes.CDLL, points: Array) -> Array:
        at, out = np.ascontiguousarray(points), np.empty(len(points))
        leaves = len(self._nodes) // 2
        counts = [ctypes.c_int64(c) for c in (leaves, len(self._leaves) // leaves, len(at))]
        arrays = [ctypes.c_void_p(a.ctypes.data) for a in (self._nodes, self._leaves, at, out)]
        built.winding(*counts[:2], *arrays[:2], counts[2], *arrays[2:])
        return out

    def _exact(self, points: Array) -> Array:
        return np.array([winding_number(self.corners, p) for p in points], dtype=float)

    def _chimneys(self, points: Array) -> Array:
        """The turns (n,) of the bands from the border edges to infinity."""
        total = np.zeros(len(points))
        count = max(1, BLOCK // max(len(self.border), 1))
        for first in range(0, len(points) if len(self.border) else 0, count):
            p = points[first : first + count, None]
            a, b = self.border[:, 1] - p, self.border[:, 0] - p  # the band runs against the mesh
            la, lb = np.linalg.norm(a, axis=2), np.linalg.norm(b, axis=2)
            top = np.einsum("nkc,kc->nk", np.cross(a, b), self.way)
            ad, bd = np.einsum("nkc,kc->nk", a, self.way), np.einsum("nkc,kc->nk", b, self.way)
            below = la * lb + np.einsum("nkc,nkc->nk", a, b) + bd * la + ad * lb
            total[first : first + count] = np.arctan2(top, below).sum(axis=1) / (2 * np.pi)
        return total


def winding_number(corners: Array, point: Array) -> float:
    """How often a closed surface, triangles (m, 3, 3), winds about a point (3,).

    Source: Van Oosterom and Strackee, "The Solid Angle of a Plane Triangle" (1983).
    """
    a, b, c = (corners[:, k] - point for k in range(3))
    la, lb, lc = (np.linalg.norm(x, axis=1) for x in (a, b, c))
    top = np.einsum("mc,mc->m", a, np.cross(b, c))
    ab, bc, ca = (np.einsum("mc,mc->m", x, y) for x, y in ((a, b), (b, c), (c, a)))
    return float(np.sum(np.arctan2(top, la * lb * lc + ab * lc + bc * la + ca * lb)) / (2 * np.pi))


@cache
def library() -> ctypes.CDLL | None:
    """The compiled sum; None, and one warning, without a C compiler."""
    text = Path(__file__).with_name("winding_number.c").read_text(encoding="utf-8")
    return codegen.compile_library("winding numbers", text)


def _bulk(corners: Array) -> tuple[float, float]:
    """Signed volume, m^3, within triangles (m, 3, 3), and their area, m^2."""
    a, b, c = np.swapaxes(corners - corners.reshape(-1, 3).mean(axis=0), 0, 1)
    volume = np.einsum("mc,mc->", a, np.cross(b, c)) / 6.0
    return float(volume), 0.5 * float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


def _border(vertices: Array, faces: Index) -> tuple[Array, Array, Array]:
    """Ends (k, 2, 3), m, of the border edges as the faces run them, and their ways (k, 3) out.

    An edge that is run more often one way than the other is there as often as that. Third, the
    triangles (k, 3, 3) that close each loop from the middle of its corners.
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
        return np.zeros((0, 2, 3)), np.zeros((0, 3)), np.zeros((0, 3, 3))
    loop = connected_components(ends[:, 0], ends[:, 1], n)[ends[:, 0]]
    _, loop = np.unique(loop, return_inverse=True)
    along = vertices[ends]
    count = np.bincount(loop)
    middle = np.stack([np.bincount(loop, along[:, 0, k]) / count for k in range(3)], axis=1)
    away = along - middle[loop][:, None]
    swept = np.cross(away[:, 0], away[:, 1])
    area = np.stack([np.bincount(loop, swept[:, k]) for k in range(3)], axis=1)
    size = np.linalg.norm(area, axis=1, keepdims=True)
    way = np.where(size > 0.0, -area / np.maximum(size, 1e-300), [0.0, 0.0, 1.0])
    capped = np.stack([along[:, 1], along[:, 0], middle[loop]], axis=1)
    return along, way[loop], capped


def _tree(corners: Array) -> tuple[Array, Array]:
    """Clusters (2 leaves, 7) of triangles (m, 3, 3), and the triangles leaf by leaf.

    Of a cluster: the middle, weighted by area; the sum of the areas, as vectors; its far distance.
    """
    m = len(corners)
    leaves = 1 << max(0, int(np.ceil(np.log2(m / LEAF))))
    size = -(-m // leaves)
    sorted_ = corners[morton_order(corners.mean(axis=1))]
    place = np.arange(leaves * size) * m // (leaves * size)
    leaf = sorted_[place]
    again = np.flatnonzero(place[1:] == place[:-1]) + 1
    leaf[again] = leaf[again, :1]  # a point
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
        node[blocks : 2 * blocks, 6] = FAR * radius
        blocks //= 2
    return node, np.ascontiguousarray(leaf)
