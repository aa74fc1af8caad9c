"""What is wrong with the rows of a skin file: numbers, names, slots."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from .. import slots
from ..files.table import Table
from .finding import Finding, finding


def not_finite(table: Table) -> Iterator[Finding]:
    """NaN and infinity."""
    bad = ~np.isfinite(np.column_stack([table.positions, table.normals])).all(axis=1)
    if bad.any():
        what = f"{bad.sum()} rows hold numbers that are not finite"
        yield finding(table, "not finite", what, "measure these taxels again", table.ids[bad])


def ids(table: Table) -> Iterator[Finding]:
    """Taxels named twice, and names below zero."""
    values, counts = np.unique(table.ids, return_counts=True)
    twice = values[counts > 1]
    if len(twice):
        what = f"{len(twice)} ids stand for more than one taxel"
        yield finding(table, "duplicate ids", what, "give every taxel an id of its own", twice)
    if np.any(values < 0):
        what = f"{np.sum(values < 0)} ids are negative"
        yield finding(table, "negative ids", what, "count from 0", values[values < 0])


def counts(table: Table) -> Iterator[Finding]:
    """Slots and taxel2Repr that do not go together."""
    if table.slots is None:
        return
    if table.slots % slots.PER_MODULE:
        what = f"{table.slots} rows are no multiple of {slots.PER_MODULE}"
        yield finding(table, "row count", what, "one row a slot, twelve a module")
    listed = table.representative
    if listed is None:
        what = "taxel2Repr is missing"
        yield finding(table, "no taxel2Repr", what, "list for each slot its module's taxel")
        return
    if len(listed) != table.slots:
        what = f"{table.slots} rows, {len(listed)} entries of taxel2Repr"
        beyond = table.ids[table.ids >= len(listed)]
        remedy = "list the rows beyond the last entry: till then, slots 6 and 10 tell their taxels"
        if len(listed) > table.slots:
            beyond = np.flatnonzero(listed >= 0)
            beyond = beyond[beyond >= table.slots]
            remedy = "add the rows" if len(beyond) else "drop the entries: they name no taxel"
        yield finding(table, "count", what, remedy, beyond)
    known = np.flatnonzero(listed[: table.slots] >= 0)
    empty = empty_slots(table)
    if len(empty):
        what = f"{len(empty)} slots of taxel2Repr hold no position"
        yield finding(table, "missing", what, "measure them, or list them as -1", empty)
    centre = slots.PER_MODULE * slots.module(known) + slots.CENTRE
    odd = known[(listed[known] != centre) & table.is_triangular(slots.module(known))]
    if len(odd):
        what = f"{len(odd)} slots name another taxel than their module's"
        remedy = "let the entry be 12 * module + 3, as for the rest of the module"
        yield finding(table, "taxel2Repr", what, remedy, odd)


def empty_slots(table: Table) -> NDArray[np.int64]:
    """Slots (k,) that taxel2Repr lists and that hold nothing."""
    if table.representative is None or table.slots is None:
        return np.zeros(0, dtype=np.int64)
    return np.setdiff1d(np.flatnonzero(table.representative[: table.slots] >= 0), table.ids)


def thermal(table: Table) -> Iterator[Finding]:
    """Values in slots 6 and 10, and others that taxel2Repr calls no taxel."""
    pads, taxel = table.is_thermal(), table.is_taxel()
    if pads.any():
        what = f"{pads.sum()} thermal slots (6 and 10 of twelve) hold positions"
        remedy = "set their rows to zero: they are no taxels"
        if taxel[pads].any():
            what += f", and taxel2Repr lists {taxel[pads].sum()} of them as taxels"
            remedy = "zero rows and -2 in taxel2Repr, unless the modules are of the first kind (12)"
        yield finding(table, "thermal", what, remedy, table.ids[pads])
    other = ~taxel & ~pads
    if other.any():
        what = f"{other.sum()} slots hold positions where taxel2Repr has no taxel"
        yield finding(
            table,
            "unlisted",
            what,
            "list them in taxel2Repr, or set the rows to zero",
            table.ids[other],
        )
