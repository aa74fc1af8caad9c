"""File formats of skins, one a module; the format of a file is recognized by its content."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from xml.etree import ElementTree

import numpy as np

from ...core.arguments import check_path
from ...core.atomic_io import atomic
from ...core.errors import SkinError, reason
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
from .table import SkinRows, SkinTable, damaged

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
    """The rows of a skin file of any format; `part` chooses one of the skins of a URDF or MJCF.

    Raises SkinError where it cannot be read, and for a part of a file of another format.
    """
    path = check_path("a skin file", path, error=SkinError)
    if not path.is_file():
        raise SkinError("no such skin file", value=str(path), remedy="check the path")
    with np.errstate(invalid="ignore"):  # numbers that are not finite are found in the table
        table = _read(_content(path), path.name, part)
    if not 0.0 < table.disc_radius < np.inf:
        raise damaged(f"{path.name}: radius of the discs", table.disc_radius, "> 0 m")
    return table


def has_parts(path: Path) -> bool:
    """Whether a skin file is of a format that holds several skins."""
    return path.is_file() and _is_xml(_content(path))


def _content(path: Path) -> bytes | str:
    """The text of a file, or the bytes of a binary format. Raises SkinError."""
    try:
        data = path.read_bytes()
        return data if data.startswith((b"glTF", b"PK")) else data.decode("utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        raise SkinError(
            f"{path.name} is not a skin file",
            value="binary data" if isinstance(error, UnicodeDecodeError) else reason(error),
            limit=f"one of {', '.join(FORMATS)}",
            remedy="give another file",
        ) from error


def _is_xml(content: bytes | str) -> bool:
    return isinstance(content, str) and content.lstrip().startswith("<")


def _read(content: bytes | str, name: str, part: str | None) -> SkinTable:
    """The rows of the content of a file. Raises SkinError."""
    if part is not None and not _is_xml(content):
        raise SkinError(
            f"{name} holds one skin",
            value=f"part {part!r}",
            limit="several are in URDF and MJCF files only",
            remedy="leave part= (--part) out",
        )
    if isinstance(content, bytes):
        return (glb if content.startswith(b"glTF") else npz).read(content, name)
    if content.startswith("ply"):
        return ply.read(content, name)
    if _is_xml(content):
        return _read_xml(content, name, part)
    if ros_transforms.HEAD in content.splitlines():
        return ros_transforms.read(content, name)
    if idyntree.MARK in content:
        return idyntree.read(content, name)
    if "[SENSORS]" in content:
        return icub_layout.read(content, name)
    if "[calibration]" in content or "taxel2Repr" in content or _starts_with_six_numbers(content):
        return icub.read(content, name)
    return csv.read(content, name)


def _read_xml(text: str, name: str, part: str | None) -> SkinTable:
    """The rows of a URDF or MJCF. Raises SkinError."""
    try:
        keep = ElementTree.TreeBuilder(insert_comments=True)  # they hold the sigmas
        root = ElementTree.fromstring(text, ElementTree.XMLParser(target=keep))
    except ElementTree.ParseError as error:
        raise damaged(f"{name} is not XML", error) from error
    if root.tag == "mujoco":
        return mjcf.read(root, name, part)
    return (urdf_tactile if urdf_tactile.sensors(root) else urdf).read(root, name, part)


def check_format(kind: str) -> None:
    """Raise SkinError unless `kind` is one of FORMATS."""
    if kind.lower() not in FORMATS:
        raise SkinError(
            "unknown format of a skin file", value=kind, remedy=f"known: {', '.join(FORMATS)}"
        )


def check_frames(kind: str, link: str | None, parent: str | None) -> None:
    """Raise SkinError where files of a kind cannot hold the names of these links; None: none."""
    if parent is not None and FORMATS[kind] not in (urdf, urdf_tactile):
        raise SkinError(
            f"a {kind} file cannot name a parent link",
            value=parent,
            remedy="write urdf or urdf_tactile, or omit parent",
        )
    if parent is not None and parent == link:
        raise SkinError("a link cannot be its own parent", value=link, remedy="name another one")
    for frame in filter(None, (link, parent)):
        if not frame.isprintable() or frame != frame.strip():
            raise SkinError(
                "the name of a frame must be printable, without spaces around it",
                value=repr(frame),
                remedy="give another link",
            )


def write(path: Path, kind: str, rows: SkinRows) -> None:
    """Write a skin atomically, as `kind`: one of FORMATS. Raises SkinError, OutputError."""
    check_format(kind)
    check_frames(kind, rows.link, rows.parent)
    module = FORMATS[kind]
    if not len(rows.ids):
        raise SkinError("a skin without taxels cannot be written", remedy="add taxels")
    lost = ~np.isfinite(rows.poses[:, :3, 3]).all(axis=1)
    if lost.any():
        taxel = int(rows.ids[lost][0])
        raise SkinError("a taxel has no position", value=f"taxel {taxel}", remedy="leave it out")
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
