"""Mesh files: formats, units, triangles, and the names of parts."""

from __future__ import annotations

import json
import re
from collections.abc import Collection, Iterator
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from ...core.errors import MeshError
from . import collada, obj
from .triangles import Triangles

UNITS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "in": 25.4e-3}
"""length units of mesh files, in m"""
FORMATS = ("stl", "obj", "ply", "off", "glb", "gltf", "dae", "msh")
"""suffixes of the formats that are read"""
METRES = ("glb", "gltf")
"""formats whose standard says m"""


def unit(path: Path, units: str | None) -> float | None:
    """The length unit of a file, in m, from `units` or its format; None: the file says it.

    Raises MeshError.
    """
    _check(path)
    if units is None:
        if _kind(path) == "dae":
            return None
        if _kind(path) in METRES:
            return 1.0
        raise MeshError(
            f"{path.name}: the file has no length unit",
            remedy=f"give units= (--units), one of {', '.join(UNITS)}; meshskin check says which "
            "one its size suggests",
        )
    return in_metres(units)


def in_metres(units: str) -> float:
    """The length unit of that name, in m. Raises MeshError."""
    if units not in UNITS:
        raise MeshError(
            "unknown units of a mesh", value=repr(units), limit=f"one of {', '.join(UNITS)}"
        )
    return UNITS[units]


def _kind(path: Path) -> str:
    return path.suffix.lower().lstrip(".")


def _check(path: Path) -> str:
    """The format of a file. Raises MeshError unless it is there, and a mesh by its suffix."""
    kind = _kind(path)
    if kind not in FORMATS:
        raise MeshError(
            "unknown format of a mesh",
            value=repr(kind),
            limit=f"one of {', '.join(FORMATS)}",
            remedy="export the mesh as STL",
        )
    if not path.is_file():
        raise MeshError("the mesh file does not exist", value=str(path))
    return kind


def read(path: Path, scale: float | None = None) -> Triangles:
    """The triangles of a file whose unit is `scale`, m; None: 1 m, or what a Collada file says.

    Raises MeshError.
    """
    kind = _check(path)
    try:
        if kind == "obj":
            text = path.read_text(encoding="utf-8", errors="replace")
            found = Triangles(*obj.read(text, path.name))
        elif kind == "dae":
            found, scale = collada.read(path, scale), 1.0
        elif kind == "msh":
            found = _by_counts(path)
        else:
            found = _by_trimesh(path, kind)
    except MeshError:
        raise
    except Exception as error:  # readers raise any exception for damaged files
        reason = " ".join(f"{error}".split()) or type(error).__name__
        raise MeshError(
            f"{path.name} cannot be read", value=reason[:200], remedy="copy or export it again"
        ) from error
    if not len(found.faces):
        raise MeshError(f"{path.name} has no faces", remedy="check the file in a mesh viewer")
    return Triangles(found.vertices * (1.0 if scale is None else scale), found.faces, found.names)


def _by_counts(path: Path) -> Triangles:
    """The triangles of a binary .msh file: numbers of vertices, normals, texture coordinates and
    faces (int32), the three arrays (float32), and the corners of the faces (int32).

    Source: MuJoCo, "XML Reference", asset/mesh. Raises MeshError.
    """
    data = path.read_bytes()
    counts = np.frombuffer(data[: len(data) // 4 * 4][:16], "<i4").astype(np.int64)
    expected = 16 + 4 * int(counts @ [3, 3, 2, 3]) if len(counts) == 4 else None
    if expected != len(data) or counts.min() < 0:
        raise MeshError(
            f"{path.name} is truncated, or not a mesh of MuJoCo",
            value=f"{len(data)} bytes",
            limit="a header of 16 bytes" if expected is None else f"{expected} by its header",
            remedy="copy it again, or export a mesh of Gmsh as STL",
        )
    corners, faces = counts[[0, 3]].tolist()
    vertices = np.frombuffer(data, "<f4", 3 * corners, 16).reshape(-1, 3)
    rows = np.frombuffer(data, "<i4", 3 * faces, len(data) - 12 * faces).reshape(-1, 3)
    return Triangles.part(vertices, rows, ())


def _by_trimesh(path: Path, kind: str) -> Triangles:
    import trimesh

    source = _text(path, kind) or path
    scene = trimesh.load_scene(source, file_type=kind, process=False)
    known = _gltf_names(path) if kind in METRES else set(scene.geometry)
    order = {name: k for k, name in enumerate(scene.geometry)}
    nodes = [(*scene.graph[node], node) for node in scene.graph.nodes_geometry]
    nodes.sort(key=lambda entry: (order[entry[1]], entry[2]))  # trimesh's order is not the file's
    parts = []
    for pose, shape, node in nodes:
        mesh = scene.geometry[shape]
        if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
            continue
        placed = mesh if np.array_equal(pose, np.eye(4)) else mesh.copy().apply_transform(pose)
        names = _names(scene, node, shape, mesh, known)
        if kind not in METRES and len(nodes) == 1:  # trimesh names it after the file
            names = iter(())
        parts.append(Triangles.part(placed.vertices, placed.faces, names))
    return Triangles.joined(parts)


def _text(path: Path, kind: str) -> BytesIO | None:
    """The text of an OFF or ASCII STL file in UTF-8, whatever its encoding; None for other files.

    Raises MeshError for a binary STL whose length is not that of its header.
    """
    if kind not in ("stl", "off"):
        return None
    size = path.stat().st_size
    with path.open("rb") as file:
        head = file.read(84)
    if kind == "stl" and head:
        expected = 84 + 50 * int.from_bytes(head[80:84], "little")
        if len(head) == 84 and size == expected:
            return None
        if not head.lstrip().lower().startswith(b"solid"):
            raise MeshError(
                f"{path.name} is truncated, or not an STL file",
                value=f"{size} bytes",
                limit=f"{expected} by its header" if len(head) == 84 else "a header of 84 bytes",
                remedy="copy or export it again",
            )
    return BytesIO(path.read_text(encoding="utf-8", errors="replace").encode())


def _gltf_names(path: Path) -> set[str]:
    """The names of nodes, meshes and materials in a glTF file; trimesh adds names of its own."""
    data = path.read_bytes()
    if data.startswith(b"glTF"):  # binary: the text is the first chunk
        data = data[20 : 20 + int.from_bytes(data[12:16], "little")]
    content = json.loads(data)
    entries = (e for kind in ("nodes", "meshes", "materials") for e in content.get(kind, []))
    return {str(entry["name"]) for entry in entries if entry.get("name")}


def _names(scene: Any, node: str, shape: str, mesh: Any, known: Collection[str]) -> Iterator[str]:
    """The names of a mesh in the file: of its nodes from the leaf up, its mesh, its material."""
    parents = scene.graph.transforms.parents
    material = getattr(getattr(mesh.visual, "material", None), "name", None)
    while node is not None:
        yield from _original(node, known)
        node = parents.get(node)
    yield from _original(shape, known)
    if material in known:
        yield str(material)


def _original(name: str, known: Collection[str]) -> Iterator[str]:
    """The name as it is in the file: trimesh appends numbers to names that occur twice."""
    bare = re.sub(r"_\d+$", "", name)
    if name in known:
        yield name
    elif bare in known:
        yield bare
