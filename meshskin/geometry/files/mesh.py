"""Mesh files: their formats and units."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import MeshError
from ..check import survey

Array = NDArray[np.float64]
Index = NDArray[np.intp]

UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 25.4e-3}
"""units of a mesh file, in m"""
FORMATS = ("stl", "obj", "ply", "off", "glb")
METRES = ("glb",)
"""formats that are in m by their standard"""


def unit(path: Path, units: str | None) -> float:
    """Length in m of a file's unit."""
    if units is None:
        if path.suffix.lower().lstrip(".") in METRES:
            return 1.0
        raise MeshError(
            f"{path.name}: units are not in the file", remedy=f"give units=, one of {[*UNITS]}"
        )
    if units not in UNITS:
        raise MeshError("units of a mesh", value=repr(units), limit=f"one of {[*UNITS]}")
    return UNITS[units]


def load(path: Path, scale: float, open: bool) -> tuple[Any, tuple[str, ...]]:
    """A clean trimesh.Trimesh in m, and what was repaired. Raises MeshError."""
    import trimesh

    vertices, faces = read(path, scale)
    found = survey(vertices, faces, open)
    for finding in found.refused:
        raise finding.error()
    return trimesh.Trimesh(found.vertices, found.faces, process=False), found.repairs


def read(path: Path, scale: float = 1.0) -> tuple[Array, Index]:
    """Vertices (n, 3), times `scale`, and faces (m, 3) of a file. Raises MeshError."""
    import trimesh

    kind = path.suffix.lower().lstrip(".")
    if kind not in FORMATS:
        raise MeshError("format of a mesh", value=repr(kind), limit=f"one of {', '.join(FORMATS)}")
    if not path.is_file():
        raise MeshError("no such mesh file", value=str(path))
    try:
        mesh = trimesh.load_mesh(path, file_type=kind, process=False)
    except (ValueError, KeyError, IndexError, TypeError, UnicodeDecodeError, OSError) as error:
        raise MeshError(f"{path.name} cannot be read", value=f"{error}") from error
    if isinstance(mesh, trimesh.Scene):
        mesh = mesh.to_mesh()
    faces = np.array(getattr(mesh, "faces", np.zeros((0, 3))), dtype=np.intp)
    if not len(faces):
        raise MeshError(
            f"{path.name} has no faces",
            remedy="check the file in a mesh viewer; one NaN in an OBJ can hide them all",
        )
    return np.array(mesh.vertices, dtype=float) * scale, faces
