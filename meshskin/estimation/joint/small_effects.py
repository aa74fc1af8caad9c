"""Many small errors of the readings that no single parameter describes, as random effects.

An estimate that leaves them out is wrong where they pass for displacements of the taxels: its
residuals hardly show that. To first order the logarithm of the likelihood of the effects x is
slope x - x information x / 2 with all other unknowns at their best. In some of the blocks of
effects they are normal with one variance, in the others zero; variance and number of blocks are
those of the largest marginal likelihood, which near zero is that of the estimate without them.
Their mean given the readings tells how far the taxels move, and their covariance how well this is
known.

Three effects hardly show in the readings, and are held to first order: lags of readings too small
to be estimated as a departure, gains that drift apart, and patches that the shape of the body
displaces. Their sizes have a prior, and the mean over all sizes counts.

Sources: Robinson, "That BLUP is a good thing: the estimation of random effects", Statistical
Science 6 (1991); Mitchell, Beauchamp, "Bayesian variable selection in linear regression", Journal
of the American Statistical Association 83 (1988); Hoeting, Madigan, Raftery, Volinsky, "Bayesian
model averaging: a tutorial", Statistical Science 14 (1999).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit, logit

from ...core.arrays import Array
from .departures import FittedReadings
from .reading_sums import CONTACT_SIZE

DEVIATIONS = np.geomspace(1e-3, 0.3, 25)
"""Standard deviations of the effects that are tried, shares of a reading: less displaces no taxel
by a tenth of its standard deviation, more is not small. Neighbours differ by a factor of 1.27:
between them the marginal likelihood is flat."""
PARTS = 15
"""Numbers of blocks with effects that are tried, from half a block to all."""

LEAST_SHARED = 4.0
"""Score, in standard deviations, from which effects that all taxels share move these: of lags, 0 to
2.2 in 92 recordings without lags, of 35 worlds; 4.3 to 9.8 with lags."""
SINGULAR = 1e-9
"""Information, relative to the largest of its block, up to which there is none: by rounding."""
OWN_DRIFTS = "gains that drift in each taxel by another part"
OWN_SPREADS = np.geomspace(0.03, 1.0, 8)
"""Standard deviations of the taxels' own drifts that are tried, relative to the common one. With
them 0.84 and 1.12 of the error is stated in the world warming_apart of studies/foreign_worlds.py at
61 taxels, 0.48 without (seeds 0 and 2), and 1.07 to 1.20 in the world warming, where all drift
alike, as without (seeds 0 to 2)."""
TOGETHER = 0.8
"""Probability, before the readings, that all taxels are read at once. Chosen: in the world hertz of
studies/foreign_worlds.py with a scan of 0.06 of a frame 1.04, 0.69 and 1.59 times the error is
stated with it, 1.04, 0.58 and 1.58 with 0.95, and 0.27, 0.27 and 0.68 without lags (three seeds);
without a scan all are equal."""
LAGGING = 0.5
"""Probability, before the readings, that they lag, under a learned response."""
SPREADS = np.geomspace(0.01, 1.0, 12)
"""Standard deviations of the lags that are tried, relative to that of channels whose reading takes
the whole frame: less displaces no taxel by a thousandth of the contacts' distance."""
AHEAD = 0.8
"""Probability, before the readings, that lags differ where a common one is estimated that is none
of friction, with the patches ahead of the contacts. There it counts as a whole. Chosen: of scans of
0.1 of a frame in any order 0.79 to 1.01 of the error is stated with it, and 0.34 to 0.38 without
(studies/foreign_worlds.py --worlds scan_places scan_drawn, at 61 taxels)."""
ALIKE = 3.0
"""Difference of log-likelihoods up to which orders of the channels are not told apart where a
common lag is estimated: there the largest mean squares of these count. With the mean over the
orders, in which one with small lags may be ahead by chance, 0.68 of the error is stated in the
world scan_drawn, and 0.84 with it."""
HELD_LAGS = "taxels that are read one after another, held to first order"
NAMED = float(2 * np.log(TOGETHER / (1 - TOGETHER))) ** 0.5
"""Score from which lags are named: readings are then four times as likely with them."""
PRIOR = np.array([3.0, 1.0])
"""Mean squares of the common lag and of the other ones, relative to the variance of the lags: those
of channels that are read evenly from the contact's time on."""
SHIFTED = "patches displaced where the curvature of the body changes, held to first order"
SHIFTS = 0.2
"""Probability, before the readings, that the factor is not zero; its variance is then 1."""
MODEL_ERROR = 0.5
"""Error of the displacements by springs, relative to them, where the factor is estimated: 0.42 to
0.58 (rms of the contacts) from those of Drake's hydroelastic contact on a robot's forearm, with the
factor that was estimated, in three recordings."""


