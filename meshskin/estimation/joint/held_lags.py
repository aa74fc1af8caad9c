"""Lags of readings that are too small to be estimated as a departure: a common one, and those of
taxels that are read one after another.

A contact that moves on until a taxel is read displaces that taxel. Where taxels are crossed in one
direction only, hardly anything shows it: a common lag by the curvature of the path, the duration of
a scan and the order of its channels where taxels are crossed in several directions. The size of the
lags has a log-uniform prior, or they are zero; the common one and the others are those of a scan
that begins at the contacts' time.

Under a learned response nothing is known of the clocks. The mean over both models and all sizes is
what the taxels are moved by, and the variance about it counts in the covariances. Under a contact
model, and where a common lag is estimated, as drag or friction, the taxels stay, and the mean
squares count by the part by which the readings raise the probability of lags: else the prior's lags
would be in each sound recording in which taxels are crossed in one direction.

Source: Hoeting, Madigan, Raftery, Volinsky, "Bayesian model averaging: a tutorial", Statistical
Science 14 (1999).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
from scipy.special import expit, logit

from ...core.arrays import Array
from .departures import FittedReadings
from .reading_sums import CONTACT_SIZE
from .small_effects import SmallEffects

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


def held_lags(fitted: FittedReadings, drag: float = 0.0) -> SmallEffects:
    """How far lags displace the taxels, and what they add to the tangential covariances.

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
    moved = alone.displaced(late)[:, :, 0]
    within = (square - mean**2)[:, None, None] * moved[:, :, None] * moved[:, None]
    return SmallEffects((2 * max(evidence, 0.0)) ** 0.5, mean[:, None] * moved, within)


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
