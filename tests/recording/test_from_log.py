"""From the streams of a log to one clock, and to a recording where contact points are known."""

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from meshskin.core.errors import ConfigError, MeshskinError, RecordingError, UnknownNameError
from meshskin.recording.contact_force import _rest_level
from meshskin.recording.from_log import recording_from_log
from meshskin.recording.log_contacts import joint_path
from meshskin.recording.log_map import LogMap, StreamMap
from meshskin.recording.readers import read_log
from meshskin.recording.readers.yarp import SKIN_CONTACTS
from meshskin.recording.recording import UNCOMPARED, Recording
from meshskin.recording.resample import log_frames
from meshskin.recording.stream import Log, Stream

from .robot_log import JOINTS, RobotLog

ROBOT = RobotLog(contacts=14, seed=3)
MAP = LogMap(
    (
        StreamMap("/joint_states", "joints"),
        StreamMap("/wrench", "wrench"),
        StreamMap("/skin", "taxels"),
    )
)
FIELDS = {"/joint_states": JOINTS, "/wrench": tuple("abcdef"), "/skin": tuple(map(str, range(25)))}


def log_of(streams, log_map=MAP):
    """A log in memory, as a reader gives it."""

    def stream(one):
        fields = FIELDS.get(one.topic, tuple("abcdefg"))
        return Stream(one.topic, "", *streams[one.topic], fields, one.kind, one.unit)

    return Log(Path("log.mcap"), tuple(map(stream, log_map.streams)))


@pytest.fixture(scope="module")
def streams():
    return ROBOT.streams()


def test_all_streams_are_brought_to_the_clock_of_the_robot(streams):
    frames = log_frames(log_of(streams), MAP)
    found = frames.skin_log
    assert found.clock_offset == pytest.approx(ROBOT.late, abs=2e-3)
    assert 0 < found.clock_sigma < 2e-3
    assert {offset.by for offset in frames.offsets} == {"force", "motion"}
    assert found.joint_names == JOINTS
    assert len(found.contacts) == 14
    still = (
        np.abs(np.gradient(ROBOT.sites[ROBOT.stroke(found.time)[1], 0])) == 0
    )  # no jump of the site
    np.testing.assert_allclose(
        found.joint_angles[still], ROBOT.joints_at(found.time)[still], atol=4e-3
    )
    np.testing.assert_allclose(found.force, ROBOT.force_at(found.time), atol=0.12)
    truth = ROBOT.rest - ROBOT.counts_at(found.time)
    assert abs((found.readings - truth).mean()) < 0.1
    assert (found.readings - truth).std() < 1.1 * np.hypot(ROBOT.noise, 0.3)


@pytest.mark.deep
def test_a_late_wrench_moves_itself_and_not_the_skin(streams):
    times, wrench = streams["/wrench"]
    frames = log_frames(log_of({**streams, "/wrench": (times + 0.06, wrench)}), MAP)
    found = frames.skin_log
    assert found.clock_offset == pytest.approx(ROBOT.late, abs=2e-3)
    np.testing.assert_allclose(found.force, ROBOT.force_at(found.time), atol=0.12)
    (note,) = frames.notes
    assert re.match(r"the wrench is (59|60)\.\d ms late against the joints", note)
    for delay in (0.06, 0.055):  # what the map says is not changed
        given = LogMap((MAP.streams[0], replace(MAP.streams[1], delay=delay), MAP.streams[2]))
        assert not log_frames(log_of({**streams, "/wrench": (times + 0.06, wrench)}), given).notes


@pytest.mark.deep
def test_what_is_odd_in_the_readings_is_noted():
    streams = RobotLog(contacts=40).streams()
    times, counts = streams["/skin"]
    counts[500, 3] = 65535
    counts[times > 39.0, 7] += 60
    notes = log_frames(log_of({**streams, "/skin": (times, counts)}), MAP).notes
    assert notes[0].startswith("1 readings of /skin jump for one frame, farther than a contact")
    assert notes[1].startswith("the level of /skin at rest jumps 38 s after its start and not back")


