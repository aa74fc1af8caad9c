"""What is wrong with where taxels are."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from .. import slots
from ..files.table import Table
from .finding import (
    SAME,
    Array,
    Finding,
    by_module,
    distinct,
    distinct_rows,
    finding,
    modular,
    sound,
)

DENSE, SPARSE = 0.2e-3, 0.1
"""m, least and most median distance of nearest neighbours that a skin in metres has"""
LARGE = 5.0
"""m, most extent of a skin"""
ALONE = 5.0
"""median distances of nearest neighbours beyond which a taxel is alone"""
WIDE = slots.SIDE
"""m, most distance of two taxels of a module"""


def duplicates(table: Table) -> Iterator[Finding]:
    """Taxels at one place."""
    from scipy.spatial import KDTree

    rows = sound(table)
    pairs = KDTree(rows.positions).query_pairs(SAME, output_type="ndarray")
    if len(pairs):
        at = np.unique(pairs)
        distinct = len(distinct_rows(rows.positions))
        what = f"{len(rows.ids)} taxels at {distinct} distinct positions: {len(at)} share theirs"
        remedy = "set these taxels' positions, from CAD or by calibration"
        yield finding(table, "duplicate positions", what, remedy, rows.ids[at])


def scale(table: Table) -> Iterator[Finding]:
    """Lengths that are not in metres."""
    points = distinct(sound(table)).positions
    if len(points) < 2:
        return
    near, extent = float(np.median(_nearest(points))), float(np.ptp(points, axis=0).max())
    what = f"taxels are {near:.3g} m apart, the skin {extent:.3g} m wide"
    if near > SPARSE or extent > LARGE:
        yield finding(
            table,
            "unit",
            f"{what}: millimetres?",
            "positions are in m: Skin.load(path, units='mm')",
        )
    elif near < DENSE:
        yield finding(table, "unit", f"{what}: kilometres?", "positions are in m")


def alone(table: Table) -> Iterator[Finding]:
    """Taxels far from all others, and from the others of their module."""
    rows = distinct(sound(table))
    if len(rows.ids) < 4:
        return
    near = _nearest(rows.positions)
    usual = float(np.median(near))
    far = near > ALONE * usual
    if far.any():
        what = f"{far.sum()} taxels lie {1e3 * near[far].min():.3g} mm and more from any other; "
        what += f"half of all have one within {1e3 * usual:.3g} mm"
        yield finding(table, "isolated", what, "check their positions", rows.ids[far])
    if not modular(table):
        return
    rows = rows.take(table.is_triangular(slots.module(rows.ids)))
    wide = []
    for own in by_module(rows.ids):
        off = rows.positions[own] - np.median(rows.positions[own], axis=0)
        wide += own[np.linalg.norm(off, axis=1) > WIDE].tolist()
    if wide:
        what = f"{len(wide)} taxels lie more than {1e3 * WIDE:g} mm from the middle of their module"
        yield finding(table, "off module", what, "check their positions and ids", rows.ids[wide])


def _nearest(points: Array) -> Array:
    """Distance (n,) in m of each point to the nearest other."""
    from scipy.spatial import KDTree

    return np.asarray(KDTree(points).query(points, k=2)[0][:, 1])
