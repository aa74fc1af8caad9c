"""Contacts of two kinds: some are displaced, all alike, in any order, and the others are not.

The displacement of a contact is normal about the mean of its kind, with one variance along the
surface for both. Its likelihood is that of its readings with the taxels as estimated, to second
order. Kinds, means and variance are those of the largest likelihood, by expectation-maximization,
and are compared with one kind, and with scatter along a line: many kinds of equal shares, whose
means are quantiles of one distribution. Contacts of each of two kinds fit one another: no reading
tells which is right, nor does the mean of both, where the estimate is.

Source: Dempster, Laird, Rubin, "Maximum likelihood from incomplete data via the EM algorithm",
Journal of the Royal Statistical Society B 39 (1977).
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from scipy.special import ndtri

from ...core.arrays import Array
from ..joint.departures import MIN_SCORE
from .contact_correlations import MIN_CONTACTS, tangents
from .random_effects import RandomEffects

MIN_SHARE = 0.05
"""Least part of the contacts that is a kind: fewer are accidents."""
MIN_APART = 0.05
"""Least distance of the means, in contact radii: nearer kinds are taken for scatter, of which half
their distance is the standard deviation."""
QUANTILES = (np.arange(9) + 0.5) / 9
"""Probabilities whose quantiles are the means of scatter along a line: on three bodies the
score was 1.1 at most for scatter by 0.3 to 1 mm, uniform, normal, Laplace's, Student's or a sine's,
7 to 25 for halves and quarters displaced by 1 or 2 mm, and 5 with scatter by 0.3 mm beside that."""
SCATTERS = tuple(
    law(QUANTILES) / np.sqrt(np.mean(law(QUANTILES) ** 2))
    for law in (
        lambda q: q - 0.5,
        ndtri,
        lambda q: -np.sign(q - 0.5) * np.log(1 - np.abs(2 * q - 1)),
    )
)
"""Those places, of mean square 1: uniform, normal, and of Laplace's distribution."""
MIN_SEEN = 0.1
"""Mean square of a direction's part along the surface, relative to the largest, from which the mean
of a kind is estimated in it: a skin that covers a small part of a ball hardly shows its normal, in
which errors of forces passed for a displacement by 6 mm."""
LEAST_SEEN = 1e-9
"""Information of a direction, relative to the prior, up to which it is rounding: a displacement in
it would be without limit."""
SHARES = (0.2, 0.5, 0.8)
"""Shares of the second kind from which the means are sought."""
MAX_CONTACTS = 1000
"""Contacts, about, whose kinds are sought, evenly chosen: two kinds of 500 have scores of 28."""
ITERATIONS, TOLERANCE = 100, 0.01
"""Iterations, at most, and the rise of the log-likelihood at which they end."""
LEAST_SIGMA = 1e-6
"""Least standard deviation of a kind, m."""


@dataclass(frozen=True)
class ContactKinds:
    """Two kinds of contacts."""

    score: float = 0.0
    """Root of twice the gain of the log-likelihood over that of one kind, or of scatter."""
    share: float = 0.0
    """Part of the contacts that is displaced."""
    apart: Array = field(default_factory=lambda: np.zeros(3))
    """Their displacement (3,), m, against the others."""

    @property
    def shown(self) -> Array:
        """Displacement (3,), m, whose square is the variance of the contacts by their kinds; zero
        where the score is not above MIN_SCORE."""
        size = (self.share * (1 - self.share)) ** 0.5
        return size * self.apart if self.score > MIN_SCORE else np.zeros(3)

    @property
    def departure(self) -> dict[str, float]:
        """Its score, by a name that says how many contacts are displaced, and by how much."""
        moved = ", ".join(f"{1e3 * x:.2g}" for x in self.apart)
        words = f"{self.share:.0%} of the contacts displaced against the others by ({moved}) mm"
        return {f"{words}, as of two indenters or frames": self.score} if self.share else {}


def contact_kinds(effects: RandomEffects) -> ContactKinds:
    """The two kinds of contacts of an estimate; of score 0 where they are not apart."""
    likelihood = _Displacements(effects)
    if len(likelihood.linear) < MIN_CONTACTS:
        return ContactKinds()
    radius = float(np.median(effects.data.radii))
    one = likelihood.fitted(np.zeros(1), np.zeros((2, 3)), 0.1 * radius, np.ones(1))
    line = np.stack([one.means[0], likelihood.principal(one)])
    sigma, two = one.sigma / 3, _Mixture(-np.inf, one.means, one.sigma, one.shares)
    for share in SHARES:
        places, shares = np.array([-2 * share, 2 * (1 - share)]), np.array([1 - share, share])
        tried = likelihood.fitted(places, line, sigma, shares)
        two = max(two, tried, key=lambda mixture: mixture.log_likelihood)
    apart, share = two.means[1] - two.means[0], float(two.shares[1])
    if share > 0.5:
        apart, share = -apart, 1 - share
    if np.linalg.norm(apart) < MIN_APART * radius or share < MIN_SHARE:
        return ContactKinds()
    equal = np.full(len(QUANTILES), 1 / len(QUANTILES))
    scatter = [likelihood.fitted(x, line, sigma, equal, equal_shares=True) for x in SCATTERS]
    less = max(mixture.log_likelihood for mixture in (one, *scatter))
    gain = max(two.log_likelihood - less, 0.0)
    return ContactKinds((2 * gain) ** 0.5, share, apart)


