"""Repairs of a triangle mesh that are safe: they change no point of the surface.

Each gives what it changed; faces are told by their numbers in the file.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import ranges
from .topology import edge_keys, edge_pairs, neighbours
from .winding_number import winding_number

Array = NDArray[np.float64]
Index = NDArray[np.intp]

SAME = 1e-7
"""vertices nearer than this, relative to the extent, are one"""


@dataclass
class MeshEdit:
    """A mesh under repair."""

    vertices: Array
    """(n, 3) m"""
    faces: Index
    """(m, 3)"""
    number: Index
    """(m,) the faces' numbers in the file"""
    twins: Index = field(default_factory=lambda: np.zeros((0, 2), dtype=np.intp))
    """(k, 2) numbers of duplicate faces that were dropped, and of those that stayed"""
    marks: list[tuple[str, Array]] = field(default_factory=list)
    """what was done, in words, and the points (k, 3), m, where"""

    def note(self, words: str, points: Array) -> None:
        """Add a repair, done at `points`."""
        self.marks.append((words, np.array(points, dtype=float).reshape(-1, 3)))

    def keep(self, rows: NDArray[np.bool_]) -> None:
        """Drop the other faces."""
        self.faces, self.number = self.faces[rows], self.number[rows]

    def middles(self, rows: NDArray[np.bool_] | Index) -> Array:
        """Middles (k, 3) of faces."""
        return np.asarray(self.vertices[self.faces[rows]].mean(axis=1))


def drop_unreferenced(draft: MeshEdit) -> None:
    """Drop vertices that no face uses."""
    used = np.zeros(len(draft.vertices), dtype=bool)
    used[draft.faces] = True
    if used.all():
        return
    lost = draft.vertices[~used]
    draft.note(f"{len(lost)} unreferenced vertices dropped", lost[np.isfinite(lost).all(axis=1)])
    draft.vertices, draft.faces = draft.vertices[used], (np.cumsum(used) - 1)[draft.faces]


def merge(draft: MeshEdit) -> None:
    """Make vertices at one place one."""
    vertices = draft.vertices
    extent = float(np.max(np.ptp(vertices, axis=0)))
    grid = np.round((vertices - vertices.min(axis=0)) / (SAME * extent)).astype(np.int64)
    factors = np.array([0x1F123BB5, 0x3C6EF372FE94F82B, 0x5851F42D4C957F2D], dtype=np.int64)
    key = (grid * factors).sum(axis=1)  # wraps around: a hash
    _, first, place = np.unique(key, return_index=True, return_inverse=True)
    if not np.array_equal(grid[first][place], grid):  # two places with one hash
        _, first, place = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    if len(first) == len(vertices):
        return
    order = np.argsort(first)
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    double = np.ones(len(vertices), dtype=bool)
    double[first] = False
    draft.note(f"{len(vertices) - len(first)} duplicate vertices merged", vertices[double])
    draft.vertices, draft.faces = vertices[first[order]], rank[place.ravel()][draft.faces]


def drop_points(draft: MeshEdit) -> None:
    """Drop faces that use a vertex twice."""
    a, b, c = draft.faces.T
    pointed = (a == b) | (b == c) | (c == a)
    if pointed.any():
        draft.note(f"{int(pointed.sum())} faces without area dropped", draft.middles(pointed))
        draft.keep(~pointed)


def drop_doubles(draft: MeshEdit) -> None:
    """Drop all but the first of faces with the same vertices."""
    a, b, c = np.sort(draft.faces, axis=1).T
    order = np.lexsort((c, b, a))
    same = (np.diff(a[order]) == 0) & (np.diff(b[order]) == 0) & (np.diff(c[order]) == 0)
    double = np.zeros(len(a), dtype=bool)
    double[order[1:][same]] = True
    if double.any():
        draft.note(f"{int(double.sum())} duplicate faces dropped", draft.middles(double))
        first = order[np.maximum.accumulate(np.where(double[order], 0, np.arange(len(a))))]
        stays = np.empty_like(first)
        stays[order] = first
        draft.twins = draft.number[np.stack([np.flatnonzero(double), stays[double]], axis=1)]
        draft.keep(~double)


def wind(draft: MeshEdit) -> Index:
    """Wind all faces of a connected part like most of them; gives the faces across edges (m, 3)."""
    across = neighbours(draft.faces)[0]
    if np.all(across >= 0):
        return across  # every edge is run both ways
    flip = against(draft.faces)
    if flip.any():
        draft.note(f"{int(flip.sum())} faces wound like the others", draft.middles(flip))
        draft.faces = np.where(flip[:, None], draft.faces[:, ::-1], draft.faces)
        across = neighbours(draft.faces)[0]
    return across


def turn_outward(draft: MeshEdit, part: Index) -> bool:
    """Turn the closed parts `part` (m,) so that normals point out of the solid; whether any was.

    A part within an odd number of others bounds a hollow: its normals point into the hollow.
    """
    count = int(part.max()) + 1 if len(part) else 0
    corners = draft.vertices[draft.faces]
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
    turned = inward[part]
    if turned.any():
        which = "" if count == 1 else f" of {int(inward.sum())} of {count} parts"
        draft.note(f"orientation{which} inverted: normals pointed inward", draft.middles(turned))
        draft.faces = np.where(turned[:, None], draft.faces[:, ::-1], draft.faces)
    return bool(turned.any())


def against(faces: Index) -> NDArray[np.bool_]:
    """Which faces (m,) are wound against the larger share of their connected part."""
    tail, head = faces.ravel(), faces[:, [1, 2, 0]].ravel()
    owner = np.repeat(np.arange(len(faces)), 3)
    one, two = edge_pairs(edge_keys(tail, head, int(faces.max(initial=-1)) + 1))
    opposed = tail[one] == tail[two]  # both run along the edge the same way
    link = np.concatenate([owner[one], owner[two]]), np.concatenate([owner[two], owner[one]])
    return _minority(len(faces), link, np.concatenate([opposed, opposed]))


def _minority(
    count: int, link: tuple[Index, Index], opposed: NDArray[np.bool_]
) -> NDArray[np.bool_]:
    """Spread a side from one node of each part over links (from, to); True on the smaller side."""
    by_start = np.argsort(link[0], kind="stable")
    to, opposed = link[1][by_start], opposed[by_start]
    first = np.searchsorted(link[0][by_start], np.arange(count + 1))
    side, part = np.zeros(count, dtype=np.int8), np.full(count, -1)
    for seed in range(count):
        if part[seed] >= 0:
            continue
        part[seed], front = seed, np.array([seed])
        while len(front):
            sizes = first[front + 1] - first[front]
            steps = ranges(first[front], sizes)
            source = np.repeat(front, sizes)
            fresh = part[to[steps]] < 0
            steps, source = steps[fresh], source[fresh]
            front, at = np.unique(to[steps], return_index=True)
            part[front] = seed
            side[front] = side[source[at]] ^ opposed[steps[at]]
    turned = np.bincount(part, side, minlength=count)
    total = np.bincount(part, minlength=count)
    return np.asarray((side == 1) ^ (turned > 0.5 * total)[part])
