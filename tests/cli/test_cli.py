"""The command line as a user meets it: results, one-line errors, exit codes, interruption."""

import contextlib
import json
import os
import re
import signal
import subprocess
import sys
import time
from dataclasses import replace

import numpy as np
import pytest

from meshskin import cli, pipeline
from meshskin.cli.options import in_options


def toml(tmp_path, text):
    file = tmp_path / "mine.toml"
    file.write_text(text)
    return str(file)


def fails(capsys, *arguments):
    """Run a command that must fail with exit code 2 and one line; return the line."""
    assert cli.main([*arguments]) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert lines[0].startswith("meshskin")
    return lines[0]


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """One run of the noisy sphere."""
    folder = tmp_path_factory.mktemp("run") / "out"
    assert cli.main(["run", "sphere_noisy", "--out", str(folder), "--seed", "3"]) == 0
    return folder


def test_a_run_leaves_everything(run):
    names = {file.name for file in run.iterdir()}
    assert {
        "recording.contacts.parquet",
        "recording.readings.parquet",
        "calibration.parquet",
        "calibration.csv",
        "metrics.json",
        "report.html",
        "figures",
    } <= names
    assert not [name for name in names if name.endswith((".part", ".probe"))]
    for figure in ("fig4_force", "fig5_estimates", "fig6_iteration", "errors", "coverage"):
        for suffix in (".png", ".svg"):
            assert (run / "figures" / (figure + suffix)).stat().st_size > 1000


def test_the_summary_counts_the_readings_that_were_used(run):
    """Fewer than were recorded where contacts or readings are left out."""
    from pathlib import Path
    from types import SimpleNamespace

    from meshskin.cli.run import summary
    from meshskin.estimation.calibration import Calibration
    from meshskin.recording.recording import Recording

    found = Calibration.load(run / "calibration")
    used = replace(found, readings=found.readings - 1)
    metrics = json.loads((run / "metrics.json").read_text())
    recording = Recording.load(run / "recording")
    given = {"metrics": metrics, "calibration": used, "recording": recording}
    said = summary(SimpleNamespace(**given), Path("out"))
    assert f"from {used.readings.sum()} of {metrics['readings']} readings in" in said
    assert "no result" not in said
    for method in ("posegraph", "posegraph_isotropic"):
        metrics[method] |= {"mean": None, "why": "too few pairs"}
    said = summary(SimpleNamespace(**given), Path("out"))
    assert "  no result        pose graph; pose graph, isotropic: too few pairs\n" in said


def test_the_table_of_a_calibration_stands_for_it_in_a_comparison(run, capsys):
    assert cli.main(["diff", str(run / "calibration.csv"), str(run)]) == 0
    assert "equal within 1 um" in capsys.readouterr().out


def test_the_help_of_calibrate_names_every_method(capsys):
    from meshskin.estimation.calibrate import METHODS

    assert cli.main(["calibrate", "--help"]) == 0
    words = set(re.findall(r"\w+", capsys.readouterr().out))
    assert set(METHODS) <= words


def test_metrics_hold_the_contract_and_the_paper_is_beaten(run):
    m = json.loads((run / "metrics.json").read_text())
    assert m["taxels"] == m["touched"] == 80
    assert m["coverage"] == {"planned": 80, "reached": 80, "given_up": 0}
    for key in ("position_error_mm", "trilateration", "posegraph", "centroid"):
        assert 0 < m[key]["mean"] <= m[key]["rms"] <= m[key]["max"]
    assert m["position_error_mm"]["mean"] == pytest.approx(m["crlb_mm"]["mean"], rel=0.25)
    assert m["nees_band"][0] * 0.9 < m["nees"] < m["nees_band"][1] * 1.1
    assert m["three_circles"]["mean"] > 8 * m["position_error_mm"]["mean"]
    assert m["posegraph_isotropic"]["mean"] > 2 * m["position_error_mm"]["mean"]
    assert m["centroid"]["mean"] > 8 * m["position_error_mm"]["mean"]
    methods = ("trilateration", "three_circles", "eq15", "posegraph", "posegraph_isotropic")
    worse = [k for k in (*methods, "posegraph_paper") if m[k]["mean"] > m["centroid"]["mean"]]
    assert m["worse_than_centroid"] == worse
    force = m["force"]
    assert force["mean_n"] == pytest.approx(force["reference_n"], rel=0.01)
    assert force["settling_s"] < 0.1
    assert force["lost_contact_steps"] == 0
    assert {"start", "load", "simulate", "calibrate", "report"} <= set(m["seconds"])
    assert m["steps_per_second"] > 0


