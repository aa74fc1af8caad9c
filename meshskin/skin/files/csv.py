"""Skin files in CSV: id, position (m), outward normal and quaternion (xyzw) in the body frame."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...core import se3
from ...core.errors import SkinError
from .table import DISC_RADIUS, Table

Array = NDArray[np.float64]

COLUMNS = ("id", "x", "y", "z", "nx", "ny", "nz", "qx", "qy", "qz", "qw")
HEAD = "# meshskin skin"


def write(poses: Array, ids: NDArray[np.int64], disc_radius: float) -> str:
    """Text of poses (n, 4, 4) and ids (n,), exact to the last bit of positions and normals."""
    rotation = poses[:, :3, :3]
    table = np.column_stack([poses[:, :3, 3], rotation[:, :, 2], se3.quaternion(rotation)])
    lines = [f"{HEAD}, disc_radius_m={float(disc_radius)!r}", ",".join(COLUMNS)]
    for name, row in zip(ids.tolist(), table.tolist(), strict=True):
        lines.append(",".join([str(name), *(repr(value) for value in row)]))
    return "\n".join(lines) + "\n"


def read(text: str, name: str) -> Table:
    """What a file's text says; SkinError where it is no such file. `name` is the file's."""
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    head = [line for line in lines if line.startswith("#")]
    body = [line for line in lines if not line.startswith("#")]
    if not body or tuple(field.strip() for field in body[0].split(",")) != COLUMNS:
        raise SkinError(
            f"{name} is no skin file",
            value=repr(body[0][:60]) if body else "no lines",
            limit=f"columns {','.join(COLUMNS)}",
        )
    rows = [_row(name, k, line) for k, line in enumerate(body[1:], start=1)]
    if not rows:
        raise SkinError(f"{name} holds no taxels")
    table = np.array([row[1] for row in rows])
    return Table(
        "csv",
        np.array([row[0] for row in rows], dtype=np.int64),
        table[:, :3],
        table[:, 3:6],
        table[:, 6:],
        _disc_radius(name, head),
    )


def _row(name: str, number: int, line: str) -> tuple[int, list[float]]:
    fields = line.split(",")
    where = f"{name}, taxel line {number}"
    try:
        values = [float(field) for field in fields[1:]]
        taxel = int(fields[0])
    except ValueError as error:
        raise SkinError(where, value=str(error)) from error
    if len(fields) != len(COLUMNS):
        raise SkinError(where, value=repr(line[:60]), limit=f"{len(COLUMNS)} numbers")
    return taxel, values


def _disc_radius(name: str, head: list[str]) -> float:
    for line in head:
        _, found, value = line.partition("disc_radius_m=")
        if found:
            try:
                return float(value)
            except ValueError as error:
                raise SkinError(f"{name}: disc radius", value=repr(value)) from error
    return DISC_RADIUS
