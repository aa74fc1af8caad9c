"""Closest points in C: Newton's method on the patches, from the nearest flat face.

A tree of bounding cylinders over the faces finds the nearest flat face, and all others whose patch
may be nearer than the minimum found. Cylinders about the mean normal are tighter around a smooth
surface than boxes: the cost hardly grows with the number of faces. Weighed and too slow for the
simulation's steps: trimesh (2.3 ms a query at 20,000 faces), libigl (5 to 10 us); this takes 0.8 us
from the face of the last step. Both know flat faces alone; embree finds rays, not closest points.
"""

from __future__ import annotations

import ctypes
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ...core import codegen
from ...core.arrays import Array, Index
from ..mesh.triangles import morton_order
from . import newton, patch
from .closest_point import FlatPoints, PatchPoints

if TYPE_CHECKING:
    from .surface import Surface

LEAF = 4
"""most faces in a leaf of the tree; the same constant stands in compiled_search.c"""
CHECK_AFTER = 6
"""edges crossed from a given face, from which the result is checked against the nearest flat one"""
UNSORTED = 100
"""most queries that are not sorted by position; sorting more makes better use of the cache"""
_INT, _REAL, _ADDRESS = ctypes.c_int64, ctypes.c_double, ctypes.c_void_p


class _Tree(ctypes.Structure):
    _fields_ = (
        ("levels", _INT),
        ("leaves", _INT),
        ("faces", _INT),
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
        ("far", _INT),
        ("hops", _INT),
        ("steps", _INT),
    )


@cache
def library() -> ctypes.CDLL | None:
    """The compiled search; None, and one warning, without a C compiler."""
    parts = (Path(__file__).with_name(name) for name in ("cylinders.c", "compiled_search.c"))
    text = "\n".join(part.read_text(encoding="utf-8") for part in parts)
    return codegen.compile_library("closest points", text)


class CompiledSearch:
    """Closest points of the patches of a surface, with the methods of ReferenceSearch."""

    def __init__(self, surface: Surface, library_: ctypes.CDLL) -> None:
        self.sharp = not surface.smooth
        self._library = library_
        patches = np.ascontiguousarray(surface.patches)
        beyond = np.ascontiguousarray(surface.neighbours, dtype=np.int64)
        slot = np.ascontiguousarray(surface.slot, dtype=np.int64)
        offsets = None if surface.smooth else surface.offsets
        self._tree, nodes = _tree(library_, surface.vertices, surface.faces, offsets)
        self._arrays = patches, beyond, slot, *nodes  # keeps the arrays alive that C points to
        tolerances = newton.NEWTON_TOLERANCE, newton.STEP_TOLERANCE
        limits = CHECK_AFTER, newton.HOPS, newton.STEPS
        self._surface = _Surface(*(a.ctypes.data for a in self._arrays[:3]), *tolerances, *limits)

    def closest(self, p: Array, face: Index | None) -> PatchPoints:
        """The closest points to p (n, 3), m; `face` (n,): faces to start from, if known."""
        n, warm = len(p), face is not None
        found = np.array(np.zeros(n) if face is None else face, dtype=np.int64)
        uv, out = np.empty((n, 2)), np.empty((len(patch.ORDERS), n, 3))
        none = np.empty(0)
        flat = None if warm else _flat_points(n)
        answers = _addresses(found, uv, out, *(flat or (none, none, none)))
        queue = morton_order(p) if n > UNSORTED and not warm else np.arange(n)
        both = ctypes.byref(self._tree), ctypes.byref(self._surface), _INT(n)
        self._library.closest(*both, *_addresses(queue, p), int(warm), int(self.sharp), *answers)
        return PatchPoints(found, uv, tuple(out), flat if self.sharp else None)

    def derivatives(self, face: Index, uv: Array) -> tuple[Array, ...]:
        """S, Su, Sv, Suu, Suv, Svv, each (n, 3), of the patches `face` (n,) at uv (n, 2)."""
        out = np.empty((len(patch.ORDERS), len(face), 3))
        inputs = np.ascontiguousarray(face, dtype=np.int64), np.ascontiguousarray(uv)
        surface = ctypes.byref(self._surface)
        self._library.derivatives(surface, _INT(len(face)), *_addresses(*inputs, out))
        return tuple(out)


class CompiledFlat:
    """Closest points of the faces (m, 3) of a mesh of vertices (n, 3), m."""

    def __init__(self, vertices: Array, faces: Index, library_: ctypes.CDLL) -> None:
        self._library = library_
        self._tree, self._arrays = _tree(library_, vertices, faces)

    def closest(self, p: Array) -> FlatPoints:
        """The closest points to p (n, 3), m."""
        n = len(p)
        found = _flat_points(n)
        queue = morton_order(p) if n > UNSORTED else np.arange(n)
        points = np.ascontiguousarray(p, dtype=float)
        self._library.flat(ctypes.byref(self._tree), _INT(n), *_addresses(queue, points, *found))
        return found


def _flat_points(n: int) -> FlatPoints:
    """Arrays for C to fill."""
    return FlatPoints(np.empty(n, dtype=np.int64), np.empty((n, 2)), np.empty(n))


def _tree(
    library_: ctypes.CDLL, vertices: Array, faces: Index, offsets: Array | None = None
) -> tuple[_Tree, tuple[NDArray[Any], ...]]:
    """A balanced tree of cylinders over the faces (m, 3) of vertices (n, 3), m, and its arrays.

    The arrays must be kept alive. offsets (m,), m: bounds of the distances between a patch and its
    face, 0 if None.
    """
    m = len(faces)
    levels = max(0, int(np.ceil(np.log2(m / LEAF))))
    centroids = np.empty(m, dtype=[("at", np.float64, 3), ("face", np.int64)])
    centroids["at"], centroids["face"] = vertices[faces].mean(axis=1), np.arange(m)
    count = (_INT(levels), _INT(m))
    library_.order(*count, *_addresses(centroids))
    face = centroids["face"].copy()
    corners = vertices[faces[face]]
    bounds = np.zeros(m) if offsets is None else offsets[face]
    node = _aligned(2 << levels)
    library_.enclose(*count, *_addresses(corners, bounds, node))
    arrays = node, corners, bounds, face
    return _Tree(levels, 1 << levels, m, *(a.ctypes.data for a in arrays)), arrays


def _aligned(rows: int) -> Array:
    """An empty array (rows, 8) whose rows are cache lines of 64 bytes."""
    room = np.empty(8 * rows + 8)
    first = -room.ctypes.data // 8 % 8
    return room[first : first + 8 * rows].reshape(rows, 8)


def _addresses(*arrays: NDArray[Any]) -> list[ctypes.c_void_p]:
    return [_ADDRESS(a.ctypes.data) for a in arrays]
