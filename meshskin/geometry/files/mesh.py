"""Mesh files: what they must hold to be a body, and what is put right in them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import MeshError
from ..walk import neighbours

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
    """Wind all faces of a connected part like most of them, and the whole outward by its volume."""
    repairs = []
    flip = against(faces)
    if flip.any():
        repairs.append(f"{int(flip.sum())} faces wound like the others")
        faces = np.where(flip[:, None], faces[:, ::-1], faces)
    centred = vertices - vertices.mean(axis=0)
    a, b, c = (centred[faces[:, k]] for k in range(3))
    if not open and float(np.sum(a * np.cross(b, c))) < 0.0:
        repairs.append("orientation inverted: normals pointed inward")
        faces = faces[:, ::-1]
    return np.ascontiguousarray(faces), repairs


def against(faces: Index) -> NDArray[np.bool_]:
    """Which faces (m,) are wound against the larger share of their connected part."""
    tail, head = faces.ravel(), faces[:, [1, 2, 0]].ravel()
    owner = np.repeat(np.arange(len(faces)), 3)
    low, high = np.minimum(tail, head), np.maximum(tail, head)
    order = np.lexsort((high, low))
    key = np.column_stack([low, high])[order]
    same = np.all(key[1:] == key[:-1], axis=1)
    lone = np.concatenate([[False], same, [False]])
    pair = np.flatnonzero(same & ~lone[:-2] & ~lone[2:])  # edges of just two faces
    one, two = order[pair], order[pair + 1]
    opposed = tail[one] == tail[two]  # both run along the edge the same way
    link = np.concatenate([owner[one], owner[two]]), np.concatenate([owner[two], owner[one]])
    return _minority(len(faces), link, np.concatenate([opposed, opposed]))


def _minority(count: int, link: tuple[Index, Index], opposed: NDArray[np.bool_]) -> Any:
    """Spread a side from one node of each part over links (from, to); True on the smaller side."""
    by_start = np.argsort(link[0], kind="stable")
    to, opposed = link[1][by_start], opposed[by_start]
    first = np.searchsorted(link[0][by_start], np.arange(count + 1))
    side, part = np.zeros(count, dtype=np.int8), np.full(count, -1)
    for seed in range(count):
        if part[seed] >= 0:
            continue
        part[seed], front = seed, np.array([seed])
        while len(front):
            sizes = first[front + 1] - first[front]
            steps = np.repeat(first[front] - np.cumsum(sizes) + sizes, sizes)
            steps += np.arange(sizes.sum())
            source = np.repeat(front, sizes)
            fresh = part[to[steps]] < 0
            steps, source = steps[fresh], source[fresh]
            front, at = np.unique(to[steps], return_index=True)
            part[front] = seed
            side[front] = side[source[at]] ^ opposed[steps[at]]
    turned = np.bincount(part, side, minlength=count)
    total = np.bincount(part, minlength=count)
    return (side == 1) ^ (turned > 0.5 * total)[part]


def check_closed(vertices: Array, faces: Index, open: bool) -> None:
    """Refuse borders (unless `open`), faces wound against each other, edges of many faces."""
    across, _ = neighbours(faces)
    if open or np.all(across >= 0):
        return
    edges = np.sort(faces[:, [1, 2, 2, 0, 0, 1]].reshape(-1, 2), axis=1)
    _, counts = np.unique(edges, axis=0, return_counts=True)
    border, many = int((counts == 1).sum()), int((counts > 2).sum())
    wound = int((across < 0).sum()) - border - int(counts[counts > 2].sum())
    raise MeshError(
        "the mesh is not watertight",
        value=f"{border} border edges, {many} edges of more than two faces, "
        f"{wound // 2} edges wound against each other",
        limit="0",
        remedy="close it in a mesh editor, or open=True",
    )
