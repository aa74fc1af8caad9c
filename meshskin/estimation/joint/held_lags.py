"""Lags of taxels that are read one after another, too small to be estimated, in their covariances.

A contact that moves on while the channels of a skin are read displaces each taxel by the time of
its channel. Where a taxel is crossed in one direction only, nothing shows that: those few that are
crossed in several tell how long a scan takes, and the order of the channels where the others are.
Lags are a common one and a part that rises with the ids or along the skin, or that each taxel has
of its own; their size has a prior with a part at zero. The estimate is not moved: the mean squares
of the lags, given the readings and over all sizes, count in the covariances, by the part by which
the readings raise the probability of lags. That part is a choice: the average over all models would
add the prior's lags to each sound recording in which taxels are crossed in one direction.

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
"""Score from which lags are named: they are then as likely as none."""
PRIOR = np.array([3.0, 1.0])
"""Mean squares of the common lag and of the other ones, relative to the variance of the lags: those
of channels that are read evenly from the contact's time on."""


def held_lags(fitted: FittedReadings, drag: float = 0.0) -> SmallEffects:
    """What lags add to the tangential covariances; the taxels stay.

    drag: distance, m, of the patches behind the contacts, if it is estimated: the common lag. The
    size of the others is then that of a scan which begins at the contacts' time.
    """
    data, n = fitted.data, len(fitted.points)
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
    if fitted.system is None or drag:  # else errors of the contacts pass for them
        trials += _of_their_own(alone, late, variances, drag)
    gain, square = (np.array(part) for part in zip(*trials, strict=True))
    largest = float(gain.max())
    weight = np.exp(gain - largest)
    evidence = largest + float(np.log(weight.mean()))
    prior, least = (AHEAD, 0.0) if drag < 0 else (1 - TOGETHER, 1 - TOGETHER)
    # the part by which the readings raise the probability of lags: where they say nothing, none
    raised = max(float(expit(logit(prior) + evidence)) - least, 0.0) / (1 - least)
    moved = alone.displaced(late)[:, :, 0]
    along = moved[:, :, None] * moved[:, None]
    square = square[gain > largest - ALIKE].max(axis=0) if drag else weight / weight.sum() @ square
    mean = raised * square
    score = (2 * max(evidence, 0.0)) ** 0.5
    return SmallEffects(score, np.zeros((n, 2)), mean[:, None, None] * along)


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
) -> Iterator[tuple[float, Array]]:
    """Of each of the variances, the gain in the log-likelihood by a common lag and one that rises
    with `order` (n, q), and the mean squares (n,) of their sums; `drag` stands for the first."""
    rises = order / max(float(np.mean(np.sum(order**2, axis=1))), 1e-300) ** 0.5
    columns = np.column_stack([np.ones(len(rises)), rises])
    prior = np.append(PRIOR[0], np.full(rises.shape[1], PRIOR[1]))
    if drag:
        columns, prior = rises, prior[1:]
    slope, information = fitted.shared(late * columns[fitted.readings.taxel])
    for variance in variances:
        gain, mean, covariance = _posterior(slope, information, variance * prior)
        within = np.einsum("ni,ij,nj->n", columns, covariance, columns)
        yield gain, (columns @ mean) ** 2 + within


def _of_their_own(
    alone: FittedReadings, late: Array, variances: Array, drag: float
) -> Iterator[tuple[float, Array]]:
    """As `_of_a_scan`, by a common lag and one of each taxel."""
    slope, information = alone.each(late[:, 0])
    information = np.maximum(information, 0.0)
    for variance in variances:
        narrower = 1 / (1 + variance * information)
        gain = float(np.sum(variance * slope**2 * narrower + np.log(narrower))) / 2
        mean, within = variance * slope * narrower, variance * narrower
        if not drag:
            common = np.array([slope @ narrower]), np.array([[information @ narrower]])
            more, shared, covariance = _posterior(*common, variance * PRIOR[:1])
            gain, mean = gain + more, mean + shared * narrower
            within = within + covariance[0, 0] * narrower**2
        yield gain, mean**2 + within


def _posterior(slope: Array, information: Array, prior: Array) -> tuple[float, Array, Array]:
    """Gain in the log-likelihood by normal parameters of variances `prior` (q,), their mean (q,)
    and covariance (q, q); slope (q,) and information (q, q): at zero."""
    matrix = np.diag(1 / prior) + information
    covariance = np.linalg.inv(matrix)
    mean = covariance @ slope
    volume = np.linalg.slogdet(np.diag(prior) @ matrix)[1]
    return float(slope @ mean - volume) / 2, mean, np.asarray(covariance)
