"""iCub position files: a header, then one row `x y z nx ny nz` for each slot (m, link frame).

A row of zeros is a slot without taxel. taxel2Repr gives for each slot the taxel that represents its
module, or -1 or -2 where there is no taxel. A file without header holds taxels only, ten a module
or without modules. Source of the format: icub-main, app/skinGui/conf.
"""

from __future__ import annotations

import re

import numpy as np

from ...core.arrays import Array
from ..slots import CENTRE, OFFSETS, PER_MODULE, TAXELS, THERMAL, is_modular
from .table import SkinRows, SkinTable, check_ids, damaged, parse_id, parse_numbers

SHAPE_TOLERANCE = 0.2e-3
"""Largest difference, m, between distances of taxels in a file without header and in a module, for
the file to be read as modules. Positions rounded to 0.1 mm change distances by up to 0.17 mm."""
MAX_SLOTS = 10_000_000
"""Largest number of rows that are written, one a slot: 1 GB of text."""
NO_MODULE, NO_TAXEL = -1, -2
"""Entries of taxel2Repr for a slot of an absent module, and for a thermal pad."""


def read(text: str, name: str) -> SkinTable:
    """The slots of a file that are not empty. Raises SkinError, with the line, for a bad line."""
    header: dict[str, str] = {}
    listed: list[Array] = []
    for number, line in enumerate(text.splitlines(), start=1):
        fields = line.split()
        if not fields or line.startswith(("#", "[")):
            continue
        if not listed and re.match(r"[A-Za-z]\w*\s", line) and fields[0].lower() != "nan":
            key, _, value = line.strip().replace("\t", " ").partition(" ")
            header[key] = value.strip()
            continue
        listed.append(parse_numbers(fields, 6, f"{name}, line {number}", "x y z nx ny nz"))
    rows = np.array(listed).reshape(-1, 6)
    filled = np.flatnonzero(np.any(rows != 0.0, axis=1))  # NaN is not zero
    if not len(filled):
        raise damaged(
            f"{name} holds no taxels",
            "only rows of zeros" if listed else "no rows",
            remedy="write a row for each: x y z nx ny nz",
        )
    ids = filled.astype(np.int64)
    if not header and _is_packed(rows):
        ids = np.add.outer(PER_MODULE * np.arange(len(rows) // len(TAXELS)), TAXELS).ravel()
    where = f"{name}: taxel2Repr"
    listed_slots = re.findall(r"-?\d+", header.get("taxel2Repr", ""))
    representative = np.array([parse_id(text, where) for text in listed_slots], np.int64)
    sigmas = None
    if "sigma_m" in header:
        listed_sigmas = header["sigma_m"].strip("() ").split()
        sigmas = parse_numbers(listed_sigmas, len(rows), f"{name}: sigma_m")[filled]
        sigmas[sigmas == 0.0] = np.nan
    return SkinTable(
        "icub",
        ids,
        rows[filled, :3],
        rows[filled, 3:],
        slots=len(rows) if header else None,
        representative=representative if "taxel2Repr" in header else None,
        sigmas=sigmas,
        frame=header.get("name"),
    )


def write(skin: SkinRows) -> str:
    """Text of the rows: positions to 1 nm, normals to 1e-9.

    The name is that of the frame; sigmas are an entry of the header, which readers of the format
    skip. The rotation about the normal and the disc's radius are not part of it. Raises SkinError
    for an id that cannot be the number of a row.
    """
    ids, poses = skin.ids, skin.poses
    check_ids(ids, "position", 0, MAX_SLOTS - 1)
    count = PER_MODULE * (int(ids.max()) // PER_MODULE + 1)
    rows = np.zeros((count, 6))
    rows[ids] = np.column_stack([poses[:, :3, 3], np.nan_to_num(poses[:, :3, 2])])
    representative = np.full(count, NO_MODULE)
    representative[ids] = ids
    if is_modular(ids):
        centre = PER_MODULE * (ids // PER_MODULE)
        representative[ids] = centre + CENTRE
        for pad in THERMAL:
            representative[centre + pad] = NO_TAXEL
    texts = ["0"] * count
    for taxel, text in zip(ids.tolist(), skin.sigma_texts(), strict=True):
        texts[taxel] = text or "0"
    lines = [
        f"name\t{skin.link}",
        "spatial_sampling\ttaxel",
        f"taxel2Repr ( {' '.join(map(str, representative.tolist()))} )",
        *([] if skin.sigmas is None else [f"sigma_m ( {' '.join(texts)} )"]),
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
