"""Defects of the positions of taxels."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial import KDTree

from .. import slots
from ..files.table import SkinTable
from .defect import (
    SAME_POSITION,
    Array,
    Defect,
    defect,
    distinct,
    distinct_rows,
    has_modules,
    located,
    module_rows,
)

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


def duplicates(table: SkinTable) -> Iterator[Defect]:
    """Taxels at the same position."""
    rows = located(table)
    pairs = KDTree(rows.positions).query_pairs(SAME_POSITION, output_type="ndarray")
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
    near, extent = float(np.median(_nearest(points))), float(np.ptp(points, axis=0).max())
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
    near = _nearest(rows.positions)
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


def _nearest(points: Array) -> Array:
    """Distance (n,) of each point to the nearest other, m."""
    return np.asarray(KDTree(points).query(points, k=2)[0][:, 1])
