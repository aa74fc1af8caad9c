"""Bags of ROS 1, ROS 2 and MCAP: values read back, torn files, foreign types, and refusals."""

import re
import struct
import sys
from contextlib import suppress

import numpy as np
import pytest
from mcap.writer import CompressionType, IndexType, Writer
from rosbags.rosbag1 import Writer as Writer1
from rosbags.rosbag2 import StoragePlugin

from meshskin.core.errors import MeshskinError, RecordingError, UnknownNameError
from meshskin.recording.log_map import LogMap, StreamMap
from meshskin.recording.readers import read_and_suggest, read_log

from . import robot_log
from .robot_log import EPOCH, RobotLog

STREAMS = RobotLog(contacts=2).streams()
MAP = LogMap(
    (
        StreamMap("/joint_states", "joints"),
        StreamMap("/wrench", "wrench"),
        StreamMap("/skin", "taxels", length=25),
    )
)
FORMATS = {
    "ros1.bag": lambda path: robot_log.write_ros1(path, STREAMS),
    "ros1_lz4.bag": lambda path: robot_log.write_ros1(path, STREAMS, Writer1.CompressionFormat.LZ4),
    "ros1_bz2.bag": lambda path: robot_log.write_ros1(path, STREAMS, Writer1.CompressionFormat.BZ2),
    "ros2_sqlite": lambda path: robot_log.write_ros2(path, STREAMS),
    "ros2_mcap": lambda path: robot_log.write_ros2(path, STREAMS, StoragePlugin.MCAP),
    "zstd.mcap": lambda path: robot_log.write_mcap(path, STREAMS, chunk_size=20_000),
    "lz4.mcap": lambda path: robot_log.write_mcap(
        path, STREAMS, chunk_size=20_000, compression=CompressionType.LZ4
    ),
    "unindexed.mcap": lambda path: robot_log.write_mcap(
        path, STREAMS, index_types=IndexType.NONE, use_summary_offsets=False
    ),
    "chunkless.mcap": lambda path: robot_log.write_mcap(path, STREAMS, use_chunking=False),
}


@pytest.fixture(scope="module")
def bags(tmp_path_factory):
    """A folder with the same log in every format."""
    folder = tmp_path_factory.mktemp("bags")
    for name, write in FORMATS.items():
        write(folder / name)
    return folder


@pytest.fixture(scope="module")
def streams():
    """The streams of a log of several chunks."""
    return RobotLog(contacts=24).streams()


def equal(log, count=None):
    """The streams of a log have the values that were written, or the first of them."""
    for stream in log.streams:
        times, values = STREAMS[stream.name]
        rows = slice(None) if count is None else slice(len(stream))
        np.testing.assert_array_equal(stream.values, values[rows])
        np.testing.assert_allclose(stream.times - EPOCH, times[rows], atol=1e-6)


@pytest.mark.parametrize("name", FORMATS)
def test_values_are_those_that_were_written(bags, name):
    log = read_log(bags / name, MAP)
    equal(log)
    assert log["/joint_states"].fields == robot_log.JOINTS
    assert log["/skin"].fields == tuple(map(str, range(25)))
    assert log.notes == ()
    assert log["/skin"].rate == pytest.approx(50, rel=1e-3)


def test_streams_keep_the_order_of_the_map(bags):
    """Two streams of one topic are not brought together: each stays with its entry of the map."""
    log_map = LogMap(
        (
            StreamMap("/wrench", "wrench"),
            StreamMap("/skin", "taxels"),
            StreamMap("/wrench", "wrench", tuple(f"wrench.torque.{axis}" for axis in "xyz")),
        )
    )
    log = read_log(bags / "zstd.mcap", log_map)
    assert [stream.name for stream in log.streams] == ["/wrench", "/skin", "/wrench"]
    assert [stream.values.shape[1] for stream in log.streams] == [6, 25, 3]


