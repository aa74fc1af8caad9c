"""How few contacts could do: the best of all designs, and a bound that no exploration beats.

Contacts spread over places x with weights xi(x) that add up to one tell of taxel i
M_i(xi) = sum_x xi(x) I_i(x), and N of them leave a mean expected error of Phi(xi) / sqrt(N) with
Phi(xi) = mean_i E|M_i^(-1/2) z|, z standard normal. Phi is convex (the inverse root is operator
convex and E|A z| a norm of A that grows with it) and of degree -1/2. With d(x) = -dPhi/dxi(x), the
tangents at the multiples of any xi thus bound every other design from below:

    Phi(eta) >= Phi(xi) sqrt(Phi(xi) / (2 max_x d(x))),

with equality at the best, to which multiplicative steps xi <- xi d^power lead. Where the taxels are
is known here, and shared unknowns are, too: an exploration that has to find out can only need more.

Source: Pukelsheim, "Optimal Design of Experiments" (2006), chapters 5 to 7 and 9.11.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..core.errors import CalibrationError
from ..core.se3 import Array
from . import chart
from .next_contact import slopes
from .uncertainty.observability import mean_distance

if TYPE_CHECKING:
    from ..geometry.body import Body
    from ..scene.belief import Belief

PITCH = 1.0 / 30.0
"""Distance of the places, in distances at which a contact is felt."""
FIRST = 9
"""Of how many places one is in the first design."""
POWER = 0.7
"""Exponent of the multiplicative steps xi <- xi d^power."""
ROUNDS, STEPS = 6, 1000
"""Most designs, each of the last one's places and of those that would tell more; steps of each."""
GAP = 2e-3
"""Relative distance of the design from its bound at which it is good enough."""
IDLE = 1e-3
"""Weight, relative to the mean one, below which a place is left out of the next design."""


@dataclass(frozen=True)
class Design:
    """The best spread of contacts over places."""

    points: Array
    """(c, 3) on the surface, m."""
    weights: Array
    """(c,) shares of the contacts."""
    error: float
    """Mean expected error times the root of the number of contacts, m."""
    bound: float
    """What no design's is below, m."""


@dataclass(frozen=True)
class Information:
    """What contacts at c places tell of n taxels: p pairs."""

    contact: np.ndarray
    """Row (p,) of the place that each pair's contact is at."""
    taxel: np.ndarray
    """Row (p,) of each pair's taxel."""
    slope: Array
    """(p, 2), 1/m: the pair's information is its square."""
    places: int
    """c."""
    taxels: int
    """n."""

    def at(self, rows: np.ndarray) -> Information:
        """What the contacts at some of the places tell."""
        place = np.full(self.places, -1)
        place[rows] = np.arange(len(rows))
        mine = place[self.contact] >= 0
        return Information(
            place[self.contact[mine]], self.taxel[mine], self.slope[mine], len(rows), self.taxels
        )

    def total(self, weights: Array) -> Array:
        """M (n, 2, 2), 1/m^2, of places weighted (c,)."""
        parts = [
            np.bincount(self.taxel, weights[self.contact] * product, self.taxels)
            for product in self._products()
        ]
        return np.asarray(
            np.stack([parts[k] for k in (0, 1, 1, 2)], axis=1).reshape(-1, 2, 2), float
        )

    def gain(self, slope: Array) -> Array:
        """-dPhi/dxi (c,) at each place, from -dPhi/dM (n, 2, 2)."""
        a, b, c = slope[:, 0, 0], slope[:, 0, 1], slope[:, 1, 1]
        first, mixed, second = self._products()
        each = a[self.taxel] * first + 2 * b[self.taxel] * mixed + c[self.taxel] * second
        return np.asarray(np.bincount(self.contact, each, self.places), float)

    def _products(self) -> tuple[Array, Array, Array]:
        u, v = self.slope.T
        return u * u, u * v, v * v


def information(belief: Belief, taxels: Array, points: Array) -> Information:
    """What contacts at `points` (c, 3) under the reference force tell of `taxels` (n, 3), m."""
    charts, hit = chart.charts_at(belief.body, taxels), belief.body.closest(points)
    contact, taxel, slope = slopes(charts, hit, belief, belief.material.effective_modulus)
    return Information(contact, taxel, slope, len(points), len(taxels))


def expected_error(belief: Belief, taxels: Array, points: Array) -> float:
    """Mean expected error, m, of taxels (n, 3) after contacts at points (c, 3); inf where one is
    not determined.
    """
    told = information(belief, taxels, points)
    return mean_error(told.total(np.ones(len(points))))[0]


def optimal_design(belief: Belief, taxels: Array, reach: float) -> Design:
    """The best spread of contacts over the surface about `taxels` (n, 3), each of which feels a
    contact up to `reach` (m) away, and the bound.

    Raises CalibrationError where no contact tells a taxel's place.
    """
    points = _places(belief.body, taxels, PITCH * reach, reach)
    told = information(belief, taxels, points)
    rows, weights, bound = np.arange(0, len(points), FIRST), np.ones(0), 0.0
    for _ in range(ROUNDS):
        start = np.concatenate([weights, np.full(len(rows) - len(weights), 1.0 / len(rows))])
        weights, error, slope = optimal_weights(told.at(rows), start / start.sum())
        gain = told.gain(slope)
        bound = max(bound, _bound(error, gain))
        if bound > (1.0 - GAP) * error:
            break
        busy = weights > IDLE / len(rows)
        more = np.setdiff1d(np.flatnonzero(gain > 0.5 * error), rows[busy])
        rows, weights = np.concatenate([rows[busy], more]), weights[busy]
    return Design(points[rows], weights, error, bound)


def optimal_weights(told: Information, weights: Array) -> tuple[Array, float, Array]:
    """The best weights (c,) of given places, their Phi, m, and -dPhi/dM (n, 2, 2)."""
    for _ in range(STEPS):
        error, slope = mean_error(told.total(weights))
        if not np.isfinite(error):
            raise CalibrationError(
                "no contact determines some taxel", remedy="lower the threshold or the noise"
            )
        gain = told.gain(slope)
        if _bound(error, gain) > (1.0 - 0.5 * GAP) * error:
            break
        weights = weights * (gain / (0.5 * error)) ** POWER
        weights /= weights.sum()
    return weights, error, slope


def _bound(error: float, gain: Array) -> float:
    """The bound that the tangents at a design's multiples give."""
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


def _places(body: Body, taxels: Array, pitch: float, reach: float) -> Array:
    """Points (c, 3) of the surface, about `pitch` apart, within `reach` of a taxel (n, 3), m."""
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
