"""Taxels that differ in gain and offset are distinguished from faulty ones."""

import numpy as np
import pytest

from meshskin.core.errors import CalibrationError
from meshskin.estimation.calibrate import calibrate
from meshskin.estimation.data.gather import gather
from meshskin.estimation.data.global_parameters import PRIORS, declared_parameters
from meshskin.estimation.joint.joint_estimator import JointEstimator
from meshskin.estimation.uncertainty.metrics import nees, position_errors

BOTH = ("modulus", "gain", "offset")


def record(world, gain, offset=0.0, noise=0.01, threshold=0.05, fault=None):
    """A recording of taxels with gains and offsets (n,), the latter relative to the peak."""
    exact = world.pressures()
    p = exact * gain + np.broadcast_to(offset, gain.shape) * world.peak_reference
    if fault is not None:
        fault(p)
    p = p / world.peak_reference
    plain = world.pressures
    world.pressures = lambda: p * world.peak_reference
    try:
        return world.record(noise, threshold)
    finally:
        world.pressures = plain


def spread(world, size=0.05, seed=4):
    return np.exp(size * np.random.default_rng(seed).normal(size=len(world.ids)))


@pytest.mark.deep
@pytest.mark.parametrize("noise", [pytest.param(0.01, marks=pytest.mark.slow), None])
@pytest.mark.parametrize("size", [pytest.param(0.05, marks=pytest.mark.slow), 0.2])
def test_taxels_of_different_gain_are_not_broken(world, size, noise):
    recording = record(world, spread(world, size), 0.005)
    found = calibrate(recording, world.belief(noise, 0.05))
    known = calibrate(recording, world.belief(noise, 0.05, unknown=BOTH))
    assert not any(found.faults)
    assert np.isfinite(found.positions).all()
    np.testing.assert_allclose(found.positions, known.positions, atol=1e-6)
    np.testing.assert_allclose(found.position_sigma, known.position_sigma, rtol=0.01)
    for name in ("gain", "offset"):
        mine, declared_ones = found.taxel_unknowns[name], known.taxel_unknowns[name]
        assert np.abs((mine - declared_ones) / declared_ones[:, 1:]).max() < 0.1
    assert 1.2 < nees(found, world.skin).mean() < 3.0  # 2 for 37 taxels, 95 % from 1.4 to 2.7
    assert any("undeclared" in words for words in found.factors)
    if noise:
        assert found.fit.good


def test_one_taxel_of_twice_the_gain(world):
    gain = np.ones(len(world.ids))
    gain[7] = 2.0
    found = calibrate(record(world, gain), world.belief(0.01, 0.05))
    assert not any(found.faults)
    assert found.fit.good
    assert position_errors(found, world.skin)[7] < 60e-6


@pytest.mark.deep
def test_faulty_taxels_among_taxels_of_different_gain_are_named(world):
    bad = [9, 18, 20]

    def fault(p):
        late = np.arange(len(p)) % 10 > 6
        p[late, 18] = 0.0
        one, other = p[late, 9], p[late, 20]
        p[late, 9], p[late, 20] = other, one.copy()

    found = calibrate(record(world, spread(world), fault=fault), world.belief(0.01, 0.05))
    assert np.array_equal(np.flatnonzero(found.faults != ""), bad)
    assert "silent" in found.faults[18]
    assert "swapped with 120" in found.faults[9]  # what it reads elsewhere still counts
    assert found.fit.good
    assert nees(found, world.skin).mean() < 3.0


def test_sound_taxels_of_equal_gain_get_no_gains(world):
    found = calibrate(world.record(0.01, 0.05), world.belief(0.01, 0.05))
    assert not found.taxel_unknowns
    assert not any("undeclared" in words for words in found.factors)


@pytest.mark.deep
def test_gains_that_do_not_converge_are_dropped(world, monkeypatch):
    recording = record(world, spread(world))
    converge = JointEstimator.converge

    def lost(run):
        if run.data.parameters.nuisance_names:
            raise CalibrationError("the joint estimate did not converge")
        converge(run)

    monkeypatch.setattr(JointEstimator, "converge", lost)
    found = calibrate(recording, world.belief(0.01, 0.05))
    assert not found.taxel_unknowns
    assert not found.fit.good


def test_what_is_declared_keeps_its_prior():
    shared = declared_parameters(("modulus", "gain"), {"gain": 0.1}, 3.0, 1e5)
    both = shared.with_nuisance(2e5)
    assert both.nuisance_names == ("gain", "offset")
    assert both.nuisance_sigma == (0.1, PRIORS["offset"] * 2e5)
    assert both.names == shared.names
    assert both.with_nuisance(3e5) == both


def test_reading_at_rest(world):
    offset = np.zeros(len(world.ids))
    offset[[2, 5]] = 0.1, 0.3
    recording = record(world, np.ones(len(world.ids)), offset, noise=0.01)
    rest = gather(recording, world.belief(0.01, 0.05)).rest / world.peak_reference
    np.testing.assert_allclose(rest, np.maximum(offset, 0.05), atol=0.005)
    assert np.count_nonzero(rest > 0.06) == 2


def test_a_gain_that_no_sound_taxel_has_is_named(world):
    gain = spread(world)
    gain[7] = 0.3
    found = calibrate(record(world, gain), world.belief(0.01, 0.05))
    assert np.array_equal(np.flatnonzero(found.faults != ""), [7])
    assert found.faults[7] == "gain of 0.3"
    assert found.fit.good