def test_scenes_are_listed(capsys):
    assert cli.main(["scenes"]) == 0
    assert "sphere_noisy" in capsys.readouterr().out


def test_unknown_scene(capsys, tmp_path):
    line = fails(capsys, "run", "sfere", "--out", str(tmp_path))
    assert "unknown scene 'sfere'" in line
    assert "did you mean sphere" in line
    line = fails(capsys, "run", "nosuch.toml", "--out", str(tmp_path))
    assert "no such scene file, got nosuch.toml" in line
    (tmp_path / "handle.stl").write_text("")
    line = fails(capsys, "run", str(tmp_path / "handle.stl"), "--out", str(tmp_path))
    assert "a scene is a TOML file" in line
    assert "[body] mesh" in line


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ([], "meshskin: the following arguments are required: COMMAND; meshskin --help"),
        (["runn"], "invalid choice: 'runn'"),
        (["run", "sphere"], "meshskin run: the following arguments are required: --out;"),
        (["run", "sphere", "--out", "o", "--seed", "1.5"], "--seed: '1.5' is not an integer"),
        (["run", "sphere", "--out", "o", "--seconds", "a"], "--seconds: 'a' is not a number"),
    ],
)
def test_a_wrong_command_line_is_said_in_one_line(capsys, words, said):
    assert cli.main(words) == 2
    line = capsys.readouterr().err
    assert said in line
    assert line.count("\n") == 1


def test_a_file_that_is_not_what_a_command_takes_is_named(capsys, tmp_path):
    table, mesh = tmp_path / "log.csv", tmp_path / "body.stl"
    table.write_text("time,x\n0,1\n")
    mesh.write_bytes(b"solid \x9d\xff")
    assert "unknown format of a mesh, got 'csv'" in fails(capsys, "check", str(table))
    assert "body.stl is not a skin file, got binary data" in fails(capsys, "lint", str(mesh))
    robot = ["--body", str(mesh), "--units", "mm", "--indenter-radius-mm", "10", "--raw"]
    line = fails(capsys, "calibrate", str(table), *robot, "--out", str(tmp_path / "out"))
    assert f"needs a map that says what its columns are; meshskin init {table} writes one" in line


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (
            ["run", "sphere", "--seed", "-1"],
            "--seed: the number is out of range, got -1, limit: at least 0",
        ),
        (
            ["run", "sphere", "--accuracy-mm", "nan"],
            "--accuracy-mm: the number must be a finite number, got nan",
        ),
        (
            ["run", "sphere", "--seconds", "0"],
            "--seconds: the number is out of range, got 0, limit: above 0",
        ),
        (
            ["cost", "sphere", "--seeds", "0"],
            "--seeds: the number is out of range, got 0, limit: at least 1",
        ),
    ],
)
def test_a_number_out_of_range_is_refused_before_anything_runs(capsys, tmp_path, options, words):
    out = tmp_path / "out"
    assert words in fails(capsys, *options, "--out", str(out))
    assert not [file for file in out.glob("*") if file.is_file()]


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ('extends = "sphere"\n[body]\nradus_mm = 3', ["radus_mm", "did you mean radius_mm"]),
        ('extends = "sphere"\n[boddy]\nx = 3', ["boddy", "did you mean body"]),
        ('extends = "sphere"\n[body]\nradius_mm = -100', ["-0.1 m", "above 0 m"]),
        ('extends = "sphere"\n[body]\nradius_m = 100', ["200 m", "mm"]),
        (
            'extends = "sphere"\n[indenter]\nposition_m = [4, 0, 0.7]',
            ["(4.0, 0.0, 0.7)", "indenter"],
        ),
        (
            'extends = "sphere"\n[[effects]]\nkind = "gausian_noise"',
            ["did you mean gaussian_noise"],
        ),
        ('[body]\nfile = "a.stl"\n[skin]', ["unknown key 'file'", 'write mesh = "a.stl"']),
        ('extends = "sphere"\n[body]\nfile = "a.stl"', ["unknown key 'file'", "write mesh ="]),
        ("[body]\n[skin]", ['write mesh = "FILE"']),
        ('extends = "sphere"\n[body]\nshape = "cube"', ["unknown shape 'cube'"]),
        ("[body]\nradius_mm = \n[skin]", ["not valid TOML", "line 2"]),
    ],
)
def test_a_wrong_scene_file_is_one_clear_line(capsys, tmp_path, text, words):
    out = tmp_path / "out"
    line = fails(capsys, "run", toml(tmp_path, text), "--out", str(out))
    for word in words:
        assert word in line
    assert not out.exists() or not list(out.iterdir())


