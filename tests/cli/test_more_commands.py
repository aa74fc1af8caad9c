"""`meshskin effects`, `init`, `report` and `scenes --show`, as a user meets them."""

import json
import shutil
import tomllib
from dataclasses import replace

import numpy as np
import pytest
import trimesh

import meshskin as ms
from meshskin import cli, effects
from meshskin.cli import effects as command
from meshskin.cli import init
from meshskin.core.errors import ConfigError
from meshskin.estimation.cross_validation import CrossValidation


def test_every_effect_is_listed_and_can_be_switched_on_as_it_is_shown(capsys):
    assert cli.main(["effects"]) == 0
    listed = [line.split()[0] for line in capsys.readouterr().out.splitlines()]
    assert listed[: len(effects.NAMES)] == list(effects.NAMES)
    defaults = {effect.name: effect for effect in effects.registered()}
    for name in effects.NAMES:
        lines = "\n".join(command.details(effects.find(name)))
        table = lines[lines.index("[[effects]]") :].replace("...  # required", "0.01")
        (given,) = tomllib.loads(table)["effects"]
        made = effects.from_table(given)
        if name in defaults:
            assert made == defaults[name]
        assert isinstance(made, effects.find(name))


def test_an_effect_is_described(capsys):
    assert cli.main(["effects", "encoder"]) == 0
    printed = capsys.readouterr().out
    for text in ("q <- q + b + n", "offset_spread : float, rad", "stage     robot"):
        assert text in printed
    assert cli.main(["effects", "encoders"]) == 2
    assert "did you mean encoder" in capsys.readouterr().err


def test_a_scene_file_is_shown(capsys):
    assert cli.main(["scenes", "--show", "sphere_noisy"]) == 0
    assert tomllib.loads(capsys.readouterr().out)["extends"] == "sphere"


