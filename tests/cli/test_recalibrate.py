"""`meshskin recalibrate` as a user meets it, and `meshskin diff` of what it wrote."""

import json
from dataclasses import replace

import numpy as np
import pytest

import meshskin as ms
from meshskin import cli


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    """A map of three modules as a skin file, and a recording after two were exchanged."""
    folder = tmp_path_factory.mktemp("recalibrate")
    scene = ms.Scene.load("sphere_noisy")
    skin = ms.Skin.modules(scene.body, count=3, seed=1).skin
    skin.save(folder / "map.csv")
    poses = skin.poses.copy()
    poses[:10], poses[10:20] = skin.poses[10:20], skin.poses[:10]
    now = scene.with_(skin=replace(skin, poses=poses))
    ms.press(now, skin.positions[::3]).save(folder / "touches")
    return folder


@pytest.mark.slow
def test_an_exchange_is_named_and_diff_shows_it(files, capsys):
    out = files / "out"
    given = [files / "map.csv", files / "touches", "--scene", "sphere_noisy", "--out", out]
    assert cli.main(["recalibrate", *map(str, given), "--taxels", str(files / "map.csv")]) == 1
    text = capsys.readouterr().out
    assert "module 0: reads at the place of module 1" in text
    assert "module 1: reads at the place of module 0" in text
    written = json.loads((out / "recalibration.json").read_text())
    assert written["modules"] == {"0": "exchanged", "1": "exchanged", "2": "confirmed"}
    assert (out / "touches.csv").read_text().startswith("x_mm,y_mm,z_mm,nx,ny,nz,tests\n")
    assert cli.main(["diff", str(files / "map.csv"), str(out)]) == 1
    assert "modules 0 and 1 exchanged" in capsys.readouterr().out


def test_touches_are_planned_without_a_recording(files, capsys):
    out = files / "plan"
    given = [files / "map.csv", "--scene", "sphere_noisy", "--out", out, "--touches", "3"]
    assert cli.main(["recalibrate", *map(str, given)]) == 0
    rows = np.genfromtxt(out / "touches.csv", delimiter=",", skip_header=1)
    assert rows.shape == (3, 7)
    assert np.allclose(np.linalg.norm(rows[:, :3], axis=1), 100, atol=0.05)
    assert "3 touches" in capsys.readouterr().out


def test_a_part_of_a_urdf_file_is_chosen(files, tmp_path, capsys):
    """As PREVIOUS and with --taxels; a part of files that have none is refused."""
    ms.Skin.load(files / "map.csv").save(tmp_path / "map.urdf")
    joint = """<link name="wrist"/><link name="wrist_skin_7"/><joint name="wrist_skin_7_fixed_joint"
      type="fixed"><parent link="wrist"/><child link="wrist_skin_7"/></joint></robot>"""
    text = (tmp_path / "map.urdf").read_text().replace("</robot>", joint)
    (tmp_path / "both.urdf").write_text(text)
    asked = ["--scene", "sphere_noisy", "--out", str(tmp_path / "out"), "--touches", "2"]
    both, part = str(tmp_path / "both.urdf"), ["--part", "map"]
    assert cli.main(["recalibrate", both, *asked]) == 2
    assert "limit: map, wrist" in capsys.readouterr().err
    assert cli.main(["recalibrate", both, *asked, *part]) == 0
    table = str(files / "map.csv")
    assert cli.main(["recalibrate", table, *asked, *part]) == 2
    assert "--part chooses a skin of a URDF" in capsys.readouterr().err
    assert cli.main(["recalibrate", table, *asked, "--taxels", both, *part]) == 0


@pytest.fixture
def asked(files, tmp_path):
    """Arguments of the command with options in place of a scene: these have no reference force."""
    ms.Scene.load("sphere_noisy").body.mesh.export(tmp_path / "ball.stl")
    known = ["--body", tmp_path / "ball.stl", "--units", "m", "--young-kpa", "200"]
    known += ["--indenter-radius-mm", "10", "--noise-kpa", "0.5", "--touches", "2"]
    return ["recalibrate", *map(str, (files / "map.csv", *known, "--out", tmp_path / "out"))]


def test_a_force_is_given(asked, tmp_path, capsys):
    out = tmp_path / "out"
    assert cli.main(asked) == 2
    assert "planned for a force; give --force-n" in capsys.readouterr().err
    assert not out.exists()
    assert cli.main([*asked, "--force-n", "3"]) == 0
    assert len((out / "touches.csv").read_text().splitlines()) == 3


@pytest.mark.deep
def test_without_a_force_it_is_that_of_the_touches(files, asked, tmp_path):
    assert cli.main([*asked[:2], str(files / "touches"), *asked[2:]]) == 1
    assert len((tmp_path / "out" / "touches.csv").read_text().splitlines()) == 3


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--false-alarm", "0.1", "--all"], "--false-alarm, --all is for the test of a map"),
        (["--false-alarm", "0.9"], "limit: at most 0.5"),
        (["--touches", "0"], "limit: at least 1"),
        (["--force-n", "nan"], "must be a finite number"),
    ],
)
def test_options_that_mean_nothing_are_refused(files, capsys, options, words):
    given = [files / "map.csv", "--scene", "sphere_noisy", "--out", files / "never"]
    assert cli.main(["recalibrate", *map(str, given), *options]) == 2
    assert words in capsys.readouterr().err
    assert not (files / "never").exists()


def test_a_map_that_is_not_there(files, capsys):
    given = [files / "nothing.csv", "--scene", "sphere_noisy", "--out", files / "out"]
    assert cli.main(["recalibrate", *map(str, given)]) == 2
    assert "nothing.csv" in capsys.readouterr().err
