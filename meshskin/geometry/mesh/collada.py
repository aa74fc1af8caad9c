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
from .triangles import Triangles


def read(path: Path, scale: float | None = None) -> Triangles:
    """The scene of a file, m, whose named parts are its geometries and materials.

    `scale`: the unit in m; None: that of the file. Raises MeshError without pycollada, and what it
    raises for a damaged file.
    """
    try:
        from collada import Collada, common
    except ImportError as error:
        raise MeshError(
            f"the mesh {path.name!r} is a Collada file, which needs pycollada",
            remedy='pip install pycollada, or "meshskin[robots]"',
        ) from error
    # of what is not triangles, elements may be unknown and references broken
    unknown = [common.DaeUnsupportedError, common.DaeBrokenRefError]
    document = Collada(str(path), ignore=unknown)
    found = Triangles.joined(list(_parts(document)))
    unit = document.assetInfo.unitmeter or 1.0 if scale is None else scale
    return Triangles(unit * found.vertices, found.faces, found.names)


def _parts(document: Any) -> Iterator[Triangles]:
    """Each part, in the file's unit, in its pose."""
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
                yield Triangles.part(triangles.vertex, faces, (str(name) for name in names if name))
