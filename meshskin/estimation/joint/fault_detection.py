"""Readings and taxels that do not tell what they should: found, named, and kept from the rest.

Outlying readings are found by graduated non-convexity: Geman-McClure weights
w = (m c^2 / (m c^2 + r^2))^2, with m falling to 1. Then each weighs what its probability of being
sound is, among outlying ones that lie anywhere. Only taxels whose chi-square cannot be chance are
weighed, so that sound recordings are estimated as if nothing could be wrong.
Source: Yang, Antonante, Tzoumas, Carlone, "Graduated Non-Convexity for Robust Spatial Perception",
IEEE Robotics and Automation Letters 5 (2020).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.se3 import Array
from ..data.measurements import Measurements, reach
from .likelihood import Readings
from .pressure import CENSORED, OBSERVED, SATURATED

GNC_STAGES = (64.0, 16.0, 4.0, 1.0)
"""m along the way."""
CUTOFF = 4.5
"""Residual, in standard deviations, beyond which a reading is outlying; c is two thirds of it."""
MIN_CUTOFF = 3.0
"""The same where outlying readings are as many as can be: one sound reading in 400 is beyond."""
SIGNIFICANCE = 1e-9
"""Probability below which a taxel's chi-square is no chance."""
MISFIT_RATIO = 1.5
"""Chi-square per degree of freedom, relative to the median's, below which no taxel is suspected."""
MAX_TAXEL_OUTLIERS = 0.5
"""Share of outlying readings from which a taxel is not believed at all."""
MAX_REWEIGHTINGS = 6
"""Most weighings by probability after those."""
WEIGHT_TOLERANCE = 0.02
"""Change of a weight that ends them."""
MIN_SCALE = 0.1
"""Least scale of residuals where the noise is not known, in nominal noises."""
MAX_SCALE = 1.25
"""Scale of what is left, relative to the noise, up to which the outlying readings are the cause."""
MAX_OUTLIER_FRACTION = 0.35
"""Share of outlying readings, of the mean taxel, from which it is the model that is wrong."""
MIN_UNANSWERED = 3
"""Contacts that press a taxel and that it does not answer, from which its silence is no reading."""
STUCK_SPREAD = 1.5
"""Spread of a stuck taxel's contacts, relative to their reach. A sound one's comes to 0.7 where it
is pressed evenly, to 1 on a ring at most, there to 1.44 if E* is believed three times too high."""


@dataclass(frozen=True)
class StuckTaxels:
    """Taxels that read the same whatever touches them."""

    rows: np.ndarray
    """Rows of the taxels."""
    level: Array
    """What they read, Pa."""


def outliers(readings: Readings) -> np.ndarray:
    """Readings (k,) that are rather outlying than sound."""
    return np.asarray(readings.weight < 0.5)


def mean_log_likelihood(
    readings: Readings, r: Array, scale: float, out: np.ndarray, width: float
) -> float:
    """Log-likelihood of what was heard, the mean reading's of the mean taxel, where the readings
    `out` (k,) are outlying: these lie evenly over `width`, the residuals r (k,) of the others are
    normal with standard deviation `scale`, all in units of the noise.
    """
    heard = readings.kind != CENSORED
    size, out, taxel = r[heard], out[heard], readings.taxel[heard]
    share = 1.0 / np.bincount(taxel)[taxel]
    share /= share.sum()
    wild = float(share[out].sum())
    sound = -0.5 * (size[~out] / scale) ** 2 - np.log(scale * np.sqrt(2 * np.pi))
    odds = wild * np.log(max(wild, 1e-300) / width) + (1 - wild) * np.log(max(1 - wild, 1e-300))
    return odds + float(share[~out] @ sound)


def outlier_fraction(readings: Readings) -> float:
    """Share of outlying readings, the mean of the taxels': one that answers always is but one."""
    heard, n = readings.kind != CENSORED, len(readings.starts) - 1
    count = np.bincount(readings.taxel[heard], minlength=n)
    out = np.bincount(readings.taxel[heard & outliers(readings)], minlength=n)
    return float(np.mean(out[count > 0] / count[count > 0])) if count.any() else 0.0


def unanswered_presses(readings: Readings) -> np.ndarray:
    """Silent readings (k,) of taxels that are silent where that cannot be.

    Then their silence elsewhere says nothing either.
    """
    silent, n = readings.kind == CENSORED, len(readings.starts) - 1
    count = np.bincount(readings.taxel[silent & outliers(readings)], minlength=n)
    return np.asarray(silent & (count >= MIN_UNANSWERED)[readings.taxel])


def stuck_taxels(data: Measurements) -> StuckTaxels:
    """Taxels with one constant reading over contacts further apart than one taxel reaches."""
    count = np.maximum(data.counts, 1)
    mean = np.bincount(data.taxel, data.pressure, len(data.ids)) / count
    off = data.pressure - mean[data.taxel]
    deviation = np.sqrt(np.bincount(data.taxel, off**2, len(data.ids)) / count)
    points = data.points[data.contact]
    centre = np.stack([np.bincount(data.taxel, x, len(count)) / count for x in points.T], axis=1)
    gap = np.sum((points - centre[data.taxel]) ** 2, axis=1)
    limit = (STUCK_SPREAD * reach(data)[data.contact]) ** 2
    far = np.bincount(data.taxel, gap - limit, len(count)) > 0
    rows = np.flatnonzero(far & (deviation < 3 * data.sigma) & (mean > 3 * deviation))
    return StuckTaxels(rows, mean[rows])


