"""Calibration of a robot's own log from the command line."""

import argparse
import json
import re
import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pytest

import meshskin as ms
from meshskin import cli
from meshskin.cli import belief_options, calibrate
from meshskin.core.errors import ConfigError, MeshError
from meshskin.estimation.calibrate import CONSTANT
from meshskin.estimation.uncalibrated import uncalibrated
from meshskin.scene.schema import body_table

from .csv_log import write_log


@pytest.fixture(scope="module")
def scene():
    return ms.Scene.load("sphere_noisy")


@pytest.fixture(scope="module")
def recording(scene):
    rng = np.random.default_rng(0)
    near = rng.normal(scale=15e-3, size=(600, 3))
    return ms.press(scene, scene.skin.positions.mean(axis=0) + near, seed=1)


@pytest.fixture(scope="module")
def log(tmp_path_factory, scene, recording):
    """A folder with a mesh in mm, and the log in CSV, in mm and kPa."""
    folder = tmp_path_factory.mktemp("log")
    mesh = scene.body.mesh.copy()
    mesh.apply_scale(1e3)
    mesh.export(folder / "ball.stl")
    return write_log(folder, recording, 1e-3 * recording.pressure, "pressure_kpa")


def known(log):
    return ["--body", str(log / "ball.stl"), "--units", "mm", "--indenter-radius-mm", "10"]


@pytest.mark.deep
def test_a_log_in_csv_with_a_mesh(scene, log, tmp_path, capsys):
    out, belief = tmp_path / "out", scene.belief()
    asked = ["calibrate", str(log), *known(log), "--young-kpa", "150", "--out", str(out)]
    asked += ["--noise-kpa", str(1e-3 * belief.noise_sigma)]
    asked += ["--threshold-kpa", str(1e-3 * belief.threshold)]
    assert cli.main([*asked, "--export", str(tmp_path / "map.csv")]) == 0
    exported = ms.Skin.load(tmp_path / "map.csv")
    off = np.linalg.norm(exported.positions - scene.skin.positions, axis=1)
    assert off.mean() < 0.03e-3
    m = json.loads((out / "metrics.json").read_text())
    assert m["determined"] == m["taxels"] == m["touched"] == 80
    assert m["contacts"] == 600
    assert m["modulus_pa"] == pytest.approx(scene.material.effective_modulus, rel=0.01)
    assert "fits" in m["fit"]["words"]
    assert m["faults"] == {}
    assert {"calibration.parquet", "calibration.csv", "report.html", "figures"} < {
        file.name for file in out.iterdir()
    }
    said = capsys.readouterr().out
    assert "80 of 80 taxels determined" in said
    assert "rotation about the normal of every taxel" in said


@pytest.mark.deep
@pytest.mark.usefixtures("no_figures")
def test_a_failed_calibration_is_written_and_ends_with_exit_code_1(log, tmp_path, capsys):
    out = tmp_path / "out"
    asked = ["calibrate", str(log), *known(log), "--young-kpa", "4500", "--out", str(out)]
    assert cli.main(asked) == calibrate.FAILED == 1
    assert capsys.readouterr().out.startswith("verdict: FAIL")
    assert json.loads((out / "metrics.json").read_text())["verdict"]["level"] == "FAIL"
    assert (out / "calibration.parquet").exists()