def test_a_mesh_without_faces(capsys, tmp_path):
    (tmp_path / "empty.stl").write_text("solid nothing\nendsolid nothing\n")
    text = '[body]\nmesh = "empty.stl"\nunits = "mm"\n[skin]\ncount = 10'
    line = fails(capsys, "run", toml(tmp_path, text), "--out", str(tmp_path / "out"))
    assert "no faces" in line


def test_a_folder_that_cannot_be_written(capsys, tmp_path):
    (tmp_path / "file").write_text("")
    line = fails(capsys, "run", "sphere", "--out", str(tmp_path / "file" / "out"))
    assert "cannot write" in line


@pytest.mark.skipif(sys.platform == "win32", reason="signals are POSIX")
@pytest.mark.parametrize(
    "wait", [0.6, *(pytest.param(k, marks=pytest.mark.slow) for k in (1.2, 2.0, 3.0))]
)
def test_ctrl_c_leaves_no_half_written_file(tmp_path, wait):
    """Interrupt at a moment of a run: whatever is there is whole, nothing is a part."""
    out, scene = tmp_path / "out", toml(tmp_path, 'extends = "sphere"\n[skin]\ncount = 12')
    process = subprocess.Popen(
        [sys.executable, "-m", "meshskin", "run", scene, "--out", str(out), "--quiet"],
        stderr=subprocess.PIPE,
        env=os.environ,
    )
    time.sleep(wait)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    if process.returncode == 0:
        return  # it was quicker than the interruption
    assert process.returncode in (130, -signal.SIGINT), err.decode()
    if process.returncode == 130:
        assert err.decode().strip().splitlines()[-1].startswith("meshskin: interrupted")
    left = [f.name for f in out.rglob("*")] if out.exists() else []
    assert not [name for name in left if name.endswith((".part", ".probe"))]
    parts = [name for name in left if name.startswith("recording.")]
    assert len(parts) in (0, 3)


@pytest.mark.slow
def test_a_method_that_finds_nothing_is_left_out_of_the_comparison(tmp_path, capsys):
    """One taxel alone has no displacements; its own place is found as ever."""
    text = 'extends = "sphere"\n[skin]\ncount = 1'
    out = tmp_path / "out"
    assert cli.main(["run", toml(tmp_path, text), "--out", str(out)]) == 0
    said = capsys.readouterr().out
    assert "1 of 1 taxels calibrated" in said
    assert "pose graph none" in said
    m = json.loads((out / "metrics.json").read_text())
    assert m["posegraph"]["mean"] is None
    assert "no two taxels are active together" in m["posegraph"]["why"]
    assert m["position_error_mm"]["max"] < 1e-3
    assert (out / "report.html").stat().st_size > 1e5


