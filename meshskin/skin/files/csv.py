"""Skin files in CSV: id, position (m), outward normal, quaternion (xyzw) in the frame that the
first line names, and the standard deviation of the position (m) where known."""

from __future__ import annotations

import numpy as np

from ...core import se3
from . import table

COLUMNS = ("id", "x", "y", "z", "nx", "ny", "nz", "qx", "qy", "qz", "qw")
HEADER = "# meshskin skin"
_RADIUS, _FRAME, _SIGMA = "disc_radius_m=", "frame=", "sigma"


def write(rows: table.SkinRows) -> str:
    """Text of the rows, exact to the last bit of positions and normals."""
    rotation = rows.poses[:, :3, :3]
    numbers = np.column_stack([rows.poses[:, :3, 3], rotation[:, :, 2], se3.quaternion(rotation)])
    known = rows.sigmas is not None
    head = f"{HEADER}, {_RADIUS}{float(rows.disc_radius)!r}, {_FRAME}{rows.link}"
    lines = [head, ",".join([*COLUMNS, *([_SIGMA] if known else [])])]
    for (taxel, _, sigma), row in zip(rows.each(), numbers.tolist(), strict=True):
        lines.append(",".join([str(taxel), *map(repr, row), *([sigma] if known else [])]))
    return "\n".join(lines) + "\n"


def read(text: str, name: str) -> table.SkinTable:
    """The rows of a file's text; `name` of the file is for errors. Raises SkinError."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    comments = [line for line in lines if line.startswith("#")]
    body = [line for line in lines if not line.startswith("#")]
    columns = tuple(field.strip() for field in body[0].split(",")) if body else ()
    if columns not in (COLUMNS, (*COLUMNS, _SIGMA)):
        raise table.damaged(
            f"{name} is not a skin file",
            repr(body[0][:60]) if body else "no lines",
            f"columns {','.join(COLUMNS)}",
            "give a file of a format that Skin.save writes, or of iCub",
        )
    if len(body) < 2:
        raise table.damaged(f"{name} holds no taxels", remedy="add a line for each")
    ids, rows, sigmas = [], [], []
    for number, line in enumerate(body[1:], start=1):
        taxel, *fields = line.split(",")
        where = f"{name}, taxel line {number}"
        sigmas.append(fields.pop() if len(columns) == len(fields) + 1 > len(COLUMNS) else "")
        rows.append(table.parse_numbers(fields, len(COLUMNS) - 1, where, f"{len(COLUMNS)} columns"))
        ids.append(table.parse_id(taxel, where))
    numbers = np.array(rows)
    head = [line.partition(_RADIUS)[2].partition(", " + _FRAME) for line in comments]
    radii = [radius for radius, _, _ in head if radius] or [repr(table.DISC_RADIUS)]
    radius = table.parse_numbers(radii[:1], 1, f"{name}: disc radius")[0]
    return table.SkinTable(
        "csv",
        np.array(ids, dtype=np.int64),
        numbers[:, :3],
        numbers[:, 3:6],
        numbers[:, 6:],
        float(radius),
        sigmas=table.parse_sigmas(sigmas, name),
        frame=next((frame for _, _, frame in head if frame), None),
    )