@dataclass(frozen=True)
class SmallEffects:
    """What small errors displace the taxels by."""

    score: float
    """In standard deviations: the root of twice the gain in the logarithm of the likelihood."""
    displacements: Array
    """(n, 2), m, of the taxels along their tangents, by errors that the estimate lacks."""
    covariances: Array
    """(n, 2, 2), m^2, of these."""

    def held(self) -> SmallEffects:
        """These where it is not certain that they are what displaces the taxels: the taxels stay,
        and the squares of their displacements count in the covariances."""
        square = self.displacements[:, :, None] * self.displacements[:, None]
        return SmallEffects(
            self.score, np.zeros_like(self.displacements), self.covariances + square
        )

    @classmethod
    def along(
        cls, score: float, moved: Array, mean: Array | float, square: Array | float
    ) -> SmallEffects:
        """Those of a parameter of each taxel, or of all, with a mean (n,) and a mean square (n,);
        moved (n, 2), m: by a unit of it."""
        mean, square = (np.broadcast_to(x, len(moved)) for x in (mean, square))
        within = (square - mean**2)[:, None, None] * moved[:, :, None] * moved[:, None]
        return cls(score, mean[:, None] * moved, within)

    @classmethod
    def none(cls, count: int, score: float = 0.0) -> SmallEffects:
        """None of `count` taxels."""
        return cls(score, np.zeros((count, 2)), np.zeros((count, 2, 2)))


def shared_effects(
    fitted: FittedReadings, columns: Array, slope: Array, information: Array
) -> SmallEffects:
    """Effects that all taxels share, with the derivatives `columns` (k, q) of the readings, and the
    slope (q,) and information (q, q) of the logarithm of the likelihood; none up to
    LEAST_SHARED."""
    score, mean, covariance = most_likely(slope[None], information[None])
    if score < LEAST_SHARED:
        return SmallEffects.none(len(fitted.points), score)
    moved = fitted.displaced(columns)
    across = moved @ covariance[0] @ np.swapaxes(moved, 1, 2)
    return SmallEffects(score, moved @ mean[0], across)


def most_likely(slope: Array, information: Array) -> tuple[float, Array, Array]:
    """Score of normal effects of the most likely variance in some of b blocks, and their mean
    (b, q) and covariance (b, q, q) given the readings; slope (b, q) and information (b, q, q): of
    the logarithm of the likelihood at zero."""
    value, vectors = np.linalg.eigh(information)
    seen = value > SINGULAR * value.max(axis=1, initial=0.0, keepdims=True)
    value = np.where(seen, value, 0.0)
    along = np.where(seen, np.einsum("bqe,bq->be", vectors, slope), 0.0)
    variance = DEVIATIONS[:, None, None] ** 2
    narrower = 1 / (1 + variance * value)
    gain = np.sum(variance * narrower * along**2 + np.log(narrower), axis=2) / 2
    part = np.geomspace(0.5 / len(slope), 1 - 1e-9, PARTS)[:, None, None]
    total = np.logaddexp(np.log1p(-part), np.log(part) + gain)
    best, at = np.unravel_index(np.argmax(total.sum(axis=2)), total.shape[:2])
    has = np.exp(np.log(part[best, 0]) + gain[at] - total[best, at])
    scaled = vectors * (variance * narrower)[at][:, None]
    mean, within = np.einsum("bqe,be->bq", scaled, along), scaled @ np.swapaxes(vectors, 1, 2)
    between = (has * (1 - has))[:, None, None] * mean[:, :, None] * mean[:, None]
    score = (2 * max(float(total[best, at].sum()), 0.0)) ** 0.5
    return score, has[:, None] * mean, has[:, None, None] * within + between


