"""From a bag to a skin: clocks, joints and taxels by joint states and raw counts alone."""

import numpy as np
import pytest

from meshskin.estimation.kinematics.calibrate_log import calibrate_log
from meshskin.recording.log_map import LogMap, StreamMap
from meshskin.recording.readers import read_log
from meshskin.recording.resample import log_frames

from ...recording import robot_log
from .simulated_log import explore
from .test_calibrate_log import KNOWN, belief, check


@pytest.mark.slow
def test_a_bag_alone(tmp_path, monkeypatch):
    exploration = explore()
    monkeypatch.setattr(robot_log, "JOINTS", exploration.log.joint_names)
    robot_log.write_mcap(tmp_path / "log.mcap", exploration.streams())
    ids = tuple(int(taxel) for taxel in exploration.scene.skin.ids)
    log_map = LogMap(
        (StreamMap("/joint_states", "joints"), StreamMap("/skin", "taxels", length=len(ids)))
    )
    log = log_frames(read_log(tmp_path / "log.mcap", log_map), log_map).skin_log
    assert tuple(log.taxel_ids) == tuple(range(len(ids)))
    assert log.clock_offset == pytest.approx(0.0, abs=0.02)
    assert np.array_equal(ids, np.arange(len(ids)))
    found = calibrate_log(log, exploration.kinematics(**KNOWN), belief(exploration))
    check(exploration, found, 1.2, already=log.clock_offset)
