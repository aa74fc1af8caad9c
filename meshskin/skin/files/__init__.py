"""File formats of bodies and skins, one a module; skin files are told apart by their content."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...core.atomic_io import atomic, write_text
from ...core.errors import SkinError
from . import csv, glb, icub, icub_layout, idyntree, ply, urdf
from .table import Table

FORMATS = {"csv": "csv", "txt": "icub", "icub": "icub", "urdf": "urdf", "ply": "ply", "glb": "glb"}
"""formats that are written, by suffix or name"""
UNTURNED = ("icub",)
"""formats that hold normals only, which may be missing"""


def read(path: Path, part: str | None = None) -> Table:
    """What a skin file says, whatever its format; `part` chooses one of a URDF's skins.

    Raises SkinError where it cannot be read.
    """
    if not path.is_file():
        raise SkinError("no such skin file", value=str(path))
    try:
        data = path.read_bytes()
        if data.startswith(b"glTF"):
            return glb.read(data, path.name)
        text = data.decode("utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SkinError(f"{path.name} is no skin file", value=str(error)) from error
    if text.startswith("ply"):
        return ply.read(text, path.name)
    if text.lstrip().startswith("<"):
        return urdf.read(text, path.name, part)
    if idyntree.MARK in text:
        return idyntree.read(text, path.name)
    if "[SENSORS]" in text:
        return icub_layout.read(text, path.name)
    if "[calibration]" in text or "taxel2Repr" in text or _is_rows(text):
        return icub.read(text, path.name)
    return csv.read(text, path.name)


def check_format(kind: str) -> None:
    """Raise SkinError if `kind` is none of FORMATS."""
    if kind.lower() not in FORMATS:
        raise SkinError(
            "format of a skin file", value=kind, remedy=f"formats: {', '.join(FORMATS)}"
        )


def write(
    path: Path, kind: str, poses: NDArray[np.float64], ids: NDArray[np.int64], disc_radius: float
) -> None:
    """Write a skin in one stroke, as `kind`: one of FORMATS. Raises SkinError."""
    check_format(kind)
    name = FORMATS[kind]
    bare = int(np.isnan(poses).any(axis=(1, 2)).sum())
    if bare and name not in UNTURNED:
        raise SkinError(
            f"taxels without a normal, for a {kind} file",
            value=bare,
            limit="0",
            remedy="a position file (.txt), or take the normals from the body: skin.onto(body)",
        )
    if name == "glb":
        with atomic(path) as temporary:
            temporary.write_bytes(glb.write(poses, ids, disc_radius))
        return
    if name == "icub":
        text = icub.write(poses, ids, path.stem)
    elif name == "urdf":
        text = urdf.write(poses, ids, disc_radius, path.stem)
    elif name == "ply":
        text = ply.write(poses, ids, disc_radius)
    else:
        text = csv.write(poses, ids, disc_radius)
    write_text(path, text)


def _is_rows(text: str) -> bool:
    """Whether the first line that is no comment holds six numbers."""
    lines = (line.split("#")[0].split() for line in text.splitlines())
    first = next((fields for fields in lines if fields), [])
    try:
        return len([float(field) for field in first]) == 6
    except ValueError:
        return False
