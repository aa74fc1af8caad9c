"""Optimal design of contacts, and a lower bound of the error of any exploration.

A design has weights xi(x), of sum one, on candidate contacts x. Its information on taxel i is
M_i(xi) = sum_x xi(x) I_i(x), and N contacts have the mean expected error Phi(xi) / sqrt(N), with
Phi(xi) = mean_i E|M_i^(-1/2) z|, z standard normal. Phi is convex (the inverse root is operator
convex, and E|A z| is a norm that increases with A) and homogeneous of degree -1/2. With
d(x) = -dPhi/dxi(x), the tangents at the multiples of any xi thus bound every other design:

    Phi(eta) >= Phi(xi) sqrt(Phi(xi) / (2 max_x d(x))),

with equality at the optimum, to which multiplicative steps xi <- xi d^power converge. The taxels'
positions and the global parameters are known here: an exploration that does not know them can only
need more contacts.

Source: Pukelsheim, "Optimal Design of Experiments" (2006), chapters 5 to 7 and 9.11.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from meshskin.core.arrays import Array
from meshskin.core.errors import CalibrationError
from meshskin.estimation import chart
from meshskin.estimation.next_contact import expected_slopes
from meshskin.estimation.uncertainty.observability import mean_distance
from meshskin.geometry.body import Body
from meshskin.scene.belief import Belief

PITCH = 1.0 / 30.0
"""Distance of the candidates, in reaches of a contact: the optimal error changes by its square."""
FIRST_STRIDE = 9
"""One of so many candidates is in the first design, which the later ones refine."""
POWER = 0.7
"""Exponent of the multiplicative steps xi <- xi d^power. Chosen: from 0.4 to 1.3 the steps converge
to the same error, with 466 to 144 of them (four taxels of sphere_noisy)."""
MAX_REFINEMENTS, MAX_STEPS = 6, 1000
"""Largest numbers of designs, each of the last one's candidates and of those that would improve it,
and of multiplicative steps of each."""
GAP = 2e-3
"""Relative distance of the design from its bound at which it is accepted."""
MIN_WEIGHT = 1e-3
"""Weight, relative to the mean one, below which a candidate is left out of the next design."""


@dataclass(frozen=True)
class Design:
    """The optimal design of contacts."""

    points: Array
    """(c, 3) on the surface, m."""
    weights: Array
    """(c,) shares of the contacts."""
    error: float
    """Mean expected error times the root of the number of contacts, m."""
    bound: float
    """Lower bound of `error` over all designs, m."""


@dataclass(frozen=True)
class Information:
    """Information of contacts at c candidates on n taxels: p pairs."""

    contact: np.ndarray
    """Candidate (p,) of each pair."""
    taxel: np.ndarray
    """Taxel (p,) of each pair."""
    slope: Array
    """(p, 2), 1/m: the pair's information is its square."""
    candidates: int
    """c."""
    taxels: int
    """n."""

    def at(self, rows: np.ndarray) -> Information:
        """The information of the candidates `rows` only."""
        index = np.full(self.candidates, -1)
        index[rows] = np.arange(len(rows))
        mine = index[self.contact] >= 0
        return Information(
            index[self.contact[mine]], self.taxel[mine], self.slope[mine], len(rows), self.taxels
        )

    def total(self, weights: Array) -> Array:
        """M (n, 2, 2), 1/m^2, of candidates with weights (c,)."""
        parts = [
            np.bincount(self.taxel, weights[self.contact] * product, self.taxels)
            for product in self._products()
        ]
        return np.asarray(
            np.stack([parts[k] for k in (0, 1, 1, 2)], axis=1).reshape(-1, 2, 2), float
        )

    def gain(self, slope: Array) -> Array:
        """-dPhi/dxi (c,) of each candidate, from -dPhi/dM (n, 2, 2)."""
        a, b, c = slope[:, 0, 0], slope[:, 0, 1], slope[:, 1, 1]
        first, mixed, second = self._products()
        each = a[self.taxel] * first + 2 * b[self.taxel] * mixed + c[self.taxel] * second
        return np.asarray(np.bincount(self.contact, each, self.candidates), float)

    def _products(self) -> tuple[Array, Array, Array]:
        u, v = self.slope.T
        return u * u, u * v, v * v


def information(belief: Belief, taxels: Array, points: Array) -> Information:
    """Information on `taxels` (n, 3) of contacts at `points` (c, 3), m, under a reference force."""
    charts, hit = chart.charts_at(belief.body, taxels), belief.body.closest(points)
    contact, taxel, slope = expected_slopes(charts, hit, belief, belief.material.effective_modulus)
    return Information(contact, taxel, slope, len(points), len(taxels))


