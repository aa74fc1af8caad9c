"""Calibration of a log of raw counts from the command line."""

import contextlib
import io
import json
import re

import numpy as np
import pytest

import meshskin as ms
from meshskin import cli

from .csv_log import write_log

LEVELS = 255


@pytest.fixture(scope="module")
def scene():
    return ms.Scene.load("sphere_noisy")


@pytest.fixture(scope="module")
def pressed(scene):
    rng = np.random.default_rng(0)
    near = rng.normal(scale=4e-3, size=(150, 3))
    return ms.press(scene, scene.skin.positions.mean(axis=0) + near, seed=1)


def counts(pressure):
    """8-bit counts that saturate."""
    return np.round(1.2 * LEVELS * pressure / (pressure + pressure.max()))


@pytest.fixture(scope="module")
def log(tmp_path_factory, scene, pressed):
    folder = tmp_path_factory.mktemp("raw")
    scene.body.mesh.export(folder / "ball.stl")
    return write_log(folder / "log", pressed, counts(pressed.pressure), "count")


@pytest.fixture(scope="module")
def known(log):
    ball = str(log.parent / "ball.stl")
    return ["--body", ball, "--units", "m", "--indenter-radius-mm", "10"]


@pytest.fixture(scope="module")
def learned(log, known):
    """The folder of the results, and what was printed in printed.txt."""
    out, printed = log.parent / "out", io.StringIO()
    with contextlib.redirect_stdout(printed):
        assert cli.main(["calibrate", str(log), *known, "--raw", "--out", str(out)]) == 0
    (out / "printed.txt").write_text(printed.getvalue(), encoding="utf-8")
    return out


@pytest.mark.deep
def test_counts_need_no_modulus_and_no_unit(scene, learned):
    out = learned
    found = ms.Calibration.load(out / "calibration")
    truth = dict(zip(scene.skin.ids, scene.skin.positions, strict=True))
    often = found.readings > 15
    off = np.array([p - truth[k] for k, p in zip(found.ids, found.positions, strict=True)])
    off = np.linalg.norm(off, axis=1)[often]
    assert often.sum() > 12
    assert np.sqrt(np.mean(off**2)) < 0.05e-3
    said = (out / "printed.txt").read_text(encoding="utf-8")
    assert "None" not in said
    m = json.loads((out / "metrics.json").read_text())
    assert m["modulus_pa"] is None
    assert m["response"]["unit"] == "counts"
    assert 0.1 < m["response"]["noise"] < 10
    assert "learned with the taxels" in said
    assert re.search(r"readings have noise of [\d.]+ counts", said)
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "Learned response of the taxels" in page
    assert re.search(r"Readings have noise of [\d.]+ counts", page)


@pytest.mark.usefixtures("no_figures")
def test_the_baseline_stands_beside_the_estimate_from_counts(scene, log, known, tmp_path, learned):
    asked = ["calibrate", str(log), *known, "--raw", "--method", "centroid"]
    assert cli.main([*asked, "--out", str(tmp_path / "baseline")]) == 0
    baseline = ms.Calibration.load(tmp_path / "baseline" / "calibration")
    found = ms.Calibration.load(learned / "calibration")
    found.report(tmp_path / "r.html", truth=scene.skin, comparisons={"centroid": baseline})
    page = (tmp_path / "r.html").read_text(encoding="utf-8")
    assert "centroid of contact points" in page
    assert "Mean error above that of the baseline" not in page


def test_raw_readings_are_not_taken_for_pascals(log, known, tmp_path, capsys):
    asked = ["calibrate", str(log), *known, "--young-kpa", "150", "--out", str(tmp_path / "out")]
    assert cli.main(asked) == 2
    assert 'give the belief readings="raw" (--raw)' in capsys.readouterr().err


def test_counts_in_the_column_of_pressures_are_named(pressed, log, known, tmp_path, capsys):
    mixed = write_log(tmp_path / "log", pressed, counts(pressed.pressure), "pressure")
    asked = ["calibrate", str(mixed), *known, "--young-kpa", "150", "--out", str(tmp_path / "out")]
    assert cli.main(asked) == 2
    said = capsys.readouterr().err
    assert "the pressures cannot be in Pa" in said
    assert "--raw" in said


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (["--noise-kpa", "1"], "got --noise-kpa together with --raw; remove it"),
        (["--threshold-kpa", "1", "--saturation-kpa", "9"], "--threshold-kpa, --saturation-kpa"),
        (["--contact", "hertz"], "got --contact together with --raw"),
        (["--modules"], "got --modules together with --raw"),
    ],
)
def test_options_that_mean_nothing_for_raw_readings(log, known, tmp_path, capsys, options, words):
    asked = ["calibrate", str(log), *known, "--raw", *options, "--out", str(tmp_path / "out")]
    assert cli.main(asked) == 2
    lines = capsys.readouterr().err.strip().splitlines()
    assert len(lines) == 1
    assert re.search(re.escape(words), lines[0])


@pytest.mark.usefixtures("no_figures")
def test_a_scene_gives_the_body_but_no_pressures(log, tmp_path):
    """The scene's threshold in Pa is above every count."""
    out = tmp_path / "out"
    asked = ["calibrate", str(log), "--scene", "sphere_noisy", "--raw", "--method", "centroid"]
    assert cli.main([*asked, "--out", str(out)]) == 0
    assert np.isfinite(ms.Calibration.load(out / "calibration").positions).any()
