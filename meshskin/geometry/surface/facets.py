"""The flat faces of a mesh, and where on them is nearest to a point.

Found in C (compiled_search.py), exactly; without a compiler in NumPy, among the faces of the
nearest samples.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from . import compiled_search
from .closest_point import ReferenceFlat
from .compiled_search import CompiledFlat

Array = NDArray[np.float64]


class Facets:
    """The flat faces of a mesh (an object with `.vertices` (n, 3), m, and `.faces` (m, 3))."""

    def __init__(self, mesh: Any) -> None:
        vertices: Array = np.array(mesh.vertices, dtype=float)
        faces = np.array(mesh.faces, dtype=np.intp)
        self._corners = vertices[faces]
        built = compiled_search.library()
        self._search = (
            ReferenceFlat(vertices, faces)
            if built is None
            else CompiledFlat(vertices, faces, built)
        )

    def closest(self, points: Array) -> tuple[Array, Array]:
        """The nearest points (n, 3), m, and the normals (n, 3) of their faces."""
        found = self._search.closest(points)
        a, b, c = (self._corners[found.face, k] for k in range(3))
        normals = np.cross(b - a, c - a)
        normals /= np.linalg.norm(normals, axis=1)[:, None]
        return a + found.uv[:, :1] * (b - a) + found.uv[:, 1:] * (c - a), normals
