"""What is wrong with normals, and with the side that modules are seen from."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...core import se3
from .. import slots
from ..files.table import Table
from .finding import Array, Finding, by_module, distinct_rows, finding, modular, sound
from .rows import empty_slots

UNIT = 0.01
"""difference of a normal's length from 1: three printed digits leave 0.001"""
CONSTANT = 1e-6
"""spread of normals that are one vector"""
FLAT = 0.5e-3
"""m, about a plane whose taxels may share one normal"""
NEIGHBOURS = 3
"""of a taxel, whose normals its own is held against"""
FITS = 1.5e-3
"""m, mean distance within which taxels fit a module"""


def normals(table: Table) -> Iterator[Finding]:
    """Normals that are missing, not of unit length, or one constant vector."""
    rows = sound(table)
    length = np.linalg.norm(rows.normals, axis=1)
    body = "take them from the body: skin.onto(body)"
    given = length > 0.0  # false for NaN, which is another finding
    none = length == 0.0
    if none.any():
        what = f"{none.sum()} of {len(none)} normals are (0, 0, 0): none is given"
        kind = "constant normals" if none.all() else "no normal"
        yield finding(table, kind, what, body, rows.ids[none])
    off = given & (np.abs(length - 1.0) > UNIT)
    if off.any():
        what = f"{off.sum()} normals are not of unit length ({length[off].min():.3g} to "
        what += f"{length[off].max():.3g})"
        yield finding(table, "not unit", what, f"divide by their length, or {body}", rows.ids[off])
    n = rows.normals[given]
    if len(n) > 2 and np.ptp(n, axis=0).max() < CONSTANT:
        what = f"all {len(n)} normals are ({n[0, 0]:g}, {n[0, 1]:g}, {n[0, 2]:g}), "
        if not _flat(rows.positions[given], n[0]):
            what += "on taxels that do not lie in a plane across it"
        elif len(empty_slots(table)):
            what += "and not all taxels of the part have a position: flat, or not known?"
        else:
            return  # a flat skin
        remedy = f"{body}, or from whole modules: Modules.of(skin)"
        yield finding(table, "constant normals", what, remedy, rows.ids[given])


def _flat(points: Array, normal: Array) -> bool:
    """Whether points (n, 3) lie in a plane across a normal."""
    height = (points - points.mean(axis=0)) @ normal / np.linalg.norm(normal)
    return float(np.abs(height).max()) < FLAT


def frames(table: Table) -> Iterator[Finding]:
    """Quaternions that are none, or whose z is not the normal."""
    from scipy.spatial.transform import Rotation

    if table.quaternions is None:
        return
    length = np.linalg.norm(table.quaternions, axis=1)
    off = np.abs(length - 1.0) > UNIT
    if off.any():
        what = f"{off.sum()} quaternions are not of unit length"
        yield finding(table, "quaternion", what, "divide by their length", table.ids[off])
    usable = np.flatnonzero(~off & np.isfinite(length) & np.isfinite(table.normals).all(axis=1))
    z = Rotation.from_quat(table.quaternions[usable]).as_matrix()[:, :, 2]
    unlike = usable[np.linalg.norm(z - table.normals[usable], axis=1) > UNIT]
    if len(unlike):
        what = f"{len(unlike)} frames have another z than the normal beside them"
        yield finding(table, "frame", what, "decide which is right", table.ids[unlike])


def turned(table: Table) -> Iterator[Finding]:
    """Normals against those of the neighbours, and modules seen from the wrong side."""
    from scipy.spatial import KDTree

    rows = sound(table)
    length = np.linalg.norm(rows.normals, axis=1)
    rows = rows.take(length > 0.0)
    n = rows.normals / length[length > 0.0, None]
    if len(n) > NEIGHBOURS:
        _, near = KDTree(rows.positions).query(rows.positions, k=NEIGHBOURS + 1)
        against = np.einsum("ij,ikj->ik", n, n[near[:, 1:]]).max(axis=1) < -0.5
        offset = rows.positions[near[:, 1:]] - rows.positions[:, None]
        height = np.abs(np.einsum("ikj,ij->ik", offset, n))
        against &= np.all(height < 0.5 * np.linalg.norm(offset, axis=2), axis=1)
        if against.any():
            what = f"{against.sum()} normals point against those of all neighbours"
            yield finding(table, "flipped", what, "turn them outward", rows.ids[against])
    if modular(table):
        triangular = table.is_triangular(slots.module(rows.ids))
        yield from _mirrored(table, rows.take(triangular), n[triangular])


def _mirrored(table: Table, rows: Table, n: Array) -> Iterator[Finding]:
    """Modules whose slots run the other way round their normal than in a real module."""
    if not len(n) or np.ptp(n, axis=0).max() < CONSTANT:
        return  # one constant vector says nothing of the sides
    wrong = []
    for group in by_module(rows.ids):
        own = group[distinct_rows(rows.positions[group])]
        outward, flat = n[own].mean(axis=0), slots.OFFSETS[slots.slot(rows.ids[own])]
        if len(own) < 4:
            continue
        pose = se3.align(flat, rows.positions[own])
        off = flat @ pose[:3, :3].T + pose[:3, 3] - rows.positions[own]
        spread = np.linalg.svd(flat - flat.mean(axis=0), compute_uv=False)[1]
        if (
            np.sqrt(np.mean(np.sum(off**2, axis=1))) < FITS
            and spread > 5e-3
            and pose[:3, 2] @ outward < -0.5
        ):
            wrong.append(slots.module(rows.ids[own[0]]))
    if wrong:
        at = rows.ids[np.isin(slots.module(rows.ids), wrong)]
        what = f"{len(wrong)} modules are mirrored: their slots run the wrong way round the normal"
        remedy = "mirror the slots of the drawing (iCub's layouts have a column for it), or turn"
        yield finding(table, "mirrored", what, f"{remedy} the normals", at)
