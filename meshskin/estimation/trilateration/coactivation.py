"""Initial estimates from co-activation: which contacts each taxel responded to.

Neither E*, gain nor force enters. It serves where trilateration fails because distances are wrong,
too few readings are left, or false responses are among them, and is close enough for the joint
estimate to converge to its optimum (studies/estimators.py measures from how far it does).
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.sparse import csr_array
from scipy.spatial import cKDTree
from scipy.special import ndtr

from ...core.arrays import Array, means_by_group, sums_by_group
from .. import chart
from ..data.corrupt_readings import copied_readings
from ..data.measurements import Measurements
from ..result import EstimatorResult
from . import trilaterate

MAX_OFFSET = 2.0
"""Distance of a trilaterated taxel from the centroid of its contacts, relative to their spread,
beyond which the centroid replaces it: the contacts that a taxel responds to surround it."""
MAX_SPREAD = 3.0
"""Spread of a taxel's contacts, relative to the median taxel's, beyond which they locate nothing.
"""
FALSE_SPREAD = 1.3
"""Spread of a taxel's contacts, relative to the reach of one contact, beyond which some responses
must be false: that of a sound, evenly pressed taxel is 0.7 (a uniform disc's RMS radius)."""
PRIOR_SILENT = 3.0
"""Contacts without response added to each neighbourhood, so that few contacts count for little."""
NEAR = 1.5
"""Distance of a contact from the middle of a taxel's contacts, in reaches of a contact, beyond
which it is distant."""
CHUNK = 64
"""Taxels whose neighbourhoods are counted at once: bounds the memory."""
FALSE_ALARM = 1e-4
"""Probability that noise alone gives a taxel's largest reading, below which the taxel responds."""
SUM_SIGMAS, SUM_RADIUS = 7.0, 0.7
"""Standard deviations by which the sum of a taxel's readings near its estimate must exceed that of
noise, where no single reading does, and the radius of the sum, in reaches of a contact. The
estimate was chosen where the readings are large, hence more than FALSE_ALARM would ask."""
NOISE = "no reading above the noise"
COPIED = "its readings are equal to those of taxel {}"
EVERYWHERE = "responds to contacts all over the body"


def contact_centroid_start(data: Measurements) -> EstimatorResult:
    """Every taxel (n) at the geometric median of the contacts it responded to.

    It needs three or more contacts that are not on a line. No pressure enters. The covariance is
    that of the contacts about the median, a generous bound.
    """
    n, seen = len(data.ids), np.flatnonzero(data.counts)
    points, reasons = np.full((n, 3), np.nan), np.full(n, trilaterate.TOO_FEW, dtype=object)
    rotations, flat = np.tile(np.eye(3), (n, 1, 1)), np.full((n, 2, 2), np.inf)
    if len(seen):
        points[seen] = trilaterate.medians(
            replace(data, pressure=np.ones_like(data.pressure)), seen
        )
        rotations[seen] = chart.frames(data.body.closest(points[seen]).normal)
        offset = data.points[data.contact] - points[data.taxel]
        local = np.einsum("kij,ki->kj", rotations[data.taxel, :, :2], offset)
        total = sums_by_group(local[:, :, None] * local[:, None, :], data.taxel, n)
        flat[seen] = total[seen] / data.counts[seen, None, None]
    spread = np.sqrt(np.trace(flat, axis1=1, axis2=2))
    enough = data.counts >= 3
    reasons[enough] = ""
    least = np.zeros(n)
    least[enough] = np.sqrt(np.maximum(np.linalg.eigvalsh(flat[enough])[:, 0], 0.0))
    narrow = least < trilaterate.MIN_WIDTH * float(np.median(data.radii))
    reasons[enough & narrow] = trilaterate.COLLINEAR
    if enough.any():
        reasons[enough & (spread > MAX_SPREAD * np.median(spread[enough]))] = EVERYWHERE
    bad = reasons != ""
    points[bad], flat[bad] = np.nan, np.diag([np.inf, np.inf])
    return EstimatorResult(points, rotations, flat, np.full(n, np.nan), reasons)


def responsive(data: Measurements, points: Array) -> np.ndarray:
    """Taxels (n,) bool, estimated at `points` (n, 3), that read more than noise, if it is known.

    The others were read and never pressed: the likelihood has an optimum for them, too, where their
    noise is a little larger, and its covariance would be far too small.
    """
    largest = np.zeros(len(data.ids))
    np.maximum.at(largest, data.taxel, data.pressure)
    if data.noise is None:
        return largest > 0.0
    responds = ndtr(-largest / data.noise) * len(data.points) < FALSE_ALARM
    doubtful = np.flatnonzero(~responds & np.isfinite(points[:, 0]))
    if not len(doubtful):
        return np.asarray(responds)
    radius = SUM_RADIUS * float(np.median(data.reach()))
    off = np.linalg.norm(data.points[data.contact] - points[data.taxel], axis=1)
    level = data.pressure * (off < radius) / data.noise  # off is NaN without an estimate
    total = np.bincount(data.taxel, level, len(responds))[doubtful]
    count = cKDTree(data.points).query_ball_point(points[doubtful], radius, return_length=True)
    c = data.threshold / data.noise  # mean and variance of noise that is cut off below c
    mean = np.exp(-(c**2) / 2.0) / np.sqrt(2 * np.pi)
    variance = c * mean + ndtr(-c) - mean**2
    responds[doubtful] = total - count * mean > SUM_SIGMAS * np.sqrt(count * variance)
    return np.asarray(responds)


def live_taxels(
    data: Measurements, start: EstimatorResult, stuck: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the taxels that are estimated from `start`, and the reasons (n,) of the others.

    stuck: rows of taxels with constant readings. Two taxels with equal readings are both left out:
    which of them is a copy is not known. Raises CalibrationError if no taxel is left.
    """
    responds = responsive(data, start.points)
    reasons = np.where(start.found & ~responds, NOISE, start.reasons)
    inside = data.pressure < data.saturation
    whole = data.pressure[inside], data.taxel[inside], data.contact[inside]
    for pair in copied_readings(*whole):
        for one, other in (pair, pair[::-1]):
            reasons[one] = COPIED.format(data.ids[other])
    live = np.setdiff1d(np.flatnonzero(reasons == ""), stuck)
    if not len(live):
        raise trilaterate.undetermined(reasons)
    return live, reasons


def without_distant_readings(data: Measurements) -> Measurements:
    """The readings without distant ones of taxels that respond to contacts all over the body.

    Such a taxel is near the contact about which it responded most: noise above a low threshold
    responds anywhere, but seldom and weakly. Where contacts are sparse, that contact is millimetres
    beside the taxel: the mean of the contacts about it, weighted by the readings, is closer.
    """
    n, where = len(data.ids), data.points[data.contact]
    off = where - means_by_group(where, data.taxel, n)[data.taxel]
    square = means_by_group(np.sum(off**2, axis=1), data.taxel, n)
    reach = float(np.median(data.reach()))
    wide = np.flatnonzero(np.sqrt(square) > FALSE_SPREAD * reach)
    if not len(wide):
        return data
    centre = np.full((n, 3), np.nan)
    centre[wide] = data.points[_densest_contact(data, wide, reach)]
    near = np.linalg.norm(where - centre[data.taxel], axis=1) < NEAR * reach
    level = np.where(near, data.pressure, 0.0)
    centre[wide] = means_by_group(where, data.taxel, n, level)[wide]
    distant = np.linalg.norm(where - centre[data.taxel], axis=1) > NEAR * reach
    return data.select(~distant)  # NaN is not distant


def _densest_contact(data: Measurements, rows: np.ndarray, radius: float) -> np.ndarray:
    """Contact (r,) about which each of the taxels `rows` read most, on average over the contacts
    within `radius`, m.

    No reading counts for more than three times the taxel's mean one.
    """
    m, tree = len(data.points), cKDTree(data.points)
    pairs = tree.sparse_distance_matrix(tree, radius, output_type="ndarray")
    near = csr_array((np.ones(len(pairs)), (pairs["i"], pairs["j"])), shape=(m, m))
    total = near.sum(axis=1) + PRIOR_SILENT
    place = np.full(len(data.ids), -1)
    place[rows] = np.arange(len(rows))
    mine = np.flatnonzero(place[data.taxel] >= 0)
    at = (data.contact[mine], place[data.taxel[mine]])
    mean = np.bincount(at[1], data.pressure[mine]) / np.bincount(at[1])
    level = np.minimum(data.pressure[mine], 3 * mean[at[1]])
    read = csr_array((level, at), shape=(m, len(rows))).tocsc()
    best = [
        ((near @ read[:, k : k + CHUNK]).toarray() / total[:, None]).argmax(axis=0)
        for k in range(0, len(rows), CHUNK)
    ]
    return np.concatenate(best)


def initial_estimate(data: Measurements, fit: EstimatorResult) -> EstimatorResult:
    """The trilateration `fit`, with the contact centroid for the taxels where it fails."""
    rough = contact_centroid_start(data)
    off = np.linalg.norm(fit.points - rough.points, axis=1)
    spread = np.sqrt(np.trace(rough.covariance, axis1=1, axis2=2))
    use = rough.found & (~fit.found | (off > MAX_OFFSET * spread))
    at = use[:, None, None]
    return EstimatorResult(
        points=np.where(at[:, 0], rough.points, fit.points),
        rotations=np.where(at, rough.rotations, fit.rotations),
        covariance=np.where(at, rough.covariance, fit.covariance),
        chi2=np.where(use, np.nan, fit.chi2),
        reasons=np.where(use, "", fit.reasons),
    )
