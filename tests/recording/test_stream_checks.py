"""Messages of garbage, and streams in turn."""

import numpy as np
import pytest

from meshskin.core.errors import RecordingError
from meshskin.recording.stream import JOINTS, TAXELS, Stream
from meshskin.recording.stream_checks import check_single, without_garbage

from .robot_log import RobotLog

ROBOT = RobotLog(contacts=12, seed=2)


def stream(times, values, kind=TAXELS):
    fields = tuple(map(str, range(values.shape[1])))
    return Stream("/skin", "", times, values, fields, kind)


def in_turn(earlier, part=slice(None)):
    """The skin of the robot with a copy of a part of itself some time, s, earlier."""
    times, counts = ROBOT.streams()["/skin"]
    both = np.concatenate([times, times[part] - earlier])
    order = np.argsort(both, kind="stable")
    return stream(both[order], np.concatenate([counts, counts[part]])[order])


@pytest.mark.parametrize("earlier", [2.0, 1.003, 1.01])
@pytest.mark.parametrize("part", [slice(None), slice(200, 700)])
def test_a_stream_with_a_copy_of_itself_is_refused(earlier, part):
    with pytest.raises(RecordingError, match="/skin holds two streams in turn"):
        check_single(in_turn(earlier, part))


@pytest.mark.parametrize("frequency", [50.0, 49.9, 48.0])
@pytest.mark.parametrize("level", [1.5, 3.0])
def test_mains_hum_is_not_refused(frequency, level):
    """In taxels of different gains, sampled at 100 Hz."""
    rng = np.random.default_rng(1)
    times = np.arange(0, 60, 0.01) + rng.normal(0, 3e-4, 6000)
    hum = level * np.sin(2 * np.pi * frequency * times + 0.8)[:, None] * rng.uniform(0.7, 1.3, 16)
    values = 200 + hum + rng.normal(0, 1.0, (6000, 16))
    check_single(stream(times, values))
    with pytest.raises(RecordingError, match="two streams in turn"):  # joints have none
        check_single(stream(times, values, JOINTS))


def test_two_skins_in_turn_are_refused_though_evenly_spaced():
    rng = np.random.default_rng(2)
    level = rng.uniform(150, 250, (2, 16))
    values = np.tile(level, (1000, 1)) + rng.normal(0, 1.0, (2000, 16))
    with pytest.raises(RecordingError, match="two streams in turn"):
        check_single(stream(np.arange(2000) / 100, values))


def test_sound_streams_are_not_refused():
    streams = ROBOT.streams()
    check_single(stream(*streams["/skin"]))
    check_single(stream(*streams["/joint_states"], JOINTS))
    rng = np.random.default_rng(0)
    for count in (3, 600, 20_000):  # noise, contacts of one frame, and nothing at all
        values = rng.normal(size=(count, 2))
        values[rng.uniform(size=count) < 0.1] += 100.0
        check_single(stream(np.arange(count) * 0.01, values))
        check_single(stream(np.arange(count) * 0.01, np.zeros((count, 1))))
    check_single(stream(*streams["/skin"][:1], np.full((len(streams["/skin"][0]), 2), np.nan)))


def test_messages_of_garbage_are_left_out_and_counted():
    times, counts = ROBOT.streams()["/skin"]
    damaged = counts.copy()
    damaged[300:303] = 1e31
    damaged[400, 3] = -2e7
    found, note = without_garbage(stream(times, damaged))
    assert note.startswith("4 samples of /skin hold values beyond 1000 times its range")
    sound = np.delete(np.arange(len(times)), [300, 301, 302, 400])
    np.testing.assert_array_equal(found.values, counts[sound])
    np.testing.assert_array_equal(found.times, times[sound])
    same, note = without_garbage(stream(times, counts))
    assert np.shares_memory(same.values, counts)
    assert note == ""
