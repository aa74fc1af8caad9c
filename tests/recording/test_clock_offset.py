"""The offset of the skin's clock from contact onsets, against force and against motion."""

import numpy as np
import pytest

from meshskin.recording.clock_offset import clock_offset
from meshskin.recording.tare import tare

from .robot_log import RobotLog


def estimate(log, by):
    streams = log.streams()
    times, counts = streams["/skin"]
    found = tare(times, counts)
    if by == "force":
        state_times, wrench = streams["/wrench"]
        states = wrench[:, :3] - [0.4, -0.2, 5.0]
    else:
        state_times, states = streams["/joint_states"]
    return clock_offset(
        times, found.readings, found.noise, found.in_contact, state_times, states, by
    )


@pytest.mark.parametrize("by", ["force", "motion"])
@pytest.mark.parametrize("late", [0.037, -0.12])
def test_the_offset_is_recovered_to_2_ms(by, late):
    found = estimate(RobotLog(late=late, seed=7), by)
    assert found.contacts == 12
    assert abs(found.offset - late) < 2e-3
    assert found.usable


@pytest.mark.parametrize("by", ["force", "motion"])
def test_sigma_is_the_scatter_over_seeds(by):
    found = [estimate(RobotLog(seed=seed), by) for seed in range(16)]
    error = np.array([one.offset - 0.037 for one in found])
    sigma = np.array([one.sigma for one in found])
    assert abs(error.mean()) < 5e-4
    assert np.max(np.abs(error)) < 2e-3
    assert 0.4 < np.mean((error / sigma) ** 2) < 2.2


def test_few_contacts_tell_nothing():
    assert estimate(RobotLog(contacts=4), "force") is None


def test_a_path_that_does_not_return_tells_nothing_or_says_so():
    """The robot slides on and lifts off elsewhere: posture and readings have no common curve."""
    log = RobotLog(contacts=12)
    times, counts = log.streams()["/skin"]
    found = tare(times, counts)
    state_times = np.arange(0, log.duration, 1 / 125)
    on = np.stack([state_times, np.sin(state_times), np.cos(1.3 * state_times)], axis=1)
    result = clock_offset(
        times, found.readings, found.noise, found.in_contact, state_times, on, "motion"
    )
    assert result is None or not result.usable