@pytest.mark.parametrize("unit", ["rad", "deg"])
def test_angles_that_jump_by_a_turn_are_of_an_endless_joint(streams, unit):
    """A wrist whose strokes cross pi."""
    times, angles = streams["/joint_states"]
    shifted = angles + np.array([0.0, 0.0, np.pi + 0.2])
    turned = (shifted + np.pi) % (2 * np.pi) - np.pi
    assert np.ptp(turned[:, 2]) > 6
    log_map = LogMap((replace(MAP.streams[0], unit=unit), *MAP.streams[2:]))
    turned = np.degrees(turned) if unit == "deg" else turned
    found = log_frames(log_of({**streams, "/joint_states": (times, turned)}, log_map), log_map)
    assert found.skin_log.clock_offset == pytest.approx(ROBOT.late, abs=2e-3)
    wrist = found.skin_log.joint_angles[:, 2]
    at = np.interp(found.skin_log.time, times, shifted[:, 2])
    turns = (wrist - at) / (2 * np.pi)
    np.testing.assert_allclose(turns, np.round(turns[0]), atol=1e-9)
    again = (wrist[:, None] + np.pi) % (2 * np.pi) - np.pi
    given = replace(found.skin_log, joint_angles=again, joint_names=("wrist",))
    path = joint_path(given, ("wrist",))
    assert np.ptp(path.at(path.time[:-1] + 0.01)[0]) < 0.2


def test_joints_that_slide_are_in_m_in_a_stream_of_degrees(streams):
    times, angles = streams["/joint_states"]
    values = np.column_stack([np.degrees(angles[:, :2]), angles[:, 2]])
    given = replace(MAP.streams[0], unit="deg", sliding=("wrist",))
    log_map = LogMap((given, MAP.streams[2]))
    found = log_frames(log_of({**streams, "/joint_states": (times, values)}, log_map), log_map)
    expected = [np.interp(found.skin_log.time, times, column) for column in angles.T]
    np.testing.assert_allclose(found.skin_log.joint_angles, np.transpose(expected), atol=1e-9)
    log_map = LogMap((replace(given, sliding=("wirst",)), MAP.streams[2]))
    with pytest.raises(UnknownNameError, match=r"wirst.*wrist"):
        log_frames(log_of(streams, log_map), log_map)


def test_presses_beside_the_taxels_do_not_move_the_level_of_the_force():
    robot = RobotLog(contacts=14, seed=3)
    robot.sites[::3] = 0.2  # where no taxel is
    found = log_frames(log_of(robot.streams()), MAP).skin_log
    assert len(found.contacts) == 9
    level = found.force - robot.force_at(found.time)
    assert np.median(level[found.in_contact]) == pytest.approx(0.0, abs=0.02)


def test_a_given_delay_is_taken_and_not_estimated(streams):
    log_map = LogMap((*MAP.streams[:2], replace(MAP.streams[2], delay=0.037)))
    frames = log_frames(log_of(streams, log_map), log_map)
    assert frames.offsets == ()
    assert (frames.skin_log.clock_offset, frames.skin_log.clock_sigma) == (0.037, None)
    assert frames.skin_log.time[0] == pytest.approx(0.004)


def test_an_offset_that_cannot_be_told_is_said(streams):
    times, angles = streams["/joint_states"]
    still = {**streams, "/joint_states": (times, np.full_like(angles, 0.5))}
    log_map = LogMap((MAP.streams[0], MAP.streams[2]))
    frames = log_frames(log_of(still, log_map), log_map)
    assert (frames.skin_log.clock_offset, frames.skin_log.clock_sigma) == (0.0, None)
    assert "do not tell the clock offset" in frames.notes[0]
    assert "estimated with the taxels by a calibration with the URDF" in frames.notes[0]
    assert "taken as 0" not in frames.notes[0]
    assert not frames.clock_compared
    given = LogMap((MAP.streams[0], replace(MAP.streams[2], delay=0.037)))
    assert log_frames(log_of(still, given), given).clock_compared