@pytest.mark.deep
@pytest.mark.usefixtures("no_figures")
def test_a_recording_with_a_scene(recording, tmp_path, capsys):
    recording.save(tmp_path / "r")
    asked = ["calibrate", str(tmp_path / "r"), "--scene", "sphere_noisy", "--out"]
    assert cli.main([*asked, str(tmp_path / "out"), "--unknown", "modulus", "gain"]) == 0
    found = ms.Calibration.load(tmp_path / "out" / "calibration")
    assert "gain" in found.taxel_unknowns
    said = capsys.readouterr().out
    assert re.search(r"E\*  .* \+- .* kPa\n", said)
    assert "% apart (1 sigma)" in said
    assert cli.main([*asked, str(tmp_path / "given"), "--unknown", "gain", "force_scale"]) == 0
    said = capsys.readouterr().out
    assert re.search(r"E\*  .* kPa, given\n", said)
    assert re.search(r"force_scale +(1|0\.9|1\.0)[\d.]* \+- ", said)  # a factor, not a logarithm
    given = ms.Calibration.load(tmp_path / "given" / "calibration")
    assert given.modulus_sigma is None
    page = (tmp_path / "given" / "report.html").read_text()
    assert "Effective modulus E*: 263.193 kPa, given." in page
    assert cli.main([*asked, str(tmp_path / "other"), "--method", "trilateration"]) == 0
    assert ms.Calibration.load(tmp_path / "other" / "calibration").method == "trilateration"
    assert "80 taxels" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--scene", "nosuch"], "nosuch"),
        ([], "missing: --body, --indenter-radius-mm, --young-kpa; give --scene"),
        (["--raw"], r"--body (or --urdf and --link), --indenter-radius-mm and --young-kpa"),
        (["--scene", "sphere_noisy", "--method", "guess"], "guess"),
        (["--scene", "sphere_noisy", "--unknown", "gains"], "gains"),
        (["--scene", "sphere_noisy", "--contact", "hertzian"], "hertzian"),
        (["--scene", "sphere_noisy", "--response-groups", "48-x"], "write each group as 48-95"),
        (["--scene", "sphere_noisy", "--response-groups", "0-9", "9"], "must be unique, got 9"),
        (["--scene", "sphere_noisy", "--noise-kpa", "-1"], "--noise-kpa: the number is out of"),
        (
            ["--scene", "sphere_noisy", "--disc-radius-mm", "0"],
            "--disc-radius-mm: the number is out",
        ),
        (
            ["--scene", "sphere_noisy", "--units", "mm"],
            "got --units together with --scene; remove either",
        ),
        (["--scene", "sphere_noisy", "--open"], "got --open together with --scene; remove either"),
        (["--scene", "sphere_noisy", "--link-mesh", "visual"], "got --link-mesh together"),
        (["--scene", "sphere_noisy", "--export", "map.xyz"], "format of a skin file"),
        (
            ["--scene", "sphere_noisy", "--method", "centroid", "--iterations", "3"],
            "--iterations is not for the method centroid; leave it out",
        ),
        (["--scene", "sphere_noisy", "--scan"], "--scan is for a robot's log; give --map, too"),
        (
            ["--scene", "sphere_noisy", "--indenter-mm", "0", "0", "0"],
            "--indenter-mm is for a robot's log; give --map, too",
        ),
        (["--scene", "sphere_noisy", "--cross-validate", "1"], "got 1, limit: at least 2"),
        (
            ["--scene", "sphere_noisy", "--method", "eq15", "--cross-validate", "5000", "--quiet"],
            "too few blocks of contacts",
        ),
        (["--scene", "sphere_noisy", "--iterations", "0"], "got 0, limit: at least 1"),
        (
            ["--scene", "sphere_noisy", "--export", "csv", "--link", "palm", "--transform"]
            + ["nan"] * 6,
            "--transform: the number must be a finite number, got nan",
        ),
    ],
)
def test_what_cannot_be_calibrated(log, tmp_path, capsys, monkeypatch, options, words):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["calibrate", str(log), *options, "--out", str(tmp_path / "out")]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert words in lines[0]
    assert not list((tmp_path / "out").glob("*"))


@pytest.mark.deep
@pytest.mark.usefixtures("no_figures")
def test_a_body_that_is_no_sphere_needs_no_contact_model_named(tmp_path):
    scene = ms.Scene.load("ellipsoid")
    mesh = scene.body.mesh.copy()
    mesh.apply_scale(1e3)
    mesh.export(tmp_path / "handle.stl")
    near = np.random.default_rng(0).normal(scale=8e-3, size=(150, 3))
    recording = ms.press(scene, scene.skin.positions.mean(axis=0) + near, seed=1)
    recording.save(tmp_path / "log")
    asked = ["calibrate", str(tmp_path / "log"), "--body", str(tmp_path / "handle.stl")]
    asked += ["--units", "mm", "--indenter-radius-mm", "10", "--young-kpa", "150"]
    assert cli.main([*asked, "--out", str(tmp_path / "out")]) == 0
    found = ms.Calibration.load(tmp_path / "out" / "calibration")
    seen = np.isfinite(found.positions[:, 0])
    assert seen.sum() > 5
    off = np.linalg.norm(found.positions[seen] - scene.skin.positions[seen], axis=1)
    assert np.median(off) < 0.05e-3


