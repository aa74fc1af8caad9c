"""`meshskin calibrate` of a robot's own log: a bag of joint states and raw counts, and a URDF."""

import json
from dataclasses import replace
from types import SimpleNamespace
from xml.etree import ElementTree

import numpy as np
import pytest

import meshskin as ms
from meshskin import cli
from meshskin.cli import live, log_options
from meshskin.core import se3
from meshskin.estimation.kinematics.joint_residuals import JointResidual
from meshskin.report.live.page import LivePage

from ..estimation.kinematics.simulated_log import CLOCK, OFFSETS, PUMA, explore
from ..recording import robot_log


def write_robot(folder, scene):
    """The arm with one link more, which holds the body."""
    tree = ElementTree.parse(PUMA)
    link = ElementTree.SubElement(tree.getroot(), "link", name="palm")
    shape = ElementTree.SubElement(ElementTree.SubElement(link, "visual"), "geometry")
    ElementTree.SubElement(shape, "mesh", filename="palm.stl")
    joint = ElementTree.SubElement(tree.getroot(), "joint", name="palm_mount", type="fixed")
    mount = np.asarray(scene.rig.mount)
    at, turn = mount[:3, 3].tolist(), se3.to_rpy(mount[:3, :3]).tolist()
    place = {"xyz": " ".join(map(repr, at)), "rpy": " ".join(map(repr, turn))}
    ElementTree.SubElement(joint, "origin", place)
    ElementTree.SubElement(joint, "parent", link="tool0")
    ElementTree.SubElement(joint, "child", link="palm")
    tree.write(folder / "robot.urdf")
    scene.body.mesh.export(folder / "palm.stl")


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """A bag, its map and the robot."""
    folder = tmp_path_factory.mktemp("robot")
    exploration = explore(headings=(0, 90, 210), taxels=37, frame=0.04)
    scene = exploration.scene
    write_robot(folder, scene)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(robot_log, "JOINTS", exploration.log.joint_names)
        robot_log.write_mcap(folder / "log.mcap", exploration.streams())
    whole = (folder / "log.mcap").read_bytes()
    (folder / "log.mcap").write_bytes(whole[:-20])  # without its end, behind all messages
    ids = np.asarray(scene.skin.ids)
    (folder / "map.toml").write_text(
        '[[stream]]\ntopic = "/joint_states"\nkind = "joints"\n'
        '[[stream]]\ntopic = "/skin"\nkind = "taxels"\n'
        f"length = {len(ids)}\n"
    )
    return replace(exploration, frames=folder)


def command(folder, *options, name="calibrate"):
    asked = [folder / "log.mcap", "--map", folder / "map.toml", "--urdf", folder / "robot.urdf"]
    asked += ["--link", "palm", "--indenter-radius-mm", 10, "--raw"]
    asked += ["--out", folder / "out"] if name == "calibrate" else []
    return cli.main([name, *map(str, [*asked, *options])])


@pytest.mark.slow
def test_one_command(folder, capsys):
    exploration, folder = folder, folder.frames
    centre = [1e3 * x for x in exploration.scene.indenter.position]
    export = ["--export", folder / "palm.xml"]
    known = ["--robot-unknown", "joint_offset", "clock_offset", "indenter_position"]
    assert command(folder, "--indenter-mm", *centre, *known, *export) == 0
    printed = capsys.readouterr().out
    assert "verdict: " in printed
    assert "off the body before the estimate" in printed
    assert "  note: read record by record" in printed
    metrics = json.loads((folder / "out" / "metrics.json").read_text())
    joints = metrics["kinematics"]["joints"]
    assert joints.keys() == set(exploration.log.joint_names)
    assert all(0 <= joint["explained"] < 1 for joint in joints.values())
    assert "Kinematics" in (folder / "out" / "report.html").read_text()
    late = metrics["unknowns"]["clock_offset"][0]
    offsets = [metrics["unknowns"][f"joint_offset {j}"][0] for j in exploration.log.joint_names]
    np.testing.assert_allclose(offsets[1:5], OFFSETS[1:5], atol=np.radians(0.1))
    assert abs(late) < 2 * CLOCK  # that which the comparison of the clocks has left
    skin = ms.Skin.load(folder / "palm.xml")
    off = np.linalg.norm(skin.positions - exploration.scene.skin.positions[skin.ids], axis=1)
    assert np.sqrt(np.mean(off**2)) < 0.1e-3
    corrected = ms.Robot.from_urdf(folder / "out" / "corrected.urdf").chain("base", "palm")
    angles = exploration.log.joint_angles[:3]
    true = ms.Robot.from_urdf(folder / "robot.urdf").chain("base", "palm")
    assert corrected.poses(angles) == pytest.approx(true.poses(angles + OFFSETS), abs=2e-3)


def test_a_joint_is_printed_where_chance_does_not_explain_its_error():
    model = SimpleNamespace(chain=SimpleNamespace(joint_names=("elbow",)), delayed=None, columns={})
    residuals = (JointResidual("elbow", 0.01, 0.6, 0.0), JointResidual("wrist", 0.01, 0.5, 1.0))
    found = SimpleNamespace(
        heights_mm=(2.0, 0.1), kinematics=model, joint_residuals=residuals, off_body=7
    )
    heights, off, *named = log_options._lines(found)
    assert off.startswith("  7 contacts left out: they lie off the body")
    assert heights == "  contacts lie 2 mm off the body before the estimate, 0.1 mm after it"
    (line,) = named
    assert line.startswith("  elbow: an error that varies with its angle would explain 60%")


@pytest.mark.slow
def test_the_log_is_played_live(folder, monkeypatch, capsys):
    pytest.importorskip("viser", reason='no viser: pip install "meshskin[live]"')
    shown, show = [], LivePage.show
    monkeypatch.setattr(
        LivePage, "show", lambda page, snapshot: (shown.append(snapshot), show(page, snapshot))
    )
    monkeypatch.setattr(LivePage, "viewers", property(lambda page: int(not shown)))
    monkeypatch.setattr(live, "AWAY", 0.0)
    centre = [1e3 * x for x in folder.scene.indenter.position]
    page = ["--port", 0, "--no-browser", "--speed", 32]
    assert command(folder.frames, "--indenter-mm", *centre, *page, name="live") == 0
    assert (
        "the response is as learned from the whole log (verdict: PASS)" in capsys.readouterr().out
    )
    last, skin = shown[-1], folder.scene.skin
    off = np.linalg.norm(last.positions - skin.positions, axis=1)
    sigma = np.sqrt(np.trace(last.covariances, axis1=1, axis2=2))
    assert last.status.determined == len(skin)
    assert np.sqrt(np.mean((off / sigma) ** 2)) < 1.5
    assert np.median(shown[len(shown) // 8].status.median_sigma / last.status.median_sigma) > 1.2


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--carrier", "base"], "need the indenter"),
        (["--indenter-mm", "1", "2", "3", "--method", "centroid"], "joint estimate"),
    ],
)
def test_options_that_miss_others_are_refused_in_one_line(tmp_path, capsys, options, words):
    assert command(tmp_path, *options) == 2
    assert words in capsys.readouterr().err.strip().splitlines()[-1]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--indenter-mm", "1", "2", "3", "--robot-unknown", "clok"], "clock_offset"),
        (["--indenter-mm", "1", "2", "3", "--carrier", "nowhere"], "nowhere"),
        ([], "contact"),
    ],
)
def test_bad_calls_are_refused_in_one_line(folder, capsys, options, words):
    assert command(folder.frames, *options) == 2
    assert words in capsys.readouterr().err.strip().splitlines()[-1]