@pytest.mark.parametrize("name", FORMATS)
def test_without_a_map_all_topics_are_listed_with_what_they_could_be(bags, name):
    log, could = read_and_suggest(bags / name)
    assert {stream.name: len(stream) for stream in log.streams} == {
        topic: len(times) for topic, (times, _) in STREAMS.items()
    }
    assert {topic: [one.kind for one in could[topic]] for topic in could} == {
        "/joint_states": ["joints"], "/wrench": ["wrench"], "/skin": ["taxels"],
    }  # fmt: skip
    assert could["/skin"][0].length == 25
    for stream in log.streams:
        np.testing.assert_allclose(stream.times - EPOCH, STREAMS[stream.name][0], atol=1e-6)


@pytest.mark.parametrize(
    "name",
    ["ros1.bag", "ros1_lz4.bag", "ros2_sqlite/ros2_sqlite.db3", "zstd.mcap", "lz4.mcap",
     "chunkless.mcap"],
)  # fmt: skip
@pytest.mark.parametrize("share", [0.55, 0.8])
def test_a_torn_file_is_read_up_to_the_tear(bags, tmp_path, name, share):
    content = (bags / name).read_bytes()
    torn = tmp_path / f"torn{(bags / name).suffix}"
    torn.write_bytes(content[: int(share * len(content))])
    log = read_log(torn, MAP)
    equal(log, count=...)
    found = sum(map(len, log.streams)) / sum(len(times) for times, _ in STREAMS.values())
    assert 0.25 * share < found < 1
    assert len(log.notes) == 1
    assert "is torn" in log.notes[0]


@pytest.mark.deep
@pytest.mark.parametrize("share", [pytest.param(0.2, marks=pytest.mark.slow), 0.35])
@pytest.mark.parametrize("suffix", ["bag", "mcap"])
def test_garbage_in_a_chunk_is_left_out_and_said(tmp_path, streams, suffix, share):
    path = tmp_path / f"garbage.{suffix}"
    if suffix == "bag":
        robot_log.write_ros1(path, streams)  # chunks of 1 MiB
    else:
        robot_log.write_mcap(path, streams, chunk_size=2**18, compression=CompressionType.NONE)
    content = bytearray(path.read_bytes())
    at = int(share * len(content))
    content[at : at + 4096] = np.random.default_rng(int(100 * share)).bytes(4096)
    path.write_bytes(content)
    log = read_log(path, MAP)
    (note,) = log.notes
    assert "damaged: the chunk at byte" in note
    kept = 0
    for stream in log.streams:
        times, values = streams[stream.name]
        row = np.round(np.interp(stream.times - EPOCH, times, np.arange(len(times)))).astype(int)
        np.testing.assert_array_equal(stream.values, values[row])
        kept += len(stream) / len(times) / 3
        assert stream.times[-1] - EPOCH > times[-1] - 1.0  # what is behind is read, too
    assert 0.5 < kept < 0.99


@pytest.mark.deep
def test_garbage_in_a_message_is_left_out_and_counted(tmp_path):
    """Garbage within one message: nothing but its content shows it."""
    path = tmp_path / "garbage.mcap"
    robot_log.write_mcap(path, STREAMS, use_chunking=False)
    content = bytearray(path.read_bytes())
    names = [found.start() for found in re.finditer(b"shoulder", content)]
    at = names[200]
    content[at - 1] = 0xFF  # of the length of the name
    path.write_bytes(content)
    log = read_log(path, MAP)
    assert log.notes == (
        "1 messages of /joint_states cannot be decoded: they are damaged, and left out",
    )
    assert len(log["/joint_states"]) == len(STREAMS["/joint_states"][0]) - 1


def test_a_bag_that_was_not_closed_has_no_index(bags, tmp_path):
    content = bytearray((bags / "ros1.bag").read_bytes())
    at = content.index(b"index_pos=") + len(b"index_pos=")
    (index,) = struct.unpack_from("<Q", content, at)
    content[at : at + 8] = bytes(8)
    path = tmp_path / "crashed.bag.active"
    path.write_bytes(content[:index])
    with pytest.raises(RecordingError, match=r"has no index: .* not closed; .*reindex.*--scan"):
        read_log(path, MAP)
    equal(read_log(path, MAP, scan=True))