def test_an_offset_that_no_calibration_can_estimate_is_taken_as_0(streams):
    """Without joints: contact points of poses are where the stamps say."""
    _, more = poses(turning=0.0)
    log_map = LogMap((MAP.streams[2], StreamMap("/tip", "pose")))
    frames = log_frames(log_of({**streams, **more}, log_map), log_map)
    assert (frames.skin_log.clock_offset, frames.skin_log.clock_sigma) == (0.0, None)
    assert not frames.clock_compared
    (note,) = frames.notes
    assert "do not tell the clock offset of the skin: it is taken as 0; for" in note
    assert "URDF" not in note


def test_frames_in_gaps_are_left_out(streams):
    times, angles = streams["/joint_states"]
    kept = (times < 5) | (times > 6)
    holed = {**streams, "/joint_states": (times[kept], angles[kept])}
    found = log_frames(log_of(holed), MAP).skin_log
    assert not np.any((found.time > 5.01) & (found.time < 5.99))
    assert np.sum(found.time > 6) > 500


def test_two_skins_of_different_rates_are_one(streams):
    times, counts = streams["/skin"]
    both = {**streams, "/palm": (times[::2], counts[::2, :9])}
    log_map = LogMap((*MAP.streams, StreamMap("/palm", "taxels", first_id=100)))
    log = log_of(both, log_map)
    palm = replace(log.streams[3], fields=tuple(map(str, range(100, 109))))
    found = log_frames(replace(log, streams=(*log.streams[:3], palm)), log_map).skin_log
    assert found.taxel_ids.tolist() == [*range(25), *range(100, 109)]
    both = found.readings[:, :9] - found.readings[:, 25:]
    assert np.nanstd(both) < 4
    assert np.isfinite(found.readings).all()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"/joint_states": lambda t, v: (t[::-1], v)}, "time of /joint_states runs backwards, got"),
        ({"/joint_states": lambda t, v: (t + 1e4, v)}, "do not overlap in time, got /joint_states"),
        ({"/wrench": lambda t, v: (t[:0], v[:0])}, "/wrench has no samples"),
        ({"/skin": lambda t, v: (t, np.full_like(v, 7.0))}, "/skin never answers: no reading ever"),
    ],
)
def test_bad_streams_are_refused(streams, change, words):
    bad = {name: change.get(name, lambda t, v: (t, v))(*pair) for name, pair in streams.items()}
    with pytest.raises(RecordingError, match=words):
        log_frames(log_of(bad), MAP)


def test_a_log_needs_the_map_that_it_was_read_with(streams):
    log = log_of(streams)
    with pytest.raises(RecordingError, match="was not read with this map; give the map to"):
        log_frames(log, LogMap(MAP.streams[1:]))
    with pytest.raises(ConfigError, match=r"must be a LogMap, got 'm.toml'; give LogMap.load"):
        log_frames(log, "m.toml")
    with pytest.raises(ConfigError, match=r"must be a LogMap, got 'm.toml'; give LogMap.load"):
        read_log(__file__, "m.toml")
    with pytest.raises(ConfigError, match="each stream of a map must be a StreamMap"):
        LogMap("m.toml")


@pytest.mark.deep
def test_bad_maps_are_refused(streams):
    log_map = LogMap(MAP.streams[:2])
    with pytest.raises(ConfigError, match="names no taxels"):
        log_frames(log_of(streams, log_map), log_map)
    log_map = LogMap((*MAP.streams, MAP.streams[0]))
    with pytest.raises(ConfigError, match="the joint shoulder is in two streams"):
        log_frames(log_of(streams, log_map), log_map)
    log_map = LogMap((*MAP.streams, MAP.streams[2]))
    with pytest.raises(MeshskinError, match=r"a taxel of the map occurs twice, got 0 .*first_id"):
        log_frames(log_of(streams, log_map), log_map)
    ids = tuple(range(100, 125))
    log_map = LogMap((*MAP.streams, replace(MAP.streams[2], ids=ids)))
    log = log_of(streams, log_map)
    again = replace(log.streams[3], fields=tuple(map(str, ids)))
    with pytest.raises(ConfigError, match="two streams of taxels of one topic, got /skin, /skin"):
        log_frames(replace(log, streams=(*log.streams[:3], again)), log_map)
    with pytest.raises(ConfigError, match="must name one stream of contact points"):
        recording_from_log(log_of(streams), MAP, log_frames(log_of(streams), MAP))


