"""The exported skin map: its frame, its parent link, and what is said of it."""

import argparse
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

import meshskin as ms
from meshskin import cli
from meshskin.cli import calibrate
from meshskin.cli.export_options import Export
from meshskin.core import se3
from meshskin.core.errors import ConfigError, SkinError

POSE = ["0.1", "0", "-0.2", "0", "0", "1.5707963267948966"]


@pytest.fixture(scope="module")
def found(recording, sphere):
    return ms.calibrate(recording, sphere.belief(), "centroid")


def options(*given):
    parser = argparse.ArgumentParser()
    calibrate.add(parser)
    return parser.parse_args(["log", "--out", "out", *map(str, given)])


def test_the_frame_of_a_map_is_the_body_s_by_default(found, tmp_path):
    file = tmp_path / "positions.csv"
    line = Export.of(options("--body", "arm.stl", "--export", file)).write(found)
    assert "80 taxels in the frame sphere, that of the body of arm.stl" in line
    assert file.read_text().splitlines()[0].endswith("frame=sphere")
    read = ms.Skin.load(file)
    assert read.frame == "sphere"
    np.testing.assert_array_equal(read.poses[:, :3, 3], found.positions)


def test_a_format_alone_names_a_file_in_the_folder_of_the_results(found, tmp_path):
    for name, file in (("urdf", "skin.urdf"), ("icub", "skin.txt"), ("mjcf", "skin.xml")):
        export = Export.of(options("--body", "arm.stl", "--out", tmp_path, "--export", name))
        assert str(tmp_path / file) in export.write(found)
        assert len(ms.Skin.load(tmp_path / file)) == 80


def test_nothing_is_written_without_a_determined_taxel(found, tmp_path):
    lost = replace(found, poses=np.full_like(found.poses, np.nan))
    asked = options("--body", "arm.stl", "--out", tmp_path, "--export", "urdf")
    line = Export.of(asked).write(lost)
    assert line.endswith("skin.urdf is not written: no taxel is determined")
    assert not (tmp_path / "skin.urdf").exists()


def test_a_link_of_a_urdf_is_the_frame(found, tmp_path):
    file = tmp_path / "map.urdf"
    asked = ("--body", "robot.urdf", "--link", "palm", "--export", file)
    assert "in the frame palm, the link of robot.urdf" in Export.of(options(*asked)).write(found)
    assert ms.Skin.load(file).frame == "palm"


def test_a_transform_moves_the_map_into_the_frame_of_a_link(found, tmp_path):
    file = tmp_path / "map.npz"
    asked = ("--body", "arm.stl", "--link", "l_forearm", "--transform", *POSE, "--export", file)
    line = Export.of(options(*asked)).write(found)
    assert "l_forearm, in which arm.stl is at 0.1 0 -0.2 0 0 1.5708" in line
    read, (x, y, z) = ms.Skin.load(file), found.positions.T
    assert read.frame == "l_forearm"
    np.testing.assert_allclose(read.positions, np.stack([0.1 - y, x, z - 0.2], axis=1), atol=1e-12)
    assert se3.is_rigid(read.poses[0])


def test_a_link_without_a_transform_is_said_to_be_the_mesh_s_frame(found, tmp_path):
    asked = ("--body", "arm.stl", "--link", "l_forearm", "--export", tmp_path / "map.csv")
    assert "taken as that of arm.stl" in Export.of(options(*asked)).write(found)


@pytest.mark.parametrize("kind", ["urdf", "urdf_tactile"])
def test_a_urdf_names_link_and_parent(found, tmp_path, kind):
    file = tmp_path / "map.urdf"
    asked = ("--body", "a.stl", "--link", "skin", "--parent", "arm", "--export", file)
    Export.of(options(*asked, "--export-format", kind)).write(found)
    robot = ElementTree.parse(file).getroot()
    joint = robot.find("joint[@name='skin_fixed_joint']")
    assert joint.find("parent").get("link") == "arm"
    assert joint.find("child").get("link") == "skin"
    assert {"arm", "skin"} <= {link.get("name") for link in robot.findall("link")}
    read = ms.Skin.load(file, part="skin")
    assert read.frame == "skin"
    np.testing.assert_allclose(read.sigmas, found.skin.sigmas, rtol=1e-12)
    pin = pytest.importorskip("pinocchio")
    assert pin.buildModelFromUrdf(str(file)).existFrame("skin")


@pytest.mark.parametrize(
    ("given", "words"),
    [
        (["--transform", *POSE], "give --export"),
        (["--parent", "arm"], "give --export"),
        (["--export", "m.csv", "--body", "a.stl", "--parent", "arm"], "a csv file cannot name a p"),
        (
            ["--export", "m.urdf", "--body", "a.stl", "--link", "arm", "--parent", "arm"],
            "cannot be its own parent",
        ),
        (["--export", "m.urdf", "--body", "a.stl", "--link", "arm "], "name of a frame must be"),
        (["--export", "m.csv", "--body", "a.stl", "--transform", *POSE], "no --link"),
        (
            ["--export", "m.csv", "--body", "a.urdf", "--link", "b", "--transform", *POSE],
            "leave --transform out",
        ),
    ],
)
def test_options_that_mean_nothing_are_refused(given, words):
    with pytest.raises((ConfigError, SkinError), match=words):
        Export.of(options(*given))


def test_a_link_of_a_mesh_without_an_export_is_refused(tmp_path, capsys):
    mesh = ms.Body.sphere(0.1, faces=320).mesh
    mesh.export(tmp_path / "ball.stl")
    assert cli.main(["check", str(tmp_path / "ball.stl"), "--units", "m", "--link", "palm"]) == 2
    assert "--link names a link of a URDF file" in capsys.readouterr().err
