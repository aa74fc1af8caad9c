"""Evidence about one unit: the likelihood of its readings if it changed, relative to that if not.

The evidence is the mean of the likelihood ratio over the hypotheses, weighted by their prior
probabilities. If the unit did not change, its expected value is one, whatever the hypotheses and
the number of readings, and so it exceeds u / alpha with a probability of at most alpha / u
(Markov's inequality): over u units, false alarms have a probability of at most alpha.

Source: Gruenwald, de Heide, Koolen, "Safe Testing", J. R. Stat. Soc. B 86 (2024).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.special import logsumexp

from ...core.arrays import Array
from .hypotheses import (
    CONFIRMED,
    DEAD,
    EXCHANGED,
    GAIN,
    MOVED,
    TURNED,
    Hypothesis,
    discrete,
    grid,
    log_prior,
    moved,
    regained,
    ring,
    unchanged,
)
from .skin_map import SkinMap
from .touches import Block, Errors, Touches, covariance_of, log_likelihood

MIN_ODDS = float(np.log(100.0))
"""ln of the likelihood ratio by which each turn, exchange and death must be excluded before a unit
or a taxel is confirmed."""
MISFIT = 0.5
"""Part of the evidence needed that a unit must misfit by before its moves and gains are tried: a
move or gain that is found misfits by all of it."""
MAX_CHANGES = 3
"""Most changes of one unit that are looked for, one after the other."""
ANSWERED = 2.0
"""A taxel was touched if a reading of so many thresholds, or of 5 % of the peak, was expected."""
LEAST_READING = 0.05
"""That 5 %: less is a touch at the very edge of the taxel's reach."""


@dataclass(frozen=True)
class Change:
    """A change of a unit that was found."""

    hypothesis: Hypothesis
    log_evidence: float
    """ln of the evidence (see above)."""
    shift: Array = field(default_factory=lambda: np.zeros(3))
    """Estimated move (3,), m."""
    shift_covariance: Array = field(default_factory=lambda: np.zeros((3, 3)))
    log_gain: float = 0.0
    """Estimated change of ln gain."""
    log_gain_sigma: float = 0.0


@dataclass(frozen=True)
class Evidence:
    """What the readings say of a unit of k taxels."""

    null: float
    """ln likelihood if nothing changed."""
    state: Hypothesis
    """The unit with its changes."""
    changes: tuple[Change, ...]
    log_evidence: float
    """Of the change that comes next, which is not accepted; -inf where none was tried."""
    touched: np.ndarray
    """(k,) bool: whether an answer was expected, or given."""
    alive: np.ndarray
    """(k,) bool: whether a touched taxel's death is excluded."""
    confirmed: bool
    """Whether all turns, exchanges and the death of the unit are excluded."""


def judge(touches: Touches, known: SkinMap, unit: int, errors: Errors, limit: float) -> Evidence:
    """The changes of a unit whose ln evidence exceeds `limit`, and what else was excluded."""
    rows, state = known.units[unit], unchanged(known, unit)
    places, first = known.covariance[rows], None
    changes: list[Change] = []
    while True:
        block = touches.blocks(rows, places, [state], errors)[0]
        c = covariance_of(block, errors, places, state)
        null = log_likelihood(block, c, errors, touches.threshold)
        first = null if first is None else first
        misfit = _misfit(block, c, errors, touches.threshold)
        steps = _alternatives(touches, known, unit, state, misfit, limit)
        expected = np.zeros(len(rows))
        np.maximum.at(expected, block.taxel, block.mean)
        blocks = touches.blocks(rows, places, steps, errors)
        ratio = np.array([
            log_likelihood(
                b, covariance_of(b, errors, places, h), errors, touches.threshold
            ) for b, h in zip(blocks, steps, strict=True)
        ]) - null  # fmt: skip
        posterior = ratio + log_prior(steps, len(known.units), expected)
        evidence = float(logsumexp(posterior))
        if evidence <= limit or len(changes) == MAX_CHANGES:
            break
        change = _change(steps, blocks, posterior, errors, places, evidence)
        changes.append(change)
        state = replace(change.hypothesis, shift_sigma=0.0, gain_sigma=0.0)
        if state.state == GAIN:
            mine = (np.arange(len(rows)) == state.taxel) | (state.taxel < 0)
            residual = change.log_gain - change.hypothesis.change
            state = replace(state, log_gain=state.log_gain + residual * mine)
        if state.state == MOVED:
            offset = change.shift - np.array(change.hypothesis.shift)
            state = replace(state, points=state.points + offset)
            places = places + change.shift_covariance
    dead = np.array([r for r, h in zip(ratio, steps, strict=True) if h.state == DEAD])
    touched = np.zeros(len(rows), dtype=bool)
    answers = block.mean > max(ANSWERED * touches.threshold, LEAST_READING)
    touched[block.taxel[answers | block.read]] = True
    excluded = [
        r < -MIN_ODDS for r, h in zip(ratio, steps, strict=True)
        if h.state in (TURNED, EXCHANGED)
    ]  # fmt: skip
    whole, alive = dead[0] < -MIN_ODDS, dead[-len(rows) :] < -MIN_ODDS
    return Evidence(
        first,
        state,
        tuple(changes),
        evidence,
        touched,
        touched & alive,
        bool(whole and all(excluded)),
    )


