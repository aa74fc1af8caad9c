"""Collada files (.dae), the meshes of links in many URDFs; read by pycollada.

Lengths are in the unit of the file, 1 m by default. The `up_axis` is ignored, as RViz and MoveIt
do: files of robots rely on it (TIAGo's say Y_UP, the default, and agree with its STL files).
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from ...core.arrays import Array, Index
from ...core.errors import MeshError


def read(path: Path, scale: float | None = None) -> tuple[Array, Index, dict[str, Index]]:
    """Vertices (n, 3), m, and faces (m, 3) of the scene of a file, and the faces (k,) of the named
    parts: its geometries and materials.

    `scale`: the unit in m; None: that of the file. Raises MeshError.
    """
    try:
        from collada import Collada, common
    except ImportError as error:
        raise MeshError(
            f"the mesh {path.name!r} is a Collada file, which needs pycollada",
            remedy='pip install pycollada, or "meshskin[robots]"',
        ) from error
    try:
        # of what is not triangles, elements may be unknown and references broken
        unknown = [common.DaeUnsupportedError, common.DaeBrokenRefError]
        document = Collada(str(path), ignore=unknown)
        parts = list(_parts(document))
    except (common.DaeError, ValueError, KeyError, IndexError, TypeError, OSError) as error:
        reason = " ".join(f"{error}".split()) or type(error).__name__
        raise MeshError(
            f"{path.name} cannot be read", value=reason[:200], remedy="copy or export it again"
        ) from error
    vertices, faces = [np.zeros((0, 3))], [np.zeros((0, 3), dtype=np.intp)]
    named: dict[str, list[Index]] = {}
    corner = first = 0
    for points, triangles, names in parts:
        vertices.append(points)
        faces.append(triangles + corner)
        for name in dict.fromkeys(names):
            named.setdefault(name, []).append(np.arange(first, first + len(triangles)))
        corner, first = corner + len(points), first + len(triangles)
    unit = document.assetInfo.unitmeter or 1.0 if scale is None else scale
    rows = {name: np.concatenate(numbers) for name, numbers in named.items()}
    return unit * np.concatenate(vertices), np.concatenate(faces), rows


def _parts(document: Any) -> Iterator[tuple[Array, Index, list[str]]]:
    """Vertices (n, 3), in the file's unit, faces (m, 3) and names of each part, in its pose."""
    if document.scene is None:
        return
    for shape in document.scene.objects("geometry"):
        for part in shape.primitives():
            triangles = part.triangleset() if hasattr(part, "triangleset") else part
            faces = getattr(triangles, "vertex_index", None)
            if faces is not None and np.ndim(faces) == 2 and np.shape(faces)[1] == 3:
                names = (
                    getattr(source, "name", None) for source in (shape.original, part.material)
                )
                yield (
                    np.array(triangles.vertex, dtype=float),
                    np.array(faces, dtype=np.intp),
                    [str(name) for name in names if name],
                )