@pytest.fixture
def mesh(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    handle = ms.Body.capsule(0.03, 0.1, faces=800).mesh.copy()
    handle.apply_scale(1e3)
    handle.export("handle.stl")
    return handle


@pytest.mark.deep
def test_init_writes_a_scene_that_loads(mesh, tmp_path, capsys):
    assert cli.main(["init", "handle.stl"]) == 0
    said = capsys.readouterr().out
    assert "meshskin run handle.toml" in said
    for key in ("units", "spacing_mm", "count", "radius_mm", "force_reference_n"):
        assert len([line for line in said.splitlines() if f"  {key} = " in line]) == 1
    assert "about the top" in said
    scene = ms.Scene.load("handle.toml")
    np.testing.assert_allclose(scene.body.mesh.extents, [0.06, 0.06, 0.16], rtol=0.02)
    assert len(scene.skin) == 80
    text = (tmp_path / "handle.toml").read_text()
    assert 'units = "mm"  # by its size' in text
    assert "direction" not in tomllib.loads(text)["skin"]
    assert "10 mm reaches" in text
    assert cli.main(["init", "handle.stl"]) == 2
    assert cli.main(["init", "handle.stl", "--out", "folder"]) == 2  # would be no scene for run
    assert "exists already" in capsys.readouterr().err


@pytest.mark.slow
def test_init_opens_a_mesh_with_borders_and_refuses_a_strange_size(mesh, capsys, monkeypatch):
    monkeypatch.setattr(init, "RADII", (5e-3,))
    opened = mesh.copy()
    opened.update_faces(np.arange(len(mesh.faces)) > 3)
    opened.export("open.stl")
    assert cli.main(["init", "open.stl", "--out", "here.toml"]) == 0
    assert ms.Scene.load("here.toml").body.name == "open"
    opened.apply_scale(1e5)
    opened.export("vast.stl")
    assert cli.main(["init", "vast.stl"]) == 2
    assert "give --units" in capsys.readouterr().err
    assert cli.main(["init", "no.stl"]) == 2


@pytest.mark.slow
def test_init_asks_for_no_more_taxels_than_fit(mesh, tmp_path, monkeypatch):
    monkeypatch.setattr(init, "RADII", (5e-3,))
    mesh = mesh.copy()
    mesh.apply_scale(0.15)  # an area for 31 taxels, of which fewer are laid
    mesh.export("small.stl")
    assert cli.main(["init", "small.stl"]) == 0
    asked = tomllib.loads((tmp_path / "small.toml").read_text())["skin"]["count"]
    assert 15 < asked < 31
    assert len(ms.Scene.load("small.toml").skin) == asked


@pytest.mark.deep
def test_init_puts_the_skin_where_the_indenter_reaches(mesh, tmp_path, monkeypatch):
    """The flat top of a can ends at an edge; its side does not."""
    monkeypatch.setattr(init, "RADII", (5e-3,))
    trimesh.creation.cylinder(20, 150, sections=120).export("can.stl")
    assert cli.main(["init", "can.stl"]) == 0
    can = tomllib.loads((tmp_path / "can.toml").read_text())
    assert can["skin"]["direction"] in ([1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0])
    assert np.ptp(ms.Scene.load("can.toml").skin.positions[:, 2]) > 0.03


def test_init_writes_the_map_of_a_log(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    time = 0.01 * np.arange(300)
    columns = {"time": time, "joint_1": np.sin(time), "skin_0": 200 + np.cos(9 * time)}
    table = np.column_stack(list(columns.values()))
    np.savetxt("run.csv", table, "%.6f", ",", header=",".join(columns), comments="")
    assert cli.main(["init", "run.csv"]) == 0
    text = (tmp_path / "run_map.toml").read_text()
    assert "300 samples at 100 Hz" in text
    assert ms.LogMap.load("run_map.toml").streams


def test_init_says_that_a_log_needs_no_map(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "log").mkdir()
    for name in ("contacts", "readings"):
        (tmp_path / "log" / f"{name}.csv").write_text("time\n0\n")
    assert cli.main(["init", "log"]) == 2
    said = capsys.readouterr().err
    assert "needs no map" in said
    assert "meshskin calibrate log" in said
    assert not (tmp_path / "log_map.toml").exists()
    body = ["--body", "ball.stl", "--units", "m", "--indenter-radius-mm", "10", "--raw"]
    trimesh.creation.icosphere(3, 0.1).export("ball.stl")
    assert cli.main(["calibrate", "log/contacts.csv", *body, "--out", "out"]) == 2
    assert "one of the two files of a log; give their folder, log" in capsys.readouterr().err
    assert cli.main(["init", "log", "--units", "mm"]) == 2
    assert "--units is for a mesh, got log; leave it out" in capsys.readouterr().err


def test_init_names_the_columns_of_a_log_that_none_is_recognized_of(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "bare.csv").write_text("time,left,right\n")  # no row
    assert cli.main(["init", "bare.csv"]) == 2
    assert "no stream of the log is recognized, got ['left', 'right']" in capsys.readouterr().err
    assert not (tmp_path / "bare_map.toml").exists()


def test_init_says_what_a_log_lacks(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    names = ["time", "cx", "dy", "ez", *(f"cell{k}" for k in range(5))]
    np.savetxt("run.csv", np.arange(90.0).reshape(10, 9) / 90, "%g", ",", header=",".join(names),
               comments="")  # fmt: skip
    assert cli.main(["init", "run.csv"]) == 0
    text = (tmp_path / "run_map.toml").read_text()
    assert "# Not recognized: cx, dy, ez." in text
    commented = (
        text[text.index("# [[stream]]") :].replace("# ", "").replace('"x", "y"', '"cx", "dy"')
    )
    added = commented.replace('"z", "force"', '"ez"')
    (tmp_path / "run_map.toml").write_text(text[: text.index("# Nothing says")] + added)
    log_map = ms.LogMap.load("run_map.toml")
    assert [len(stream.fields) for stream in ms.read_log("run.csv", log_map).streams] == [5, 3]


@pytest.fixture(scope="module")
def folder(tmp_path_factory, sphere, recording):
    """What `meshskin run sphere` leaves that the page is made from."""
    out = tmp_path_factory.mktemp("run")
    recording.save(out / "recording")
    ms.calibrate(recording, sphere.belief(), "centroid").save(out / "calibration")
    metrics = {"scene": "sphere", "inputs": {"scene": "sphere", "seed": 1}, "taxels": 80}
    metrics["seconds"] = {"calibrate": 2.0, "report": 3.0}
    (out / "metrics.json").write_text(json.dumps(metrics))
    return out


@pytest.mark.slow
def test_the_page_is_written_again(folder, capsys):
    assert cli.main(["report", str(folder), "--quiet"]) == 0
    page = (folder / "report.html").read_text()
    assert "3D view" in page
    assert capsys.readouterr().out == ""


def test_the_page_gets_what_the_folder_and_its_inputs_hold(folder, capsys, monkeypatch):
    given = {}
    monkeypatch.setattr(ms.Calibration, "report", lambda self, path, **rest: given.update(rest))
    assert cli.main(["report", str(folder)]) == 0
    assert given["body"].name == "sphere"
    assert given["seconds"] == {"calibrate": 2.0}  # the page is drawn anew
    assert "written again" in capsys.readouterr().out
    metrics = json.loads((folder / "metrics.json").read_text())
    (folder / "metrics.json").write_text(json.dumps(metrics | {"inputs": {"scene": "gone.toml"}}))
    assert cli.main(["report", str(folder)]) == 0
    assert "left out         scene: no such scene file" in capsys.readouterr().out
    assert given["body"] is None
    assert given["recording"] is not None
    assert cli.main(["report", str(folder / "figures")]) == 2
    capsys.readouterr()
    assert cli.main(["report", str(folder), "--units", "mm"]) == 2
    assert "--units is for the body; give --body, too" in capsys.readouterr().err
    robot = ["--body", str(folder / "toy.urdf"), "--link", "palm", "--folder", str(folder)]
    assert cli.main(["report", str(folder), *robot]) == 2
    assert "toy.urdf" in capsys.readouterr().err


def test_the_page_gets_the_recording_that_was_calibrated(folder, tmp_path, capsys, monkeypatch):
    """The folder of a run may hold the results of a later calibration of another recording."""
    given = {}
    monkeypatch.setattr(ms.Calibration, "report", lambda self, path, **rest: given.update(rest))
    out, log = tmp_path / "out", tmp_path / "log"
    shutil.copytree(folder, out)
    earlier = ms.Recording.load(out)
    later = earlier.with_columns(force=earlier.force + 1)
    later.save(log)
    metrics = {"inputs": {"recording": str(log)}, "recording_digest": later.digest}
    (out / "metrics.json").write_text(json.dumps(metrics))
    assert cli.main(["report", str(out)]) == 0
    assert given["recording"] == later
    wrong = f"{out / 'recording'} is not the recording that was calibrated"
    (out / "metrics.json").write_text(json.dumps(metrics | {"inputs": {}}))
    assert cli.main(["report", str(out)]) == 0
    assert wrong in capsys.readouterr().out
    assert given["recording"] is None
    assert cli.main(["report", str(out), "--recording", str(out / "recording")]) == 2
    assert wrong in capsys.readouterr().err
    (out / "metrics.json").write_text(json.dumps({"contacts": 3}))  # by a version without digests
    assert cli.main(["report", str(out)]) == 0
    assert wrong in capsys.readouterr().out


def test_the_page_gets_the_contacts_that_were_held_out(folder, tmp_path, capsys, monkeypatch):
    given = {}
    monkeypatch.setattr(ms.Calibration, "report", lambda self, path, **rest: given.update(rest))
    for path in folder.glob("calibration.*"):
        shutil.copy(path, tmp_path)
    (tmp_path / "metrics.json").write_text(json.dumps({"cross_validation": {"localized": 2}}))
    points, rows = np.arange(9.0).reshape(3, 3), np.arange(3)
    held_out = CrossValidation(points, points + np.nan, -points, rows, 1.0 * rows, rows, 4e-3)
    held_out.save(tmp_path / "cross_validation.parquet")
    assert cli.main(["report", str(tmp_path)]) == 0
    assert given["validation"] == held_out
    assert "held out" not in capsys.readouterr().out
    shutil.copy(tmp_path / "calibration.parquet", tmp_path / "cross_validation.parquet")
    assert cli.main(["report", str(tmp_path)]) == 0
    assert given["validation"] is None
    assert "holds no cross-validation" in capsys.readouterr().out


def test_left_out_taxels_are_a_warning_in_python(sphere, recording):
    belief = sphere.belief(taxel_ids=[*sphere.skin.ids, 500, 501])
    with pytest.warns(ms.LeftOutWarning, match=r"2 of 82 taxels are not calibrated \(2: never"):
        found = ms.calibrate(recording, belief, "centroid")
    assert found.reasons_left_out == ["never touched"] * 2
    with pytest.raises(ms.MeshskinError) as refused:
        replace(found, poses=np.full_like(found.poses, np.nan)).skin  # noqa: B018
    assert not isinstance(refused.value, ConfigError)
