"""Statistics that detect outlying readings and faulty taxels.

Outlying readings are found by graduated non-convexity: Geman-McClure weights
w = (m c^2 / (m c^2 + r^2))^2, with m decreasing to 1. Then each reading is weighted by its
probability of being sound, among outlying ones that are uniformly distributed. Only taxels whose
chi-square chance cannot explain are weighted, so that sound recordings are estimated as if no
reading could be wrong.
Source: Yang, Antonante, Tzoumas, Carlone, "Graduated Non-Convexity for Robust Spatial Perception",
IEEE Robotics and Automation Letters 5 (2020).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import chdtrc

from ...core.arrays import MAD, Array, means_by_group, robust_sigma, sums_by_group
from ...scene.belief import RAW
from ..data.measurements import Measurements
from ..result import join_words
from .pressure import CENSORED, OBSERVED, SATURATED
from .readings import Readings

GNC_STAGES = (64.0, 16.0, 4.0, 1.0)
"""m of the stages: at the first, residuals up to 8 c keep a quarter of their weight; a factor of 4
between stages, as 1.4 to the power of four iterations in the source."""
CUTOFF = 4.5
"""Residual, in standard deviations, beyond which a reading is outlying: 7e-6 of the sound ones are,
less than one of a usual recording; c is two thirds of it, where the weight is a quarter."""
MIN_CUTOFF = 3.0
"""The least cutoff, where outlying readings are most frequent: 1 of 370 sound ones exceeds it."""
SIGNIFICANCE = 1e-9
"""Probability of a taxel's chi-square by chance, below which it misfits: 1000 recordings of 1000
sound taxels have a false alarm with a probability of 1e-3."""
CONTACT_SIGNIFICANCE = 0.1
"""Expected number of sound contacts of a recording that misfit by chance. Misfitting contacts are
looked for only where the test of fit fails."""
MISFIT_RATIO = 1.5
"""Chi-square per degree of freedom, relative to the typical one, up to which no taxel misfits,
whatever its number of readings: small errors of the model are significant in many readings."""
MAX_TAXEL_OUTLIERS = 0.5
"""Fraction of outlying readings from which a taxel's estimate is dropped: they are the majority."""
MAX_REWEIGHTINGS = 6
"""Largest number of weightings by probability after the stages."""
WEIGHT_TOLERANCE = 0.02
"""Change of a weight below which the weightings have converged."""
MIN_SCALE = 0.1
"""Least scale of the residuals where the noise is not known, in nominal noises: 0.1 % of the peak,
below which errors of the contact model, not noise, would decide."""
MAX_SCALE = 1.25
"""Scale of the remaining residuals, relative to the noise, up to which the outlying readings were
the cause of the misfit."""
MAX_OUTLIER_FRACTION = 0.35
"""Fraction of outlying readings, mean of the taxels, from which the model is taken to be wrong: the
median of the residuals breaks down at one half."""
MIN_UNANSWERED = 3
"""Number of contacts that press a taxel without a response, from which its silence is a fault."""
STUCK_SPREAD = 1.5
"""RMS spread of a stuck taxel's contacts, relative to their reach. A sound one's is 0.7 where it is
pressed evenly, at most 1 on a ring, and 1.44 there if E* is believed three times too high."""


@dataclass(frozen=True)
class StuckTaxels:
    """Taxels with a constant reading, whatever touches them."""

    rows: np.ndarray
    """Rows of the taxels."""
    level: Array
    """Their readings, Pa."""


def outliers(readings: Readings) -> np.ndarray:
    """Readings (k,) bool that are more likely outlying than sound."""
    return np.asarray(readings.weight < 0.5)


def even(readings: Readings) -> np.ndarray:
    """Readings (k,) bool that noise changes by more than an edge of the body may: their residuals
    tell of noise and model."""
    return np.asarray(readings.precision > 0.5)


def spread(readings: Readings, scale: float) -> Array:
    """Standard deviations (k,) of the residuals of all readings where that of the noise is `scale`,
    in units of the data's: what an edge of the body changes does not depend on the noise."""
    return np.asarray(np.sqrt(1.0 + readings.precision * (scale**2 - 1.0)))


def _telling(readings: Readings) -> np.ndarray:
    """Readings (k,) bool whose residuals depend on noise and model."""
    return (readings.kind == OBSERVED) & ~outliers(readings) & even(readings)


def mean_log_likelihood(
    readings: Readings, r: Array, scale: float, out: np.ndarray, width: float
) -> float:
    """Log-likelihood per reading, mean of the taxels, of a mixture.

    The readings `out` (k,) are outlying, uniform over `width`; the residuals r (k,) of the others
    are normal with the `spread` of `scale`, all in units of the noise.
    """
    read = readings.kind != CENSORED
    size, out, taxel = r[read], out[read], readings.taxel[read]
    sigma = spread(readings, scale)[read][~out]
    share = 1.0 / np.bincount(taxel)[taxel]
    share /= share.sum()
    outlying = float(share[out].sum())
    sound = -0.5 * (size[~out] / sigma) ** 2 - np.log(sigma * np.sqrt(2 * np.pi))
    mixture = outlying * np.log(max(outlying, 1e-300) / width)
    mixture += (1 - outlying) * np.log(max(1 - outlying, 1e-300))
    return mixture + float(share[~out] @ sound)


