"""Taxels that answer strongly at a second place: ids exchanged during the recording, or two logs in
one. Where the body was pressed in one order, most taxels answer in one part of the recording only,
and nothing but the few that answer in both tells that the others have wrong ids.

A second place that is far is one whatever else the taxel does. A nearer one is a second place where
several taxels have one from the same time on: the estimate takes their readings there for outlying.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...core.arrays import Array, spreads_by_group
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
DIVIDED, GATHERED = 3.0, 1.5
"""Distance of the middles of a taxel's strong readings before and after a time, and their own
spread, rms, in that of a usual taxel's strong readings, from which, and up to which, they are at
two places. Strong readings at one place lie in a disc, which is 2.83 wide in this unit."""
MIN_COMPARED = 40
"""Number of taxels that answer before and after, for which fewer are taken: two that seem exchanged
by chance are no failure, three are."""
FAINT = 0.25
"""Largest reading of a taxel, in the median taxel's, below which it may be noise, which is read
anywhere."""
EACH = 2
"""Strong readings, at least, before and after: one may be corrupt."""
AT_ONE = 0.8
"""Distance of the farther of both middles from the estimated position, in that between them, from
which the taxel was put at one of them. Between two lanes that are as far apart as a patch is wide,
it answers strongly in both and lies between them: at 0.7 at most under Hertz' pressure, for lanes
1.2 radii of the patch apart and more."""


class SecondPlaces:
    """The taxels of a calibration that answer strongly at a second place, and of how many that
    would show one."""

    def __init__(self, data: Measurements, calibration: Calibration) -> None:
        """data: with the distant readings."""
        self.calibration, positions = calibration, calibration.positions
        self.extent = float(np.sum(np.ptp(data.points, axis=0) ** 2)) if len(data.points) else 0.0
        far = second_places(data, positions)
        exchanged, both, part = exchanged_taxels(data, positions)
        self.taxels, self.of, self.time = far, int(np.isfinite(positions).all(axis=1).sum()), ""
        self.confirmed = np.zeros(len(data.ids), dtype=bool)
        least = self.of
        if len(exchanged) > 1:
            self.taxels, self.of = np.union1d(far, exchanged), len(np.union1d(far, both))
            self.time = f" from {part:.0%} of the recording on, of those that answer before it, too"
            self.confirmed[np.setdiff1d(both, self.taxels)] = True
            least = max(self.of, MIN_COMPARED)
        self.share = len(self.taxels) / max(least, 1)

    def findings(self) -> list[Finding]:
        """The verdict on them."""
        if self.share <= MAX_TAXELS[0]:
            return []
        ids = ", ".join(map(str, self.calibration.ids[self.taxels[:3]]))
        words = (
            f"{len(self.taxels)} of {self.of} taxels answer strongly at a second place (limit "
            f"{MAX_TAXELS[0]:.0%}; ids {ids}{' ...' if len(self.taxels) > 3 else ''})"
            f"{self.time}: their ids were exchanged during the recording, and others have wrong "
            "ids, too, or their readings come late from then on, or the skin was pressed at two "
            "places at once; calibrate parts of the recording one by one"
        )
        return [(FAIL if self.share > MAX_TAXELS[1] else DOUBT, words)]

    def widened(self) -> Calibration:
        """The calibration with the variance of a place anywhere among the contacts added to that of
        the taxels, where they are a failure: those that answer at one place only may have wrong
        ids, too. Taxels that answer at one place before and after the time are left as they are.
        """
        if self.share <= MAX_TAXELS[1]:
            return self.calibration
        covariances = self.calibration.covariances.copy()
        covariances[~self.confirmed, :3, :3] += self.extent / 12 * np.eye(3)
        return replace(self.calibration, covariances=covariances)


def exchanged_taxels(data: Measurements, positions: Array) -> tuple[np.ndarray, np.ndarray, float]:
    """Rows of the taxels that answer strongly at one place before a time and at another after it,
    rows of all that answer strongly before and after it, and the part of the contacts before the
    time at which most do. A taxel's strong readings are divided where they then spread least.
    positions (n, 3), m: those estimated; NaN if there is none."""
    largest, n = np.zeros(len(data.ids)), len(data.ids)
    np.maximum.at(largest, data.taxel, data.pressure)
    largest[largest < FAINT * np.median(largest[data.counts > 0])] = np.inf
    strong = np.flatnonzero(data.pressure > STRONG * largest[data.taxel])
    strong = strong[np.lexsort((data.contact[strong], data.taxel[strong]))]
    where = data.points[data.contact[strong]]
    contact, taxel = data.contact[strong], data.taxel[strong]
    count = np.bincount(taxel, minlength=n)
    square = spreads_by_group(where, taxel) * count[count > 0] / (count[count > 0] - 1 + 1e-9)
    if not (count >= MIN_READINGS).any():
        return np.empty(0, dtype=int), np.empty(0, dtype=int), 0.0
    usual, ends = np.median(square[count[count > 0] >= MIN_READINGS]) ** 0.5, np.cumsum(count)
    between = np.zeros((n, 2), dtype=int)
    for t in np.flatnonzero(count >= 2 * EACH):
        rows = slice(ends[t] - count[t], ends[t])
        between[t] = _division(where[rows], contact[rows], usual, positions[t])
    last, first = between.T  # contact at one place, and at the other; of others both are 0
    at = max(last.tolist(), key=lambda at: int(np.sum((last <= at) & (first > at))))
    exchanged = np.flatnonzero((last <= at) & (first > at))
    before, after = (np.bincount(taxel[x], minlength=n) for x in (contact <= at, contact > at))
    both = np.minimum(before, after) >= EACH
    both[exchanged] = True
    return exchanged, np.flatnonzero(both), float(at + 1) / max(len(data.points), 1)


def _division(where: Array, contact: np.ndarray, usual: float, position: Array) -> tuple[int, int]:
    """The contacts before and after which readings at (q, 3), m, in the order of their contacts
    (q,), are at two places; (0, 0) where they are not. usual: spread, m, at one place; position
    (3,), m: that of the taxel, NaN if unknown."""
    k, middle = np.arange(EACH, len(where) - EACH + 1), where.mean(axis=0)
    off = where - middle
    sums, squares = np.cumsum(off, axis=0), np.cumsum(np.sum(off**2, axis=1))
    number = np.stack([k, len(where) - k])
    means = np.stack([sums[k - 1], -sums[k - 1]]) / number[:, :, None]
    square = np.stack([squares[k - 1], squares[-1] - squares[k - 1]]) / number
    spread = square - np.sum(means**2, axis=2)
    best = int(np.argmin(np.sum(number * spread, axis=0)))
    apart = np.linalg.norm(means[0, best] - means[1, best])
    if apart < DIVIDED * usual or spread[:, best].max() > (GATHERED * usual) ** 2:
        return 0, 0
    if np.linalg.norm(means[:, best] - (position - middle), axis=1).max() < AT_ONE * apart:
        return 0, 0
    return int(contact[k[best] - 1]), int(contact[k[best]])


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
