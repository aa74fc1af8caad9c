"""Evidence about one unit: the likelihood of its readings if it changed, relative to that if not.

The evidence is the mean of the likelihood ratio over the hypotheses, weighted by their prior
probabilities. If the unit did not change, its expected value is one, whatever the hypotheses and
the number of readings, and so it exceeds u / alpha with a probability of at most alpha / u
(Markov's inequality): over u units, false alarms have a probability of at most alpha. This needs
the likelihood of an unchanged unit as it is, over all places that the map allows: that of a module
is linearized where the readings place its taxels (Laplace's method), that of a single taxel is a
mixture. A coarser likelihood of a change costs power only.

Where the evidence is nearly that large, its probability if the unit did not change is drawn. The
evidence E is the ratio of the density Q of the readings under the changes, weighted by their prior
probabilities, to the density P under none. With importance sampling from Q

    P(E >= e) = E_Q[1/E; E >= e],

which is at most 1/e, Markov's bound; a few hundred draws give it to a tenth, however small it is.

Sources: Gruenwald, de Heide, Koolen, "Safe Testing", J. R. Stat. Soc. B 86 (2024); Siegmund,
"Importance Sampling in the Monte Carlo Study of Sequential Tests", Annals of Statistics 4 (1976).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.special import logsumexp

from ...core.arrays import Array
from .blocks import Block, Errors, Stack, all_log_likelihoods, log_likelihoods
from .hypotheses import (
    CONFIRMED,
    DEAD,
    EXCHANGED,
    GAIN,
    MOVED,
    TURNED,
    Hypothesis,
    discrete,
    dispersed,
    grid,
    log_prior,
    moved,
    regained,
    ring,
    unchanged,
)
from .touches import Touches

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
DRAWS = 300
"""Sets of readings that are drawn."""
MAX_DRAWN = 4_000_000
"""Largest number of entries of the covariances of all hypotheses, of which readings are drawn: 32
MB; a unit with more readings than that, about 100, shows its changes without."""
ANSWERED = 2.0
"""A taxel was touched if a reading of so many thresholds, or of 5 % of the peak, was expected."""
LEAST_READING = 0.05
"""Least expected reading of a touched taxel, relative to the peak: less is at its reach's edge."""


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
    rival: Hypothesis | None = None
    """The change that is next in probability, where it is not excluded."""
    log_rival: float = -np.inf
    """ln of its probability, relative to that of `hypothesis`."""


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


def judge(touches: Touches, unit: int, errors: Errors, limit: float) -> Evidence:
    """The changes of a unit that would be found with a probability of at most exp(-limit) if it had
    not changed, and what else was excluded."""
    start = state = unchanged(touches.known, unit)
    changes: list[Change] = []
    nulls: list[float] = []
    while True:
        tried = _trial(touches, unit, state, errors, limit)
        nulls.append(tried.null)
        evidence = float(logsumexp(tried.posterior))
        log_chance = _log_chance(touches, unit, tried, errors, evidence, limit)
        if log_chance > -limit or len(changes) == MAX_CHANGES:
            break
        change = replace(_change(tried, errors, evidence), log_chance=log_chance)
        changes.append(change)
        state = _changed(change, len(state.points))
    touched, alive, confirmed = _excluded(tried, touches.threshold, len(state.points))
    # the errors are fitted to places that are as uncertain as in the map
    state = replace(state, covariance=start.covariance)
    return Evidence(nulls[0], state, tuple(changes), evidence, touched, alive, confirmed)


@dataclass(frozen=True)
class _Trial:
    """The alternatives to a state of a unit, and what the readings say of them."""

    null: float
    """ln likelihood of the state."""
    alike: float
    """The same, linearized as the alternatives are: what is excluded is compared with this."""
    block: Block
    """The readings under it."""
    null_blocks: list[Block]
    """The readings under its components, one where they are straight over its uncertainty."""
    log_null: Array
    """ln of the weights of the components."""
    blocks: list[Block]
    """The readings under each of the alternatives (h,)."""
    ratio: Array
    """ln likelihoods (h,) relative to that of the state."""
    log_prior: Array
    """ln prior probabilities (h,)."""

    @property
    def posterior(self) -> Array:
        """ln (h,) of the probabilities of the alternatives, relative to that of the state."""
        return self.ratio + self.log_prior