@dataclass(frozen=True)
class _Mixture:
    """Kinds of displacements."""

    log_likelihood: float
    means: Array
    """(q, 3), m."""
    sigma: float
    """m."""
    shares: Array
    """(q,)."""


class _Displacements:
    """The likelihood of the displacements of the contacts that taxels answer."""

    def __init__(self, effects: RandomEffects) -> None:
        used = np.flatnonzero(effects.probes.touched)
        used = used[:: -(-len(used) // MAX_CONTACTS) or 1]
        whole, prior = effects.system().contacts[used], effects.prior[1][:2]
        by_force = whole[:, :2, 2:] @ whole[:, 2:, :2] / whole[:, 2:, 2:]
        value, vectors = np.linalg.eigh(whole[:, :2, :2] - by_force - np.diag(prior))
        value = np.maximum(value, 0.0)  # but for rounding
        self.information = (vectors * value[:, None]) @ np.swapaxes(vectors, 1, 2)
        """(m, 2, 2)."""
        errors = effects.unknowns.errors[used, :2]
        right = np.einsum("mij,mj->mi", self.information + np.diag(prior), errors)
        known = vectors * (value > LEAST_SEEN * prior.max())[:, None]
        self.linear = np.einsum("mik,mjk,mj->mi", known, vectors, right)
        """Information times displacement (m, 2), without the prior."""
        self.tangents = tangents(effects)[used]
        value, vectors = np.linalg.eigh(np.einsum("mai,maj->ij", self.tangents, self.tangents))
        self.seen = vectors[:, value > MIN_SEEN * value[2]]
        """Directions (3, r) in which the means of kinds are estimated."""

    def _posterior(self, mixture: _Mixture) -> tuple[Array, Array, Array]:
        """Displacements (q, m, 2) as of each kind, their variances (m,), and the logarithms (q, m)
        of the likelihoods of each kind and contact."""
        precision = mixture.sigma**-2.0
        inverse = np.linalg.inv(self.information + precision * np.eye(2))
        mean = np.einsum("mai,qi->qma", self.tangents, mixture.means)
        right = self.linear + precision * mean
        found = np.einsum("mij,qmj->qmi", inverse, right)
        log_odds = np.sum(right * found, axis=2) - precision * np.sum(mean**2, axis=2)
        log_odds += np.linalg.slogdet(precision * inverse)[1]
        log_share = np.log(mixture.shares)[:, None]
        return found, np.trace(inverse, axis1=1, axis2=2), log_odds / 2 + log_share

    def principal(self, mixture: _Mixture) -> Array:
        """Standard deviation (3,), m, of the displacements about one kind along their main
        direction."""
        found = self._posterior(mixture)[0][0]
        off = np.einsum("mai,ma->mi", self.tangents, found) - mixture.means[0]
        value, vectors = np.linalg.eigh(off.T @ off / len(off))
        return np.asarray(vectors[:, 2] * value[2] ** 0.5)

    def fitted(
        self, places: Array, line: Array, sigma: float, shares: Array, equal_shares: bool = False
    ) -> _Mixture:
        """The most likely kinds with means at `places` (q,) along a line, from one (2, 3), its
        origin and unit, from sigma, m, and from shares (q,) on, which stay with `equal_shares`."""
        powers = np.stack([np.ones_like(places), places], axis=1)
        seen, size = self.tangents @ self.seen, 2 * self.seen.shape[1]
        mixture = _Mixture(-np.inf, powers @ line, sigma, shares)
        for _ in range(ITERATIONS):
            found, variance, log_likelihood = self._posterior(mixture)
            total = np.logaddexp.reduce(log_likelihood, axis=0)
            odds = np.exp(log_likelihood - total)
            kinds = np.einsum("qm,mai,maj->qij", odds, seen, seen)
            normal = np.einsum("qa,qb,qij->aibj", powers, powers, kinds).reshape(size, size)
            right = powers.T @ np.einsum("qm,mai,qma->qi", odds, seen, found)
            line = np.linalg.pinv(normal, hermitian=True) @ right.ravel()
            means = powers @ line.reshape(2, -1) @ self.seen.T
            off = found - np.einsum("mai,qi->qma", self.tangents, means)
            square = float(np.sum(odds * (np.sum(off**2, axis=2) + variance))) / (2 * len(total))
            rise = float(total.sum()) - mixture.log_likelihood
            mixture = _Mixture(
                float(total.sum()), means, max(square**0.5, LEAST_SIGMA),
                shares if equal_shares else np.maximum(odds.mean(axis=1), 1e-6),
            )  # fmt: skip
            if rise < TOLERANCE:
                break
        return mixture
