"""The probability of an evidence without a change, by drawing readings with changes.

The evidence E is the ratio of the density Q of the readings under the changes, weighted by their
prior probabilities, to the density P under none. With importance sampling from Q

    P(E >= e) = E_Q[1/E; E >= e],

which is at most 1/e, Markov's bound; a few hundred draws give it to a tenth, however small it is.

Source: Siegmund, "Importance Sampling in the Monte Carlo Study of Sequential Tests", Annals of
Statistics 4 (1976).
"""

from __future__ import annotations

import numpy as np
from scipy.special import logsumexp

from ...core.arrays import Array
from .touches import Errors, log_likelihoods

DRAWS = 300
"""Sets of readings that are drawn."""


def log_chance(
    mean: Array, c: Array, log_prior: Array, evidence: float, errors: Errors, threshold: float
) -> float:
    """ln of the probability of an ln evidence of `evidence` or more, if there is no change.

    mean (1 + h, q) and c (1 + h, q, q): means and covariances of the readings of the same pairs,
    without a change first, and with h changes; log_prior (h,): ln of their prior probabilities,
    whose sum may be less than one: changes that are left out have Markov's bound. threshold:
    readings below it are silent.
    """
    rng, weight = np.random.default_rng(0), np.exp(log_prior)
    total = float(weight.sum())
    found = np.zeros(DRAWS)
    chosen = rng.choice(len(weight), DRAWS, p=weight / total)
    for k, change in enumerate(chosen):
        level = rng.multivariate_normal(mean[1 + change], c[1 + change], method="cholesky")
        level = np.where(level > threshold, level, np.nan)
        likelihood = log_likelihoods(level, mean, c, errors, threshold)
        drawn = float(logsumexp(likelihood[1:] - likelihood[0] + log_prior))
        found[k] = np.exp(evidence - drawn) if drawn >= evidence else 0.0
    share = total * float(found.mean()) + max(1 - total, 0.0)
    return float(np.log(share)) - evidence if share > 0 else -np.inf
