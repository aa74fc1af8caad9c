"""The search for closest points in C: the same walks, from the exactly nearest flat face.

A tree of bounding cylinders over the faces finds that face, and every other whose patch may be
nearer than what a walk found: no sample of the mesh stands in for it, as in search.py. Cylinders
about the mean normal hug a smooth surface, as boxes do not: the cost hardly grows with the faces.
"""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ...core import codegen
from ..mesh.triangles import morton_order
from . import newton, patch
from .closest_point import FlatPoints, PatchPoints

if TYPE_CHECKING:
    from .surface import Surface

Array = NDArray[np.float64]
Index = NDArray[np.intp]
Long = NDArray[np.int64]

LEAF = 4
"""faces in a leaf of the tree, at most, as in compiled_search.c"""
CHECK_AFTER = 6
"""hops after which a walk is checked against the global nearest face"""
UNSORTED = 100
"""queries, at most, that are taken as they come: more are sorted by place, for the cache"""
_WHOLE, _REAL, _ADDRESS = ctypes.c_int64, ctypes.c_double, ctypes.c_void_p


class _Tree(ctypes.Structure):
    _fields_ = (
        ("levels", _WHOLE),
        ("leaves", _WHOLE),
        ("faces", _WHOLE),
        ("node", _ADDRESS),
        ("corner", _ADDRESS),
        ("lift", _ADDRESS),
        ("face", _ADDRESS),
    )


class _Surface(ctypes.Structure):
    _fields_ = (
        ("patch", _ADDRESS),
        ("beyond", _ADDRESS),
        ("slot", _ADDRESS),
        ("quadratic", _REAL),
        ("still", _REAL),
        ("far", _WHOLE),
        ("hops", _WHOLE),
        ("steps", _WHOLE),
    )


@cache
def library() -> ctypes.CDLL | None:
    """The compiled search; None, and one warning, without a C compiler."""
    parts = (Path(__file__).with_name(name) for name in ("cylinders.c", "compiled_search.c"))
    text = "\n".join(part.read_text(encoding="utf-8") for part in parts)
    return codegen.compile_library("closest points", text)


class CompiledSearch:
    """Closest points on the patches of a surface, as `Search`."""

    def __init__(self, surface: Surface, built: ctypes.CDLL) -> None:
        self.sharp = not surface.smooth
        self._library = built
        patches = np.ascontiguousarray(surface.patches)
        beyond = np.ascontiguousarray(surface.neighbours, dtype=np.int64)
        slot = np.ascontiguousarray(surface.slot, dtype=np.int64)
        lifts = None if surface.smooth else surface.offsets
        nodes = build_tree(built, surface.vertices, surface.faces, lifts)
        self._kept = patches, beyond, slot, *nodes  # the addresses below are theirs
        ends = (
            newton.NEWTON_TOLERANCE,
            newton.STEP_TOLERANCE,
            CHECK_AFTER,
            newton.HOPS,
            newton.STEPS,
        )
        self._surface = _Surface(*(a.ctypes.data for a in self._kept[:3]), *ends)
        self._tree = _pointers(nodes)

    def closest(self, p: Array, face: Index | None) -> PatchPoints:
        """The feet of p (n, 3), m; `face` (n,): faces to start from, if known."""
        n, warm = len(p), face is not None
        foot = np.array(np.zeros(n) if face is None else face, dtype=np.int64)
        uv, out = np.empty((n, 2)), np.empty((len(patch.ORDERS), n, 3))
        none = np.empty(0)
        flat = (
            None if warm else FlatPoints(np.empty(n, dtype=np.int64), np.empty((n, 2)), np.empty(n))
        )
        answers = _addresses(foot, uv, out, *(flat or (none, none, none)))
        queue = morton_order(p) if n > UNSORTED and not warm else np.arange(n)
        both = ctypes.byref(self._tree), ctypes.byref(self._surface), _WHOLE(n)
        self._library.closest(*both, *_addresses(queue, p), int(warm), int(self.sharp), *answers)
        return PatchPoints(foot, uv, tuple(out), flat if self.sharp else None)

    def derivatives(self, face: Index, uv: Array) -> tuple[Array, ...]:
        """S, Su, Sv, Suu, Suv, Svv, each (n, 3), of the patches `face` (n,) at uv (n, 2)."""
        out = np.empty((len(patch.ORDERS), len(face), 3))
        inputs = np.ascontiguousarray(face, dtype=np.int64), np.ascontiguousarray(uv)
        surface = ctypes.byref(self._surface)
        self._library.derivatives(surface, _WHOLE(len(face)), *_addresses(*inputs, out))
        return tuple(out)

    def descend(self, p: Array, face: Index) -> tuple[Index, Array]:
        """Faces (n,) and uv (n, 2) where walks from `face` (n,) towards p (n, 3), m, end."""
        foot, uv = np.array(face, dtype=np.int64), np.empty((len(p), 2))
        surface = ctypes.byref(self._surface)
        self._library.descend(surface, _WHOLE(len(p)), *_addresses(p, foot, uv))
        return foot, uv


