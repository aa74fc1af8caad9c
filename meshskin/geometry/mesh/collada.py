"""Collada files (.dae), as URDFs name them for their links; read by pycollada.

Lengths are in the file's own unit, 1 m where it names none. Its axes are those of the link: the
`up_axis` turns nothing. RViz and MoveIt take it so, and robots' files rely on it: those of TIAGo
say Y_UP, which is the default, and agree with its STL files as they are.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import MeshError
from .mesh_file import Array, Index, Triangles


def read(path: Path) -> Triangles:
    """The triangles of all that a file's scene shows, in m. Raises MeshError."""
    try:
        from collada import Collada, common
    except ImportError as error:
        raise MeshError(
            f"the mesh {path.name!r} is a Collada file, which needs pycollada",
            remedy='pip install pycollada, or "meshskin[robots]"',
        ) from error
    if not path.is_file():
        raise MeshError("no such mesh file", value=str(path))
    try:
        # what is shown beside triangles may be unknown, or refer to nothing
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
    """Corners (n, 3), in the file's unit, and faces (m, 3) of each part, placed by its nodes."""
    if document.scene is None:
        return
    for shape in document.scene.objects("geometry"):
        for part in shape.primitives():
            triangles = part.triangleset() if hasattr(part, "triangleset") else part
            faces = getattr(triangles, "vertex_index", None)
            if faces is not None and np.ndim(faces) == 2 and np.shape(faces)[1] == 3:
                yield np.array(triangles.vertex, dtype=float), np.array(faces, dtype=np.intp)
