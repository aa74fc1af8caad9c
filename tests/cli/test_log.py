"""`meshskin log` as a user meets it."""

import re

import numpy as np
import pytest

from meshskin import cli
from meshskin.recording.recording import Recording

from ..recording import robot_log
from ..recording.robot_log import RobotLog
from .test_skin import fails

ROBOT = RobotLog(contacts=8, seed=5)


@pytest.fixture(scope="module")
def bag(tmp_path_factory):
    path = tmp_path_factory.mktemp("log") / "run.mcap"
    robot_log.write_mcap(path, ROBOT.streams())
    return path


def test_streams_are_listed_and_a_first_map_is_written_and_used(bag, tmp_path, capsys):
    path = tmp_path / "map.toml"
    assert cli.main(["log", str(bag), "--write-map", str(path)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0] == "run.mcap: 3 streams, times from 1700000000.000000 s"
    assert lines[3].split()[:6] == ["/skin", "740", "50", "0.041", "14.821", "0"]
    assert "taxels in data, 25" in lines[3]
    assert lines[-1] == f"map: {path}"
    assert cli.main(["log", str(bag), "--map", str(path)]) == 0
    out = capsys.readouterr().out
    assert "readings fall under pressure" in out
    assert "in 8 contacts (applied)" in out
    late = float(out.partition("skin late by ")[2].split()[0])
    assert late == pytest.approx(37, abs=2)
    assert "3 joints, 25 taxels" in out


def test_a_recording_is_written_where_contact_points_are_known(tmp_path, capsys):
    streams = ROBOT.streams()
    time = np.arange(0, ROBOT.duration, 1 / 100)
    depth, site = ROBOT.stroke(time)
    folder = tmp_path / "log"
    folder.mkdir()
    tables = {
        "skin": [f"taxel_{k}" for k in range(25)],
        "wrench": ["fx", "fy", "fz", "tx", "ty", "tz"],
        "tip": ["x", "y", "z", "qx", "qy", "qz", "qw"],
    }
    pose = np.column_stack([ROBOT.sites[site], depth, *(0 * time,) * 3, 1 + 0 * time])
    streams["/tip"] = time, pose
    for name, columns in tables.items():
        times, values = streams[f"/{name}"]
        np.savetxt(
            folder / f"{name}.csv", np.column_stack([times, values]), delimiter=",",
            header=",".join(["time_s", *columns]), comments="",
        )  # fmt: skip
    (tmp_path / "map.toml").write_text(
        '[[stream]]\ntopic = "skin/taxel_*"\nkind = "taxels"\n'
        '[[stream]]\ntopic = "wrench"\nkind = "wrench"\nvalues = ["f?"]\n'
        '[[stream]]\ntopic = "tip"\nkind = "pose"\nvalues = ["x", "y", "z", "q?"]\n'
    )
    out = tmp_path / "run"
    command = ["log", folder, "--map", tmp_path / "map.toml", "--out", out]
    assert cli.main([*map(str, command)]) == 0
    printed = capsys.readouterr().out
    recording = Recording.load(out)
    assert f"recording: {out}, {len(recording.time)} contacts" in printed
    _, site = ROBOT.stroke(recording.time)
    np.testing.assert_allclose(recording.points[:, :2], ROBOT.sites[site], atol=1e-6)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        (
            'topic = "/skn"\nkind = "taxels"',
            "unknown topic '/skn' in run.mcap; did you mean /skin?",
        ),
        ('topic = "/wrench"\nkind = "joints"', "wrong type for joints"),
        ('topic = "/skin"\nkind = "taxels"\nlength = 24', "another length than the map says"),
    ],
)
def test_what_is_not_as_the_map_says_is_one_line(bag, tmp_path, capsys, text, words):
    (tmp_path / "map.toml").write_text(f"[[stream]]\n{text}\n")
    assert words in fails(capsys, "log", bag, "--map", tmp_path / "map.toml")


def test_bad_files_and_options_are_one_line(bag, tmp_path, capsys):
    assert "no log at" in fails(capsys, "log", tmp_path / "none.bag")
    (tmp_path / "text.bag").write_text("hello")
    assert "is no log" in fails(capsys, "log", tmp_path / "text.bag")
    assert "--out needs --map" in fails(capsys, "log", bag, "--out", tmp_path / "x")


