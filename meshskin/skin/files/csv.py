"""Skin files in CSV: id, position (m), outward normal, quaternion (xyzw) in the frame that the
first line names, and the standard deviation of the position (m) where known."""

from __future__ import annotations

import numpy as np

from ...core import se3
from .table import (
    DISC_RADIUS,
    SkinRows,
    SkinTable,
    damaged,
    parse_id,
    parse_numbers,
    parse_sigmas,
)

COLUMNS = ("id", "x", "y", "z", "nx", "ny", "nz", "qx", "qy", "qz", "qw")
HEADER = "# meshskin skin"
_RADIUS, _FRAME, _SIGMA = "disc_radius_m=", "frame=", "sigma"


def write(rows: SkinRows) -> str:
    """Text of the rows, exact to the last bit of positions and normals."""
    rotation = rows.poses[:, :3, :3]
    table = np.column_stack([rows.poses[:, :3, 3], rotation[:, :, 2], se3.quaternion(rotation)])
    known = rows.sigmas is not None
    head = f"{HEADER}, {_RADIUS}{float(rows.disc_radius)!r}, {_FRAME}{rows.link}"
    lines = [head, ",".join([*COLUMNS, *([_SIGMA] if known else [])])]
    for taxel, row, sigma in zip(
        rows.ids.tolist(), table.tolist(), rows.sigma_texts(), strict=True
    ):
        lines.append(",".join([str(taxel), *map(repr, row), *([sigma] if known else [])]))
    return "\n".join(lines) + "\n"


def read(text: str, name: str) -> SkinTable:
    """The rows of a file's text; `name` of the file is for errors. Raises SkinError."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    comments = [line for line in lines if line.startswith("#")]
    body = [line for line in lines if not line.startswith("#")]
    columns = tuple(field.strip() for field in body[0].split(",")) if body else ()
    if columns not in (COLUMNS, (*COLUMNS, _SIGMA)):
        raise damaged(
            f"{name} is not a skin file",
            repr(body[0][:60]) if body else "no lines",
            f"columns {','.join(COLUMNS)}",
            "give a file of a format that Skin.save writes, or of iCub",
        )
    if len(body) < 2:
        raise damaged(f"{name} holds no taxels", remedy="add a line for each")
    ids, rows, sigmas = [], [], []
    for number, line in enumerate(body[1:], start=1):
        taxel, *fields = line.split(",")
        where = f"{name}, taxel line {number}"
        sigmas.append(fields.pop() if len(columns) == len(fields) + 1 > len(COLUMNS) else "")
        rows.append(parse_numbers(fields, len(COLUMNS) - 1, where, f"{len(COLUMNS)} columns"))
        ids.append(parse_id(taxel, where))
    table = np.array(rows)
    head = [line.partition(_RADIUS)[2].partition(", " + _FRAME) for line in comments]
    radii = [radius for radius, _, _ in head if radius]
    radius = parse_numbers(radii[:1], 1, f"{name}: disc radius")[0] if radii else DISC_RADIUS
    return SkinTable(
        "csv",
        np.array(ids, dtype=np.int64),
        table[:, :3],
        table[:, 3:6],
        table[:, 6:],
        float(radius),
        sigmas=parse_sigmas(sigmas, name),
        frame=next((frame for _, _, frame in head if frame), None),
    )