def poses(turning):
    """Poses of the contact and of the body in the world: the contact point is (site, depth) in the
    body frame, its normal -z, and the body turns if `turning`."""
    time = np.arange(0, ROBOT.duration, 1 / 100)
    depth, site = ROBOT.stroke(time)
    points = np.column_stack([ROBOT.sites[site], depth])
    body = Rotation.from_rotvec(np.column_stack([0.1 * time * turning, 0 * time, 0.02 * time]))
    origin = np.column_stack([0.3 + 0 * time, 0.01 * time, 0 * time])
    flip = Rotation.from_rotvec([np.pi, 0, 0])
    contact = np.column_stack([origin + body.apply(points), (body * flip).as_quat()])
    return points, {
        "/tip": (time, contact),
        "/body": (time, np.column_stack([origin, body.as_quat()])),
    }


def test_a_recording_has_the_contact_points_in_the_body_frame(streams, tmp_path):
    _, more = poses(turning=1.0)
    extra = (StreamMap("/tip", "pose"), StreamMap("/body", "pose", of="body"))
    log_map = LogMap((*MAP.streams, *extra))
    log = log_of({**streams, **more}, log_map)
    frames = log_frames(log, log_map)
    recording = recording_from_log(log, log_map, frames)
    depth, site = ROBOT.stroke(recording.time)
    np.testing.assert_allclose(recording.points[:, :2], ROBOT.sites[site], atol=2e-5)
    np.testing.assert_allclose(recording.points[:, 2], depth, atol=1e-4)
    np.testing.assert_allclose(recording.normals, np.tile([0, 0, -1.0], (len(depth), 1)), atol=1e-6)
    np.testing.assert_allclose(recording.force, ROBOT.force_at(recording.time), atol=0.12)
    turned = Rotation.from_rotvec(np.outer(recording.time, [0.1, 0, 0.02]))
    np.testing.assert_allclose(recording.headings, turned.as_matrix(), atol=1e-5)
    assert recording.metadata["readings"] == "raw"
    assert "clock" not in recording.metadata
    untold = recording_from_log(log, log_map, replace(frames, clock_compared=False))
    assert untold.metadata["clock"] == UNCOMPARED
    assert len(recording.pressure) == 25 * len(recording.time)
    assert np.abs(recording.time_lag).max() == 0
    recording.save(tmp_path / "log")
    again = Recording.load(tmp_path / "log")
    assert again.metadata["taxel_ids"] == list(range(25))


def test_presses_beside_the_taxels_are_no_noise_of_the_force():
    robot = RobotLog(contacts=14, seed=3)
    robot.sites[::3] = 0.2  # where no taxel is
    time = np.arange(0, robot.duration, 1 / 100)
    depth, site = robot.stroke(time)
    tip = np.column_stack(
        [robot.sites[site], depth, 0 * np.stack([time] * 3, axis=1), 1 + 0 * time]
    )
    log_map = LogMap((*MAP.streams, StreamMap("/tip", "pose")))
    log = log_of({**robot.streams(), "/tip": (time, tip)}, log_map)
    recording = recording_from_log(log, log_map, log_frames(log, log_map))
    assert len(np.unique(robot.stroke(recording.time)[1])) == 9
    assert recording.force.min() < 0.5


@pytest.mark.parametrize("delay", [None, 0.037])
def test_contacts_that_the_robot_computes_from_its_taxels_have_the_clock_of_the_skin(
    streams, delay
):
    """The contact point moves by 40 mm/s."""
    time = np.arange(0.004, ROBOT.duration, 1 / 50)
    depth, _ = ROBOT.stroke(time)
    along = np.column_stack([0.04 * time, 0 * time, 0 * time])[depth > 0]
    log_map = LogMap(
        (*MAP.streams[:2], replace(MAP.streams[2], delay=delay), StreamMap("/touch", "contacts"))
    )
    log = log_of({**streams, "/touch": (time[depth > 0] + ROBOT.late, along)}, log_map)
    touch = replace(log.streams[3], fields=("px", "py", "pz"), type=SKIN_CONTACTS)
    log = replace(log, streams=(*log.streams[:3], touch))
    recording = recording_from_log(log, log_map, log_frames(log, log_map))
    assert len(recording.time) > 300
    np.testing.assert_allclose(recording.points[:, 0], 0.04 * recording.time, atol=8e-5)


