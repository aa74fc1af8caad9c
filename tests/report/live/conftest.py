"""A few contacts on the paper's sphere, made in milliseconds, with the arm's joint angles."""

from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pytest

import meshskin as ms
from meshskin.estimation.next_contact import NextTouch
from meshskin.estimation.online.status import KEEP_GOING, OnlineStatus
from meshskin.report.live.replay import Snapshot
from meshskin.report.live.stage import Stage


@pytest.fixture(scope="session")
def touched(noisy):
    """Contacts over ten taxels, 0.1 s apart with a pause of a minute, at random joint angles."""
    points = noisy.skin.positions[:10]
    made = ms.press(noisy, points, seed=1)
    time = np.arange(10) / 10 + np.where(np.arange(10) > 4, 60.0, 0.0)
    index = made.reading_contact
    contacts = made.contacts.set_column(0, "time", pa.array(time))
    readings = made.readings.set_column(0, "time", pa.array(time[index]))
    q = np.random.default_rng(0).uniform(-1, 1, (10, 6))
    motion = pa.table({"time": time} | {f"q{k + 1}": q[:, k] for k in range(6)})
    return ms.Recording(contacts, readings, made.metadata, motion)


@pytest.fixture(scope="session")
def stage(noisy, touched):
    """The stage of these contacts."""
    return Stage.of_scene(touched, noisy, noisy.belief())


def status(**changes) -> OnlineStatus:
    """What an online calibration tells."""
    touch = NextTouch(np.array([0.0, 0.0, -0.1]), np.array([0.0, 0.0, -1.0]), 7, 1e-4)
    values = {
        "used": 9, "rejected": 1, "outlying": 0, "determined": 78, "weak": 1, "unseen": 1,
        "median_sigma": 2e-5, "worst_sigma": 3e-4, "unknowns": {"modulus": (np.log(2.0), 0.01)},
        "undetermined": (), "next_touch": touch, "verdict": KEEP_GOING, "why": "too early",
        "residual": 1.1,
    }  # fmt: skip
    return OnlineStatus(**(values | changes))


@pytest.fixture
def snapshot(noisy):
    """Estimates of all taxels but two: one is weak, one unseen; sigma 0.02 mm along the skin."""
    count = len(noisy.skin)
    positions = noisy.skin.positions.copy()
    positions[1] = np.nan
    rotation = noisy.skin.poses[:, :3, :3]
    covariances = rotation @ np.diag([2e-5, 2e-5, 0.0]) ** 2 @ np.swapaxes(rotation, 1, 2)
    covariances[:2] = np.nan
    assert count == 80
    return Snapshot(3, 0.3, positions, covariances, status())


class Online:
    """Stands for an online calibration in tests of the replay: keeps what it is given."""

    def __init__(self, ids) -> None:
        self.ids, self.given, self.settled = np.asarray(ids), [], 0
        n = len(self.ids)
        self.poses, self.covariances = np.full((n, 4, 4), np.nan), np.full((n, 6, 6), np.inf)
        self.provisional = np.full((n, 3), np.nan)

    def update(self, contacts, readings):
        self.given.append((contacts, np.array(readings)))
        return status()

    def settle(self):
        self.settled += 1
        return status()


@pytest.fixture
def controls():
    """Real time, not paused."""
    return SimpleNamespace(speed=1.0, paused=False)