def body_of(log, *options):
    """The body of the belief that options of the command describe."""
    parser = argparse.ArgumentParser()
    calibrate.add(parser)
    rest = ["--indenter-radius-mm", "10", "--young-kpa", "150", "--out", "out"]
    asked = [str(log), "--body", *map(str, options), *rest]
    return belief_options.belief_of(parser.parse_args(asked), [1]).body


def test_groups_of_taxels_that_respond_in_their_own_way():
    parser = argparse.ArgumentParser()
    calibrate.add(parser)
    asked = [
        "log",
        "--out",
        "out",
        "--scene",
        "sphere_noisy",
        "--response-groups",
        "3-5,8",
        "60-79",
    ]
    groups = belief_options.belief_of(parser.parse_args(asked), [1]).response_groups
    assert [ids.tolist() for ids in groups] == [[3, 4, 5, 8], list(range(60, 80))]


def test_every_option_of_a_body_is_one_of_calibrate_and_check(log, tmp_path, capsys, scene):
    """An open mesh, and the link of a URDF file whose mesh is in another folder."""
    dome = scene.body.mesh.copy()
    dome.update_faces(dome.triangles_center[:, 2] < 0.0)
    (tmp_path / "meshes").mkdir()
    file = tmp_path / "meshes" / "dome.stl"
    dome.export(file)
    with pytest.raises(MeshError, match="not watertight"):
        body_of(log, file, "--units", "m")
    assert len(body_of(log, file, "--units", "m", "--open").mesh.faces) == len(dome.faces)
    asked = ["calibrate", str(log), "--body", str(file), "--units", "m", "--out", str(tmp_path)]
    assert cli.main([*asked, "--indenter-radius-mm", "10", "--young-kpa", "150"]) == 2
    assert "or --open if it is meant to be open" in capsys.readouterr().err
    assert cli.main(["check", str(file), "--units", "m", "--open"]) == 0
    (tmp_path / "urdf").mkdir()
    urdf = tmp_path / "urdf" / "toy.urdf"
    shape = '<geometry><mesh filename="package://toy/dome.stl"/></geometry>'
    urdf.write_text(
        f"""<robot name="toy"><link name="palm"><visual><origin xyz="0 0 1"/>{shape}</visual>
        <collision>{shape}</collision></link></robot>"""
    )
    link = ["--link", "palm", "--folder", tmp_path / "meshes", "--open"]
    assert body_of(log, urdf, *link).mesh.bounds[1, 2] == pytest.approx(1.0, abs=6e-3)
    low = body_of(log, urdf, *link, "--link-mesh", "collision").mesh.bounds[1, 2]
    assert low == pytest.approx(0.0, abs=6e-3)
    assert cli.main(["check", str(urdf), *map(str, link)]) == 0
    assert "can be a body" in capsys.readouterr().out
    table = {"mesh": "urdf/toy.urdf", "link": "palm", "folders": ["meshes"], "open": True}
    assert body_table(table).make(tmp_path).mesh.bounds[1, 2] == pytest.approx(1.0, abs=6e-3)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["toy.urdf"], "toy.urdf is a URDF file; name one of its links: --link"),
        (["toy.urdf", "--link", "palm", "--units", "mm"], "got --units; remove it"),
        (
            ["ball.stl", "--units", "mm", "--folder", "."],
            "--folder is for a URDF file",
        ),
        (["ball.stl", "--link-mesh", "visual"], "--link-mesh is for a URDF file"),
    ],
)
def test_options_of_a_body_that_do_not_go_together(log, options, words):
    with pytest.raises(ConfigError, match=re.escape(words)):
        body_of(log, *options)


