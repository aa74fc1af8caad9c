"""Taxels that answer strongly at a second place: ids exchanged during the recording, or two logs in
one. Where the body was pressed in one order, most taxels answer in one part of the recording only,
and nothing but the few that answer in both tells that the others have wrong ids.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...core.arrays import Array
from ..calibration import Calibration
from ..data.measurements import Measurements
from ..trilateration.coactivation import NEAR
from .verdict import DOUBT, FAIL, Finding

STRONG = 0.6
"""Share of a taxel's largest reading near its place from which a distant one is strong: what lags
or lingers is at most a half."""
APART = 3.0
"""Distance of a second place, in reaches of a contact: nearer, it is the edge of a wider patch."""
MIN_READINGS, MIN_GATHERED = 4, 0.8
"""Strong readings, at least, that make a second place, and their share within NEAR reaches of one
another: second contacts at the same time scatter over the body."""
SAMPLE = 500
"""Strong readings of a taxel whose pairs are compared, at most: all pairs of the thousands that a
taxel with a short circuit has would fill the memory; a share of 0.8 of 500 is known to 0.02."""
MAX_TAXELS = 0.02, 0.05
"""Share of the taxels that answer at a second place from which it is a doubt, and a failure: where
a twentieth answers at both, most of the others have answered only at the wrong one."""


def findings(data: Measurements, calibration: Calibration) -> list[Finding]:
    """The verdict on second places; data: with the distant readings."""
    taxels = second_places(data, calibration.positions)
    placed = int(np.isfinite(calibration.positions).all(axis=1).sum())
    doubt, failure = (share * placed for share in MAX_TAXELS)
    if len(taxels) <= doubt:
        return []
    ids = ", ".join(map(str, calibration.ids[taxels[:3]]))
    words = (
        f"{len(taxels)} of {placed} taxels answer strongly at a second place (limit "
        f"{MAX_TAXELS[0]:.0%}; ids {ids}{' ...' if len(taxels) > 3 else ''}): their ids were "
        "exchanged during the recording, and others have wrong ids, too, or the skin was pressed "
        "at two places at once; calibrate parts of the recording one by one"
    )
    return [(FAIL if len(taxels) > failure else DOUBT, words)]


def widened(data: Measurements, calibration: Calibration) -> Calibration:
    """The calibration with the variance of a place anywhere among the contacts added to that of
    every taxel, where second places are a failure: those that answer at one place only may have
    wrong ids, too."""
    placed = int(np.isfinite(calibration.positions).all(axis=1).sum())
    if len(second_places(data, calibration.positions)) <= MAX_TAXELS[1] * placed:
        return calibration
    covariances = calibration.covariances.copy()
    anywhere = float(np.sum(np.ptp(data.points, axis=0) ** 2)) / 12
    covariances[:, :3, :3] += anywhere * np.eye(3)
    return replace(calibration, covariances=covariances)


def second_places(data: Measurements, positions: Array) -> np.ndarray:
    """Rows of the taxels that answer strongly at a place far from their positions (n, 3), m."""
    reach = float(np.median(data.reach()))
    where = data.points[data.contact]
    off = np.linalg.norm(where - positions[data.taxel], axis=1)
    largest = np.full(len(data.ids), np.inf)
    near = off <= NEAR * reach  # NaN, of a taxel without a position, is neither near nor far
    np.minimum.at(largest, data.taxel[near], 0.0)
    np.maximum.at(largest, data.taxel[near], data.pressure[near])
    strong = np.flatnonzero((off > NEAR * reach) & (data.pressure > STRONG * largest[data.taxel]))
    strong = strong[np.argsort(data.taxel[strong], kind="stable")]
    count = np.bincount(data.taxel[strong], minlength=len(data.ids))
    ends, found = np.cumsum(count), []
    for taxel in np.flatnonzero(count >= MIN_READINGS):
        rows = strong[ends[taxel] - count[taxel] : ends[taxel]]
        points = where[rows[:: -(-len(rows) // SAMPLE)]]
        apart = np.linalg.norm(points[:, None] - points, axis=2)
        gathered = (apart < NEAR * reach).mean(axis=1)
        middle = points[np.argmax(gathered)]
        far = np.linalg.norm(middle - positions[taxel]) > APART * reach
        if far and gathered.max() >= MIN_GATHERED:
            found.append(taxel)
    return np.array(found, dtype=int)