def _trial(touches: Touches, unit: int, state: Hypothesis, errors: Errors, limit: float) -> _Trial:
    """The alternatives to `state`; continuous ones only where the unit misfits (which makes the
    evidence smaller, never larger)."""
    known, threshold = touches.known, touches.threshold
    (block,) = touches.blocks(unit, [state], errors)
    as_expected = np.where(block.read, block.mean, np.nan)
    usual = replace(block, level=as_expected).log_likelihood(errors, threshold)
    null_blocks, log_null = [block], np.zeros(1)
    null = alike = block.log_likelihood(errors, threshold)
    single = len(state.points) == 1
    if not single:  # too many places for components of all of them
        null = touches.straight(unit, state, errors).log_likelihood(errors, threshold)
    if usual - null >= MISFIT * limit and single:
        parts, log_null = dispersed(state, touches.data.body)
        null_blocks = touches.blocks(unit, parts, errors)
        each = all_log_likelihoods(null_blocks, errors, threshold)
        null = alike = float(logsumexp(log_null + each))
    steps = discrete(touches, unit, state)
    if usual - null >= MISFIT * limit:
        if state.state == CONFIRMED:
            steps += moved(state, touches.data.body, grid())
        steps += regained(state, known.slots is None)
    blocks = touches.blocks(unit, steps, errors)
    ratio = all_log_likelihoods(blocks, errors, threshold) - null
    expected = np.zeros(len(state.points))
    np.maximum.at(expected, block.taxel, block.mean)
    prior = log_prior(steps, len(known.units), expected, known.slots is None)
    return _Trial(null, alike, block, null_blocks, log_null, blocks, ratio, prior)


def _log_chance(
    touches: Touches, unit: int, tried: _Trial, errors: Errors, evidence: float, limit: float
) -> float:
    """ln of a bound on the probability of so large an evidence if the unit is as it was tried:
    Markov's, or, where that does not suffice but might nearly, the drawn one."""
    if not limit - SLACK < evidence <= limit:
        return -evidence
    steps = [block.hypothesis for block in (*tried.null_blocks, *tried.blocks)]
    blocks = touches.blocks(unit, steps, errors, same_pairs=True)
    if len(steps) * len(blocks[0].mean) ** 2 > MAX_DRAWN:
        return -evidence
    mean = np.stack([b.mean for b in blocks])
    c = np.stack([b.covariance(errors) for b in blocks])
    weights = tried.log_null, tried.log_prior
    same, rows = blocks[0], touches.known.units[unit]

    def null(level: Array) -> float:
        """As `_trial` has it."""
        levels = np.full((len(touches.level), len(rows)), np.nan)
        levels[same.contact, same.taxel] = level
        block = touches.straight(unit, same.hypothesis, errors, levels)
        return block.log_likelihood(errors, touches.threshold)

    several = len(rows) > 1
    return log_chance(
        mean, c, *weights, evidence, errors, touches.threshold, null if several else None,
        None if several else Stack(blocks, errors),
    )  # fmt: skip


def log_chance(
    mean: Array, c: Array, log_null: Array, log_prior: Array, evidence: float, errors: Errors,
    threshold: float, null: Callable[[Array], float] | None = None, stack: Stack | None = None,
) -> float:  # fmt: skip
    """ln of the probability of an ln evidence of `evidence` or more, if there is no change.

    mean (p + h, q) and c (p + h, q, q): means and covariances of the readings of the same pairs, of
    the p components without a change first, and with h changes; log_null (p,): ln of the weights of
    the components; log_prior (h,): ln of the prior probabilities of the changes, whose sum may be
    less than one: changes that are left out have Markov's bound. threshold: readings below it are
    silent. null: ln likelihood of readings (q,) if there is no change, in place of the components'.
    stack: all of them (p + h) of a single taxel, whose likelihoods take less time.
    """
    rng, weight, first = np.random.default_rng(0), np.exp(log_prior), len(log_null)
    total = float(weight.sum())
    found = np.zeros(DRAWS)
    chosen = rng.choice(len(weight), DRAWS, p=weight / total)
    for k, change in enumerate(chosen):
        level = rng.multivariate_normal(mean[first + change], c[first + change], method="cholesky")
        level = np.where(level > threshold, level, np.nan)
        likelihood = (
            log_likelihoods(level, mean, c, errors, threshold) if stack is None
            else stack.log_likelihoods(threshold, level)
        )  # fmt: skip
        without = null(level) if null else logsumexp(likelihood[:first] + log_null)
        drawn = float(logsumexp(likelihood[first:] + log_prior) - without)
        found[k] = np.exp(evidence - drawn) if drawn >= evidence else 0.0
    share = total * float(found.mean()) + max(1 - total, 0.0)
    return float(np.log(share)) - evidence if share > 0 else -np.inf