@pytest.mark.parametrize("name", ["ros1_lz4.bag", "lz4.mcap"])
def test_an_unknown_codec_is_named(bags, tmp_path, name):
    content = (bags / name).read_bytes()
    path = tmp_path / name
    path.write_bytes(content.replace(b"lz4", b"zzz"))
    with pytest.raises(RecordingError, match=r"codec that is not read, got zzz, limit: .*; "):
        read_log(path, MAP)


def test_what_is_no_bag_is_refused(tmp_path):
    path = tmp_path / "empty.mcap"
    path.write_bytes(b"\x89MCAP0\r\n")
    with pytest.raises(RecordingError, match="no readable message"):
        read_log(path)
    path.unlink()
    with pytest.raises(RecordingError, match=r"holds no log: no bag, no data.log"):
        read_log(tmp_path)
    (tmp_path / "binary.bag").write_bytes(bytes(range(256)))
    with pytest.raises(RecordingError, match=r"binary.bag is no log: neither a bag nor a table"):
        read_log(tmp_path / "binary.bag")
    with pytest.raises(RecordingError, match="no log at"):
        read_log(tmp_path / "missing.bag")


@pytest.mark.parametrize(
    ("stream", "kind", "words"),
    [
        (StreamMap("/joint_state", "joints"), UnknownNameError, "did you mean /joint_states"),
        (StreamMap("/wrench", "joints"), RecordingError, "wrong type for joints, got geometry"),
        (StreamMap("/skin", "taxels", length=24), MeshskinError,
         "message 0 of /skin has another length than the map says, got 25 values, limit: length ="),
        (StreamMap("/skin", "taxels", ("values",)), MeshskinError,
         "unknown field 'values' in the field path values .*known: data, layout"),
        (StreamMap("/joint_states", "taxels", ("name",)), MeshskinError, "must contain numbers"),
        (StreamMap("/wrench", "pose", ("wrench.force.x",)), MeshskinError, "be a pose, got 1"),
        (StreamMap("/skin", "taxels", ids=(1, 2)), MeshskinError, "one for each taxel, got 2 ids"),
    ],
)  # fmt: skip
def test_what_is_not_as_the_map_says_is_refused(bags, stream, kind, words):
    with pytest.raises(kind, match=words):
        read_log(bags / "ros1.bag", LogMap((stream,)))


def test_frames_of_another_length_are_refused(tmp_path):
    times, values = STREAMS["/skin"]
    path = tmp_path / "mixed.mcap"
    rows = [*values[:3], values[3][:20]]
    robot_log.write_mcap(path, {"/skin": (times[:4], rows)})
    with pytest.raises(RecordingError, match=r"message 3 .*those before, got 20 .*limit: 25"):
        read_log(path, LogMap((StreamMap("/skin", "taxels"),)))


XELA = {
    "xela_server_ros2/msg/Taxel": "uint16 x\nuint16 y\nuint16 z",
    "xela_server_ros2/msg/SensorFull": "float64 time\nTaxel[] taxels",
    "xela_server_ros2/msg/SensStream": "SensorFull[] sensors",
}
TACTILE = {
    "tactile_msgs/msg/TactileState": "std_msgs/Header header\nsensor_msgs/ChannelFloat32[] sensors"
}
GENTACT = {"gentact/msg/SensorData": "int32[] sensor_values\nint32 num_sensors\nstring timestamp"}


def xela(store, row, time=0.0):
    types = store.types
    taxels = [types["xela_server_ros2/msg/Taxel"](x=1, y=2, z=int(z)) for z in row]
    halves = [
        types["xela_server_ros2/msg/SensorFull"](time=time, taxels=t)
        for t in (taxels[:6], taxels[6:])
    ]
    return types["xela_server_ros2/msg/SensStream"](sensors=halves)


def tactile(store, row, time=3.0, order="ab"):
    channel = store.types["sensor_msgs/msg/ChannelFloat32"]
    parts = {"a": row[:6], "b": row[6:]}
    sensors = [channel(name=n, values=parts[n].astype(np.float32)) for n in order]
    header = robot_log.header(store, time)
    return store.types["tactile_msgs/msg/TactileState"](header=header, sensors=sensors)


