"""File formats of skins, one a module; the format of a file is recognized by its content."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from xml.etree import ElementTree

import numpy as np

from ...core.arguments import check_path
from ...core.atomic_io import atomic
from ...core.errors import SkinError
from . import (
    csv,
    glb,
    icub,
    icub_layout,
    idyntree,
    mjcf,
    npz,
    ply,
    ros_transforms,
    urdf,
    urdf_tactile,
)
from .table import SkinRows, SkinTable

FORMATS: dict[str, ModuleType] = {
    "csv": csv,
    "txt": icub,
    "icub": icub,
    "urdf": urdf,
    "urdf_tactile": urdf_tactile,
    "xml": mjcf,
    "mjcf": mjcf,
    "npz": npz,
    "yaml": ros_transforms,
    "ply": ply,
    "glb": glb,
}
"""Modules of the formats that are written, by suffix or name."""


def read(path: str | Path, part: str | None = None) -> SkinTable:
    """The rows of a skin file of any format; `part` chooses one of the skins of a URDF.

    Raises SkinError where it cannot be read.
    """
    path = check_path("a skin file", path, error=SkinError)
    if not path.is_file():
        raise SkinError("no such skin file", value=str(path))
    try:
        data = path.read_bytes()
        if data.startswith(b"glTF"):
            return glb.read(data, path.name)
        if data.startswith(b"PK"):
            return npz.read(data, path.name)
        text = data.decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SkinError(
            f"{path.name} is not a skin file",
            value="binary data" if isinstance(error, UnicodeDecodeError) else str(error),
            limit=f"one of {', '.join(FORMATS)}",
        ) from error
    if text.startswith("ply"):
        return ply.read(text, path.name)
    if text.lstrip().startswith("<"):
        return _read_xml(text, path.name, part)
    if ros_transforms.HEAD in text.splitlines():
        return ros_transforms.read(text, path.name)
    if idyntree.MARK in text:
        return idyntree.read(text, path.name)
    if "[SENSORS]" in text:
        return icub_layout.read(text, path.name)
    if "[calibration]" in text or "taxel2Repr" in text or _starts_with_six_numbers(text):
        return icub.read(text, path.name)
    return csv.read(text, path.name)


def _read_xml(text: str, name: str, part: str | None) -> SkinTable:
    """The rows of a URDF or MJCF. Raises SkinError."""
    try:
        keep = ElementTree.TreeBuilder(insert_comments=True)  # they hold the sigmas
        root = ElementTree.fromstring(text, ElementTree.XMLParser(target=keep))
    except ElementTree.ParseError as error:
        raise SkinError(f"{name} is not XML", value=str(error)) from error
    if root.tag == "mujoco":
        return mjcf.read(root, name, part)
    return (urdf_tactile if urdf_tactile.sensors(root) else urdf).read(root, name, part)


def check_format(kind: str) -> None:
    """Raise SkinError unless `kind` is one of FORMATS."""
    if kind.lower() not in FORMATS:
        raise SkinError(
            "unknown format of a skin file", value=kind, remedy=f"known: {', '.join(FORMATS)}"
        )


def write(path: Path, kind: str, rows: SkinRows) -> None:
    """Write a skin atomically, as `kind`: one of FORMATS. Raises SkinError, OutputError."""
    check_format(kind)
    module = FORMATS[kind]
    if rows.parent is not None and module not in (urdf, urdf_tactile):
        raise SkinError(
            f"a {kind} file cannot name a parent link",
            value=rows.parent,
            remedy="write urdf or urdf_tactile, or omit parent",
        )
    if rows.parent == rows.link:
        raise SkinError("a link cannot be its own parent", value=rows.link)
    bare = int(np.isnan(rows.poses).any(axis=(1, 2)).sum())
    if bare and module is not icub:
        raise SkinError(
            f"taxels without a normal cannot be written to a {kind} file",
            value=bare,
            limit="0",
            remedy="write a position file (.txt), or take the normals from the body: "
            "skin.onto(body)",
        )
    content = module.write(rows)
    with atomic(path) as temporary:
        temporary.write_bytes(content.encode() if isinstance(content, str) else content)


def _starts_with_six_numbers(text: str) -> bool:
    """Whether the first line that is not a comment holds six numbers."""
    lines = (line.split("#")[0].split() for line in text.splitlines())
    first = next((fields for fields in lines if fields), [])
    try:
        return len([float(field) for field in first]) == 6
    except ValueError:
        return False