@pytest.mark.parametrize(("rate", "second"), [(50, None), (200, None), (50, 20.0)])
def test_contacts_of_a_stream_are_taken_where_there_is_one(streams, rate, second):
    """second: distance, mm, of another contact at the same times in the second half of the log."""
    time = np.arange(0, ROBOT.duration, 1 / rate) + 0.004
    depth, site = ROBOT.stroke(time)
    time, pressed = time[depth > 0], depth > 0
    rows = np.column_stack([ROBOT.sites[site], 0 * depth])[pressed] * 1e3
    if second is not None:
        twice = np.repeat(np.arange(len(time)), 1 + (time > ROBOT.duration / 2))
        other = np.diff(twice, prepend=-1) == 0
        time, rows = time[twice], rows[twice] + second * np.outer(other, [1.0, 0.0, 0.0])
    log_map = LogMap((*MAP.streams, StreamMap("/touch", "contacts", unit="mm")))
    log = log_of({**streams, "/touch": (time, rows)}, log_map)
    touch = replace(log.streams[3], fields=("px", "py", "pz"))
    log = replace(log, streams=(*log.streams[:3], touch))
    recording = recording_from_log(log, log_map, log_frames(log, log_map))
    _, site = ROBOT.stroke(recording.time)
    np.testing.assert_allclose(recording.points[:, :2], ROBOT.sites[site], atol=1e-9)
    assert np.isnan(recording.normals).all()
    assert len(recording.time) > (300 if second is None else 150)
    assert second is None or recording.time.max() < ROBOT.duration / 2


def test_readings_in_pascals_are_recorded_above_the_noise_of_all_taxels(streams):
    """Taxel 3 has twice the noise of the others, and taxel 7 ten times."""
    times, counts = streams["/skin"]
    noise = np.random.default_rng(1).normal(0, ROBOT.noise, (2, len(times)))
    counts = counts.copy()
    counts[:, [3, 7]] += np.sqrt([3, 99]) * noise.T
    _, more = poses(turning=0.0)
    log_map = LogMap(
        (*MAP.streams[:2], replace(MAP.streams[2], unit="kPa"), StreamMap("/tip", "pose"))
    )
    log = log_of({**streams, **more, "/skin": (times, counts)}, log_map)
    recording = recording_from_log(log, log_map, log_frames(log, log_map))
    assert "readings" not in recording.metadata
    least = recording.metadata["threshold_pa"]
    assert least == pytest.approx(3.35 * 1e3 * 2 * ROBOT.noise, rel=0.1)
    assert np.nanmin(recording.pressure) >= least
    noisy = recording.reading_taxel == 7
    assert noisy.sum() == len(recording.time)
    assert np.array_equal(np.isnan(recording.pressure), noisy & np.isnan(recording.pressure))
    assert np.isnan(recording.pressure).sum() > 0.5 * noisy.sum()
    assert len(recording.pressure) < 0.5 * 25 * len(recording.time)


def test_what_is_no_log_is_refused_with_its_value():
    with pytest.raises(ConfigError, match="a log must be a Log, got 3"):
        log_frames(3, LogMap((StreamMap("/skin", "taxels"),)))


def test_a_force_without_a_level_at_rest_may_be_left_out():
    """A skin in contact from the first frame to the last tells no level of the force."""
    frames = np.arange(500) / 50
    with pytest.raises(RecordingError) as error:
        _rest_level(frames, np.ones((500, 3)), np.arange(500) > 5, "/wrench")
    assert "got 1% of 500 frames without contact, limit: 10% of 10 s" in str(error.value)
    assert "leave /wrench out of the map" in str(error.value)
