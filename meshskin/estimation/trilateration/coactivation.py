"""Where taxels are by co-activation: which contacts each answered.

No E*, gain or force enters: this holds where trilateration fails, because its distances are wrong,
too few are left, or false answers are among them, and is near enough for the joint estimate to find
its optimum (studies/estimators.py measures how near that is).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ...core.se3 import Array
from .. import chart
from ..data.measurements import Measurements, reach
from . import trilaterate

if TYPE_CHECKING:
    from ...geometry.body import Body

OUTSIDE = 2.0
"""Distance of a trilaterated taxel from the middle of its contacts at which it is not believed,
relative to their spread."""
SCATTERED = 3.0
"""Spread of a taxel's contacts, relative to the median taxel's, beyond which they show nothing."""
WIDE = 1.3
"""Spread of a taxel's contacts, relative to the reach of one contact, beyond which some of its
answers must be false: of a sound taxel it is some 0.7."""
SHY = 3.0
"""Contacts without an answer that are added to each neighbourhood, so that few prove little."""
CHUNK = 64
"""Taxels whose neighbourhoods are counted at once."""
CHANCE = 1e-4
"""Probability that noise alone makes a taxel's largest reading, below which it is more than noise.
"""
ABOVE, WITHIN = 7.0, 0.7
"""Standard deviations by which the sum of a taxel's readings about its place is above that of noise
where it was pressed, though none of them is; and how far about it, in reaches of a contact."""
NOISE = "no reading above the noise"
"""Why a taxel is then undetermined."""
EVERYWHERE = "answers to contacts all over"
"""Why a taxel is then undetermined."""


def contact_centroid_start(data: Measurements, body: Body) -> trilaterate.Fit:
    """Every taxel (n) at the middle of its contacts, where three or more answered, not on a line.

    No pressure enters: only which contacts were answered.
    The middle is the geometric median, which a few false answers elsewhere do not move. Its
    covariance is that of the contacts about it: a bound, and a generous one.
    """
    n, seen = len(data.ids), np.flatnonzero(data.counts)
    points, why = np.full((n, 3), np.nan), np.full(n, trilaterate.FEW, dtype=object)
    rotations, scatter = np.tile(np.eye(3), (n, 1, 1)), np.full((n, 3, 3), np.inf)
    if len(seen):
        equal = replace(data, pressure=np.ones_like(data.pressure))
        points[seen] = trilaterate.medians(equal, body, seen)
        rotations[seen] = chart.frames(body.closest(points[seen]).normal)
        local = np.einsum("kij,ki->kj", rotations[data.taxel],
                          data.points[data.contact] - points[data.taxel])  # fmt: skip
        for i, j in np.ndindex(3, 3):
            total = np.bincount(data.taxel, local[:, i] * local[:, j], n)
            scatter[seen, i, j] = total[seen] / data.counts[seen]
    flat = scatter[:, :2, :2]
    spread = np.sqrt(np.trace(flat, axis1=1, axis2=2))
    enough = data.counts >= 3
    why[enough] = ""
    least = np.zeros(n)
    least[enough] = np.sqrt(np.maximum(np.linalg.eigvalsh(flat[enough])[:, 0], 0.0))
    why[enough & (least < trilaterate.NARROW * float(np.median(data.radii)))] = trilaterate.LINE
    if enough.any():
        why[enough & (spread > SCATTERED * np.median(spread[enough]))] = EVERYWHERE
    bad = why != ""
    points[bad], flat[bad] = np.nan, np.diag([np.inf, np.inf])
    return trilaterate.Fit(points, rotations, flat, np.full(n, np.nan), why)


def responsive(data: Measurements, points: Array) -> np.ndarray:
    """Which taxels (n,), about at `points` (n, 3), read more than noise, where that is known.

    The others were read and never pressed: there is a place for them, too, where their noise is a
    little larger, and it would be stated to a fraction of a millimetre.
    """
    from scipy.spatial import cKDTree
    from scipy.stats import norm

    largest = np.zeros(len(data.ids))
    np.maximum.at(largest, data.taxel, data.pressure)
    if not data.noise:
        return largest > 0.0
    more = norm.sf(largest / data.noise) * len(data.points) < CHANCE
    doubtful = np.flatnonzero(~more & np.isfinite(points[:, 0]))
    if not len(doubtful):
        return np.asarray(more)
    radius = WITHIN * float(np.median(reach(data)))
    off = np.linalg.norm(data.points[data.contact] - points[data.taxel], axis=1)
    level = data.pressure * (off < radius) / data.noise  # off is NaN where there is no place
    total = np.bincount(data.taxel, level, len(more))[doubtful]
    count = cKDTree(data.points).query_ball_point(points[doubtful], radius, return_length=True)
    least = data.threshold / data.noise  # of noise that is told: its mean and variance
    mean = norm.pdf(least)
    variance = least * mean + norm.sf(least) - mean**2
    more[doubtful] = total - count * mean > ABOVE * np.sqrt(count * variance)
    return np.asarray(more)


def without_distant_readings(data: Measurements) -> Measurements:
    """The readings without far-away ones of taxels that answer to contacts all over.

    Such a taxel is where it answered the contacts within reach most: noise above a low threshold
    answers anywhere, but seldom, and weakly.
    """
    n, where = len(data.ids), data.points[data.contact]
    count = np.maximum(data.counts, 1)[:, None]
    mean = np.stack([np.bincount(data.taxel, x, n) for x in where.T], axis=1) / count
    square = np.bincount(data.taxel, np.sum((where - mean[data.taxel]) ** 2, axis=1), n)
    range_ = float(np.median(reach(data)))
    wide = np.flatnonzero(np.sqrt(square / count[:, 0]) > WIDE * range_)
    if not len(wide):
        return data
    centre = np.full((n, 3), np.nan)
    centre[wide] = data.points[_densest(data, wide, range_)]
    far = np.linalg.norm(where - centre[data.taxel], axis=1) > 1.5 * range_
    keep = ~far  # NaN is not far
    return replace(data, **{k: getattr(data, k)[keep] for k in ("contact", "taxel", "pressure")})


def _densest(data: Measurements, rows: np.ndarray, radius: float) -> np.ndarray:
    """Contact (r,) about which each of the taxels `rows` answered most, on average over contacts.

    No reading counts for more than three of the taxel's mean ones.
    """
    from scipy.sparse import csr_array
    from scipy.spatial import cKDTree

    m, tree = len(data.points), cKDTree(data.points)
    pairs = tree.sparse_distance_matrix(tree, radius, output_type="ndarray")
    near = csr_array((np.ones(len(pairs)), (pairs["i"], pairs["j"])), shape=(m, m))
    total = near.sum(axis=1) + SHY
    place = np.full(len(data.ids), -1)
    place[rows] = np.arange(len(rows))
    mine = np.flatnonzero(place[data.taxel] >= 0)
    at = (data.contact[mine], place[data.taxel[mine]])
    mean = np.bincount(at[1], data.pressure[mine]) / np.bincount(at[1])
    level = np.minimum(data.pressure[mine], 3 * mean[at[1]])
    answered = csr_array((level, at), shape=(m, len(rows))).tocsc()
    best = [
        ((near @ answered[:, k : k + CHUNK]).toarray() / total[:, None]).argmax(axis=0)
        for k in range(0, len(rows), CHUNK)
    ]
    return np.concatenate(best)


def initial_estimate(data: Measurements, body: Body) -> trilaterate.Fit:
    """Trilateration by least squares, and co-activation for the taxels where it fails."""
    fit, rough = trilaterate.least_squares(data, body), contact_centroid_start(data, body)
    off = np.linalg.norm(fit.points - rough.points, axis=1)
    spread = np.sqrt(np.trace(rough.covariance, axis1=1, axis2=2))
    take = rough.found & (~fit.found | (off > OUTSIDE * spread))
    at = take[:, None, None]
    return trilaterate.Fit(
        points=np.where(at[:, 0], rough.points, fit.points),
        rotations=np.where(at, rough.rotations, fit.rotations),
        covariance=np.where(at, rough.covariance, fit.covariance),
        chi2=np.where(take, np.nan, fit.chi2),
        reasons=np.where(take, "", fit.reasons),
    )
