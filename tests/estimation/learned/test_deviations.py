"""Variances from the data: in a linear model with known truth, unbiased."""

from dataclasses import replace

import numpy as np
import pytest

from meshskin.estimation.learned.deviations import Deviations, Effects, log_step

GROUPS, EACH = 4000, 4


def balanced(sigma, noise, seed=0):
    """Group effects of deviation `sigma` read EACH times with `noise`; posterior mean and variance
    are closed forms."""
    rng = np.random.default_rng(seed)
    effects = sigma * rng.standard_normal(GROUPS)
    return effects + noise * rng.standard_normal(GROUPS) / np.sqrt(EACH)


def effects(modes, posterior, sigma):
    """Of independent effects with one posterior variance."""
    part = 1 - posterior / sigma**2
    return Effects(modes @ modes / sigma**2, GROUPS * part, GROUPS * part**2, GROUPS)


@pytest.mark.parametrize("truth", [0.3, 1.0, 3.0])
def test_scoring_converges_to_the_variance_of_the_effects(truth):
    means, noise, sigma = balanced(truth, 1.0), 1.0, 0.1
    for _ in range(30):
        posterior = 1 / (1 / sigma**2 + EACH / noise**2)
        modes = posterior * EACH / noise**2 * means
        step, _ = log_step(effects(modes, posterior, sigma))
        sigma *= np.exp(step / 2)
    closed = np.sqrt(np.mean(means**2) - noise**2 / EACH)  # the restricted likelihood's maximum
    assert sigma == pytest.approx(closed, rel=1e-6)
    assert sigma == pytest.approx(truth, rel=0.05)


def test_effects_that_are_not_there_vanish():
    means, sigma = balanced(0.0, 1.0, seed=3), 1.0
    for _ in range(40):
        posterior = 1 / (1 / sigma**2 + EACH)
        modes = posterior * EACH * means
        step, _ = log_step(effects(modes, posterior, sigma))
        sigma *= np.exp(step / 2)
    assert sigma < 0.1


def test_a_variance_near_zero_rests_where_its_score_is_within_chance():
    """Its information vanishes with the square of the variance: the step is the longest one, for a
    score that says nothing."""
    information = 3e-5
    by_chance, shown = (Effects(0.125 + z * (2 * information) ** 0.5, 0.125, information, 2000)
                        for z in (0.3, 3.0))  # fmt: skip
    assert log_step(by_chance, careful=True)[1] < 0.05
    assert log_step(by_chance)[0] == pytest.approx(np.log(50))
    assert log_step(shown, careful=True) == (pytest.approx(np.log(50)), np.inf)


@pytest.mark.parametrize(("noise", "relative"), [(1.0, 0.0), (0.5, 0.02), (2.0, 0.05)])
def test_both_parts_of_the_noise(noise, relative):
    rng = np.random.default_rng(1)
    mu = 100 * rng.random(20000)
    free = 0.3 + 0.6 * rng.random(len(mu))
    deviation = np.hypot(noise, relative * mu)
    squares = free * (deviation * rng.standard_normal(len(mu))) ** 2
    found = Deviations(noise=1.0).with_noise(mu, np.zeros_like(mu), squares, free, 2)
    assert found.noise == pytest.approx(noise, rel=0.06)
    assert found.relative == pytest.approx(relative, abs=0.004)
    constant = Deviations(noise=1.0).with_noise(mu, np.zeros_like(mu), squares, free, 1)
    assert constant.relative == 0.0
    assert constant.noise == pytest.approx(np.sqrt(np.mean(deviation**2)), rel=0.05)


@pytest.mark.parametrize("shape", [0.0, 0.3, 1.0])
def test_what_readings_show_of_uneven_patches(shape):
    rng = np.random.default_rng(2)
    mu, uneven = 100 * rng.random(20000), 30 * rng.random(20000) ** 4
    deviation = np.sqrt(1.0 + (0.02 * mu) ** 2 + (shape * uneven) ** 2)
    squares = (deviation * rng.standard_normal(len(mu))) ** 2
    found = Deviations(noise=2.0).with_noise(mu, uneven, squares, np.ones(len(mu)), 2)
    assert found.shape == pytest.approx(shape, rel=0.05, abs=0.05)
    assert found.noise == pytest.approx(1.0, rel=0.06)
    assert found.relative == pytest.approx(0.02, abs=0.004)


def test_few_readings_in_uneven_contacts_show_what_is_believed():
    mu, uneven = np.zeros(1000), np.zeros(1000)
    uneven[0] = 20.0
    squares = np.ones(1000)
    found = Deviations(noise=1.0).with_noise(mu, uneven, squares, np.ones(1000), 1)
    assert 0.8 < found.shape < 1.0


def test_noise_grows_with_the_reading():
    d = Deviations(noise=3.0, relative=0.1)
    np.testing.assert_allclose(d.noise_of(np.array([-5.0, 0.0, 40.0])), [3.0, 3.0, 5.0])


def test_the_force_of_contacts_whose_force_was_not_measured_keeps_its_least_deviation():
    small = {"force": Effects(square=1.0, determined=500.0, information=400.0, count=1000)}
    moved, gain = Deviations(force=0.3, least_force=0.3).moved(small)
    assert (moved.force, gain) == (0.3, 0.0)
    assert Deviations(force=0.3).moved(small)[0].force < 0.2
    large = {"force": replace(small["force"], square=900.0)}
    assert Deviations(force=0.3, least_force=0.3).moved(large)[0].force > 0.3
