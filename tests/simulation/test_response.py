"""The force response against a first-order lag, whose settling time is known in closed form."""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest

import meshskin as ms
from meshskin.core.errors import SimulationError
from meshskin.simulation.response import describe_departure, force_response


def test_a_first_order_lag_settles_after_log_50_time_constants():
    time = np.arange(0, 1, 1e-4)
    force = np.where(time < 0.1, 0.0, 3.0 * (1 - np.exp(-(time - 0.1) / 0.02)))
    got = force_response(time, force, 3.0)
    assert got.touch == pytest.approx(0.1, abs=2e-4)
    assert got.settling == pytest.approx(0.02 * np.log(50), abs=3e-4)
    assert got.mean == pytest.approx(3.0, rel=1e-3)
    assert got.overshoot == 0
    assert got.lost == 0


def test_a_force_that_never_settles_or_never_comes():
    time = np.arange(0, 1, 1e-2)
    assert force_response(time, np.full(100, 2.0), 3.0).settling == np.inf
    lost = force_response(time, np.where(time == 0.5, 0.0, 3.0), 3.0)
    assert lost.lost == 1
    with pytest.raises(SimulationError, match="no contact force"):
        force_response(time, np.zeros(100), 3.0)


def test_lighter_contacts_are_judged_by_their_own_reference():
    time, reference = np.arange(0, 1, 1e-2), np.repeat([3.0, 1.5, 0.75], [50, 30, 20])
    got = force_response(time, 1.01 * reference, reference)
    assert (got.reference, got.lighter) == (3.0, (0.75, 1.5))
    assert got.settling == 0
    assert got.mean == pytest.approx(3.03)
    assert got.disturbance == pytest.approx(0.01)
    assert force_response(time, reference, 3.0).disturbance == pytest.approx(0.75)
    assert force_response(time, reference, 3.0).lighter == ()


def test_air_and_sliding_are_told_from_the_touch():
    """Two places: the second touch, the way between and the slide's disturbance are no settling."""
    place = ["approach"] * 10 + ["touch"] * 50 + ["hold"] * 20 + ["slide"] * 100 + ["leave"] * 20
    force = np.concatenate([np.zeros(12), np.full(168, 3.0), np.zeros(20)])
    force[15], force[120] = 3.3, 2.7
    time, phase = 1e-3 * np.arange(400), place * 2
    got = force_response(time, np.tile(force, 2), 3.0, phase)
    assert got.touch == pytest.approx(0.012)
    assert got.settling == pytest.approx(0.004)
    assert got.overshoot == pytest.approx(0.1)
    assert got.disturbance == pytest.approx(0.1)  # not the rise of the second touch, from 0 N
    assert got.lost == 2  # of the second touch: the first is waited for


def sliding(force, phase):
    """A recording with steps of 1 ms, a reference of 3 N, and a contact along x every 10 ms."""
    time = 1e-3 * np.arange(len(force))
    columns = {"time": time, "phase": phase, "force": force, "reference": np.full(len(force), 3.0)}
    at, zero = time[::10], np.zeros(len(time[::10]))
    contacts = {"time": at, "px": at, "py": zero, "pz": zero, "nx": zero, "ny": zero}
    contacts |= {"nz": zero + 1.0, "force": zero + 3.0}
    readings = {"time": at, "taxel": zero.astype(int), "pressure": zero + 1.0}
    return ms.Recording(pa.table(contacts), pa.table(readings), {}, pa.table(columns))


@pytest.mark.parametrize("low_or_high", [2.3, 3.7])
def test_a_force_that_leaves_its_reference_after_settling_is_described(low_or_high):
    phase = ["approach"] * 5 + ["touch"] * 5 + ["hold"] * 10 + ["slide"] * 20
    force = np.concatenate([np.zeros(5), np.full(5, 9.0), np.full(30, 3.0)])
    assert describe_departure(sliding(force, phase)) == ""
    force[30] = 3.0 + 0.9 * (low_or_high - 3.0)
    force[31] = low_or_high
    recording = sliding(force, phase)
    words = describe_departure(recording)
    assert f"{low_or_high:g} N instead of 3 N at 0.031 s" in words
    assert "near (30.0, 0.0, 0.0) mm of the body" in words
    assert "in 10 % of the steps" in words
    assert "exploration.speed" in words
    empty = recording.contacts.slice(0, 0), recording.readings.slice(0, 0)
    without = describe_departure(ms.Recording(*empty, {}, recording.motion))
    assert without == words.replace(", near (30.0, 0.0, 0.0) mm of the body", "")
    force[32] = 0.0
    assert "0 N (contact lost) instead of 3 N at 0.032 s" in describe_departure(
        sliding(force, phase)
    )


@pytest.mark.deep
def test_a_simulation_warns_of_a_force_that_leaves_its_reference():
    scene = ms.Scene.load("sphere_noisy")
    fast = replace(scene.exploration, speed=0.4, ramp=0.02, turn_rate=10.0)
    slow_law = replace(scene.law, gamma=10.0)
    with pytest.warns(UserWarning, match="the contact force left its reference"):
        ms.simulate(scene.with_(exploration=fast, law=slow_law), seed=1)
