"""What lags that an estimate lacks displace the taxels by."""

from types import SimpleNamespace

import numpy as np
import pytest

from meshskin.estimation.joint.departures import TIMES, WIDTHS
from meshskin.estimation.learned import lags as module
from meshskin.estimation.learned.lags import LEAST_SCORE, NAME, SHARES, lags

READINGS, FAMILY = 400, len(TIMES) + len(WIDTHS)


class Fitted:
    """Readings of unit noise, which depend on the places of two taxels and have lags of the given
    share, estimated without them."""

    def __init__(self, share, seed=0):
        rng = np.random.default_rng(seed)
        self.data = self.readings = None
        self.points = np.zeros((2, 3))
        self.mu, self.offset = np.ones(READINGS), np.zeros(READINGS)
        self.columns = 20.0 * rng.normal(size=(READINGS, FAMILY))
        self.places = 1e5 * (self.columns[:, :4] / 20 + rng.normal(size=(READINGS, 4)))
        self.shares = share * np.sign(rng.normal(size=FAMILY))
        self.level = self.columns @ self.shares + rng.normal(size=READINGS)
        self.explained = self.places @ np.linalg.pinv(self.places)

    def creeps(self, electronics):
        return self.columns[:, : len(TIMES)]

    def shared(self, columns):
        left = columns - self.explained @ columns
        return left.T @ self.level, left.T @ left

    def displaced(self, columns):
        return (np.linalg.pinv(self.places) @ columns).reshape(2, 2, -1)


@pytest.fixture(autouse=True)
def plays(monkeypatch):
    """The other columns are what the play operator adds to the pressures."""
    fitted = Fitted(0.0)

    def electronics(*_):
        columns = iter(fitted.columns[:, len(TIMES) :].T)
        return SimpleNamespace(peak=1.0, play=lambda p, half: (p + next(columns), None, None))

    monkeypatch.setattr(module, "Electronics", electronics)


def marginal(fitted, share):
    """Logarithm of the likelihood of the readings with shares of this deviation, of which the
    places explain a part, up to a constant."""
    free = np.eye(READINGS) - fitted.explained
    basis = np.linalg.svd(free)[0][:, : READINGS - 4]
    seen, level = basis.T @ fitted.columns, basis.T @ fitted.level
    covariance = np.eye(len(level)) + share**2 * seen @ seen.T
    return -(np.linalg.slogdet(covariance)[1] + level @ np.linalg.solve(covariance, level)) / 2


def test_shares_are_those_of_the_largest_marginal_likelihood():
    fitted = Fitted(0.02)
    found = lags(fitted)
    gains = [marginal(fitted, share) - marginal(fitted, 0.0) for share in SHARES]
    assert found.score == pytest.approx((2 * max(gains)) ** 0.5, rel=1e-6)
    assert found.departure == {NAME: found.score}
    best = SHARES[int(np.argmax(gains))]
    left = fitted.columns - fitted.explained @ fitted.columns
    covariance = np.linalg.inv(left.T @ left + np.eye(FAMILY) / best**2)
    mean = covariance @ left.T @ fitted.level
    moved = (np.linalg.pinv(fitted.places) @ fitted.columns).reshape(2, 2, -1)
    np.testing.assert_allclose(found.displacements, moved @ mean, rtol=1e-6)
    expected = np.einsum("nap,pq,nbq->nab", moved, covariance, moved)
    np.testing.assert_allclose(found.covariances, expected, rtol=1e-6)


def test_taxels_return_to_where_they_are():
    fitted = Fitted(0.05)
    error = (np.linalg.pinv(fitted.places) @ fitted.level).reshape(2, 2)
    left = error - lags(fitted).displacements
    assert np.abs(left).max() < 0.3 * np.abs(error).max()


def test_chance_moves_no_taxel():
    found = [lags(Fitted(0.0, seed)) for seed in range(40)]
    assert not any(one.displacements.any() or one.covariances.any() for one in found)
    assert max(one.score for one in found) < LEAST_SCORE
    assert min(one.score for one in found) == 0.0  # the likeliest variance is near zero