def gentact(store, row):
    values = row.astype(np.int32)
    return store.types["gentact/msg/SensorData"](sensor_values=values, num_sensors=9, timestamp="")


@pytest.mark.parametrize(
    ("definitions", "make"), [(XELA, xela), (TACTILE, tactile), (GENTACT, gentact)]
)
def test_skins_with_their_own_messages(tmp_path, definitions, make):
    rows = np.arange(27).reshape(3, 9)
    kind = list(definitions)[-1]
    path = tmp_path / "skin.mcap"
    robot_log.write_types(
        path, "/skin", kind, definitions,
        [(k / 10, lambda store, row=row: make(store, row)) for k, row in enumerate(rows)],
    )  # fmt: skip
    (guess,) = read_and_suggest(path)[1]["/skin"]
    assert (guess.kind, guess.length) == ("taxels", 9)
    for stream in (guess, StreamMap("/skin", "taxels")):
        np.testing.assert_array_equal(read_log(path, LogMap((stream,)))["/skin"].values, rows)


@pytest.mark.parametrize(
    ("topic", "count"), [("/arm/joint_command", 0), ("/desired/q", 0), ("/arm/joint_states", 1)]
)
def test_commanded_joints_are_not_proposed(tmp_path, topic, count):
    path, kind, none = tmp_path / "arm.mcap", "sensor_msgs/msg/JointState", np.empty(0)
    state = {"name": ["elbow"], "position": np.ones(1), "velocity": none, "effort": none}
    rows = [(0.1, lambda s: s.types[kind](header=robot_log.header(s, 0.1), **state))]
    robot_log.write_types(path, topic, kind, {}, rows)
    assert len(read_and_suggest(path)[1][topic]) == count


def test_the_time_of_a_sensor_is_proposed_where_it_is_set(tmp_path):
    path, kind = tmp_path / "skin.mcap", list(XELA)[-1]
    rows = [(k / 10, lambda store, k=k: xela(store, np.arange(9), 5 + k / 10)) for k in range(3)]
    robot_log.write_types(path, "/skin", kind, XELA, rows)
    (guess,) = read_and_suggest(path)[1]["/skin"]
    assert guess.time == "sensors[0].time"
    np.testing.assert_allclose(read_log(path, LogMap((guess,)))["/skin"].times, [5, 5.1, 5.2])


def test_sensors_in_another_order_keep_their_taxels(tmp_path):
    path, kind = tmp_path / "skin.mcap", next(iter(TACTILE))

    def write(*orders):
        rows = [(k, lambda s, o=o: tactile(s, np.arange(9), order=o)) for k, o in enumerate(orders)]
        robot_log.write_types(path, "/skin", kind, TACTILE, rows)

    write("ab", "ba", "ab")
    stream = read_log(path, LogMap((StreamMap("/skin", "taxels"),)))["/skin"]
    np.testing.assert_array_equal(stream.values, [np.arange(9)] * 3)
    write("a", "b", "a", "b")  # two skins in turn
    with pytest.raises(RecordingError, match=r"message 1 .* has other elements .* got b, limit: a"):
        read_log(path, LogMap((StreamMap("/skin", "taxels"),)))
    by_name = tuple(f"sensors[name={name}].values" for name in "ab")
    with pytest.raises(RecordingError, match=r"find other numbers of values .*\(0, 3\).*\(6, 0\)"):
        read_log(path, LogMap((StreamMap("/skin", "taxels", by_name),)))
    only = LogMap((StreamMap("/skin", "taxels", by_name[1:]),))
    np.testing.assert_array_equal(read_log(path, only)["/skin"].values, [[6, 7, 8]] * 2)


def test_one_sensor_is_taken_by_its_name(tmp_path):
    path = tmp_path / "skin.mcap"
    robot_log.write_types(
        path, "/skin", "tactile_msgs/msg/TactileState", TACTILE,
        [(0.1, lambda store: tactile(store, np.arange(9)))],
    )  # fmt: skip
    stream = StreamMap("/skin", "taxels", ("sensors[name=b].values",))
    np.testing.assert_array_equal(read_log(path, LogMap((stream,)))["/skin"].values, [[6, 7, 8]])