def test_time_that_runs_backwards_is_one_line_after_the_list(tmp_path, capsys):
    streams = ROBOT.streams()
    times, angles = streams["/joint_states"]
    back = times.copy()
    back[700:] -= 1.0
    path = tmp_path / "back.mcap"
    store = robot_log.get_typestore(robot_log.Stores.ROS2_HUMBLE)
    assert "sensor_msgs/msg/JointState" in store.types
    kind = "sensor_msgs/msg/JointState"

    def state(time, row):
        return lambda s: s.types[kind](
            header=robot_log.header(s, time), name=list(robot_log.JOINTS), position=row,
            velocity=np.empty(0), effort=np.empty(0),
        )  # fmt: skip

    rows = [(t, state(b, row)) for t, b, row in zip(times, back, angles, strict=True)]
    robot_log.write_types(path, "/joint_states", kind, {}, rows)
    assert cli.main(["log", str(path)]) == 2
    out = capsys.readouterr()
    assert "/joint_states" in out.out
    assert len(out.err.strip().splitlines()) == 1
    assert "runs backwards" in out.err


def test_a_torn_file_is_said_to_be_torn(bag, tmp_path, capsys):
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(bag.read_bytes()[:-5000])
    assert cli.main(["log", str(torn)]) == 0
    out = capsys.readouterr().out
    assert "note: torn.mcap is torn in the record from byte" in out
    assert "messages before the tear are read" in out


def test_a_file_torn_before_its_first_message_is_one_line(bag, tmp_path, capsys):
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(bag.read_bytes()[:5000])
    line = fails(capsys, "log", torn)
    assert "has no readable message: torn.mcap is torn in the record from byte" in line
    assert "are read" not in line
    assert line.rstrip().endswith("copy the file again, or record it again")


URDF = """<robot name="arm"><link name="base"/><link name="tip"><visual><geometry>
<mesh filename="tip.stl"/></geometry></visual></link><link name="a"/><link name="b"/>
<joint name="shoulder" type="revolute"><parent link="base"/><child link="a"/>
<axis xyz="0 0 1"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
<joint name="ELBOW" type="continuous"><parent link="a"/><child link="b"/><axis xyz="0 1 0"/></joint>
<joint name="wrist" type="revolute"><parent link="b"/><child link="tip"/>
<axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint></robot>"""

OTHER = URDF.replace('"wrist"', '"x"').replace("shoulder", "y")
NARROW = URDF.replace("-2", "-.01").replace('"2"', '".01"')


@pytest.mark.parametrize("mapped", [False, True])
def test_joints_and_links_of_a_robot_are_compared(bag, tmp_path, capsys, mapped):
    urdf, path = tmp_path / "arm.urdf", tmp_path / "map.toml"
    urdf.write_text(URDF.replace("ELBOW", "elbows"))
    assert cli.main(["log", str(bag), "--write-map", str(path)]) == 0
    options = ["--map", str(path)] if mapped else []
    capsys.readouterr()
    assert cli.main(["log", str(bag), "--urdf", str(urdf), *options]) == 0
    out = capsys.readouterr().out
    for words in (
        "robot arm: joints shoulder, elbows, wrist", "links with meshes tip",
        "/joint_states: 2 of 3 joints are in arm.urdf",
        "joint elbow of /joint_states is not in arm.urdf (did you mean elbows?)",
        "joints of arm.urdf that the log lacks: elbows",
    ):  # fmt: skip
        assert words in out


@pytest.mark.parametrize(
    ("urdf", "options", "words"),
    [
        (OTHER, [], "unknown joint 'shoulder' of"),
        (URDF, ["--link", "tool"], "unknown link 'tool'"),
        (URDF, ["--link", "base"], "no visual mesh of link 'base'"),
        (NARROW, [], "cannot be in rad, got .*unit = .deg"),
        (None, ["--link", "tip"], "--link is for a URDF file.*give --urdf"),
    ],
)  # fmt: skip
def test_a_robot_of_another_log_is_one_line(bag, tmp_path, capsys, urdf, options, words):
    if urdf is not None:
        (tmp_path / "arm.urdf").write_text(urdf)
        options = [*options, "--urdf", str(tmp_path / "arm.urdf")]
    path = tmp_path / "map.toml"
    assert cli.main(["log", str(bag), "--write-map", str(path), *options]) == 2
    assert path.is_file() == (urdf is not None and options[0] != "--link")  # to be corrected
    error = capsys.readouterr().err.strip()
    assert re.search(words, error)
    assert "\n" not in error
