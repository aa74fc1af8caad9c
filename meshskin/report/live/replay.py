"""A recording as it would come in: contacts in their time are calibrated online and shown."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ...core.arrays import Array
from ...estimation.calibration import Calibration
from ...estimation.online.frames import RecordedFrames
from ...estimation.online.online_calibration import OnlineCalibration
from ...estimation.online.status import OnlineStatus
from ...recording.recording import Recording

if TYPE_CHECKING:
    from .panel import Panel

REFRESH = 1.0 / 15.0
"""Time between two pictures, s: motion looks continuous, and a core has time to calibrate."""
MOST_FRAMES = 32
"""Most frames of an update: where the calibration cannot keep up, the replay slows down, and the
page goes on moving."""
LONGEST_PAUSE = 0.5
"""Longest time without contact that is replayed, s; longer ones are cut."""


@dataclass(frozen=True)
class Snapshot:
    """The state of an online calibration after the contacts up to `row`."""

    row: int
    """Row of the last contact in the recording."""
    time: float
    """Its time after the first contact, s."""
    positions: Array
    """Estimates (n, 3), body frame, m, not determined ones, too; NaN where there is none."""
    covariances: Array
    """(n, 3, 3), body frame, m^2; NaN where a taxel is not determined."""
    status: OnlineStatus
    """Status of the online calibration."""

    @classmethod
    def of(cls, online: OnlineCalibration, status: OnlineStatus, row: int, time: float) -> Snapshot:
        """The present estimates of an online calibration."""
        return cls(row, time, online.provisional, _in_body_frame(online), status)

    def concluded(self, found: Calibration) -> Snapshot:
        """With the estimates of a calibration of all contacts, and no next touch."""
        status = replace(self.status, next_touch=None)
        covariances = _in_body_frame(found)
        return replace(self, positions=found.positions, covariances=covariances, status=status)


def _in_body_frame(found: OnlineCalibration | Calibration) -> Array:
    """Covariances (n, 3, 3), m^2, of the positions; NaN where a taxel is not determined."""
    turn, local = found.poses[:, :3, :3], found.covariances[:, :3, :3]
    known = np.isfinite(turn).all(axis=(1, 2)) & np.isfinite(local).all(axis=(1, 2))
    covariances = np.full_like(local, np.nan)
    covariances[known] = turn[known] @ local[known] @ np.swapaxes(turn[known], 1, 2)
    return covariances


def replay_times(recording: Recording) -> Array:
    """Times (m,), s, at which the contacts are shown at speed 1: without long pauses, from 0."""
    steps = np.diff(recording.time, prepend=recording.time[:1])
    return np.cumsum(np.minimum(steps, LONGEST_PAUSE))


def replay(
    recording: Recording,
    online: OnlineCalibration,
    controls: Panel,
    clock: Callable[[], float] = time.monotonic,
    sleep: Callable[[float], None] = time.sleep,
    errors: Array | None = None,
) -> Iterator[Snapshot]:
    """Feed the contacts to `online` at the speed of the panel; yield a snapshot after each update.

    Every REFRESH the contacts that are due, at most MOST_FRAMES, go in as one update. After
    the last one all taxels that wait are estimated anew. errors (m, 3): of the contacts, where
    known.
    """
    frames = RecordedFrames(recording, online.ids, errors)
    due, done, now = replay_times(recording), 0, 0.0
    before = clock()
    while done < len(due):
        sleep(max(REFRESH - (clock() - before), 0.0))
        now += 0.0 if controls.paused else controls.speed * (clock() - before)
        before = clock()
        end = min(int(np.searchsorted(due, now, side="right")), done + MOST_FRAMES)
        if end > done:
            now = min(now, due[end - 1] + REFRESH * controls.speed)
            status = online.update(*frames.part(done, end))
            done = end
            yield Snapshot.of(online, status, end - 1, recording.time[end - 1] - recording.time[0])
    if done:
        elapsed = recording.time[-1] - recording.time[0]
        yield Snapshot.of(online, online.settle(), done - 1, elapsed)