@pytest.mark.parametrize("name", ["none", "."])
def test_no_log(tmp_path, capsys, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    assert cli.main(["calibrate", name, "--scene", "sphere", "--out", "out"]) == 2
    assert f"no recording at {name}: " in capsys.readouterr().err


def test_an_export_that_cannot_be_written_is_refused_before_the_work(log, tmp_path, capsys):
    (tmp_path / "file").write_text("")
    asked = ["calibrate", str(log), *known(log), "--young-kpa", "150"]
    asked += ["--out", str(tmp_path / "out"), "--export", str(tmp_path / "file" / "map.csv")]
    assert cli.main(asked) == 2
    assert "cannot write" in capsys.readouterr().err
    assert not list((tmp_path / "out").glob("*"))


@pytest.mark.deep
@pytest.mark.usefixtures("no_figures")
def test_why_taxels_are_left_out_is_said(log, tmp_path, capsys):
    for name in ("contacts.csv", "ball.stl"):
        shutil.copy(log / name, tmp_path)
    head, *readings = (log / "readings.csv").read_text().splitlines()
    own = [line for line in readings if line.split(",")[1] == "7"]
    few = [line for line in readings if line not in own[2:]]
    (tmp_path / "readings.csv").write_text("\n".join([head, *few]))
    asked = ["calibrate", str(tmp_path), *known(log), "--young-kpa", "150", "--contact", "hertz"]
    asked += ["--method", "trilateration", "--out", str(tmp_path / "out")]
    assert cli.main(asked) == 0
    assert "left out         1 taxel: fewer than three readings" in capsys.readouterr().out


def found_with(level, reasons):
    """A calibration whose taxels without a position are left out for the `reasons`."""
    lost = np.array([bool(words) for words in reasons])
    planned = SimpleNamespace(points=np.zeros((1, 3)), taxel=[7], unreached=np.flatnonzero(lost))
    return SimpleNamespace(
        verdict=SimpleNamespace(level=level), belief=True, ids=np.arange(len(lost)),
        reasons=np.array(reasons), observed=np.tile(~lost[:, None], 6),
        next_contacts=lambda count: planned,
    )  # fmt: skip


def test_a_taxel_that_never_changes_is_not_looked_for():
    touch = "(0.0, 0.0, 0.0) mm, for taxel 7"
    assert calibrate.next_touches(found_with("PASS", ["", CONSTANT])) == []
    assert calibrate.next_touches(found_with("DOUBT", ["", CONSTANT])) == [touch]
    swept = [touch, "sweep for the 1 taxel without any reading"]
    assert calibrate.next_touches(found_with("PASS", ["", CONSTANT, "never read"])) == swept


@pytest.mark.slow
def test_held_out_contacts(log, tmp_path, capsys):
    out = tmp_path / "out"
    asked = ["calibrate", str(log), *known(log), "--young-kpa", "200", "--out", str(out)]
    assert cli.main([*asked, "--cross-validate", "2"]) == 0
    m = json.loads((out / "metrics.json").read_text())["cross_validation"]
    assert m["folds"] == 2
    assert m["error_mm"]["rms"] < 0.15 < 0.4 < m["centroid_error_mm"]["rms"]
    assert f"{m['localized']} of 600 contacts localized to" in capsys.readouterr().out
    figure = out / "figures" / "residuals.svg"
    written = {path: path.read_text() for path in (out / "report.html", figure)}
    for path in written:
        path.unlink()
    assert cli.main(["report", str(out)]) == 0
    assert "left out" not in capsys.readouterr().out
    for words in ("Held-out contacts", "Right: from the points of the held-out contacts"):
        for page in (written[out / "report.html"], (out / "report.html").read_text()):
            assert words in page
    assert abs(len(figure.read_text()) / len(written[figure]) - 1) < 0.01  # both panels


def test_readings_of_silent_taxels_are_not_counted(scene):
    """A dense table has a row for every taxel in every frame."""
    pressed = ms.press(scene, scene.skin.positions[:5], seed=1)
    rows, ids = np.meshgrid(pressed.time, scene.skin.ids, indexing="ij")
    dense = np.zeros(rows.shape)
    dense[pressed.reading_contact, np.searchsorted(scene.skin.ids, pressed.reading_taxel)] = 5e3
    columns = [rows.ravel(), ids.ravel().astype(np.int32), dense.ravel()]
    recording = replace(pressed, readings=pa.table(columns, schema=pressed.readings.schema))
    metrics = calibrate.assess(uncalibrated(recording, scene.belief()), recording)
    assert metrics["readings"] == len(pressed.pressure) < len(recording.pressure)
