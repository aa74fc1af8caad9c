"""What the errors of contacts add to slopes of the likelihood, against Laplace's integral."""

from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.optimize import minimize_scalar

from meshskin.estimation.learned import lags as module
from meshskin.estimation.learned.lags import slope_beyond_mode

CONTACTS, EACH, PRIOR = 200, 5, 4.0
RNG = np.random.default_rng(2)
LEVEL = 3.0 + RNG.random((CONTACTS, EACH))
LAG = RNG.normal(0.5, 0.2, (CONTACTS, EACH))
"""Part of each reading that a share of the lag takes away."""


@dataclass
class Fitted:
    mu: np.ndarray
    curvature: np.ndarray
    jacobian: np.ndarray


def predicted(errors, share=0.0):
    """Readings (m, EACH) that grow with the contacts' errors (m,) of ln force."""
    return LEVEL * np.exp(errors)[:, None] * (1 - share * LAG)


class System:
    """Normal equations of the contacts' errors alone."""

    def __init__(self):
        self.contacts = np.zeros((CONTACTS, 3, 3)) + np.eye(3)
        self.contacts[:, 2, 2] = PRIOR + np.sum(LEVEL**2, axis=1)

    def transposed(self, jacobian, columns):
        return ((jacobian[:, :, None] * columns.reshape(CONTACTS, EACH, -1)).sum(axis=1),)

    def solve(self, part):
        return (part / self.contacts[:, 2, 2, None],)

    def forward(self, jacobian, parts):
        return (jacobian[:, :, None] * parts[0][:, None]).reshape(CONTACTS * EACH, -1)


def moved(effects, errors):
    mu = predicted(errors[:, 2])
    rate = mu.ravel() - LEVEL.ravel()
    return SimpleNamespace(mu=mu.ravel(), jacobian=mu, slopes=lambda: (rate, np.ones_like(rate)))


@pytest.fixture
def effects(monkeypatch):
    monkeypatch.setattr(module, "_moved", moved)
    monkeypatch.setattr(module, "contact_leverages", lambda fitted: np.array([0.1]))
    fitted = Fitted(LEVEL.ravel(), np.ones(LEVEL.size), LEVEL)
    return SimpleNamespace(
        fitted=lambda: fitted,
        system=System,
        data=SimpleNamespace(force_measured=True),
        electronics=None,
    )


def columns(fitted):
    return -(fitted.mu * LAG.ravel())[:, None]


def half_log_determinant(share):
    """Half the log determinant of the information on the errors, at the mode under the share."""
    total = 0.0
    for level, lag in zip(LEVEL, LAG, strict=True):
        weaker = level * (1 - share * lag)

        def cost(e, level=level, weaker=weaker):
            return np.sum((weaker * np.exp(e) - level) ** 2) / 2 + PRIOR * e**2 / 2

        e = minimize_scalar(cost, bracket=(-0.1, 0.1), tol=1e-12).x
        mu = weaker * np.exp(e)
        total += np.log(np.sum(mu**2 + (mu - level) * mu) + PRIOR) / 2
    return total


def test_slope_is_that_of_the_log_determinant(effects):
    expected = -(half_log_determinant(1e-3) - half_log_determinant(-1e-3)) / 2e-3
    assert expected > 1.0
    assert slope_beyond_mode(effects, columns)[0] == pytest.approx(expected, rel=0.2)


def test_none_where_the_deviation_of_force_errors_is_a_bound(effects):
    effects.data.force_measured = False
    assert not slope_beyond_mode(effects, columns).any()


def test_none_where_contacts_have_no_errors(effects, monkeypatch):
    monkeypatch.setattr(module, "contact_leverages", lambda fitted: np.array([1e-4]))
    assert not slope_beyond_mode(effects, columns).any()
