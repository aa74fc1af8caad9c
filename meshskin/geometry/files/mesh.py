"""Mesh files: what they must hold to be a body, and what is put right in them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import MeshError
from ..surface import neighbours

Array = NDArray[np.float64]
Index = NDArray[np.intp]

UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 25.4e-3}
"""units of a mesh file, in m"""
FORMATS = ("stl", "obj", "ply", "off", "glb")
METRES = ("glb",)
"""formats that are in m by their standard"""
SAME = 1e-7
"""vertices nearer than this, relative to the extent, are one"""


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

    vertices, faces = _read(path)
    vertices = vertices * scale
    vertices, faces, repairs = clean(vertices, faces)
    faces, turned = orient(vertices, faces, open)
    check_closed(vertices, faces, open)
    return trimesh.Trimesh(vertices, faces, process=False), (*repairs, *turned)


def _read(path: Path) -> tuple[Array, Index]:
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
        raise MeshError(f"{path.name} has no faces", remedy="check the file in a mesh viewer")
    return np.array(mesh.vertices, dtype=float), faces


def clean(vertices: Array, faces: Index) -> tuple[Array, Index, list[str]]:
    """Merge equal vertices, drop unused ones and faces without area; refuse what is not finite."""
    repairs = []
    bad = np.any(~np.isfinite(vertices), axis=1)
    if bad[faces].any():
        row = int(np.flatnonzero(bad)[0])
        raise MeshError("a vertex is not finite", value=vertices[row].tolist(), limit="finite")
    used = np.zeros(len(vertices), dtype=bool)
    used[faces] = True
    if not used.all():
        repairs.append(f"{int((~used).sum())} unreferenced vertices dropped")
        vertices, faces = vertices[used], (np.cumsum(used) - 1)[faces]
    extent = float(np.max(np.ptp(vertices, axis=0)))
    if not extent > 0.0:
        raise MeshError("largest extent of the mesh", value=f"{extent} m", limit="> 0")
    grid = np.round((vertices - vertices.min(axis=0)) / (SAME * extent)).astype(np.int64)
    _, first, merged = np.unique(grid, axis=0, return_index=True, return_inverse=True)
    if len(first) < len(vertices):
        repairs.append(f"{len(vertices) - len(first)} duplicate vertices merged")
        order = np.argsort(first)
        rank = np.empty_like(order)
        rank[order] = np.arange(len(order))
        vertices, faces = vertices[first[order]], rank[merged.ravel()][faces]
    pointed = (
        (faces[:, 0] == faces[:, 1]) | (faces[:, 1] == faces[:, 2]) | (faces[:, 2] == faces[:, 0])
    )
    if pointed.any():
        repairs.append(f"{int(pointed.sum())} faces without area dropped")
        faces = faces[~pointed]
    _, kept = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    if len(kept) < len(faces):
        repairs.append(f"{len(faces) - len(kept)} duplicate faces dropped")
        faces = faces[np.sort(kept)]
    if not len(faces):
        raise MeshError("a mesh whose faces have no area")
    return vertices, faces, repairs


def orient(vertices: Array, faces: Index, open: bool) -> tuple[Index, list[str]]:
    """Wind all faces alike, and outward: by the enclosed volume of each connected part."""
    import trimesh

    repairs = []
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    if not mesh.is_winding_consistent:
        before = mesh.faces.copy()
        trimesh.repair.fix_winding(mesh)
        changed = int((before != mesh.faces).any(axis=1).sum())
        if changed:
            repairs.append(f"{min(changed, len(faces) - changed)} faces wound like the others")
        faces = np.array(mesh.faces, dtype=np.intp)
    centred = vertices - vertices.mean(axis=0)
    a, b, c = (centred[faces[:, k]] for k in range(3))
    volume = float(np.sum(a * np.cross(b, c)) / 6.0)
    if volume < 0.0 and not open:
        repairs.append("orientation inverted: normals pointed inward")
        faces = faces[:, ::-1]
    return np.ascontiguousarray(faces), repairs


def check_closed(vertices: Array, faces: Index, open: bool) -> None:
    """Refuse borders (unless `open`), faces wound against each other, edges of many faces."""
    across, _ = neighbours(faces)
    if open or np.all(across >= 0):
        return
    edges = np.sort(faces[:, [1, 2, 2, 0, 0, 1]].reshape(-1, 2), axis=1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    border, many = int((counts == 1).sum()), int((counts > 2).sum())
    against = int((across < 0).sum()) - border - int(counts[counts > 2].sum())
    raise MeshError(
        "the mesh is not watertight",
        value=f"{border} border edges, {many} edges of more than two faces, "
        f"{against // 2} edges wound against each other",
        limit="0",
        remedy="close it in a mesh editor, or open=True",
    )
