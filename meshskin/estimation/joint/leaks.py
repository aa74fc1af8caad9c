"""Which neighbours crosstalk: within modules they do, across the gaps between modules they do not.

The share of every pair of neighbours is estimated beside the unknowns of the taxel that reads, all
others being known. The pairs are a mixture of those with a common share and those with none, which
the algorithm of expectation and maximization tells apart. Source: Dempster, Laird, Rubin, "Maximum
likelihood from incomplete data via the EM algorithm", Journal of the Royal Statistical Society B 39
(1977).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.arrays import Array, sums_by_group
from .departures import FittedReadings
from .electronics import Electronics

ROUNDS = 100
"""Iterations of the mixture, from which its parts no longer change."""
CARE = 0.5
"""Part of the logarithm of the odds that counts: places, contacts and response are not known."""
TINY = 1e-12
"""Added to the diagonal of the normal equations: shares that no reading determines."""
MIN_GAIN = 3.0
"""Least increase of the log-likelihood by the mixture over one share of all pairs."""


@dataclass(frozen=True)
class Leaks:
    """Pairs of n taxels that crosstalk."""

    key: np.ndarray
    """Row of the one times n plus row of the other (p,), rising: one entry
    for each direction in which a pair is compared."""
    weight: Array
    """Probability (p,) that it crosstalks."""

    def of(self, key: np.ndarray) -> Array:
        """Weights (q,) of the pairs (q,); 0 of others."""
        at = np.minimum(np.searchsorted(self.key, key), len(self.key) - 1)
        return np.where(self.key[at] == key, self.weight[at], 0.0)

    def change_from(self, before: Leaks) -> float:
        """Largest change of a weight; pairs that only one of the two has have 0 in the other."""
        key = np.union1d(self.key, before.key)
        return float(np.abs(self.of(key) - before.of(key)).max())


def leaking_pairs(fitted: FittedReadings, share: float) -> Leaks | None:
    """The pairs of neighbours that crosstalk; None where all do alike, or there are no neighbours.
    share: of the crosstalk that `fitted` has."""
    n = len(fitted.points)
    key, value, variance = _shares(fitted, share)
    if not len(key):
        return None
    first, second = np.divmod(key, n)
    pair = np.minimum(first, second) * n + np.maximum(first, second)
    owner = np.unique(pair, return_inverse=True)[1]
    weight = np.bincount(owner, 1 / variance)
    mean = np.bincount(owner, value / variance) / weight
    common = float(weight @ mean) / float(weight.sum())
    level, part = 2 * max(common, 0.0), 0.5
    for _ in range(ROUNDS):
        odds = weight * level * (mean - level / 2) + np.log(part / (1 - part))
        member = 1 / (1 + np.exp(-np.clip(odds, -50, 50)))
        level = float((weight * member) @ mean) / float(weight @ member)
        part = float(np.clip(member.mean(), 1e-3, 1 - 1e-3))
    odds = weight * level * (mean - level / 2)
    member = 1 / (1 + np.exp(-np.clip(CARE * odds + np.log(part / (1 - part)), -50, 50)))
    mixture = np.logaddexp(np.log(1 - part), np.log(part) + odds).sum()
    uniform = float((weight * common) @ (mean - common / 2))
    if level <= 0 or mixture - uniform < MIN_GAIN:
        return None
    return Leaks(key, member[owner])


def leak_covariances(fitted: FittedReadings, share: float) -> Array:
    """Covariances (n, 2, 2), m^2, of the places by not knowing which neighbours crosstalk."""
    n, leaks = len(fitted.points), fitted.data.leaks
    if leaks is None:
        return np.zeros((n, 2, 2))
    pairs = _Pairs.of(fitted)
    size, weight = len(fitted.own), leaks.of(pairs.key)
    own, by_share = pairs.matrix[:, :size, :size], pairs.matrix[:, :size, size:]
    moved = np.linalg.solve(own, by_share)[:, :2]
    variance = np.zeros((n, by_share.shape[2]))
    variance[pairs.taxel, pairs.slot] = share**2 * weight * (1 - weight) / CARE
    return np.asarray(np.einsum("nas,ns,nbs->nab", moved, variance, moved))


def _shares(fitted: FittedReadings, share: float) -> tuple[Array, Array, Array]:
    """Keys (q,) of the ordered pairs of neighbours, the reading one's row times n plus the other's,
    and the estimate (q,) and variance (q,) of the share of each."""
    pairs, leaks = _Pairs.of(fitted), fitted.data.leaks
    inverse = np.linalg.inv(pairs.matrix)
    found = (inverse @ pairs.right[..., None])[..., 0]
    at = pairs.taxel, len(fitted.own) + pairs.slot
    has = np.ones(len(pairs.key)) if leaks is None else leaks.of(pairs.key)
    variance = np.diagonal(inverse, axis1=1, axis2=2)
    return pairs.key, found[at] + share * has, variance[at]


@dataclass(frozen=True)
class _Pairs:
    """Normal equations of each taxel's own unknowns (D) and the shares of its neighbours (S)."""

    key: np.ndarray
    """Ordered pairs (q,), as in Leaks."""
    taxel: np.ndarray
    """The taxel (q,) that reads, and its place (q,) among the shares."""
    slot: np.ndarray
    matrix: Array
    """(n, D + S, D + S)."""
    right: Array
    """(n, D + S)."""

    @classmethod
    def of(cls, fitted: FittedReadings) -> _Pairs:
        """Of the readings, others being known."""
        readings, n, size = fitted.readings, len(fitted.points), len(fitted.own)
        entries = Electronics(fitted.data, readings, fitted.points).all_neighbours.tocoo()
        row, column = entries.row, entries.col
        key = readings.taxel[row] * n + readings.taxel[column]
        unique, owner = np.unique(key, return_inverse=True)
        taxel = unique // n
        slot = np.arange(len(unique)) - np.searchsorted(taxel, taxel)
        columns = np.zeros((len(fitted.mu), size + int(slot.max(initial=0)) + 1))
        columns[:, :size] = fitted.own.T
        columns[row, size + slot[owner]] = np.maximum(fitted.mu - fitted.offset, 0.0)[column]
        width = columns.shape[1]
        matrix = np.zeros((n, width, width))
        for k in range(width):
            weighted = columns * (fitted.curvature * columns[:, k])[:, None]
            matrix[:, k] = sums_by_group(weighted, readings.taxel, n)
        prior = np.append(fitted.prior, np.zeros(width - size))
        matrix += np.diag(prior)
        diagonal = np.diagonal(matrix, axis1=1, axis2=2)
        matrix[:, np.arange(width), np.arange(width)] += 1e-6 * diagonal + TINY
        right = -sums_by_group(columns * fitted.rate[:, None], readings.taxel, n)
        return cls(unique, taxel, slot, matrix, right)
