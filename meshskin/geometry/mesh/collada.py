"""Collada files (.dae), the meshes of links in many URDFs; read by pycollada.

Lengths are in the unit of the file, 1 m by default. The `up_axis` is ignored, as RViz and MoveIt
do: files of robots rely on it (TIAGo's say Y_UP, the default, and agree with its STL files).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import MeshError
from .mesh_file import Array, Index, Triangles


def read(path: Path) -> Triangles:
    """The triangles of the scene of a file, in m. Raises MeshError."""
    try:
        from collada import Collada, common
    except ImportError as error:
        raise MeshError(
            f"the mesh {path.name!r} is a Collada file, which needs pycollada",
            remedy='pip install pycollada, or "meshskin[robots]"',
        ) from error
    if not path.is_file():
        raise MeshError("the mesh file does not exist", value=str(path))
    try:
        # of what is not triangles, elements may be unknown and references broken
        unknown = [common.DaeUnsupportedError, common.DaeBrokenRefError]
        document = Collada(str(path), ignore=unknown)
        parts = list(_parts(document))
    except (common.DaeError, ValueError, KeyError, IndexError, TypeError, OSError) as error:
        raise MeshError(f"{path.name} cannot be read", value=f"{error}") from error
    if not parts:
        raise MeshError(f"{path.name} has no faces", remedy="check the file in a mesh viewer")
    firsts = np.cumsum([0, *(len(vertices) for vertices, _ in parts[:-1])])
    scale = document.assetInfo.unitmeter or 1.0
    return Triangles(
        scale * np.concatenate([vertices for vertices, _ in parts]),
        np.concatenate([faces + k for (_, faces), k in zip(parts, firsts, strict=True)]),
    )


def _parts(document: Any) -> Iterator[tuple[Array, Index]]:
    """Vertices (n, 3), in the file's unit, and faces (m, 3) of each part, posed by its nodes."""
    if document.scene is None:
        return
    for shape in document.scene.objects("geometry"):
        for part in shape.primitives():
            triangles = part.triangleset() if hasattr(part, "triangleset") else part
            faces = getattr(triangles, "vertex_index", None)
            if faces is not None and np.ndim(faces) == 2 and np.shape(faces)[1] == 3:
                yield np.array(triangles.vertex, dtype=float), np.array(faces, dtype=np.intp)
