"""A defect of a skin, and helpers of the checks that find them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import Array, rows_by_key
from .. import slots
from ..files.table import LAST_DIGIT, SkinTable


@dataclass(frozen=True)
class Defect:
    """One defect of a skin."""

    kind: str
    """name of the check"""
    what: str
    """one sentence with the numbers"""
    remedy: str
    """what to do"""
    taxels: tuple[int, ...] = ()
    """ids of the taxels (or slots) concerned"""
    modules: tuple[int, ...] = ()
    """their modules, if the file has modules"""


def defect(
    table: SkinTable, kind: str, what: str, remedy: str, at: NDArray[np.int64] | None = None
) -> Defect:
    """A defect of the taxels with ids `at` of a table."""
    ids = np.zeros(0, dtype=np.int64) if at is None else np.unique(at)
    modules = np.unique(slots.module(ids)) if has_modules(table) else ids[:0]
    return Defect(kind, what, remedy, tuple(ids.tolist()), tuple(modules.tolist()))


def has_modules(table: SkinTable) -> bool:
    """Whether ids are 12 * module + slot, for some triangular modules at least."""
    if table.slots is None:
        return slots.is_modular(table.ids)
    return bool(table.is_triangular(slots.module(table.ids)).any())


def located(table: SkinTable) -> SkinTable:
    """The taxels with finite positions."""
    return table.take(table.is_taxel() & np.isfinite(table.positions).all(axis=1))


def distinct(table: SkinTable) -> SkinTable:
    """The first row of each distinct position."""
    keep = np.zeros(len(table.ids), dtype=bool)
    keep[distinct_rows(table.positions)] = True
    return table.take(keep)


def distinct_rows(points: Array) -> NDArray[np.intp]:
    """The first row of each of the distinct points (n, 3), in order."""
    first = np.unique(np.round(points / LAST_DIGIT), axis=0, return_index=True)[1]
    return np.sort(first)


def module_rows(ids: NDArray[np.int64]) -> list[NDArray[np.intp]]:
    """Rows of the taxels of each module."""
    order = np.argsort(ids, kind="stable")
    return [order[rows] for rows in rows_by_key(slots.module(ids[order])) if len(rows)]