def held_lags(fitted: FittedReadings, drag: float = 0.0) -> SmallEffects:
    """How far lags displace the taxels, and what they add to the tangential covariances.

    A contact that moves on until a taxel is read displaces that taxel. Where taxels are crossed in
    one direction only, hardly anything shows it: a common lag by the curvature of the path, the
    duration of a scan and the order of its channels where taxels are crossed in several directions.
    The size of the lags has a log-uniform prior, or they are zero; the common one and the others
    are those of a scan that begins at the contacts' time.

    Under a learned response nothing is known of the clocks. The mean over both models and all sizes
    is what the taxels are moved by, and the variance about it counts in the covariances. Under a
    contact model, and where a common lag is estimated, as drag or friction, the taxels stay, and
    the mean squares count by the part by which the readings raise the probability of lags: else the
    prior's lags would be in each sound recording in which taxels are crossed in one direction.

    drag: distance, m, of the patches behind the contacts by drag or friction, if it is estimated:
    the common lag.
    """
    data, n, learned = fitted.data, len(fitted.points), fitted.system is not None
    steps = np.linalg.norm(np.diff(data.points, axis=0), axis=1)
    unit = float(np.median(steps)) / 12**0.5 if len(steps) else 0.0
    if not unit > 0 or "skew" in data.parameters.nuisance_names:  # each taxel's is estimated
        return SmallEffects.none(n)
    late, alone = unit * fitted.moved(data.headway[:, :, None]), of_single_taxels(fitted)
    variances = np.array([drag**2 / PRIOR[0] / unit**2]) if drag else SPREADS**2
    order, places = np.argsort(np.argsort(data.ids[fitted.readings.live])), fitted.points
    of_ids, by_place = (order[:, None] + 0.5) / n, places - places.mean(axis=0)
    trials = list(_of_a_scan(fitted, late, variances, drag, of_ids - of_ids.mean()))
    if drag:  # else other errors pass for them: an ellipsoid had 1.5 times the error
        trials += _of_a_scan(fitted, late, variances, drag, by_place)
    elif learned:
        trials += _of_a_scan(fitted, late, variances, drag, np.empty((n, 0)))
    if drag or not learned:  # else errors of the contacts pass for them
        trials += of_their_own(alone, late[:, 0], variances, 0.0 if drag else float(PRIOR[0]))
    gain, mean, square = (np.array(part) for part in zip(*trials, strict=True))
    largest = float(gain.max())
    weight = np.exp(gain - largest)
    evidence = largest + float(np.log(weight.mean()))
    prior = AHEAD if drag < 0 else LAGGING if learned and not drag else 1 - TOGETHER
    probability = float(expit(logit(prior) + evidence))
    if drag > 0 or not learned:  # by what the readings raise it: where they say nothing, none
        probability = max(probability - prior, 0.0) / (1 - prior)
    weight *= probability / weight.sum()
    square = probability * square[gain > largest - ALIKE].max(axis=0) if drag else weight @ square
    mean = weight @ mean if learned and not drag else np.zeros(n)
    score = (2 * max(evidence, 0.0)) ** 0.5
    return SmallEffects.along(score, alone.displaced(late)[:, :, 0], mean, square)


def own_drifts(fitted: FittedReadings, drift: Array) -> SmallEffects:
    """What gains displace the taxels by that drift in each by another part of the common `drift`
    (m,) of their logarithms, as sensitivities to temperature differ.

    Where contacts proceed across a taxel while its gain drifts, hardly anything shows it. The size
    of these parts therefore has a log-uniform prior, as that of lags.
    """
    level = np.maximum(fitted.mu - fitted.offset, 0.0)
    column, alone = level * drift[fitted.readings.contact], of_single_taxels(fitted)
    trials = zip(*of_their_own(alone, column, OWN_SPREADS**2), strict=True)
    gain, mean, square = (np.array(part) for part in trials)
    weight = np.exp(gain - gain.max()) / np.sum(np.exp(gain - gain.max()))
    moved = alone.displaced(column[:, None])[:, :, 0]
    return SmallEffects.along(0.0, moved, weight @ mean, weight @ square)


def contact_leverages(fitted: FittedReadings) -> Array:
    """Leverages (k,) of the readings in the errors of their contacts, the other unknowns known."""
    assert fitted.system is not None
    jacobian = fitted.jacobian[:, -CONTACT_SIZE:]
    inverse = np.linalg.inv(fitted.system.contacts)[fitted.readings.contact]
    return np.asarray(fitted.curvature * np.einsum("ka,kab,kb->k", jacobian, inverse, jacobian))


