"""A log of a robot with skin on one clock: its shape, its contacts, and what it refuses."""

from dataclasses import replace

import numpy as np
import pytest

from meshskin.core.errors import RecordingError
from meshskin.recording.skin_log import SkinLog
from meshskin.recording.stream import Stream

LOG = SkinLog(
    time=np.arange(6) / 50,
    joint_names=("shoulder", "elbow"),
    joint_angles=np.zeros((6, 2)),
    taxel_ids=np.array([3, 5, 9]),
    readings=np.zeros((6, 3)),
    noise=np.ones(3),
    in_contact=np.array([False, True, True, False, False, True]),
)


def test_contacts_are_the_runs_of_frames_in_contact():
    assert LOG.contacts == [slice(1, 3), slice(5, 6)]
    assert repr(LOG) == (
        "<SkinLog: 6 frames over 0.1 s, 2 joints, 3 taxels, 2 contacts, without forces>"
    )


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"force": np.zeros(5)}, r"force .*wrong shape, got \(5,\), limit: \(6,\)"),
        ({"readings": np.zeros((6, 2))}, r"readings .*got \(6, 2\), limit: \(6, 3\)"),
        ({"time": np.array([0, 1, 2, 2, 3, 4.0])}, r"got 2.0 s after 2.0 s in frame 3"),
        ({"joint_names": ("elbow", "elbow")}, "a joint of a log occurs twice, got elbow"),
        ({"taxel_ids": np.array([3, 5, 3])}, "a taxel of a log occurs twice, got 3"),
        ({"joint_angles": np.full((6, 2), np.inf)}, "inf of shoulder in frame 0"),
    ],
)
def test_inconsistent_logs_are_refused(changes, words):
    with pytest.raises(RecordingError, match=words):
        replace(LOG, **changes)


def test_joints_in_messages_of_their_own_have_no_gaps_between_these():
    """Three joints in a burst of 0.2 ms every 10 ms, and one pause."""
    cycles = 0.01 * np.arange(100)
    cycles[60:] += 0.5
    times = (cycles[:, None] + [0.0, 1e-4, 2e-4]).ravel()
    values = np.where(np.tile(np.eye(3, dtype=bool), (100, 1)), 0.3, np.nan)
    stream = Stream("/joint_states", "", times, values, ("a", "b", "c"), "joints", "rad")
    assert stream.rate == pytest.approx(100.0)
    assert [round(gap.end - gap.start, 3) for gap in stream.gaps] == [0.51]