def is_placed(
    touches: Touches, known: SkinMap, unit: int, errors: Errors, state: Hypothesis
) -> bool:
    """Whether a move of a unit in `state` by MOVE, in each of eight directions, is excluded."""
    rows = known.units[unit]
    places = known.covariance[rows]
    steps = [state, *moved(state, touches.data.body, ring())]
    null, *moves = [
        log_likelihood(b, covariance_of(b, errors, places, h), errors, touches.threshold)
        for b, h in zip(touches.blocks(rows, places, steps, errors), steps, strict=True)
    ]
    return max(moves) < null - MIN_ODDS


def _alternatives(
    touches: Touches,
    known: SkinMap,
    unit: int,
    state: Hypothesis,
    misfit: float,
    limit: float,
) -> list[Hypothesis]:
    """The hypotheses about a unit; continuous ones only where it misfits (which makes the evidence
    smaller, never larger)."""
    found = discrete(known, unit, state, touches)
    if misfit < MISFIT * limit:
        return found
    if state.state == CONFIRMED:
        found += moved(state, touches.data.body, grid())
    return found + regained(state, known.slots is None)


def _misfit(block: Block, c: Array, errors: Errors, threshold: float) -> float:
    """By how much the ln likelihood is below that of readings as expected."""
    as_expected = np.where(block.read, block.mean, np.nan)
    perfect = log_likelihood(replace(block, level=as_expected), c, errors, threshold)
    return perfect - log_likelihood(block, c, errors, threshold)


def _change(
    steps: list[Hypothesis],
    blocks: list[Block],
    posterior: Array,
    errors: Errors,
    places: Array,
    evidence: float,
) -> Change:
    """The most probable kind of change, with the estimate of what it leaves open."""
    kinds = [(h.state, h.taxel, h.value) for h in steps]
    total = {
        kind: logsumexp([p for p, k in zip(posterior, kinds, strict=True) if k == kind])
        for kind in kinds
    }
    best = max(total, key=lambda kind: float(total[kind]))
    if best[0] in (DEAD, GAIN) and best[1] < 0:  # one taxel alone explains as much: no more is said
        alone = {k: v for k, v in total.items() if k[0] == best[0] and k[1] >= 0}
        single = max(alone, key=lambda kind: float(alone[kind]), default=best)
        best = single if total[single] > total[best] - MIN_ODDS else best
    mine = [k for k, kind in enumerate(kinds) if kind == best]
    first = max(mine, key=lambda k: posterior[k])
    share = np.exp(posterior[mine] - logsumexp(posterior[mine]))
    if best[0] not in (MOVED, GAIN):
        return Change(steps[first], evidence)
    estimates = [_estimate(steps[k], blocks[k], errors, places) for k in mine]
    mean = np.array([m for m, _ in estimates])
    centre = share @ mean
    spread = np.einsum("h,hi,hj->ij", share, mean - centre, mean - centre)
    covariance = spread + np.einsum("h,hij->ij", share, np.array([c for _, c in estimates]))
    if best[0] == MOVED:
        return Change(steps[first], evidence, shift=centre, shift_covariance=covariance)
    return Change(
        steps[first], evidence, log_gain=float(centre[0]),
        log_gain_sigma=float(np.sqrt(covariance[0, 0])),
    )  # fmt: skip


def _estimate(h: Hypothesis, block: Block, errors: Errors, places: Array) -> tuple[Array, Array]:
    """Posterior mean (d,) and covariance (d, d) of the move, m, or of the change of ln gain."""
    at = np.array(h.shift) if h.state == MOVED else np.array([h.change])
    sigma = h.shift_sigma if h.state == MOVED else h.gain_sigma
    by = h.open_slopes(block.taxel, block.slope, block.mean)
    assert by is not None
    read = np.flatnonzero(block.read)
    prior = np.eye(len(at))
    if h.state == MOVED:
        up = h.normals.mean(axis=0)
        prior -= np.outer(up, up) / (up @ up)
    if not len(read):
        return at, sigma**2 * prior
    c = covariance_of(block, errors, places, h)[np.ix_(read, read)]
    solved = cho_solve(cho_factor(c, lower=True), by[read])
    mean = at + sigma * solved.T @ (block.level - block.mean)[read]
    return mean, sigma**2 * (prior - by[read].T @ solved)
