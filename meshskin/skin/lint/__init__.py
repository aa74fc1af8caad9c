"""Defects of skin files: each has a name, a description, the taxels concerned and a remedy.

A check takes the rows of a file as written and yields defects.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from ...core.errors import SkinError
from .. import files
from ..files.table import SkinTable
from ..skin import Skin
from . import normals, rows
from .defect import Defect

__all__ = ["CHECKS", "Defect", "check", "lint"]

CHECKS: tuple[Callable[[SkinTable], Iterator[Defect]], ...] = (
    *(rows.not_finite, rows.ids, rows.counts, rows.thermal),
    *(normals.normals, normals.frames, normals.flipped),
    *(rows.duplicates, rows.scale, rows.isolated),
)


def lint(skin: Skin | str | Path, part: str | None = None) -> tuple[Defect, ...]:
    """The defects of a skin, or of a skin file; empty if there are none.

    `part` chooses one of the skins of a URDF or MJCF file. Raises SkinError where a file cannot be
    read, and for a part of anything else.
    """
    if isinstance(skin, Skin):
        if part is not None:
            raise SkinError("part= chooses a skin of a file", value=part, remedy="leave it out")
        table = SkinTable("skin", skin.ids, skin.positions, np.nan_to_num(skin.normals))
    else:
        table = files.read(skin, part)
    return check(table)


def check(table: SkinTable) -> tuple[Defect, ...]:
    """The defects of the rows of a file."""
    return tuple(defect for find in CHECKS for defect in find(table))
