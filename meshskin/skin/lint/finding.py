"""A defect of a skin, and what its finders share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .. import slots
from ..files.table import Table

Array = NDArray[np.float64]

SAME = 1e-6
"""m, within which two positions are one"""


@dataclass(frozen=True)
class Finding:
    """One defect of a skin."""

    kind: str
    """the check's name"""
    what: str
    """one sentence with its numbers"""
    remedy: str
    """what to do"""
    taxels: tuple[int, ...] = ()
    """ids of the taxels (or slots) at fault"""
    modules: tuple[int, ...] = ()
    """their modules, where the file has modules"""


def finding(
    table: Table, kind: str, what: str, remedy: str, at: NDArray[np.int64] | None = None
) -> Finding:
    """A finding about the taxels `at` of a table."""
    ids = np.zeros(0, dtype=np.int64) if at is None else np.unique(at)
    modules = np.unique(slots.module(ids)) if modular(table) else ids[:0]
    return Finding(kind, what, remedy, tuple(ids.tolist()), tuple(modules.tolist()))


def modular(table: Table) -> bool:
    """Whether ids are 12 * module + slot, at least of some triangular modules."""
    if table.slots is None:
        return slots.is_modular(table.ids)
    return bool(table.is_triangular(slots.module(table.ids)).any())


def sound(table: Table) -> Table:
    """The taxels whose positions are finite."""
    return table.take(table.is_taxel() & np.isfinite(table.positions).all(axis=1))


def distinct(table: Table) -> Table:
    """One row of every position."""
    keep = np.zeros(len(table.ids), dtype=bool)
    keep[distinct_rows(table.positions)] = True
    return table.take(keep)


def distinct_rows(points: Array) -> NDArray[np.intp]:
    """The first row of each of the distinct points (n, 3), in order."""
    first = np.unique(np.round(points / SAME), axis=0, return_index=True)[1]
    return np.sort(first)


def by_module(ids: NDArray[np.int64]) -> list[NDArray[np.intp]]:
    """The rows of each module."""
    order = np.argsort(ids, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(slots.module(ids[order]))) + 1)
