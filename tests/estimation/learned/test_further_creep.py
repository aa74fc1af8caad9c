"""What a further creep displaces the taxels by."""

from types import SimpleNamespace

import numpy as np
import pytest

from meshskin.estimation.learned import further_creep as module
from meshskin.estimation.learned.further_creep import LEAST_SCORE, NAME, further_creep


class Fitted:
    """Five readings of two taxels, whose residuals show a creep with the second of three time
    constants, of a share that is `score` standard deviations."""

    def __init__(self, score, names=("creep",)):
        self.data = SimpleNamespace(parameters=SimpleNamespace(names=names))
        self.readings, self.points = None, np.zeros((2, 3))
        self.slope = np.array([0.1, -score, 0.2]) * 50.0
        self.moved = np.array([[[1.0], [0.0]], [[0.5], [-2.0]]]) * 1e-3

    def creeps(self, electronics):
        return np.arange(15.0).reshape(5, 3)

    def shared(self, columns):
        return self.slope, np.diag([2500.0, 2500.0, 2500.0])

    def displaced(self, columns):
        np.testing.assert_array_equal(columns[:, 0], [1.0, 4.0, 7.0, 10.0, 13.0])
        return self.moved


@pytest.fixture(autouse=True)
def electronics(monkeypatch):
    monkeypatch.setattr(module, "Electronics", lambda *_: None)


def test_the_square_of_the_displacement_counts():
    found = further_creep(Fitted(5.0))
    share = 5.0 / 50.0
    assert found.departure == {NAME: pytest.approx(5.0)}
    expected = share**2 * 1e-6 * np.array([[[1, 0], [0, 0]], [[0.25, -1], [-1, 4]]])
    np.testing.assert_allclose(found.covariances, expected, atol=1e-18)


def test_small_ones_are_chance():
    assert not further_creep(Fitted(LEAST_SCORE - 0.1)).covariances.any()


def test_the_first_creep_is_estimated_instead():
    assert further_creep(Fitted(5.0, names=("hysteresis",))) is None
