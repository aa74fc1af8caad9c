"""The mesh of a link in a URDF file, with its scale and origin, in the link frame."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Iterable
from pathlib import Path, PurePosixPath

import numpy as np

from ...core.arrays import Array
from ...core.errors import MeshError, MeshskinError, UnknownNameError, reason
from ...core.se3 import from_rpy
from . import mesh_file
from .triangles import Triangles

KINDS = ("visual", "collision")
"""elements of a link that have a geometry"""


def read(
    urdf: Path, link: str, folders: Iterable[str | Path] = (), kind: str = "visual"
) -> Triangles:
    """The triangles, m, link frame, of all meshes of a link in a URDF file, as `in_tree`.

    Raises MeshError, UnknownNameError.
    """
    try:
        root = ET.fromstring(urdf.read_bytes())
    except (OSError, ET.ParseError) as error:
        raise MeshError(f"cannot read the URDF file {str(urdf)!r}", value=reason(error)) from error
    return in_tree(root, urdf, link, folders, kind)


def in_tree(
    root: ET.Element, urdf: Path, link: str, folders: Iterable[str | Path], kind: str
) -> Triangles:
    """The triangles, m, link frame, of all meshes of a link; root: of the tree of the file `urdf`.

    `folders` are searched for the meshes, besides the folder of the URDF file and its parents.
    kind: one of KINDS. Raises MeshError, UnknownNameError.
    """
    if kind not in KINDS:
        raise UnknownNameError("kind of a link's mesh", kind, KINDS)
    links = {element.get("name", ""): element for element in root.findall("link")}
    if link not in links:
        raise UnknownNameError("link", link, links, f" in {urdf.name}")
    where = f" of link {link!r} in {urdf.name}"
    every = [*folders, *urdf.resolve().parents[:-1]]
    shapes = links[link].findall(kind)
    found = [placed(s, every, where) for s in shapes if s.find("geometry/mesh") is not None]
    if not found:
        kinds = [e.tag for shape in shapes for e in shape.findall("geometry/*")]
        raise MeshError(
            f"no {kind} mesh{where}",
            value=", ".join(kinds) or f"no <{kind}>",
            remedy='choose another link, or kind="collision", or a body such as Body.capsule',
        )
    return Triangles.joined(found)


def placed(shape: ET.Element, folders: Iterable[str | Path], where: str) -> Triangles:
    """The triangles, m, link frame, of a shape that is a mesh. Raises MeshError.

    where: appended to messages.
    """
    mesh, origin = shape.find("geometry/mesh"), shape.find("origin")
    assert mesh is not None
    scale = vector(mesh, "scale", "1 1 1", 3, where)
    if not scale.all():
        raise MeshError(f"the scale of the mesh{where} is zero", value=scale.tolist())
    raw = mesh_file.read(find_mesh(mesh.get("filename", ""), folders))
    turn = from_rpy(vector(origin, "rpy", "0 0 0", 3, where))
    vertices = (raw.vertices * scale) @ turn.T + vector(origin, "xyz", "0 0 0", 3, where)
    mirrored = np.prod(scale) < 0.0
    return Triangles(vertices, raw.faces[:, ::-1] if mirrored else raw.faces, raw.names)


def vector(
    element: ET.Element | None,
    key: str,
    default: str,
    size: int,
    where: str,
    error: type[MeshskinError] = MeshError,
) -> Array:
    """The numbers (size,) of an attribute; `default` where it is absent. Raises `error`."""
    text = default if element is None else element.get(key, default)
    try:
        values = np.array([float(part) for part in text.split()])
    except ValueError:
        values = np.array([np.nan])
    if values.shape != (size,) or not np.isfinite(values).all():
        raise error(f"bad {key}{where}", value=repr(text), limit=f"{size} numbers")
    return values


def find_mesh(name: str, folders: Iterable[str | Path]) -> Path:
    """The file that a URDF names by a path, `file://` or `package://`, in one of the `folders`.

    The whole path is tried first, then the path without its first folders. Raises MeshError.
    """
    bare = name.partition("://")[2] or name
    if Path(bare).is_absolute() and Path(bare).is_file():
        return Path(bare)
    parts = PurePosixPath(bare.lstrip("/")).parts
    where = [Path(folder) for folder in folders]
    for k in range(len(parts)):
        for folder in where:
            if (path := folder.joinpath(*parts[k:])).is_file():
                return path
    raise MeshError(
        f"the mesh {name!r} is in none of the folders that are searched",
        remedy="give from_urdf folders=, or [arm] folders in the scene",
    )