def test_a_definition_that_the_bag_lacks_is_given(tmp_path):
    """An old bag in SQLite has no definitions; that of the skin comes from a .msg file."""
    import sqlite3

    folder = tmp_path / "old"
    store = robot_log.get_typestore(robot_log.Stores.ROS2_HUMBLE)
    kind, text = next(iter(GENTACT.items()))
    store.register(robot_log.get_types_from_msg(text, kind))
    with robot_log.Writer2(folder, version=9) as writer:
        connection = writer.add_connection("/skin", kind, typestore=store)
        writer.write(connection, 5, store.serialize_cdr(gentact(store, np.arange(9)), kind))
    with sqlite3.connect(folder / "old.db3") as database:
        database.execute("DELETE FROM message_definitions")
    (folder / "metadata.yaml").unlink()
    log_map = LogMap((StreamMap("/skin", "taxels"),))
    with pytest.raises(RecordingError, match=r"does not define .*SensorData; give its \.msg file"):
        read_log(folder / "old.db3", log_map)
    (tmp_path / "SensorData.msg").write_text(text)
    log = read_log(folder / "old.db3", log_map, messages=[tmp_path / "SensorData.msg"])
    np.testing.assert_array_equal(log["/skin"].values, [np.arange(9)])


def test_standard_types_within_a_definition_that_is_given(tmp_path):
    """A recorder that did not find the definition wrote none, and those of other topics."""
    (kind, text), path = next(iter(TACTILE.items())), tmp_path / "skin.mcap"
    rows = [(0.1, lambda store: tactile(store, np.arange(9)))]
    robot_log.write_types(path, "/skin", kind, TACTILE, rows, stated=False)
    log, could = read_and_suggest(path)
    assert not could["/skin"]
    assert any("does not define the message type of /skin" in note for note in log.notes)
    (tmp_path / "TactileState.msg").write_text(text)
    (guess,) = read_and_suggest(path, messages=[tmp_path / "TactileState.msg"])[1]["/skin"]
    assert (guess.kind, guess.length) == ("taxels", 9)


@pytest.mark.parametrize("back", [0.05, 0.5])
def test_messages_that_arrive_late_are_sorted_by_their_stamps(tmp_path, back):
    kind, path, stamps = next(iter(TACTILE)), tmp_path / "skin.mcap", 0.01 * np.arange(90)
    stamps[40] = stamps[41] - back
    robot_log.write_types(
        path, "/skin", kind, TACTILE,
        [
            (k / 100, lambda store, t=t: tactile(store, np.full(9, round(1e3 * t)), t))
            for k, t in enumerate(stamps)
        ],
    )  # fmt: skip
    stream = read_log(path, LogMap((StreamMap("/skin", "taxels"),)))["/skin"]
    if back > 0.1:
        with pytest.raises(RecordingError, match="the time of /skin runs backwards"):
            stream.check_times()
        return
    stream.check_times()
    np.testing.assert_allclose(stream.times - robot_log.EPOCH, np.sort(stamps), atol=1e-6)
    np.testing.assert_array_equal(stream.values[:, 0], np.sort(np.round(1e3 * stamps)))


@pytest.mark.parametrize(("field", "unit"), [("stamp", 1.0), ("stamp_ms", 1e-3)])
def test_messages_in_json(tmp_path, field, unit):
    """With the unit in the name of the field of times."""
    path = tmp_path / "json.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start()
        schema = writer.register_schema("skin", "jsonschema", b"{}")
        channel = writer.register_channel("/skin", "json", schema)
        for k in range(3):
            pads = f'"pads": [{{"v": [1, 2, {k}]}}, {{"v": [4, 5]}}]'
            data = f'{{"{field}": {k / 10 / unit}, {pads}}}'
            writer.add_message(channel, log_time=k, data=data.encode(), publish_time=k)
        writer.finish()
    stream = StreamMap("/skin", "taxels", ("pads[].v",), time=field)
    log = read_log(path, LogMap((stream,)))
    np.testing.assert_array_equal(log["/skin"].values, [[1, 2, k, 4, 5] for k in range(3)])
    np.testing.assert_allclose(log["/skin"].times, [0, 0.1, 0.2])


