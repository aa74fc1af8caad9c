"""iCub position files: a header, then one row `x y z nx ny nz` for each slot (m, link frame).

A row of zeros is a slot without taxel. taxel2Repr gives for each slot the taxel that represents its
module, or -1 or -2 where there is no taxel. A file without header holds taxels only, ten a module
or without modules. Source of the format: icub-main, app/skinGui/conf.
"""

from __future__ import annotations

import re
from dataclasses import dataclass

import numpy as np

from ...core.arrays import Array
from ...core.errors import SkinError
from ..slots import CENTRE, OFFSETS, PER_MODULE, TAXELS, THERMAL, Ids, is_modular
from .table import SkinTable, parse_numbers

SHAPE_TOLERANCE = 0.2e-3
"""Largest difference, m, between distances of taxels in a file without header and in a module, for
the file to be read as modules. Positions rounded to 0.1 mm change distances by up to 0.17 mm."""
MAX_SLOTS = 10_000_000
"""Largest number of rows that are written, one a slot: 1 GB of text."""
NO_MODULE, NO_TAXEL = -1, -2
"""Entries of taxel2Repr for a slot of an absent module, and for a thermal pad."""


@dataclass(frozen=True, eq=False)
class PositionFile:
    """A position file line for line."""

    header: tuple[tuple[str, str], ...]
    """lines before the rows as key and value: name, spatial_sampling, taxel2Repr, ..."""
    rows: Array
    """(slots, 6) position, m, and normal, as written"""

    @property
    def representative(self) -> Ids | None:
        """(k,) taxel2Repr, if the file has it."""
        text = dict(self.header).get("taxel2Repr")
        return None if text is None else np.array(re.findall(r"-?\d+", text), dtype=np.int64)


def parse(text: str, name: str) -> PositionFile:
    """The lines of a file. Raises SkinError, with the line, where one cannot be read."""
    header: list[tuple[str, str]] = []
    rows: list[Array] = []
    for number, line in enumerate(text.splitlines(), start=1):
        fields = line.split()
        if not fields or line.startswith(("#", "[")):
            continue
        if not rows and re.match(r"[A-Za-z]\w*\s", line) and fields[0].lower() != "nan":
            key, _, value = line.strip().replace("\t", " ").partition(" ")
            header.append((key, value.strip()))
            continue
        rows.append(parse_numbers(fields, 6, f"{name}, line {number}", "x y z nx ny nz"))
    if not rows:
        raise SkinError(f"{name} holds no taxels")
    return PositionFile(tuple(header), np.array(rows))


def read(text: str, name: str) -> SkinTable:
    """The slots of a file that are not empty. Raises SkinError."""
    file = parse(text, name)
    rows = file.rows
    filled = np.flatnonzero(np.any(rows != 0.0, axis=1))  # NaN is not zero
    if not len(filled):
        raise SkinError(f"{name} holds no taxels", value="only rows of zeros")
    ids = filled.astype(np.int64)
    if not file.header and _is_packed(rows):
        ids = np.add.outer(PER_MODULE * np.arange(len(rows) // len(TAXELS)), TAXELS).ravel()
    return SkinTable(
        "icub",
        ids,
        rows[filled, :3],
        rows[filled, 3:],
        slots=len(rows) if file.header else None,
        representative=file.representative,
    )


def write(poses: Array, ids: Ids, disc_radius: float, name: str) -> str:
    """Text of poses (n, 4, 4) and ids (n,): positions to 1 nm, normals to 1e-9.

    The rotation about the normal and the disc's radius are not part of the format. Raises SkinError
    for an id that cannot be the number of a row.
    """
    for worst in (int(ids.min()), int(ids.max())):
        if not 0 <= worst < MAX_SLOTS:
            limit = f"0 to {MAX_SLOTS - 1}"
            raise SkinError("id of a taxel in a position file", value=worst, limit=limit)
    count = PER_MODULE * (int(ids.max()) // PER_MODULE + 1)
    rows = np.zeros((count, 6))
    rows[ids] = np.nan_to_num(np.column_stack([poses[:, :3, 3], poses[:, :3, 2]]))
    representative = np.full(count, NO_MODULE)
    representative[ids] = ids
    if is_modular(ids):
        centre = PER_MODULE * (ids // PER_MODULE)
        representative[ids] = centre + CENTRE
        for pad in THERMAL:
            representative[centre + pad] = NO_TAXEL
    lines = [
        f"name\t{name}",
        "spatial_sampling\ttaxel",
        f"taxel2Repr ( {' '.join(map(str, representative.tolist()))} )",
        "[calibration]",
    ]
    lines += [" ".join(f"{value:.9f}" for value in row) for row in rows.tolist()]
    return "\n".join(lines) + "\n"


def _is_packed(rows: Array) -> bool:
    """Whether rows (n, 6) are modules of ten taxels, without rows for thermal pads."""
    if len(rows) % len(TAXELS) or not np.isfinite(rows).all():
        return False
    points = rows[:, :3].reshape(-1, len(TAXELS), 3)
    distances = np.linalg.norm(points[:, :, None] - points[:, None], axis=3)
    flat = OFFSETS[list(TAXELS)]
    ideal = np.linalg.norm(flat[:, None] - flat[None], axis=2)
    return bool(np.max(np.abs(distances - ideal)) < SHAPE_TOLERANCE)
