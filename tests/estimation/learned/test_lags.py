"""What lags that an estimate lacks displace the taxels by."""

from types import SimpleNamespace

import numpy as np
import pytest

from meshskin.estimation.joint.departures import TIMES, WIDTHS
from meshskin.estimation.joint.small_effects import (
    LEAST_SHARED,
    contact_leverages,
    most_likely,
)
from meshskin.estimation.learned import lags as module
from meshskin.estimation.learned.lags import lags

READINGS, FAMILY = 400, len(TIMES) + len(WIDTHS)


def at_the_mode(columns):
    return np.zeros(FAMILY)


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
        self.level = self.columns @ (share * np.sign(rng.normal(size=FAMILY)))
        self.level += rng.normal(size=READINGS)

    def creeps(self, electronics):
        return self.columns[:, : len(TIMES)]

    def shared(self, columns):
        left = columns - self.places @ np.linalg.pinv(self.places) @ columns
        return left.T @ self.level, left.T @ left

    def displaced(self, columns):
        return (np.linalg.pinv(self.places) @ columns).reshape(2, 2, -1)


@pytest.fixture(autouse=True)
def plays(monkeypatch):
    """What the play operators add to the pressures are the columns of `Fitted` but for creep's."""
    added = Fitted(0.0).columns[:, len(TIMES) :].T

    def electronics(*_):
        columns = iter(added)
        return SimpleNamespace(peak=1.0, play=lambda p, half: (p + next(columns), None, None))

    monkeypatch.setattr(module, "Electronics", electronics)


def test_displacements_are_those_of_the_most_likely_shares():
    fitted = Fitted(0.02)
    found, (slope, information) = lags(fitted, at_the_mode), fitted.shared(fitted.columns)
    score, mean, covariance = most_likely(slope[None], information[None])
    moved = fitted.displaced(fitted.columns)
    assert found.score == pytest.approx(score)
    np.testing.assert_allclose(found.displacements, moved @ mean[0], rtol=1e-6)
    expected = np.einsum("nap,pq,nbq->nab", moved, covariance[0], moved)
    np.testing.assert_allclose(found.covariances, expected, rtol=1e-6)


def test_taxels_return_to_where_they_are():
    fitted = Fitted(0.05)
    error = (np.linalg.pinv(fitted.places) @ fitted.level).reshape(2, 2)
    left = error - lags(fitted, at_the_mode).displacements
    assert np.abs(left).max() < 0.3 * np.abs(error).max()


def test_leverage_of_contacts():
    """Two readings of unit noise in a contact, which a displacement explains but for its prior."""
    jacobian = np.zeros((2, 5))
    jacobian[:, 2] = 3.0, 4.0  # of the contact's first displacement
    system = SimpleNamespace(contacts=np.diag([25.0 + 5.0, 1.0, 1.0])[None])
    readings = SimpleNamespace(contact=np.zeros(2, dtype=int))
    fitted = SimpleNamespace(
        jacobian=jacobian, system=system, readings=readings, curvature=np.ones(2)
    )
    assert np.mean(contact_leverages(fitted)) == pytest.approx(25 / 30 / 2)


def test_chance_moves_no_taxel():
    found = [lags(Fitted(0.0, seed), at_the_mode) for seed in range(40)]
    assert not any(one.displacements.any() or one.covariances.any() for one in found)
    assert max(one.score for one in found) < LEAST_SHARED


def test_what_the_errors_of_the_contacts_favour_is_no_lag():
    fitted = Fitted(0.02)
    slope, _ = fitted.shared(fitted.columns)
    assert lags(fitted, lambda columns: -slope).score < LEAST_SHARED
    assert lags(fitted, at_the_mode).score > LEAST_SHARED
