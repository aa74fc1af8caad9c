"""Defects of normals, of frames, and of the side from which modules are seen."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from scipy.spatial import KDTree

from ...core import se3
from .. import slots
from ..files.table import SkinTable
from .defect import Array, Defect, defect, distinct_rows, has_modules, located, module_rows
from .rows import empty_slots

LENGTH_TOLERANCE = 0.01
"""Largest difference of the length of a normal from 1: three printed digits leave 0.001."""
CONSTANT = 1e-6
"""Largest range of the components of normals that are one constant vector: printed normals have at
most six digits."""
FLATNESS = 0.5e-3
"""Largest distance of taxels from a plane on which they may share one normal, m."""
NEIGHBOURS = 3
"""Nearest neighbours with whose normals that of a taxel is compared."""
BEHIND = 0.15
"""Depth below a taxel, in their distance from it, from which its nearest neighbours are on the
other side of a thin plate: at the middle of a plate as thick as a quarter of the spacing it is
0.24; neighbours at 6 mm on a hollow of radius 20 mm, seen from a flipped taxel, have 0.15."""
FIT_TOLERANCE = 1.5e-3
"""Largest rms distance of taxels from the fitted module for its side to be decided, m: far below
the 6.5 mm between neighbouring taxels."""


def normals(table: SkinTable) -> Iterator[Defect]:
    """Normals that are missing, not of unit length, or one constant vector."""
    rows = located(table)
    length = np.linalg.norm(rows.normals, axis=1)
    body = "take them from the body: skin.onto(body)"
    given = length > 0.0  # False for NaN, which is another defect
    none = length == 0.0
    if none.any():
        what = f"{none.sum()} of {len(none)} normals are (0, 0, 0): the file has none"
        kind = "constant normals" if none.all() else "no normal"
        yield defect(table, kind, what, body, rows.ids[none])
    off = given & (np.abs(length - 1.0) > LENGTH_TOLERANCE)
    if off.any():
        what = f"{off.sum()} normals are not of unit length ({length[off].min():.3g} to "
        what += f"{length[off].max():.3g})"
        yield defect(table, "not unit", what, f"divide by their length, or {body}", rows.ids[off])
    n = rows.normals[given]
    if len(n) > 2 and np.ptp(n, axis=0).max() < CONSTANT:
        what = f"all {len(n)} normals are ({n[0, 0]:g}, {n[0, 1]:g}, {n[0, 2]:g}), "
        if not _flat(rows.positions[given], n[0]):
            what += "on taxels that do not lie in a plane perpendicular to it"
        elif len(empty_slots(table)):
            what += (
                "and not all taxels of the part have a position: a plane skin, or unknown normals?"
            )
        else:
            return  # a plane skin
        remedy = f"{body}, or from whole modules: Modules.of(skin)"
        yield defect(table, "constant normals", what, remedy, rows.ids[given])


def _flat(points: Array, normal: Array) -> bool:
    """Whether points (n, 3) lie in a plane perpendicular to a normal."""
    height = (points - points.mean(axis=0)) @ normal / np.linalg.norm(normal)
    return float(np.abs(height).max()) < FLATNESS


def frames(table: SkinTable) -> Iterator[Defect]:
    """Quaternions that are not of unit norm, or whose z axis is not the normal."""
    from scipy.spatial.transform import Rotation

    if table.quaternions is None:
        return
    length = np.linalg.norm(table.quaternions, axis=1)
    off = np.abs(length - 1.0) > LENGTH_TOLERANCE
    if off.any():
        what = f"{off.sum()} quaternions are not of unit length"
        yield defect(table, "quaternion", what, "divide by their length", table.ids[off])
    usable = np.flatnonzero(~off & np.isfinite(length) & np.isfinite(table.normals).all(axis=1))
    z = Rotation.from_quat(table.quaternions[usable]).as_matrix()[:, :, 2]
    differ = usable[np.linalg.norm(z - table.normals[usable], axis=1) > LENGTH_TOLERANCE]
    if len(differ):
        what = f"{len(differ)} frames have a z axis other than their normal"
        yield defect(table, "frame", what, "find out which is correct", table.ids[differ])


def flipped(table: SkinTable) -> Iterator[Defect]:
    """Normals opposite to those of the neighbours, and modules seen from the wrong side."""
    rows = located(table)
    length = np.linalg.norm(rows.normals, axis=1)
    given = (length > 0.0) & np.isfinite(length)
    rows = rows.take(given)
    n = rows.normals / length[given, None]
    if len(n) > NEIGHBOURS:
        _, near = KDTree(rows.positions).query(rows.positions, k=NEIGHBOURS + 1)
        against = np.einsum("ij,ikj->ik", n, n[near[:, 1:]]).max(axis=1) < -0.5
        offset = rows.positions[near[:, 1:]] - rows.positions[:, None]
        apart = np.linalg.norm(offset, axis=2)
        height = np.einsum("ikj,ij->ik", offset, n)
        against &= np.all(np.abs(height) < 0.5 * apart, axis=1)
        against &= ~np.all(height < -BEHIND * apart, axis=1)
        if against.any():
            what = f"{against.sum()} normals are opposite to those of all neighbours"
            yield defect(table, "flipped", what, "reverse them", rows.ids[against])
    if has_modules(table):
        triangular = table.is_triangular(slots.module(rows.ids))
        yield from _mirrored(table, rows.take(triangular), n[triangular])


def _mirrored(table: SkinTable, rows: SkinTable, n: Array) -> Iterator[Defect]:
    """Modules whose slots are in reverse order around the normal."""
    if not len(n) or np.ptp(n, axis=0).max() < CONSTANT:
        return  # a constant vector does not tell the sides
    wrong = []
    for group in module_rows(rows.ids):
        own = group[distinct_rows(rows.positions[group])]
        outward, flat = n[own].mean(axis=0), slots.OFFSETS[slots.slot(rows.ids[own])]
        if len(own) < 4:
            continue
        pose = se3.align(flat, rows.positions[own])
        off = se3.transform_points(pose, flat) - rows.positions[own]
        spread = np.linalg.svd(flat - flat.mean(axis=0), compute_uv=False)[1]
        if (
            np.sqrt(np.mean(np.sum(off**2, axis=1))) < FIT_TOLERANCE
            and spread > 5e-3
            and pose[:3, 2] @ outward < -0.5
        ):
            wrong.append(slots.module(rows.ids[own[0]]))
    if wrong:
        at = rows.ids[np.isin(slots.module(rows.ids), wrong)]
        what = (
            f"{len(wrong)} modules are mirrored: their slots are in reverse order around the normal"
        )
        remedy = "mirror the slots of the drawing (iCub's layouts have a column for it), or reverse"
        yield defect(table, "mirrored", what, f"{remedy} the normals", at)
