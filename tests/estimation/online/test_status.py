"""The tests behind the verdict keep their false-alarm rates."""

import numpy as np
import pytest

from meshskin.estimation.online.status import FALSE_ALARM, SequentialTest, moved_taxels
from meshskin.estimation.uncertainty.goodness_of_fit import chance


def test_the_levels_of_all_looks_add_up_to_the_false_alarm_rate():
    test = SequentialTest()
    levels = [test.look(count) for count in range(1, 100_000)]
    assert sum(levels) < FALSE_ALARM
    assert sum(levels) == pytest.approx(FALSE_ALARM, rel=0.02)
    assert levels[28] == 0.0 < levels[29] == FALSE_ALARM / 2


def test_moves_are_found_and_seldom_imagined():
    rng, n = np.random.default_rng(0), 100
    root = 1e-5 * rng.normal(size=(n, 2, 2))
    covariance = root @ np.swapaxes(root, 1, 2) + 1e-10 * np.eye(2)
    factor = np.linalg.cholesky(covariance)
    alarms = 0
    for _ in range(2000):
        offset = np.einsum("nij,nj->ni", factor, rng.normal(size=(n, 2)))
        alarms += moved_taxels(offset, covariance, 0.05).any()
    assert alarms / 2000 == pytest.approx(0.05, abs=0.02)
    offset[7] += 10 * np.sqrt(np.trace(covariance[7]))
    assert np.flatnonzero(moved_taxels(offset, covariance, 1e-3)).tolist() == [7]


def test_residuals_above_the_noise_are_a_misfit():
    rng = np.random.default_rng(0)
    square = rng.chisquare(500, size=4000)
    assert np.mean([chance(x, 500) < 0.01 for x in square]) == pytest.approx(0.01, abs=0.005)
    assert chance(1.5 * 500, 500) < 1e-6
