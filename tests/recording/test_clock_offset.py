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


@pytest.mark.deep
@pytest.mark.parametrize("by", [pytest.param("force", marks=pytest.mark.slow), "motion"])
def test_sigma_is_the_scatter_over_seeds(by):
    found = [estimate(RobotLog(seed=seed), by) for seed in range(16)]
    error = np.array([one.offset - 0.037 for one in found])
    sigma = np.array([one.sigma for one in found])
    assert abs(error.mean()) < 5e-4
    assert np.max(np.abs(error)) < 2e-3
    assert 0.4 < np.mean((error / sigma) ** 2) < 2.2


def presses(seed, length, taxels=8, away=0.0):
    """Times, counts, times and forces of 20 presses of random force, which slide by `length`, m,
    under it; discs of pressure over `taxels` squared taxels 6 mm apart, of gains of their own."""
    rng = np.random.default_rng(seed)
    rise = 0.5 - 0.5 * np.cos(np.pi * np.arange(75) / 75)
    force, places = [np.zeros(500)], [np.zeros((500, 2))]
    for _ in range(20):
        hold, air, turn = rng.integers(200, 300), rng.integers(450, 550), rng.uniform(0, 2 * np.pi)
        level = np.concatenate([rise, np.ones(hold), rise[::-1], np.zeros(air)])
        force.append(rng.uniform(2.4, 3.6) * level)
        share = np.interp(np.arange(len(level)), [75, 75 + hold], [0, 1])
        start = rng.uniform(-away, 6e-3 * (taxels - 1) + away, 2)
        places.append(start + length * share[:, None] * [np.cos(turn), np.sin(turn)])
    force, places = np.concatenate(force), np.concatenate(places)
    time, rows = 2e-3 * np.arange(len(force)), np.arange(rng.integers(10), len(force), 10)
    sites = 6e-3 * np.stack(np.divmod(np.arange(taxels**2), taxels), axis=1)
    root = np.cbrt(force[rows, None] / 3.0)  # Hertz: radius and peak of the pressure
    apart = np.linalg.norm(places[rows, None] - sites, axis=2) / (4e-3 * np.maximum(root, 1e-9))
    counts = 120 * root * np.sqrt(np.maximum(1 - apart**2, 0.0)) * rng.lognormal(0, 0.1, taxels**2)
    counts = np.round(240 - counts + rng.normal(0, 1.5, counts.shape))
    wrench = [0.0, 0.0, 5.0] + force[::2, None] * [0.0, 0.0, 1.0]
    wrench += rng.normal(0, 0.02, wrench.shape)
    return time[rows] + 0.037, counts, time[::2], wrench


def estimate_of_presses(seed, length, **where):
    times, counts, state_times, wrench = presses(seed, length, **where)
    found = tare(times, counts)
    return clock_offset(
        times, found.readings, found.noise, found.in_contact, state_times, wrench, "force"
    )


def test_the_noise_of_taxels_that_are_not_pressed_is_no_slide():
    found = estimate_of_presses(0, 0.0, taxels=20)
    assert found.contacts > 15
    assert abs(found.offset - 0.037) < 4 * found.sigma < 0.02


@pytest.mark.deep
def test_strokes_over_the_skin_tell_nothing():
    """Other taxels answer at their end than at their onset, as strongly as it happens."""
    for seed in range(10):
        assert estimate_of_presses(seed, 0.02) is None
        assert estimate_of_presses(seed, 0.03, away=0.02) is None


@pytest.mark.deep
@pytest.mark.parametrize(
    "length",
    [pytest.param(0.0, marks=pytest.mark.slow), 1e-3, pytest.param(3e-3, marks=pytest.mark.slow)],
)
def test_sigma_holds_where_contacts_slide_by_part_of_a_taxel(length):
    found = [estimate_of_presses(seed, length) for seed in range(16)]
    score = np.array([(one.offset - 0.037) / one.sigma for one in found if one is not None])
    assert len(score) >= 12
    assert np.max(np.abs(score)) < 4
    assert 0.3 < np.mean(score**2) < 2.2
    usable = [one for one in found if one is not None and one.usable]
    assert np.max(np.abs([one.offset - 0.037 for one in usable])) < 0.02
    assert length > 1e-3 or len(usable) == len(found)


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