def outlier_fraction(readings: Readings) -> float:
    """Fraction of outlying readings, mean of the taxels: each counts equally."""
    read, n = readings.kind != CENSORED, len(readings.starts) - 1
    count = np.bincount(readings.taxel[read], minlength=n)
    out = np.bincount(readings.taxel[read & outliers(readings)], minlength=n)
    return float(np.mean(out[count > 0] / count[count > 0])) if count.any() else 0.0


def unanswered_presses(readings: Readings) -> np.ndarray:
    """Silent readings (k,) bool of taxels whose silence is a fault.

    Their silence elsewhere is not informative either.
    """
    silent, n = readings.kind == CENSORED, len(readings.starts) - 1
    count = np.bincount(readings.taxel[silent & outliers(readings)], minlength=n)
    return np.asarray(silent & (count >= MIN_UNANSWERED)[readings.taxel])


def stuck_taxels(data: Measurements) -> StuckTaxels:
    """Taxels with a constant reading in contacts further apart than one taxel can sense."""
    n, points = len(data.ids), data.points[data.contact]
    mean = means_by_group(data.pressure, data.taxel, n)
    off = data.pressure - mean[data.taxel]
    deviation = np.sqrt(means_by_group(off**2, data.taxel, n))
    centre = means_by_group(points, data.taxel, n)
    gap = np.sum((points - centre[data.taxel]) ** 2, axis=1)
    limit = (STUCK_SPREAD * data.reach()[data.contact]) ** 2
    far = np.bincount(data.taxel, gap - limit, n) > 0
    rows = np.flatnonzero(far & (deviation < 3 * data.sigma) & (mean > 3 * deviation))
    return StuckTaxels(rows, mean[rows])


def name_left_out(faults: np.ndarray, data: Measurements, stuck: StuckTaxels) -> None:
    """Add the corrupt readings that were left out, and when taxels ceased to answer, to the faults
    (n,); those of stuck taxels are their level alone."""
    for row, count in zip(*np.unique(data.corrupt[:, 1], return_counts=True), strict=True):
        left_out = f"{count} corrupt, stuck or negative readings left out"
        faults[row] = join_words(faults[row], left_out)
    for row, last in data.ended:
        after = data.time[last] - data.time[0]
        faults[row] = join_words(faults[row], f"answers no more after {after:.3g} s")
    raw = data.belief.readings == RAW
    for row, level in zip(stuck.rows, stuck.level * data.unit, strict=True):
        words = f"a level of {level:.3g}" if raw else f"{level / 1e3:.3g} kPa"
        faults[row] = f"stuck at {words}"


def residuals(readings: Readings, mu: Array, sigma: float) -> Array:
    """Residuals (k,) in units of their standard deviations by noise and edges; of censored readings
    the excess over their limit."""
    r = mu - readings.level / sigma
    r[readings.kind == CENSORED] = np.maximum(r[readings.kind == CENSORED], 0.0)
    r[readings.kind == SATURATED] = np.minimum(r[readings.kind == SATURATED], 0.0)
    return r * np.sqrt(readings.precision)


def beyond_edge(readings: Readings, r: Array, sigma: float) -> Array:
    """The residuals r (k,), of which those of silent readings count from where taxels answer: the
    expected reading that divides silent ones from others with the fewest on the wrong side.

    A response whose edge is less steep than the taxels' expects readings of all of them where none
    reads. No taxel is at fault there; one that is silent where others read at the same level is.
    """
    silent = readings.kind == CENSORED
    if not (r[silent] > 0).any():
        return r
    root = np.sqrt(readings.precision)
    above = r / root + np.where(silent, 0.0, readings.level - readings.level[silent].max()) / sigma
    order = np.argsort(-above)
    wrong = np.cumsum(np.where(silent[order], 1, -1))  # with a division after each
    last = int(np.argmin(wrong))
    edge = max(float(above[order[min(last + 1, len(order) - 1)]]), 0.0) if wrong[last] < 0 else 0.0
    return np.where(silent, np.maximum(r - edge * root, 0.0), r)


def reading_scale(readings: Readings, r: Array) -> float:
    """Robust standard deviation of the residuals r (k,), by the median of their sizes."""
    r = r[_telling(readings)]
    return robust_sigma(r) if len(r) else 1.0


