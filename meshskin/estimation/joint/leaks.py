"""Which taxels crosstalk: those of a module, of a line of a matrix, or of a scan one after another.

What a taxel reads of each taxel near it is a common share of that one's pressure, or none. The
shares are estimated beside the unknowns of the taxel that reads and the global parameters, all
others being known: their log-likelihood is a quadratic form. Which ones are there is found by a
mean field; its bound of the likelihood tells, too, whether any is, and whether the two of a pair
read of each other alike, or each ordered pair has its own probability.

Source: Jordan, Ghahramani, Jaakkola, Saul, "An introduction to variational methods for graphical
models", Machine Learning 37 (1999).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...core.arrays import Array
from .departures import FittedReadings
from .electronics import FAR, NEXT, near_pairs, nearest
from .pressure import OBSERVED
from .small_effects import SmallEffects, most_likely, shared_effects

ROUNDS, DAMPING, SETTLED = 300, 0.5, 1e-3
"""Largest number of rounds of the mean field, the part of a change that is made in each, and the
largest change of a probability at which it has converged: 20 to 80 are usual."""
DISTANT, NEIGHBOURS, NEXT_ID, LAST_ID = range(4)
PARTS = 0.1, 0.5, 0.5, 0.5
"""First part of each kind of pairs that crosstalk: of those beyond NEXT, of neighbours, and where
the other taxel has the next id, or the last one, as channels of a multiplexer."""
STARTS, HELD = (1.0, 1.5, 2.5), 20
"""Factors that the first share is raised by, for the first rounds: few pairs with a large share
resemble many with a small one, and a mean field ends at either. The likelier one counts."""
CARE = 0.5
"""Part of the logarithm of the odds of a pair that its uncertainty rests on: contacts and the other
taxels are not known, nor other pairs, which a mean field takes as independent. Of the errors 0.93
and 1.27 are stated with it, 0.75 and 0.85 with 1, 1.8 and 2.3 with 0.25, and 0.7 without these
variances (studies/foreign_worlds.py --worlds crosstalk_faint, seeds 0 and 1)."""
RIDGE, TINY = 1e-6, 1e-12
"""Added to the diagonal of normal equations, relative to it and at least: shares that no reading
determines."""
LEAST_SCORE = 2.5
"""Score, in standard deviations, of further shares from which taxels move: 0 to 1.4 in 92
recordings without crosstalk, of 35 worlds."""
LOST_SHARE = "a loss of the readings in proportion to the sum of all"
"""Name of this departure."""
MIN_GAIN = 3.0
"""Least increase of the log-likelihood by the mixture over one share of all neighbours."""


@dataclass(frozen=True)
class Leaks:
    """Pairs of n taxels that crosstalk."""

    key: np.ndarray
    """Row of the one that reads times n plus row of the other (p,), rising."""
    weight: Array
    """Probability (p,) that it crosstalks."""
    variance: Array
    """Variance (p,) of whether it does, 0 or 1."""
    gain: float = 0.0
    """Increase of the log-likelihood by a common share of these."""

    def of(self, key: np.ndarray, values: Array | None = None) -> Array:
        """Weights, or values (p,), of the pairs (q,); 0 of others."""
        at = np.minimum(np.searchsorted(self.key, key), len(self.key) - 1)
        return np.where(self.key[at] == key, (self.weight if values is None else values)[at], 0.0)

    def reading(self, count: int) -> float:
        """Fraction of `count` taxels that read of another one, rather than not."""
        return len(np.unique(self.key[self.weight > 0.5] // count)) / count

    def change_from(self, before: Leaks) -> float:
        """Largest change of a weight; pairs that only one of the two has have 0 in the other."""
        key = np.union1d(self.key, before.key)
        return float(np.abs(self.of(key) - before.of(key)).max())


def leaking_pairs(fitted: FittedReadings, share: float = 0.0) -> Leaks | None:
    """The pairs of taxels that crosstalk; None where all neighbours do alike and no others, where
    none do, or there are none. share: of the crosstalk that `fitted` has."""
    shares = _Shares.of(fitted, share)
    if not len(shares.key):
        return None
    first, second = np.divmod(shares.key, len(fitted.points))
    pair = np.minimum(first, second) * len(fitted.points) + np.maximum(first, second)
    both, each = np.unique(pair, return_inverse=True)[1], np.arange(len(pair))
    trials = (shares.mixture(owner, raised) for owner in (both, each) for raised in STARTS)
    found = max(trials, key=lambda leaks: leaks.gain)
    return found if found.gain > shares.uniform() + MIN_GAIN else None


def crosstalk_score(fitted: FittedReadings, uniform: float) -> float:
    """Score of crosstalk, in standard deviations: of single pairs, or `uniform`, that of all
    neighbours alike."""
    leaks = leaking_pairs(fitted)
    return uniform if leaks is None else max(uniform, (2 * leaks.gain) ** 0.5)


def further_shares(fitted: FittedReadings) -> SmallEffects:
    """What the crosstalk that `fitted` lacks displaces the taxels by: shares of any size and sign
    of what each taxel near it reads, of some of the taxels."""
    shares = _Shares.of(fitted, 0.0)
    if not len(shares.key):
        return SmallEffects.none(len(fitted.points))
    slope, common = (
        np.zeros((*shares.own.shape[:2], *x.shape[1:])) for x in (shares.right, shares.common)
    )
    slope[shares.at], common[shares.at] = shares.right, shares.common
    information = shares.own - common @ np.swapaxes(common, 1, 2)
    score, mean, covariance = most_likely(slope, information)
    if score < LEAST_SCORE:
        return SmallEffects.none(len(fitted.points), score)
    displacements = np.einsum("nas,ns->na", shares.moved, mean)
    across = shares.moved @ covariance @ np.swapaxes(shares.moved, 1, 2)
    return SmallEffects(score, displacements, across)


def lost_share(fitted: FittedReadings) -> SmallEffects:
    """What a loss of the readings in proportion to the sum of all at once displaces the taxels by,
    as where a common supply sags. The part of a taxel's own reading is compression, which the
    response has; an error of the force would widen the patch, too."""
    level, contact = np.maximum(fitted.mu - fitted.offset, 0.0), fitted.readings.contact
    read = level * (fitted.readings.kind == OBSERVED)
    total = np.bincount(contact, read)
    others = total[contact] - read
    column = (level * others / max(float(np.median(total[total > 0])), TINY))[:, None]
    return shared_effects(fitted, column, *fitted.shared(column))


def leak_covariances(fitted: FittedReadings, share: float) -> Array:
    """Covariances (n, 2, 2), m^2, of the places by not knowing which pairs crosstalk."""
    leaks, found = fitted.data.leaks, np.zeros((len(fitted.points), 2, 2))
    if leaks is None:
        return found
    size, (key, at, matrix, _) = len(fitted.own), _normal_equations(fitted)
    others = slice(size, size + int(at[1].max(initial=-1)) + 1)
    variance = np.zeros((len(matrix), others.stop - size))
    variance[at] = share**2 * leaks.of(key, leaks.variance)
    moved = np.linalg.solve(matrix[:, :size, :size], matrix[:, :size, others])[:, :2]
    return np.asarray(np.einsum("nas,ns,nbs->nab", moved, variance, moved))


@dataclass(frozen=True)
class _Shares:
    """The log-likelihood right x - x L x / 2 of the shares x (q,) of ordered pairs of taxels, with
    the unknowns of the one that reads and the global parameters at their best."""

    key: np.ndarray
    """Pairs (q,), as in Leaks."""
    near: np.ndarray
    """Whether they are neighbours (q,) bool."""
    kind: np.ndarray
    """DISTANT, NEIGHBOURS, NEXT_ID or LAST_ID (q,)."""
    at: tuple[np.ndarray, np.ndarray]
    """The taxel (q,) that reads, and the place (q,) of the other one among those that it reads."""
    own: Array
    """Blocks (n, S, S) of L where the global parameters are known."""
    common: Array
    """C (q, ks): these take C C^T from L."""
    right: Array
    """(q,)."""
    moved: Array
    """Displacements (n, 2, S), m, of the taxels by unit shares."""

    @classmethod
    def of(cls, fitted: FittedReadings, share: float) -> _Shares:
        """Those of readings with a crosstalk of `share`."""
        key, at, matrix, slope = _normal_equations(fitted)
        size, n, kept = len(fitted.own), len(matrix), np.zeros(1, dtype=int)
        if fitted.system is not None:  # the global parameters but for the common share itself
            p = fitted.data.parameters
            kept = np.delete(np.arange(len(p.sigma)), p.columns.get("crosstalk", slice(0, 0)))
        width = int(at[1].max(initial=-1)) + 1
        by_own = np.linalg.solve(matrix[:, :size, :size], matrix[:, :size])
        right = slope - np.einsum("nij,ni->nj", by_own, slope[:, :size])
        others, rest = slice(size, size + width), size + width + kept
        known = matrix[:, rest[:, None], rest].sum(axis=0)
        matrix -= np.swapaxes(matrix[:, :size], 1, 2) @ by_own
        coupling = matrix[:, others][:, :, rest]
        common = matrix[:, rest[:, None], rest].sum(axis=0)
        if fitted.system is not None:  # with their priors
            common += fitted.system.shared[np.ix_(kept, kept)] - known
        first, second = np.divmod(key, n)
        distance = np.linalg.norm(fitted.points[first] - fitted.points[second], axis=1)
        near = distance < NEXT * nearest(fitted.points)[first]
        apart = np.diff(fitted.data.ids[fitted.readings.live][[first, second]], axis=0)[0]
        kind = np.where(near, NEIGHBOURS, DISTANT)
        kind = np.where(apart == 1, NEXT_ID, np.where(apart == -1, LAST_ID, kind))
        by_common = coupling[at] @ _inverse_root(common)
        own = matrix[:, others, others].copy()
        moved = np.asarray(by_own[:, :2, others])
        found = cls(key, near, kind, at, own, by_common, right[:, others][at], moved)
        leaks = fitted.data.leaks
        has = near.astype(float) if leaks is None else leaks.of(key)
        return replace(found, right=found.right + found.product(share * has))

    def product(self, x: Array) -> Array:
        """L x (q,)."""
        spread = np.zeros(self.own.shape[:2])
        spread[self.at] = x
        own = (self.own @ spread[..., None])[..., 0][self.at]
        return np.asarray(own - self.common @ (self.common.T @ x))

    def uniform(self) -> float:
        """Increase of the log-likelihood by one share of all neighbours."""
        x = self.near.astype(float)
        slope = max(float(self.right @ x), 0.0)
        return slope**2 / (2 * max(float(x @ self.product(x)), TINY))

    def mixture(self, owner: np.ndarray, raised: float = 1.0) -> Leaks:
        """Pairs with a common share and others without one; those of one `owner` (q,) alike.
        raised: factor of STARTS."""
        kind: np.ndarray = np.zeros(int(owner.max()) + 1, dtype=int)
        np.maximum.at(kind, owner, self.kind)
        diagonal = self.own[(*self.at, self.at[1])] - np.sum(self.common**2, axis=1)
        part: Array = np.array(PARTS)[kind]
        member, evidence, gain, least = part, np.zeros(len(part)), 0.0, 0.0
        for round_ in range(ROUNDS):
            x = member[owner]
            product = self.product(x)
            square = float(x @ product + diagonal @ (x - x**2))
            level = float(self.right @ x) / max(square, TINY)
            if level <= 0:
                return Leaks(self.key, np.zeros(len(self.key)), np.zeros(len(self.key)))
            gain = level * float(self.right @ x) / 2 - _divergence(member, part)
            least = raised * level if round_ == 0 else least
            level = max(level, least) if round_ < HELD else level
            alone = product - diagonal * (x - 0.5)
            evidence = np.bincount(owner, level * (self.right - level * alone)).astype(float)
            change = DAMPING * (_probability(evidence, part) - member)
            member = member + change
            part = ((np.bincount(kind, member) + 0.5) / (np.bincount(kind) + 1))[kind]
            if round_ >= HELD and np.abs(change).max() < SETTLED:
                break
        careful = _probability(CARE * evidence, part)[owner]
        variance = careful * (1 - careful) / CARE
        return Leaks(self.key, _probability(evidence, part)[owner], variance, gain)


def _probability(evidence: Array, part: Array) -> Array:
    """Probabilities by the logarithm of the odds, and what they are before."""
    return np.asarray(1 / (1 + np.exp(-np.clip(evidence + np.log(part / (1 - part)), -50, 50))))


def _divergence(member: Array, part: Array) -> float:
    """Kullback and Leibler's, of probabilities `member` from `part`."""
    terms = ((m, p) for m, p in ((member, part), (1 - member, 1 - part)))
    return sum(float(m @ np.log(np.maximum(m, TINY) / p)) for m, p in terms)


