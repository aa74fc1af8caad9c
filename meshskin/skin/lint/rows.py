"""Defects of the rows of a skin file: numbers, ids, slots, and positions of taxels."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from ...core.arrays import median_spacing, neighbour_distances
from .. import slots
from ..files.table import LAST_DIGIT, SkinTable
from .defect import Defect, defect, distinct, distinct_rows, has_modules, located, module_rows

MIN_SPACING, MAX_SPACING = 0.2e-3, 0.1
"""Range of the median distance between nearest neighbours of a skin in metres, m: taxels in mm are
a thousand times farther apart."""
MAX_EXTENT = 5.0
"""Largest extent of a skin, m: larger than a robot."""
ISOLATED = 5.0
"""Distance to the nearest taxel, in medians over the skin, above which a taxel is isolated. In a
layout it scatters by less than 8 % (tests/skin/test_skin.py)."""
MODULE_RADIUS = slots.SIDE
"""Largest distance of a taxel from the centre of its module, m: in a module it is at most 12 mm."""


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


def duplicates(table: SkinTable) -> Iterator[Defect]:
    """Taxels at the same position."""
    rows = located(table)
    pairs = KDTree(rows.positions).query_pairs(LAST_DIGIT, output_type="ndarray")
    if len(pairs):
        at = np.unique(pairs)
        distinct = len(distinct_rows(rows.positions))
        what = f"{len(rows.ids)} taxels at {distinct} distinct positions: {len(at)} share theirs"
        remedy = "set these taxels' positions, from CAD or by calibration"
        yield defect(table, "duplicate positions", what, remedy, rows.ids[at])


def scale(table: SkinTable) -> Iterator[Defect]:
    """Lengths that are not in metres."""
    points = distinct(located(table)).positions
    if len(points) < 2:
        return
    near, extent = median_spacing(points), float(np.ptp(points, axis=0).max())
    what = f"taxels are {near:.3g} m apart, the skin {extent:.3g} m wide"
    if near > MAX_SPACING or extent > MAX_EXTENT:
        yield defect(
            table,
            "unit",
            f"{what}: millimetres?",
            "positions are in m: Skin.load(path, units='mm')",
        )
    elif near < MIN_SPACING:
        yield defect(table, "unit", f"{what}: kilometres?", "positions are in m")


def isolated(table: SkinTable) -> Iterator[Defect]:
    """Taxels far from all others, or from the others of their module."""
    rows = distinct(located(table))
    if len(rows.ids) < 4:
        return
    near = neighbour_distances(rows.positions)
    usual = float(np.median(near))
    far = near > ISOLATED * usual
    if far.any():
        what = f"{far.sum()} taxels lie {1e3 * near[far].min():.3g} mm and more from any other; "
        what += f"half of all have one within {1e3 * usual:.3g} mm"
        yield defect(table, "isolated", what, "check their positions", rows.ids[far])
    if not has_modules(table):
        return
    rows = rows.take(table.is_triangular(slots.module(rows.ids)))
    wide = []
    for own in module_rows(rows.ids):
        off = rows.positions[own] - np.median(rows.positions[own], axis=0)
        wide += own[np.linalg.norm(off, axis=1) > MODULE_RADIUS].tolist()
    if wide:
        radius = f"{1e3 * MODULE_RADIUS:g} mm"
        what = f"{len(wide)} taxels lie more than {radius} from the centre of their module"
        yield defect(table, "off module", what, "check their positions and ids", rows.ids[wide])
