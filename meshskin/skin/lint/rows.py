"""Defects of the rows of a skin file: numbers, ids, slots."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from .. import slots
from ..files.table import SkinTable
from .defect import Defect, defect


def not_finite(table: SkinTable) -> Iterator[Defect]:
    """NaN and infinite numbers."""
    bad = ~np.isfinite(np.column_stack([table.positions, table.normals])).all(axis=1)
    if bad.any():
        what = f"{bad.sum()} rows hold numbers that are not finite"
        yield defect(table, "not finite", what, "measure these taxels again", table.ids[bad])


def ids(table: SkinTable) -> Iterator[Defect]:
    """Repeated and negative ids."""
    values, counts = np.unique(table.ids, return_counts=True)
    twice = values[counts > 1]
    if len(twice):
        what = f"{len(twice)} ids stand for more than one taxel"
        yield defect(table, "duplicate ids", what, "give every taxel an id of its own", twice)
    if np.any(values < 0):
        what = f"{np.sum(values < 0)} ids are negative"
        yield defect(table, "negative ids", what, "count from 0", values[values < 0])


def counts(table: SkinTable) -> Iterator[Defect]:
    """Numbers of slots and entries of taxel2Repr that disagree."""
    if table.slots is None:
        return
    if table.slots % slots.PER_MODULE:
        what = f"{table.slots} rows are not a multiple of {slots.PER_MODULE}"
        yield defect(table, "row count", what, "one row a slot, twelve a module")
    listed = table.representative
    if listed is None:
        what = "taxel2Repr is missing"
        yield defect(table, "no taxel2Repr", what, "list for each slot its module's taxel")
        return
    if len(listed) != table.slots:
        what = f"{table.slots} rows, {len(listed)} entries of taxel2Repr"
        beyond = table.ids[table.ids >= len(listed)]
        remedy = (
            "list the rows beyond the last entry: until then, slots 6 and 10 are taken as thermal"
        )
        if len(listed) > table.slots:
            beyond = np.flatnonzero(listed >= 0)
            beyond = beyond[beyond >= table.slots]
            remedy = "add the rows" if len(beyond) else "remove the entries: they are not taxels"
        yield defect(table, "count", what, remedy, beyond)
    known = np.flatnonzero(listed[: table.slots] >= 0)
    empty = empty_slots(table)
    if len(empty):
        what = f"{len(empty)} slots of taxel2Repr hold no position"
        yield defect(table, "missing", what, "measure them, or list them as -1", empty)
    centre = slots.PER_MODULE * slots.module(known) + slots.CENTRE
    wrong = known[(listed[known] != centre) & table.is_triangular(slots.module(known))]
    if len(wrong):
        what = f"{len(wrong)} slots name another taxel than their module's"
        remedy = "let the entry be 12 * module + 3, as for the rest of the module"
        yield defect(table, "taxel2Repr", what, remedy, wrong)


def empty_slots(table: SkinTable) -> NDArray[np.int64]:
    """Slots (k,) that taxel2Repr lists and whose rows are empty."""
    if table.representative is None or table.slots is None:
        return np.zeros(0, dtype=np.int64)
    return np.setdiff1d(np.flatnonzero(table.representative[: table.slots] >= 0), table.ids)


def thermal(table: SkinTable) -> Iterator[Defect]:
    """Positions in thermal slots (6 and 10), and in slots that are not taxels by taxel2Repr."""
    pads, taxel = table.is_thermal(), table.is_taxel()
    if pads.any():
        what = f"{pads.sum()} thermal slots (6 and 10 of twelve) hold positions"
        remedy = "set their rows to zero: they are not taxels"
        if taxel[pads].any():
            what += f", and taxel2Repr lists {taxel[pads].sum()} of them as taxels"
            remedy = "zero rows and -2 in taxel2Repr, unless the modules are of the first kind (12)"
        yield defect(table, "thermal", what, remedy, table.ids[pads])
    other = ~taxel & ~pads
    if other.any():
        what = f"{other.sum()} slots hold positions where taxel2Repr has no taxel"
        yield defect(
            table,
            "unlisted",
            what,
            "list them in taxel2Repr, or set the rows to zero",
            table.ids[other],
        )
