"""Skin files in CSV: id, position (m), outward normal and quaternion (xyzw) in the body frame."""

from __future__ import annotations

import numpy as np

from ...core import se3
from ...core.arrays import Array
from ...core.errors import SkinError
from ..slots import Ids
from .table import DISC_RADIUS, SkinTable, parse_numbers

COLUMNS = ("id", "x", "y", "z", "nx", "ny", "nz", "qx", "qy", "qz", "qw")
HEADER = "# meshskin skin"
_RADIUS = "disc_radius_m="


def write(poses: Array, ids: Ids, disc_radius: float, name: str) -> str:
    """Text of poses (n, 4, 4) and ids (n,), exact to the last bit of positions and normals."""
    rotation = poses[:, :3, :3]
    table = np.column_stack([poses[:, :3, 3], rotation[:, :, 2], se3.quaternion(rotation)])
    lines = [f"{HEADER}, {_RADIUS}{float(disc_radius)!r}", ",".join(COLUMNS)]
    for taxel, row in zip(ids.tolist(), table.tolist(), strict=True):
        lines.append(",".join([str(taxel), *map(repr, row)]))
    return "\n".join(lines) + "\n"


def read(text: str, name: str) -> SkinTable:
    """The rows of a file's text; `name` of the file is for errors. Raises SkinError."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    comments = [line for line in lines if line.startswith("#")]
    body = [line for line in lines if not line.startswith("#")]
    if not body or tuple(field.strip() for field in body[0].split(",")) != COLUMNS:
        raise SkinError(
            f"{name} is not a skin file",
            value=repr(body[0][:60]) if body else "no lines",
            limit=f"columns {','.join(COLUMNS)}",
        )
    if len(body) < 2:
        raise SkinError(f"{name} holds no taxels")
    ids, rows = [], []
    for number, line in enumerate(body[1:], start=1):
        taxel, *fields = line.split(",")
        where = f"{name}, taxel line {number}"
        rows.append(parse_numbers(fields, len(COLUMNS) - 1, where, f"{len(COLUMNS)} columns"))
        try:
            ids.append(np.int64(int(taxel)))
        except (ValueError, OverflowError) as error:
            raise SkinError(where, value=str(error)) from error
    table = np.array(rows)
    columns = (table[:, :3], table[:, 3:6], table[:, 6:])
    radii = [line.partition(_RADIUS)[2] for line in comments if _RADIUS in line]
    radius = parse_numbers(radii[:1], 1, f"{name}: disc radius")[0] if radii else DISC_RADIUS
    return SkinTable("csv", np.array(ids), *columns, float(radius))
