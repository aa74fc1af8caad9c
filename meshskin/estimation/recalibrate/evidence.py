"""Evidence about one unit: the likelihood of its readings if it changed, relative to that if not.

The evidence is the mean of the likelihood ratio over the hypotheses, weighted by their prior
probabilities. If the unit did not change, its expected value is one, whatever the hypotheses and
the number of readings, and so it exceeds u / alpha with a probability of at most alpha / u
(Markov's inequality): over u units, false alarms have a probability of at most alpha. Where the
evidence is nearly that large, its probability if the unit did not change is drawn (chance.py).

Source: Gruenwald, de Heide, Koolen, "Safe Testing", J. R. Stat. Soc. B 86 (2024).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.special import logsumexp

from ...core.arrays import Array
from .chance import log_chance
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
SLACK = 6.0
"""How far the ln evidence may be below what Markov's inequality asks for the probability to be
drawn: that inequality is too wide by 2 to 4 there, and drawing takes a second."""
MAX_DRAWN = 4_000_000
"""Largest number of entries of the covariances of all hypotheses, of which readings are drawn: 32
MB; a unit with more readings than that, about 100, shows its changes without."""
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
    log_chance: float = 0.0
    """ln of a bound on the probability of so large an evidence if there is no change."""
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
    """The changes of a unit that would be found with a probability of at most exp(-limit) if it had
    not changed, and what else was excluded."""
    rows, state = known.units[unit], unchanged(known, unit)
    places, first = known.covariance[rows], None
    changes: list[Change] = []
    while True:
        tried = _trial(touches, known, unit, state, places, errors, limit)
        first = tried.null if first is None else first
        evidence = float(logsumexp(tried.posterior))
        log_chance = _log_chance(touches, rows, places, state, tried, errors, evidence, limit)
        if log_chance > -limit or len(changes) == MAX_CHANGES:
            break
        change = replace(_change(tried, errors, places, evidence), log_chance=log_chance)
        changes.append(change)
        state = _changed(change, len(rows))
        places = places + change.shift_covariance
    touched, alive, confirmed = _excluded(tried, touches.threshold, len(rows))
    return Evidence(first, state, tuple(changes), evidence, touched, alive, confirmed)


@dataclass(frozen=True)
class _Trial:
    """The alternatives to a state of a unit, and what the readings say of them."""

    null: float
    """ln likelihood of the state."""
    block: Block
    """The readings under it."""
    steps: list[Hypothesis]
    blocks: list[Block]
    """The readings under each of the steps (h,)."""
    ratio: Array
    """ln likelihoods (h,) relative to that of the state."""
    log_prior: Array
    """ln prior probabilities (h,)."""

    @property
    def posterior(self) -> Array:
        """ln (h,) of the probabilities of the steps, relative to that of the state."""
        return self.ratio + self.log_prior


def _trial(
    touches: Touches,
    known: SkinMap,
    unit: int,
    state: Hypothesis,
    places: Array,
    errors: Errors,
    limit: float,
) -> _Trial:
    """The alternatives to `state`; continuous ones only where the unit misfits (which makes the
    evidence smaller, never larger)."""
    rows, threshold = known.units[unit], touches.threshold
    block = touches.blocks(rows, places, [state], errors)[0]
    c = covariance_of(block, errors, places, state)
    null = log_likelihood(block, c, errors, threshold)
    steps = discrete(known, unit, state, touches)
    if _misfit(block, c, errors, threshold) >= MISFIT * limit:
        if state.state == CONFIRMED:
            steps += moved(state, touches.data.body, grid())
        steps += regained(state, known.slots is None)
    blocks = touches.blocks(rows, places, steps, errors)
    ratio = np.array([
        log_likelihood(b, covariance_of(b, errors, places, h), errors, threshold)
        for b, h in zip(blocks, steps, strict=True)
    ]) - null  # fmt: skip
    expected = np.zeros(len(rows))
    np.maximum.at(expected, block.taxel, block.mean)
    return _Trial(null, block, steps, blocks, ratio, log_prior(steps, len(known.units), expected))


def _log_chance(
    touches: Touches,
    rows: np.ndarray,
    places: Array,
    state: Hypothesis,
    tried: _Trial,
    errors: Errors,
    evidence: float,
    limit: float,
) -> float:
    """ln of a bound on the probability of so large an evidence if the unit is in `state`: Markov's,
    or, where that does not suffice but might nearly, the drawn one."""
    if not limit - SLACK < evidence <= limit:
        return -evidence
    steps = [state, *tried.steps]
    blocks = touches.blocks(rows, places, steps, errors, same_pairs=True)
    if len(steps) * len(blocks[0].mean) ** 2 > MAX_DRAWN:
        return -evidence
    mean = np.stack([b.mean for b in blocks])
    c = np.stack([
        covariance_of(b, errors, places, h) for b, h in zip(blocks, steps, strict=True)
    ])  # fmt: skip
    return log_chance(mean, c, tried.log_prior, evidence, errors, touches.threshold)


def _changed(change: Change, k: int) -> Hypothesis:
    """The unit of k taxels after a change, at the estimate of what it left open."""
    state = replace(change.hypothesis, shift_sigma=0.0, gain_sigma=0.0)
    if state.state == GAIN:
        mine = (np.arange(k) == state.taxel) | (state.taxel < 0)
        residual = change.log_gain - change.hypothesis.change
        return replace(state, log_gain=state.log_gain + residual * mine)
    if state.state == MOVED:
        offset = change.shift - np.array(change.hypothesis.shift)
        return replace(state, points=state.points + offset)
    return state


def _excluded(tried: _Trial, threshold: float, k: int) -> tuple[np.ndarray, np.ndarray, bool]:
    """Which of the k taxels (k,) were touched, which of these (k,) are not dead, and whether all
    turns, exchanges and the death of the unit are excluded."""
    block, out = tried.block, tried.ratio < -MIN_ODDS
    touched = np.zeros(k, dtype=bool)
    answers = block.mean > max(ANSWERED * threshold, LEAST_READING)
    touched[block.taxel[answers | block.read]] = True
    states = np.array([h.state for h in tried.steps], dtype=object)
    dead = out[states == DEAD]  # the whole unit, and then each of its taxels
    confirmed = dead[0] and out[np.isin(states, (TURNED, EXCHANGED))].all()
    return touched, touched & dead[-k:], bool(confirmed)


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


def _misfit(block: Block, c: Array, errors: Errors, threshold: float) -> float:
    """By how much the ln likelihood is below that of readings as expected."""
    as_expected = np.where(block.read, block.mean, np.nan)
    perfect = log_likelihood(replace(block, level=as_expected), c, errors, threshold)
    return perfect - log_likelihood(block, c, errors, threshold)


def _change(tried: _Trial, errors: Errors, places: Array, evidence: float) -> Change:
    """The most probable kind of change, with the estimate of what it leaves open."""
    steps, blocks, posterior = tried.steps, tried.blocks, tried.posterior
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
    by = h.open_slopes(block.taxel, block.slope, block.by_scale)
    assert by is not None
    read = np.flatnonzero(block.read)
    tangent = np.eye(len(at))  # a move has no part along the normal
    if h.state == MOVED:
        up = h.normals.mean(axis=0)
        tangent -= np.outer(up, up) / (up @ up)
    if not len(read):
        return at, sigma**2 * tangent
    c = covariance_of(block, errors, places, h)[np.ix_(read, read)]
    solved = cho_solve(cho_factor(c, lower=True), by[read])
    mean = at + sigma * tangent @ solved.T @ (block.level - block.mean)[read]
    left = np.eye(len(at)) - by[read].T @ solved
    return mean, sigma**2 * tangent @ left @ tangent
