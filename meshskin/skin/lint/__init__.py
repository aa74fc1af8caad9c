"""What is wrong with a skin file: named defects, with the taxels at fault and a remedy.

Each check takes the rows of a file as they are written and gives what it finds.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from .. import files
from ..files.table import Table
from ..skin import Skin
from . import normals, places, rows
from .finding import Finding

__all__ = ["CHECKS", "Finding", "check", "lint"]

CHECKS: tuple[Callable[[Table], Iterator[Finding]], ...] = (
    *(rows.not_finite, rows.ids, rows.counts, rows.thermal),
    *(normals.normals, normals.frames, normals.turned),
    *(places.duplicates, places.scale, places.alone),
)


def lint(skin: Skin | str | Path, part: str | None = None) -> tuple[Finding, ...]:
    """What is wrong with a skin, or with a skin file; empty where nothing is.

    `part` chooses one of a URDF's skins. Raises SkinError where a file cannot be read.
    """
    if isinstance(skin, Skin):
        table = Table("skin", skin.ids, skin.positions, np.nan_to_num(skin.normals))
    else:
        table = files.read(Path(skin), part)
    return check(table)


def check(table: Table) -> tuple[Finding, ...]:
    """What is wrong with the rows of a file."""
    return tuple(finding for find in CHECKS for finding in find(table))