def _inverse_root(matrix: Array) -> Array:
    """R (ks, ks) with R R^T the inverse of a matrix (ks, ks), without directions that nothing
    determines."""
    scale = np.sqrt(np.maximum(np.diag(matrix), TINY))
    value, vectors = np.linalg.eigh(matrix / np.outer(scale, scale))
    size = (value > RIDGE) / np.sqrt(np.maximum(value, RIDGE))
    return np.asarray(vectors / scale[:, None] * size)


def _normal_equations(
    fitted: FittedReadings,
) -> tuple[np.ndarray, tuple[np.ndarray, np.ndarray], Array, Array]:
    """Pairs (q,) as in Leaks, their place `at` as in _Shares, and of each taxel the matrix
    (n, D + S + ks, .) of its own unknowns, what it reads of each of the others and the global
    parameters, and the gradient (n, .)."""
    readings, n, size = fitted.readings, len(fitted.points), len(fitted.own)
    row, column = near_pairs(readings, fitted.points, FAR)
    pair = readings.taxel[row] * n + readings.taxel[column]
    key, owner = np.unique(pair, return_inverse=True)
    taxel = key // n
    slot = np.arange(len(key)) - np.searchsorted(taxel, taxel)
    pressure = np.maximum(fitted.mu - fitted.offset, 0.0)
    gain = np.broadcast_to(fitted.gain, pressure.shape)
    shared = pressure[:, None]  # a common scale, where the global parameters have no derivatives
    if fitted.system is not None:
        shared = fitted.jacobian[:, size : size + len(fitted.data.parameters.sigma)]
    first = size + int(slot.max(initial=-1)) + 1
    columns = np.zeros((len(fitted.mu), first + shared.shape[1]))
    columns[:, :size], columns[:, first:] = fitted.own.T, shared
    columns[row, size + slot[owner]] = gain[row] * pressure[column] / gain[column]
    matrix = np.empty((n, columns.shape[1], columns.shape[1]))
    slope = np.empty(matrix.shape[:2])
    for k in range(n):
        mine = slice(*readings.starts[k : k + 2])
        part = columns[mine]
        matrix[k] = part.T @ (fitted.curvature[mine, None] * part)
        slope[k] = -(fitted.rate[mine] @ part)
    diagonal = np.einsum("nii->ni", matrix)
    diagonal[:, :size] += fitted.prior
    diagonal[:, :first] += RIDGE * diagonal[:, :first] + TINY
    return key, (taxel, slot), matrix, slope