def residuals(readings: Readings, mu: Array, sigma: float) -> Array:
    """Residuals (k,) in units of the noise; of censored readings what exceeds their limit."""
    r = mu - readings.level / sigma
    r[readings.kind == CENSORED] = np.maximum(r[readings.kind == CENSORED], 0.0)
    r[readings.kind == SATURATED] = np.minimum(r[readings.kind == SATURATED], 0.0)
    return r


def reading_scale(readings: Readings, r: Array) -> float:
    """Scale of the residuals, by the median, which few outlying ones do not move."""
    r = r[(readings.kind == OBSERVED) & ~outliers(readings)]
    return float(np.median(np.abs(r))) / 0.6745 if len(r) else 1.0


def taxel_scale(readings: Readings, r: Array) -> float:
    """The same where all taxels count alike: one that answers always is but one."""
    counted = (readings.kind == OBSERVED) & ~outliers(readings)
    if not counted.any():
        return 1.0
    size, taxel = np.abs(r[counted]), readings.taxel[counted]
    order = np.argsort(size)
    share = np.cumsum(1.0 / np.bincount(taxel)[taxel[order]])
    return float(size[order[np.searchsorted(share, 0.5 * share[-1])]]) / 0.6745


def successive_difference_scale(readings: Readings, r: Array) -> float:
    """Scale of what the residuals of a taxel change by from one contact to the next: noise, and
    little of what a wrong model does to them all alike.
    """
    heard = np.flatnonzero((readings.kind == OBSERVED) & ~outliers(readings))
    heard = heard[np.lexsort((readings.contact[heard], readings.taxel[heard]))]
    same = np.diff(readings.taxel[heard]) == 0
    change = np.abs(np.diff(r[heard]))[same]
    return float(np.median(change)) / (np.sqrt(2.0) * 0.6745) if len(change) else 1.0


def misfitting_taxels(readings: Readings, r: Array, scale: float) -> np.ndarray:
    """Taxels whose residuals cannot be chance, with noise of `scale`."""
    from scipy.stats import chi2

    n = len(readings.starts) - 1
    counted = ~outliers(readings) & ((readings.kind == OBSERVED) | (r != 0))
    count = np.bincount(readings.taxel, counted, n)
    total = np.bincount(readings.taxel, np.where(counted, r**2, 0.0), n) / scale**2
    chance = chi2.sf(total, np.maximum(count - 2, 1))
    return np.flatnonzero((total > MISFIT_RATIO * count) & (chance < SIGNIFICANCE))


def robust_weights(r: Array, scale: float, stage: float, cut: float = CUTOFF) -> Array:
    """Geman-McClure weights (k,) at a stage m; at m = 0, the probability that a reading is sound,
    one half where its residual is `cut`, in units of `scale`.
    """
    if not stage:
        from scipy.special import expit

        return np.asarray(expit((cut**2 - (r / scale) ** 2) / 2))
    c2 = stage * (2 / 3 * CUTOFF * scale) ** 2
    return np.asarray((c2 / (c2 + r**2)) ** 2)


def equal_odds_cutoff(r: Array, scale: float) -> float:
    """Residual, in units of `scale`, at which a reading is as likely sound as outlying.

    The sound of the residuals r (k,) are normal; the outlying ones, a share e of them, lie evenly
    over a width w: (1 - e) exp(-c^2 / 2) / sqrt(2 pi) = e / w. No less than LEAST_CUT, nor more
    than CUT.
    """
    out = np.abs(r) > CUTOFF * scale
    share = np.clip(np.mean(out), 1e-6, 0.5) if len(r) else 1e-6
    low, high = np.quantile(r[out], [0.25, 0.75]) / scale if out.any() else (0.0, 0.0)
    ratio = (1 - share) / share * max(2 * (high - low), 2 * CUTOFF) / np.sqrt(2 * np.pi)
    return float(np.clip(np.sqrt(2 * np.log(ratio)), MIN_CUTOFF, CUTOFF))


def swapped_taxels(
    data: Measurements, readings: Readings, points: Array, guilty: np.ndarray
) -> dict[int, int]:
    """Which of the taxels `guilty` (rows of `points`) read in one another's place.

    Their outlying readings lie about the other's position, both ways.
    """
    out = outliers(readings) & (readings.kind == OBSERVED)
    power = np.where(out, readings.level**2, 0.0)
    total = np.bincount(readings.taxel, power, len(points))
    where = np.stack(
        [np.bincount(readings.taxel, power * x, len(points))
         for x in data.points[readings.contact].T], axis=1
    )  # fmt: skip
    found: dict[int, int] = {}
    guilty = guilty[total[guilty] > 0]
    if len(guilty) < 2:
        return found
    where = where[guilty] / total[guilty, None]
    gap = np.linalg.norm(where[:, None] - points[guilty], axis=2)
    nearest = gap.argmin(axis=1)
    limit = 0.5 * float(np.median(reach(data)))
    there = gap < np.minimum(limit, 0.5 * np.diag(gap)[:, None])  # and far from its own place
    for a, b in enumerate(nearest):
        if a != b and nearest[b] == a and there[a, b] and there[b, a]:
            found[int(guilty[a])] = int(guilty[b])
    return found