@pytest.mark.slow
def test_a_method_that_places_nothing_is_left_out_of_the_comparison(tmp_path, monkeypatch):
    """It returns, without an error of its own, a calibration in which no taxel has a place."""
    whole = pipeline.Estimation.without_verdict

    def places_nothing(estimation, method, progress):
        found = whole(estimation, method, progress)
        if method != "posegraph_paper":
            return found
        nowhere = np.full_like(found.poses, np.nan)
        why = np.full(len(found.ids), "shares too few contacts")
        return replace(found, poses=nowhere, reasons=why)

    monkeypatch.setattr(pipeline.Estimation, "without_verdict", places_nothing)
    drawn = {"figures_left_out": []}  # the test above draws them
    monkeypatch.setattr(pipeline, "_report", lambda _, result: result.metrics.update(drawn))
    text = 'extends = "sphere"\n[skin]\ncount = 7'
    assert cli.main(["run", toml(tmp_path, text), "--out", str(tmp_path / "out")]) == 0
    m = json.loads((tmp_path / "out" / "metrics.json").read_text())
    assert m["posegraph_paper"]["mean"] is None
    assert "shares too few contacts, got 0 placed, limit: 3" in m["posegraph_paper"]["why"]
    assert m["posegraph"]["mean"] is not None


def test_a_budget_that_nothing_resolves_is_refused_at_once(tmp_path, capsys):
    out = tmp_path / "out"
    assert cli.main(["run", "sphere_noisy", "--out", str(out), "--budget-mm", "1e-9"]) == 2
    assert "got 1e-09 mm, limit: at least 1e-06 mm" in capsys.readouterr().err
    assert not out.exists()


@pytest.mark.deep
def test_what_an_earlier_run_found_is_not_left_beside_another_recording(tmp_path, monkeypatch):
    from meshskin.core.errors import CalibrationError

    def fails(*_, **__):
        raise CalibrationError("nothing to see")

    for name in ("report.html", "metrics.json", "calibration.csv", "notes.txt"):
        (tmp_path / name).write_text("of an earlier run")
    monkeypatch.setattr(pipeline.Estimation, "calibrate", fails)
    text = 'extends = "sphere"\n[skin]\ncount = 3'
    assert cli.main(["run", toml(tmp_path, text), "--out", str(tmp_path), "--quiet"]) == 2
    kept = {file.name for file in tmp_path.iterdir()}
    assert "recording.contacts.parquet" in kept
    assert "notes.txt" in kept
    assert not {"report.html", "metrics.json", "calibration.csv"} & kept


def test_a_reader_that_ends_early_is_no_error():
    command = [sys.executable, "-m", "meshskin", "scenes"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
    process.stdout.close()
    assert process.stderr.read() == b""
    assert process.wait() == cli.CLOSED_PIPE


def test_an_interruption_that_a_library_swallows_still_ends_in_the_exit_code(monkeypatch, capsys):
    def swallow(options):
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
        return 0

    monkeypatch.setattr(cli.scenes, "command", swallow)
    assert cli.main(["scenes"]) == cli.INTERRUPTED
    assert capsys.readouterr().err.startswith("meshskin: interrupted")


def test_messages_name_options_of_the_command_line():
    text = (
        """estimate unknown=("modulus", "force_scale"); likely millimetres: units='mm', open=True"""
    )
    said = "estimate --unknown modulus force_scale; likely millimetres: --units mm, --open"
    assert in_options(text) == said
    assert in_options('unknown=("gain",)') == "--unknown gain"
    assert in_options("give from_urdf folders=, or") == "give --folder, or"


def test_unknown_arguments_lead_to_the_help_of_their_command(capsys):
    line = fails(capsys, "scenes", "sphere", "--all")
    told = "unknown arguments: sphere --all; meshskin scenes --help lists what it takes"
    assert line.strip() == f"meshskin scenes: {told}"