def _changed(change: Change, k: int) -> Hypothesis:
    """The unit of k taxels after a change, at the estimate of what it left open."""
    covariance = change.hypothesis.covariance + change.shift_covariance
    state = replace(change.hypothesis, shift_sigma=0.0, gain_sigma=0.0, covariance=covariance)
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
    block, out = tried.block, tried.ratio + tried.null - tried.alike < -MIN_ODDS
    touched = np.zeros(k, dtype=bool)
    answers = block.mean > max(ANSWERED * threshold, LEAST_READING)
    touched[block.taxel[answers | block.read]] = True
    states = np.array([b.hypothesis.state for b in tried.blocks], dtype=object)
    dead = out[states == DEAD]  # the whole unit, and then each of its taxels
    confirmed = dead[0] and out[np.isin(states, (TURNED, EXCHANGED))].all()
    return touched, touched & dead[-k:], bool(confirmed)


def is_placed(touches: Touches, unit: int, errors: Errors, state: Hypothesis) -> bool:
    """Whether a move of a unit in `state` by MOVE, in each of eight directions, is excluded."""
    steps = [state, *moved(state, touches.data.body, ring())]
    blocks = touches.blocks(unit, steps, errors)
    null, *moves = all_log_likelihoods(blocks, errors, touches.threshold)
    return bool(max(moves) < null - MIN_ODDS)


def _change(tried: _Trial, errors: Errors, evidence: float) -> Change:
    """The most probable kind of change, with the estimate of what it leaves open."""
    steps, posterior = [block.hypothesis for block in tried.blocks], tried.posterior
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
    others = {k: v for k, v in total.items() if k != best and (k[0] != best[0] or k[1] >= 0)}
    rival, ratio = None, -np.inf
    if others:
        next_best = max(others, key=lambda kind: float(others[kind]))
        ratio = float(others[next_best] - total[best])
        rival = steps[kinds.index(next_best)] if ratio > -MIN_ODDS else None
    share = np.exp(posterior[mine] - logsumexp(posterior[mine]))
    found = Change(steps[first], evidence, rival=rival, log_rival=ratio)
    if best[0] not in (MOVED, GAIN):
        return found
    estimates = [_estimate(tried.blocks[k], errors) for k in mine]
    mean = np.array([m for m, _ in estimates])
    centre = share @ mean
    spread = np.einsum("h,hi,hj->ij", share, mean - centre, mean - centre)
    covariance = spread + np.einsum("h,hij->ij", share, np.array([c for _, c in estimates]))
    if best[0] == MOVED:
        return replace(found, shift=centre, shift_covariance=covariance)
    gain, sigma = float(centre[0]), float(np.sqrt(covariance[0, 0]))
    return replace(found, log_gain=gain, log_gain_sigma=sigma)


def _estimate(block: Block, errors: Errors) -> tuple[Array, Array]:
    """Posterior mean (d,) and covariance (d, d) of the move, m, or of the change of ln gain."""
    h, by = block.hypothesis, block.open_slopes
    at = np.array(h.shift) if h.state == MOVED else np.array([h.change])
    sigma = h.shift_sigma if h.state == MOVED else h.gain_sigma
    assert by is not None
    read = np.flatnonzero(block.read)
    tangent = np.eye(len(at))  # a move has no part along the normal
    if h.state == MOVED:
        up = h.normals.mean(axis=0)
        tangent -= np.outer(up, up) / (up @ up)
    if not len(read):
        return at, sigma**2 * tangent
    c = block.covariance(errors)[np.ix_(read, read)]
    solved = cho_solve(cho_factor(c, lower=True), by[read])
    mean = at + sigma * tangent @ solved.T @ (block.level - block.mean)[read]
    left = np.eye(len(at)) - by[read].T @ solved
    return mean, sigma**2 * tangent @ left @ tangent