def taxel_scale(readings: Readings, r: Array) -> float:
    """Robust standard deviation of the residuals r (k,), by a median in which all taxels count
    equally, however many readings they have.
    """
    counted = _telling(readings)
    if not counted.any():
        return 1.0
    size, taxel = np.abs(r[counted]), readings.taxel[counted]
    order = np.argsort(size)
    share = np.cumsum(1.0 / np.bincount(taxel)[taxel[order]])
    return float(size[order[np.searchsorted(share, 0.5 * share[-1])]]) / MAD


def successive_difference_scale(readings: Readings, r: Array) -> float:
    """Robust standard deviation of the noise, by the changes of a taxel's residuals r (k,) from one
    contact to the next: errors of the model change little.
    """
    used = np.flatnonzero(_telling(readings))
    used = used[np.lexsort((readings.contact[used], readings.taxel[used]))]
    same = np.diff(readings.taxel[used]) == 0
    change = np.abs(np.diff(r[used]))[same]
    return float(np.median(change)) / (np.sqrt(2.0) * MAD) if len(change) else 1.0


def misfitting_taxels(readings: Readings, r: Array, scale: float) -> np.ndarray:
    """Rows of the taxels whose residuals r (k,) chance does not explain, with noise of `scale`."""
    n = len(readings.starts) - 1
    counted = ~outliers(readings) & ((readings.kind == OBSERVED) | (r != 0))
    count = np.bincount(readings.taxel, counted, n)
    square = (r / spread(readings, scale)) ** 2
    total = np.bincount(readings.taxel, np.where(counted, square, 0.0), n)
    chance = chdtrc(np.maximum(count - 2, 1), total)
    return np.flatnonzero((total > MISFIT_RATIO * count) & (chance < SIGNIFICANCE))


def misfitting_contacts(readings: Readings, r: Array, scale: float) -> np.ndarray:
    """Contacts whose residuals r (k,) chance does not explain, with noise of `scale`."""
    counted = ~outliers(readings) & ((readings.kind == OBSERVED) | (r != 0))
    count = np.bincount(readings.contact[counted])
    square = (r / spread(readings, scale)) ** 2
    total = np.bincount(readings.contact[counted], square[counted])
    pressed = count > 0
    chance = np.where(pressed, chdtrc(np.maximum(count, 1), total), 1.0)
    return np.flatnonzero(chance < CONTACT_SIGNIFICANCE / max(int(pressed.sum()), 1))


def robust_weights(r: Array, stage: float, cutoff: float) -> Array:
    """Geman-McClure weights (k,) at a stage m of residuals r (k,), in standard deviations; at
    m = 0, the probability that a reading is sound, one half where its residual is `cutoff`.
    """
    if not stage:
        from scipy.special import expit

        return np.asarray(expit((cutoff**2 - r**2) / 2))
    c2 = stage * (2 / 3 * CUTOFF) ** 2
    return np.asarray((c2 / (c2 + r**2)) ** 2)


def equal_odds_cutoff(r: Array) -> float:
    """Residual at which a reading is as likely sound as outlying, in standard deviations, as r.

    The sound residuals of r (k,) are normal; the outlying ones, a fraction e, are uniform over a
    width w: (1 - e) exp(-c^2 / 2) / sqrt(2 pi) = e / w. Between MIN_CUTOFF and CUTOFF.
    """
    out = np.abs(r) > CUTOFF
    share = np.clip(np.mean(out), 1e-6, 0.5) if len(r) else 1e-6
    low, high = np.quantile(r[out], [0.25, 0.75]) if out.any() else (0.0, 0.0)
    ratio = (1 - share) / share * max(2 * (high - low), 2 * CUTOFF) / np.sqrt(2 * np.pi)
    return float(np.clip(np.sqrt(2 * np.log(ratio)), MIN_CUTOFF, CUTOFF))


def swapped_taxels(
    data: Measurements, readings: Readings, points: Array, faulty: np.ndarray
) -> dict[int, int]:
    """Pairs among the taxels `faulty` (rows of `points`, m) whose ids are exchanged.

    The outlying readings of each are centred about the other's position, and far from its own.
    """
    out = outliers(readings) & (readings.kind == OBSERVED)
    power = np.where(out, readings.level**2, 0.0)
    total = np.bincount(readings.taxel, power, len(points))
    contact_points = data.points[readings.contact]
    sums = sums_by_group(power[:, None] * contact_points, readings.taxel, len(points))
    faulty = faulty[total[faulty] > 0]
    if len(faulty) < 2:
        return {}
    centres = sums[faulty] / total[faulty, None]
    gap = np.linalg.norm(centres[:, None] - points[faulty], axis=2)
    nearest = gap.argmin(axis=1)
    limit = 0.5 * float(np.median(data.reach()))
    close = gap < np.minimum(limit, 0.5 * np.diag(gap)[:, None])
    return {
        int(faulty[a]): int(faulty[b])
        for a, b in enumerate(nearest)
        if a != b and nearest[b] == a and close[a, b] and close[b, a]
    }