def expected_error(belief: Belief, taxels: Array, points: Array) -> float:
    """Mean expected error, m, of `taxels` (n, 3) after contacts at `points` (c, 3), m."""
    return mean_error(information(belief, taxels, points).total(np.ones(len(points))))[0]


def optimal_design(belief: Belief, taxels: Array, reach: float) -> Design:
    """The optimal design on the surface about `taxels` (n, 3), m, that respond to contacts up to
    `reach`, m, away, and its bound.

    Raises CalibrationError where no contact determines a taxel.
    """
    points = _candidates(belief.body, taxels, PITCH * reach, reach)
    known = information(belief, taxels, points)
    rows, weights, bound = np.arange(0, len(points), FIRST_STRIDE), np.ones(0), 0.0
    for _ in range(MAX_REFINEMENTS):
        start = np.concatenate([weights, np.full(len(rows) - len(weights), 1.0 / len(rows))])
        weights, error, slope = optimal_weights(known.at(rows), start / start.sum())
        gain = known.gain(slope)
        bound = max(bound, _bound(error, gain))
        if bound > (1.0 - GAP) * error:
            break
        used = weights > MIN_WEIGHT / len(rows)
        more = np.setdiff1d(np.flatnonzero(gain > 0.5 * error), rows[used])
        rows, weights = np.concatenate([rows[used], more]), weights[used]
    return Design(points[rows], weights, error, bound)


def optimal_weights(known: Information, weights: Array) -> tuple[Array, float, Array]:
    """The optimal weights (c,) of given candidates, their Phi, m, and -dPhi/dM (n, 2, 2)."""
    for _ in range(MAX_STEPS):
        error, slope = mean_error(known.total(weights))
        if not np.isfinite(error):
            raise CalibrationError(
                "no contact determines some taxel", remedy="lower the threshold or the noise"
            )
        gain = known.gain(slope)
        if _bound(error, gain) > (1.0 - 0.5 * GAP) * error:
            break
        weights = weights * (gain / (0.5 * error)) ** POWER
        weights /= weights.sum()
    return weights, error, slope


def _bound(error: float, gain: Array) -> float:
    """The lower bound of Phi, m, from the tangents at a design's multiples."""
    return float(error * np.sqrt(0.5 * error / gain.max()))


def mean_error(total: Array) -> tuple[float, Array]:
    """Phi, m, of information M (n, 2, 2), and -dPhi/dM (n, 2, 2).

    Of the standard deviations s_1 >= s_2, E|M^(-1/2) z| is sqrt(2/pi) s_1 E(1 - (s_2/s_1)^2).
    """
    from scipy.special import ellipe, ellipk

    value, axes = np.linalg.eigh(total)
    if value.min() <= 0.0:
        return np.inf, np.zeros_like(total)
    large, small = 1.0 / np.sqrt(value.T)
    m = 1.0 - (small / large) ** 2
    flat = m < 1e-6  # (E - K) / 2m tends to -pi/8
    change = np.where(flat, -np.pi / 8, (ellipe(m) - ellipk(m)) / (2 * np.where(flat, 1.0, m)))
    by_large = ellipe(m) + 2 * change * (small / large) ** 2
    by_small = -2 * change * small / large
    scale = np.sqrt(2 / np.pi) / len(total)
    slope = 0.5 * scale * np.stack([by_large * large**3, by_small * small**3], axis=1)
    mean = float(mean_distance(np.asarray(np.linalg.inv(total))).mean())
    return mean, np.asarray(np.einsum("nij,nj,nkj->nik", axes, slope, axes))


def _candidates(body: Body, taxels: Array, pitch: float, reach: float) -> Array:
    """Points (c, 3) of the surface, about `pitch` apart, within `reach` of a taxel (n, 3); m."""
    from scipy.spatial import cKDTree

    side = pitch * np.arange(-np.ceil(reach / pitch), np.ceil(reach / pitch) + 1)
    flat = np.stack(np.meshgrid(side, side), axis=-1).reshape(-1, 2)
    flat = flat[np.linalg.norm(flat, axis=1) <= reach]
    charts = chart.charts_at(body, taxels)
    tree, kept = cKDTree(taxels), []
    for k in range(len(taxels)):
        points = body.closest(charts[np.full(len(flat), k)].at(flat)).point
        kept.append(points[tree.query(points)[1] == k])
    return np.concatenate(kept)
