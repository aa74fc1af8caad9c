"""Observability, the Cramér-Rao bound's ingredients, and the metrics against a truth."""

from types import SimpleNamespace

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.stats import norm

from meshskin.core import se3
from meshskin.core.errors import CalibrationError
from meshskin.estimation.calibrate import calibrate
from meshskin.estimation.uncertainty import observability
from meshskin.estimation.uncertainty.metrics import (
    bound_mm,
    is_ideal,
    nees_band,
    position_errors,
    summary_mm,
)
from meshskin.estimation.uncertainty.observability import cramer_rao, mean_distance
from meshskin.simulation.contact_samplers import concatenate


def test_mean_distance_against_samples_and_closed_forms():
    round_, line = np.diag([4.0, 4.0]), np.diag([9.0, 0.0])
    assert mean_distance(np.array([round_, line])) == pytest.approx(
        [2 * np.sqrt(np.pi / 2), 3 * np.sqrt(2 / np.pi)]
    )
    root = np.array([[1.0, 0.0], [0.7, 0.3]])
    sample = np.random.default_rng(0).normal(size=(400_000, 2)) @ root.T
    expected = mean_distance((root @ root.T)[None])[0]
    assert np.linalg.norm(sample, axis=1).mean() == pytest.approx(expected, rel=5e-3)
    assert mean_distance(np.diag([np.inf, np.inf])[None])[0] == np.inf


@pytest.mark.parametrize("c", [-8.0, -2.0, 0.0, 1.5, 6.0])
def test_censored_information_is_the_mean_squared_score(c):
    # Score of a reading y ~ N(0, 1): y where y > c, else that of the event y <= c.
    heard = quad(lambda y: y**2 * norm.pdf(y), c, np.inf, epsabs=1e-14)[0]
    silent = np.exp(2 * norm.logpdf(c) - norm.logcdf(c))
    assert observability.censored_information(np.array([c]))[0] == pytest.approx(
        heard + silent, abs=1e-12
    )


def test_bound_increases_with_the_noise_and_marks_unbounded_taxels(world):
    recording = world.record(0.01, 0.05)
    bounds = [cramer_rao(recording, world.belief(s, 0.05), world.skin) for s in (0.01, 0.02)]
    assert 1.7 < bounds[1].mean / bounds[0].mean < 2.3
    assert bounds[0].mean < bounds[0].rms
    with pytest.raises(CalibrationError, match="noise_sigma"):
        cramer_rao(recording, world.belief(None), world.skin)
    far = world.truth.copy()
    far[5] = -far[5]
    away = SimpleNamespace(ids=world.ids, positions=far)
    bound = cramer_rao(recording, world.belief(0.01, 0.05), away)
    assert np.flatnonzero(~bound.bounded).tolist() == [5]
    belief, located = world.belief(0.01, 0.05), world.ids[:4]
    one = 1e3 * bounds[0].expected[:4].mean()
    assert bound_mm(recording, belief, world.skin, located)["mean"] == pytest.approx(one)
    every = bound_mm(recording, belief, world.skin, located[:0])["mean"]
    assert every == pytest.approx(1e3 * bounds[0].mean)
    with pytest.raises(CalibrationError, match="lacks taxels"):
        cramer_rao(
            recording,
            world.belief(0.01, 0.05),
            SimpleNamespace(ids=world.ids[1:], positions=far[1:]),
        )


def test_a_second_pass_without_noise_halves_the_variances_of_the_bound(world):
    recording, belief = world.record(0.0, 0.05), world.belief(0.01, 0.05)
    once = cramer_rao(recording, belief, world.skin)
    twice = cramer_rao(concatenate(recording, recording), belief, world.skin)
    assert once.rms / twice.rms == pytest.approx(np.sqrt(2), rel=1e-3)


def test_unknown_modulus_costs_information(world):
    recording, belief = world.record(0.01, 0.05), world.belief(0.01, 0.05)
    found = cramer_rao(recording, belief, world.skin)
    assert 1e-4 < found.modulus_sigma < 3e-3


def test_pose_covariance_maps_translations_to_tilt():
    tangential = np.array([np.diag([4e-10, 1e-10]), np.diag([np.inf, np.inf])])
    shape = np.array([np.diag([10.0, 5.0])] * 2)
    covariance = observability.pose_covariance(tangential, shape)
    variance = np.diag(covariance[0])
    assert variance[:2] == pytest.approx([4e-10, 1e-10])
    assert variance[3] == pytest.approx(25 * 1e-10 + 1e-10)  # about x: a move along y
    assert variance[4] == pytest.approx(100 * 4e-10 + 1e-10)
    assert np.isinf(variance[5])
    assert (np.linalg.eigvalsh(covariance[0, :5, :5]) > 0).all()
    assert np.isinf(np.diag(covariance[1])).all()
    observed = observability.degrees_of_freedom(covariance, 1e-3)
    assert observed.tolist() == [[True] * 5 + [False], [False] * 6]
    assert not observability.degrees_of_freedom(covariance, 1e-5).any()


def test_errors_with_and_without_the_gauge(world):
    found = calibrate(world.record(), world.belief(), method="trilateration")
    shift = se3.transform(se3.exp_so3([0.01, 0.0, -0.02]), [1e-3, 2e-3, 0.0])
    moved = SimpleNamespace(
        ids=world.ids[::-1], positions=(world.truth @ shift[:3, :3].T + shift[:3, 3])[::-1]
    )
    assert position_errors(found, moved).mean() > 1e-3
    assert position_errors(found, moved, gauge=True).max() < 1e-7
    summary = summary_mm(np.array([1e-3, np.nan, 3e-3]))
    assert summary == pytest.approx({"mean": 2.0, "rms": np.sqrt(5), "max": 3.0})
    assert np.isnan(summary_mm(np.array([np.nan]))["mean"])


@pytest.mark.deep
def test_readings_without_noise_are_ideal(world):
    assert is_ideal(calibrate(world.record(), world.belief()))
    assert not is_ideal(calibrate(world.record(0.001), world.belief(0.001)))


def test_nees_band_holds_the_mean():
    low, high = nees_band(50)
    means = np.random.default_rng(1).chisquare(2, size=(20_000, 50)).mean(axis=1)
    assert np.mean((means > low) & (means < high)) == pytest.approx(0.95, abs=0.01)


def test_the_covariance_along_the_normal_holds_and_is_the_smallest(world):
    """The believed surface is the true one: only rounding separates taxels from it."""
    found = calibrate(world.record(0.01, 0.05), world.belief(0.01, 0.05))
    error = world.truth - found.positions
    height = np.einsum("ni,ni->n", error, found.poses[:, :3, 2])
    sigma = np.sqrt(np.diagonal(found.covariances, axis1=1, axis2=2))
    assert (np.abs(height) < 4 * sigma[:, 2]).all()
    assert (sigma[:, 2] < 0.5 * sigma[:, :2].min(axis=1)).all()
