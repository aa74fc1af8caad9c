"""The replay of a recording: what the online calibration is given, and when."""

import numpy as np
import pytest

from meshskin.core.errors import CalibrationError
from meshskin.estimation.online.frames import RecordedFrames
from meshskin.report.live import replay as module
from meshskin.report.live.replay import LONGEST_PAUSE, REFRESH, replay, replay_times

from .conftest import Online


class Clock:
    """Time that passes only by sleeping."""

    def __init__(self) -> None:
        self.now = 0.0

    def __call__(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self.now += seconds


def played(recording, online, controls, clock):
    return list(replay(recording, online, controls, clock, clock.sleep))


def test_every_contact_and_reading_is_given_once_and_in_order(touched, controls):
    online = Online(touched.metadata["taxel_ids"])
    shots = played(touched, online, controls, Clock())
    points = np.concatenate([contacts.points for contacts, _ in online.given])
    np.testing.assert_array_equal(points, touched.points)
    given = np.concatenate([readings for _, readings in online.given])
    dense = np.zeros((len(touched.time), len(online.ids)))
    column = {k: j for j, k in enumerate(online.ids.tolist())}
    for row, taxel, pressure in zip(
        touched.reading_contact, touched.reading_taxel, touched.pressure, strict=True
    ):
        dense[row, column[int(taxel)]] = pressure
    np.testing.assert_array_equal(given, dense)
    assert [shot.row for shot in shots] == [*sorted({shot.row for shot in shots[:-1]}), 9]
    assert online.settled == 1


def test_it_takes_the_time_of_the_recording_without_its_pauses(touched, controls):
    clock = Clock()
    played(touched, Online(touched.metadata["taxel_ids"]), controls, clock)
    assert replay_times(touched)[-1] == pytest.approx(0.8 + LONGEST_PAUSE)
    assert 0 <= clock.now - (0.8 + LONGEST_PAUSE) <= 1.01 * REFRESH


def test_twice_the_speed_takes_half_the_time(touched, controls):
    clock, controls.speed = Clock(), 2.0
    played(touched, Online(touched.metadata["taxel_ids"]), controls, clock)
    assert 0 <= clock.now - (0.8 + LONGEST_PAUSE) / 2 <= 1.01 * REFRESH


def test_nothing_comes_in_while_it_is_held(touched, controls):
    clock, online = Clock(), Online(touched.metadata["taxel_ids"])
    controls.paused = True

    def sleep(seconds: float) -> None:
        clock.sleep(seconds)
        if clock.now > 5.0:
            controls.paused = False

    list(replay(touched, online, controls, clock, sleep))
    assert clock.now >= 5.0 + 0.8 + LONGEST_PAUSE - REFRESH


def test_a_slow_calibration_slows_the_replay_down(touched, controls, monkeypatch):
    monkeypatch.setattr(module, "MOST_FRAMES", 2)
    clock, online = Clock(), Online(touched.metadata["taxel_ids"])
    update = online.update

    def slow(contacts, readings):
        clock.sleep(10.0)
        return update(contacts, readings)

    online.update = slow
    played(touched, online, controls, clock)
    assert max(len(contacts) for contacts, _ in online.given) == 2
    assert sum(len(contacts) for contacts, _ in online.given) == 10


def test_taxels_that_the_belief_does_not_know_are_refused(touched):
    with pytest.raises(CalibrationError, match="does not know"):
        RecordedFrames(touched, np.arange(3))


def test_a_snapshot_turns_covariances_into_the_body_frame(noisy):
    online = Online(noisy.skin.ids)
    online.poses, online.provisional = noisy.skin.poses.copy(), noisy.skin.positions
    root = np.random.default_rng(1).normal(size=(80, 6, 6))
    online.covariances = root @ np.swapaxes(root, 1, 2)
    online.covariances[5], online.poses[6] = np.inf, np.nan
    snapshot = module.Snapshot.of(online, online.settle(), 9, 1.0)
    known = np.isfinite(snapshot.covariances).all(axis=(1, 2))
    assert np.flatnonzero(~known).tolist() == [5, 6]
    normals = noisy.skin.normals  # the third axis of a taxel's frame
    across = np.einsum("ni,nij,nj->n", normals, snapshot.covariances, normals)
    np.testing.assert_allclose(across[known], online.covariances[known, 2, 2])