def of_single_taxels(fitted: FittedReadings) -> FittedReadings:
    """The readings of each taxel as if the others were known, at the optimum: what is not known of
    the errors of its contacts is noise of its readings."""
    if (system := fitted.system) is None:
        return fitted
    step = system.solve(*(part[..., None] for part in system.gradient))
    rate = fitted.rate - fitted.curvature * system.forward(fitted.jacobian, step)[:, 0]
    free = np.maximum(1 - contact_leverages(fitted), 0.0)
    return replace(fitted, rate=rate, curvature=fitted.curvature * free, system=None)


def _of_a_scan(
    fitted: FittedReadings, late: Array, variances: Array, drag: float, order: Array
) -> Iterator[tuple[float, Array, Array]]:
    """Of each of the variances, the gain in the log-likelihood by a common lag and one that rises
    with `order` (n, q), and the means (n,) and mean squares (n,) of their sums; `drag` stands for
    the first. Without an order, the others are as large as those of a scan of the common one."""
    n, q = order.shape
    rises = order / max(float(np.mean(np.sum(order**2, axis=1))), 1e-300) ** 0.5
    columns = rises if drag else np.column_stack([np.ones(n), rises])
    prior = np.append(PRIOR[:1], np.full(q, PRIOR[1]))[-columns.shape[1] :]
    slope, information = fitted.shared(late * columns[fitted.readings.taxel])
    for variance in variances:
        gain, lag, covariance = _posterior(slope, information, variance * prior)
        mean = columns @ lag
        square = mean**2 + np.einsum("ni,ij,nj->n", columns, covariance, columns)
        yield gain, mean, square if q else square * (1 + PRIOR[1] / PRIOR[0])


def of_their_own(
    alone: FittedReadings, column: Array, variances: Array, common: float = 0.0
) -> Iterator[tuple[float, Array, Array]]:
    """Of each of the variances, the gain in the log-likelihood by a parameter of each taxel, with
    the derivatives `column` (k,) of its readings, and the means (n,) and mean squares (n,) of the
    parameters; beside a common one of `common` times the variance, if any."""
    slope, information = alone.each(column)
    information = np.maximum(information, 0.0)
    for variance in variances:
        narrower = 1 / (1 + variance * information)
        gain = float(np.sum(variance * slope**2 * narrower + np.log(narrower))) / 2
        mean, within = variance * slope * narrower, variance * narrower
        if common:
            sums = np.array([slope @ narrower]), np.array([[information @ narrower]])
            more, shared, covariance = _posterior(*sums, np.array([variance * common]))
            gain, mean = gain + more, mean + shared * narrower
            within = within + covariance[0, 0] * narrower**2
        yield gain, mean, mean**2 + within


def _posterior(slope: Array, information: Array, prior: Array) -> tuple[float, Array, Array]:
    """Gain in the log-likelihood by normal parameters of variances `prior` (q,), their mean (q,)
    and covariance (q, q); slope (q,) and information (q, q): at zero."""
    matrix = np.diag(1 / prior) + information
    covariance = np.linalg.inv(matrix)
    mean = covariance @ slope
    volume = np.linalg.slogdet(np.diag(prior) @ matrix)[1]
    return float(slope @ mean - volume) / 2, mean, np.asarray(covariance)


def shifted_patches(fitted: FittedReadings, factor: float = 0.0) -> SmallEffects:
    """What patches displaced by the shape of the body add to the tangential covariances; the taxels
    stay.

    Where the curvature of the body changes within a patch, as beside a fillet, the pressure leans
    to the flatter side. Taxels there are displaced alike, so that residuals hardly show it. How far
    is known from the body but for a factor: about 1 of a foundation of springs as wide as believed,
    less of a deep layer, more of a softer one, and 0 of a patch about the contact point.

    factor: where it is estimated with the taxels; what a foundation of springs gets wrong is left.
    """
    data, n = fitted.data, len(fitted.points)
    column = fitted.moved(data.patch_shifts[:, :, None])
    if not column.any():
        return SmallEffects.none(n)
    if factor:
        moved = MODEL_ERROR * factor * of_single_taxels(fitted).displaced(column)[:, :, 0]
        return SmallEffects.along(0.0, moved, 0.0, 1.0)
    evidence, (mean,), covariance = _posterior(*fitted.shared(column), np.ones(1))
    square = float(expit(evidence + logit(SHIFTS))) * (covariance[0, 0] + mean**2)
    moved = fitted.displaced(column)[:, :, 0]
    return SmallEffects.along(max(2 * evidence, 0.0) ** 0.5, moved, 0.0, square)