class CompiledFlat:
    """The flat faces (m, 3) of a mesh of vertices (n, 3), m, nearest to points."""

    def __init__(self, vertices: Array, faces: Index, built: ctypes.CDLL) -> None:
        self._library, self._kept = built, build_tree(built, vertices, faces)
        self._tree = _pointers(self._kept)

    def closest(self, p: Array) -> FlatPoints:
        """The nearest faces of p (n, 3), m, and where on them."""
        n = len(p)
        found = FlatPoints(np.empty(n, dtype=np.int64), np.empty((n, 2)), np.empty(n))
        queue = morton_order(p) if n > UNSORTED else np.arange(n)
        points = np.ascontiguousarray(p, dtype=float)
        self._library.flat(ctypes.byref(self._tree), _WHOLE(n), *_addresses(queue, points, *found))
        return found


def _pointers(nodes: tuple[Array, Array, Array, Long]) -> _Tree:
    """What C sees of a tree; the arrays must be kept."""
    leaves = len(nodes[0]) // 2
    count = leaves.bit_length() - 1, leaves, len(nodes[3])
    return _Tree(*count, *(a.ctypes.data for a in nodes))


def build_tree(
    built: ctypes.CDLL, vertices: Array, faces: Index, lifts: Array | None = None
) -> tuple[Array, Array, Array, Long]:
    """A balanced tree of cylinders over the faces (m, 3) of vertices (n, 3), m.

    lifts (m,), m: how far what belongs to a face is from it, 0 if None. Gives the cylinders
    (2 leaves, 8), and corners (m, 3, 3), lifts (m,) and numbers (m,) of the faces, leaf by leaf.
    """
    m = len(faces)
    levels = max(0, int(np.ceil(np.log2(m / LEAF))))
    spots = np.empty(m, dtype=[("at", np.float64, 3), ("face", np.int64)])
    spots["at"], spots["face"] = vertices[faces].mean(axis=1), np.arange(m)
    count = (_WHOLE(levels), _WHOLE(m))
    built.order(*count, *_addresses(spots))
    face = spots["face"].copy()
    corners = vertices[faces[face]]
    high = np.zeros(m) if lifts is None else lifts[face]
    node = _in_lines(2 << levels, 8)
    built.enclose(*count, *_addresses(corners, high, node))
    return node, corners, high, face


def _in_lines(rows: int, columns: int) -> Array:
    """An empty array that starts where a line of the cache does, 64 bytes."""
    room = np.empty(rows * columns + 8)
    first = -room.ctypes.data // 8 % 8
    return room[first : first + rows * columns].reshape(rows, columns)


def _addresses(*arrays: NDArray[Any]) -> list[ctypes.c_void_p]:
    return [_ADDRESS(a.ctypes.data) for a in arrays]