def test_joints_of_two_publishers_are_sorted_by_name(tmp_path):
    store = robot_log.get_typestore(robot_log.Stores.ROS2_HUMBLE)
    kind = "sensor_msgs/msg/JointState"

    def state(names, values):
        return lambda s: s.types[kind](
            header=robot_log.header(s, 1.0), name=names, position=np.array(values, float),
            velocity=np.empty(0), effort=np.empty(0),
        )  # fmt: skip

    assert kind in store.types
    path = tmp_path / "two.mcap"
    rows = [
        (0.0, state(["a", "b"], [1, 2])),
        (0.1, state(["c"], [3])),
        (0.2, state(["b", "a"], [5, 4])),
    ]
    robot_log.write_types(path, "/joint_states", kind, {}, rows)
    stream = read_log(path, LogMap((StreamMap("/joint_states", "joints"),)))["/joint_states"]
    assert stream.fields == ("a", "b", "c")
    nan = np.nan
    np.testing.assert_array_equal(stream.values, [[1, 2, nan], [nan, nan, 3], [4, 5, nan]])


JOINT_STATE = "sensor_msgs/msg/JointState"


def states(path, *rows):
    """Joint states of these names and positions."""

    def make(names, values):
        return lambda s: s.types[JOINT_STATE](
            header=robot_log.header(s, 1.0), name=names, position=np.array(values, float),
            velocity=np.ones(2), effort=np.empty(0),
        )  # fmt: skip

    every = [(k / 10, make(*row)) for k, row in enumerate(rows)]
    robot_log.write_types(path, "/joint_states", JOINT_STATE, {}, every)


def test_states_without_positions_are_left_out(tmp_path):
    """Controllers may publish velocities alone, and first."""
    path = tmp_path / "log.mcap"
    states(path, (["a", "b"], []), (["a", "b"], [1, 2]), (["a", "b"], []))
    (guess,) = read_and_suggest(path)[1]["/joint_states"]
    log = read_log(path, LogMap((guess,)))
    np.testing.assert_array_equal(log.streams[0].values, [[1, 2]])
    assert log.notes == ("2 messages of /joint_states hold no joints: they are left out",)


@pytest.mark.parametrize(
    ("names", "values", "words"),
    [
        (["a", "b"], [1], "message 1 .*got 2 names, 2 of them different, limit: 1 .*; remove the"),
        (["a", ""], [1, 2], "message 1 .*got 2 names, 1 of them different, limit: 2 positions"),
    ],
)
def test_joints_without_a_position_or_a_name(tmp_path, names, values, words):
    states(tmp_path / "log.mcap", (["a", "b"], [1, 2]), (names, values))
    with pytest.raises(RecordingError, match=words):
        read_log(tmp_path / "log.mcap", LogMap((StreamMap("/joint_states", "joints"),)))


def test_a_wrench_is_no_joint(bags):
    force = StreamMap("/wrench", "joints", ("wrench.force.x",))
    with pytest.raises(RecordingError, match=r"wrong type for joints.*; write kind = .wrench"):
        read_log(bags / "ros1.bag", LogMap((force,)))


def test_a_part_of_every_message_is_the_remedy(tmp_path):
    path = tmp_path / "log.mcap"
    robot_log.write_mcap(path, {"/skin": (np.arange(4) / 10, [[1, 2], [3, 4, 5], [6, 7], [8, 9]])})
    with pytest.raises(RecordingError, match=r"got 3 values, limit: 2 .* such as data\[:2\], and"):
        read_log(path, LogMap((StreamMap("/skin", "taxels", length=2),)))
    (stream,) = read_log(path, LogMap((StreamMap("/skin", "taxels", ("data[:2]",)),))).streams
    np.testing.assert_array_equal(stream.values, [[1, 2], [3, 4], [6, 7], [8, 9]])


