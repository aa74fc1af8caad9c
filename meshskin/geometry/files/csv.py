"""Skin files in CSV: id, position (m), outward normal and quaternion (xyzw) in the body frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ... import se3
from ...atomic import write_text
from ...errors import SkinError

Array = NDArray[np.float64]

COLUMNS = ("id", "x", "y", "z", "nx", "ny", "nz", "qx", "qy", "qz", "qw")
HEAD = "# meshskin skin"


def save(path: Path, poses: Array, ids: NDArray[np.int64], disc_radius: float) -> None:
    """Write poses (n, 4, 4) and ids (n,) to a file that is either whole or not there."""
    rotation = poses[:, :3, :3]
    table = np.column_stack([poses[:, :3, 3], rotation[:, :, 2], se3.quaternion(rotation)])
    lines = [f"{HEAD}, disc_radius_m={disc_radius!r}", ",".join(COLUMNS)]
    for name, row in zip(ids.tolist(), table.tolist(), strict=True):
        lines.append(",".join([str(name), *(repr(value) for value in row)]))
    write_text(path, "\n".join(lines) + "\n")


def load(path: Path) -> tuple[Array, NDArray[np.int64], float]:
    """Poses (n, 4, 4), ids (n,) and the disc radius (m) of a file; SkinError where it is none."""
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise SkinError("a skin file cannot be read", value=str(error)) from error
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    head = [line for line in lines if line.startswith("#")]
    body = [line for line in lines if not line.startswith("#")]
    if not body or tuple(field.strip() for field in body[0].split(",")) != COLUMNS:
        raise SkinError(
            f"{path.name} is no skin file",
            value=repr(body[0][:60]) if body else "no lines",
            limit=f"columns {','.join(COLUMNS)}",
        )
    rows = [_row(path, k, line) for k, line in enumerate(body[1:], start=1)]
    if not rows:
        raise SkinError(f"{path.name} holds no taxels")
    ids = np.array([row[0] for row in rows], dtype=np.int64)
    if len(np.unique(ids)) < len(ids):
        raise SkinError(f"{path.name} names a taxel twice", value=_first_double(ids))
    table = np.array([row[1] for row in rows])
    return _poses(path, table), ids, _disc_radius(path, head)


def _row(path: Path, number: int, line: str) -> tuple[int, list[float]]:
    fields = line.split(",")
    try:
        values = [float(field) for field in fields[1:]]
        name = int(fields[0])
    except ValueError as error:
        raise SkinError(f"{path.name}, taxel line {number}", value=str(error)) from error
    if len(fields) != len(COLUMNS) or not np.isfinite(values).all():
        raise SkinError(
            f"{path.name}, taxel line {number}",
            value=repr(line[:60]),
            limit=f"{len(COLUMNS)} finite numbers",
        )
    return name, values


def _poses(path: Path, table: Array) -> Array:
    from scipy.spatial.transform import Rotation

    quaternion = table[:, 6:]
    length = np.linalg.norm(quaternion, axis=1)
    if np.any(np.abs(length - 1.0) > 1e-3):
        worst = int(np.argmax(np.abs(length - 1.0)))
        raise SkinError(
            f"{path.name}, taxel line {worst + 1}: length of the quaternion",
            value=f"{length[worst]:.4g}",
            limit="1",
        )
    rotation = Rotation.from_quat(quaternion).as_matrix()
    off = np.linalg.norm(rotation[:, :, 2] - table[:, 3:6], axis=1)
    if np.any(off > 1e-3):
        worst = int(np.argmax(off))
        raise SkinError(
            f"{path.name}, taxel line {worst + 1}: normal and quaternion disagree",
            value=f"{off[worst]:.3g}",
            limit="1e-3",
        )
    return se3.transform(rotation, table[:, :3])


def _disc_radius(path: Path, head: list[str]) -> float:
    for line in head:
        _, found, value = line.partition("disc_radius_m=")
        if found:
            try:
                return float(value)
            except ValueError as error:
                raise SkinError(f"{path.name}: disc radius", value=repr(value)) from error
    return 2e-3


def _first_double(ids: NDArray[np.int64]) -> int:
    values, counts = np.unique(ids, return_counts=True)
    return int(values[counts > 1][0])