def test_messages_compressed_one_by_one(bags, tmp_path):
    """As `ros2 bag record --compression-mode message` writes them; metadata.yaml may be lost."""
    from rosbags.rosbag2 import CompressionFormat, CompressionMode

    streams = {"/skin": (np.arange(9) / 10, np.arange(36.0).reshape(9, 4))}
    store = robot_log.get_typestore(robot_log.Stores.ROS2_HUMBLE)
    for mode in (CompressionMode.MESSAGE, CompressionMode.FILE):
        writer = robot_log.Writer2(tmp_path / mode.name, version=9)
        writer.set_compression(mode, CompressionFormat.ZSTD)
        with writer:
            for time, topic, kind, message in robot_log.messages(store, streams):
                if not writer.connections:
                    known = writer.add_connection(topic, kind, typestore=store)
                writer.write(known, time, store.serialize_cdr(message, kind))
        (tmp_path / mode.name / "metadata.yaml").unlink()
    given = LogMap((StreamMap("/skin", "taxels"),))
    (stream,) = read_log(tmp_path / "MESSAGE", given).streams
    np.testing.assert_array_equal(stream.values, streams["/skin"][1])
    with pytest.raises(RecordingError, match=r"compressed files and no metadata.*zstd -d"):
        read_log(tmp_path / "FILE", given)


def test_poses_of_one_frame_among_transforms(tmp_path):
    kind = "tf2_msgs/msg/TFMessage"
    definitions = {kind: "geometry_msgs/TransformStamped[] transforms"}

    def transforms(*frames):
        def make(store):
            t = store.types
            parts = [
                t["geometry_msgs/msg/TransformStamped"](
                    header=robot_log.header(store, time), child_frame_id=name,
                    transform=t["geometry_msgs/msg/Transform"](
                        translation=t["geometry_msgs/msg/Vector3"](x=time, y=0.0, z=1.0),
                        rotation=t["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
                    ),
                )
                for name, time in frames
            ]  # fmt: skip
            return t[kind](transforms=parts)

        return make

    path = tmp_path / "tf.mcap"
    rows = [(9.0, transforms(("tip", 1.0), ("elbow", 1.0))), (9.1, transforms(("elbow", 2.0))),
            (9.2, transforms(("tip", 3.0)))]  # fmt: skip
    robot_log.write_types(path, "/tf", kind, definitions, rows)
    guesses = read_and_suggest(path)[1]["/tf"]
    assert [guess.kind for guess in guesses] == ["pose", "pose"]
    stream = read_log(path, LogMap((guesses[0],)))["/tf"]
    np.testing.assert_allclose(stream.times - EPOCH, [1.0, 3.0])
    np.testing.assert_array_equal(stream.values, [[1, 0, 1, 0, 0, 0, 1], [3, 0, 1, 0, 0, 0, 1]])


def test_without_rosbags_the_remedy_is_named(bags, monkeypatch):
    monkeypatch.setitem(sys.modules, "rosbags.highlevel", None)
    with pytest.raises(
        RecordingError, match=r"needs rosbags; pip install rosbags, or .meshskin\[logs"
    ):
        read_log(bags / "ros1.bag")


def test_a_message_without_values_is_refused(tmp_path):
    path = tmp_path / "empty.mcap"
    robot_log.write_mcap(path, {"/skin": ([1.0], [[]])})
    with pytest.raises(RecordingError, match="message 0 of /skin holds no values"):
        read_log(path, LogMap((StreamMap("/skin", "taxels"),)))


@pytest.mark.deep
@pytest.mark.parametrize(
    "name",
    ["ros1.bag", "ros2_sqlite/ros2_sqlite.db3", pytest.param("lz4.mcap", marks=pytest.mark.slow)],
)
def test_a_damaged_file_is_a_log_or_a_named_error(bags, tmp_path, name):
    content = (bags / name).read_bytes()
    rng = np.random.default_rng(6)
    path = tmp_path / f"damaged{(bags / name).suffix}"
    for _ in range(6):
        damaged = bytearray(content)
        at = rng.integers(0, len(content) - 3000)
        damaged[at : at + 3000] = bytes(3000)
        path.write_bytes(damaged)
        with suppress(MeshskinError):
            log = read_log(path, MAP)
            assert [stream.name for stream in log.streams] == [one.topic for one in MAP.streams]
