"""The table of wrong logs: its rows are those of the calibration, and say what is wrong."""

import csv

import pytest


@pytest.mark.deep
def test_the_table(script, tmp_path, capsys):
    names = ["sound", "pressures 2 times too large", "contact points 1 mm aside"]
    found = script("wrong_logs").main(
        ["--out", str(tmp_path), "--contact", "hertz", "--logs", *names]
    )
    sound, large, aside = found
    assert sound["verdict"] == "PASS"
    assert sound["error_mm"] == pytest.approx(sound["sigma_mm"], rel=0.2)
    assert large["verdict"] == "FAIL"
    assert large["error_mm"] < 3 * large["sigma_mm"]  # sigma is widened by the misfit
    assert aside["verdict"] == "DOUBT"
    assert aside["error_mm"] == pytest.approx(1.0, rel=0.02)  # no reading shows it
    assert "moved by (-1," in aside["reason"]
    assert not any(row["learned"] for row in found)
    written = list(csv.DictReader((tmp_path / "wrong_logs.csv").open()))
    assert [row["log"] for row in written] == names
    assert float(written[1]["sigma_mm"]) == large["sigma_mm"]
    assert "FAIL: the model does not fit" in capsys.readouterr().out


@pytest.mark.slow
def test_the_learned_response_mends_a_scale(script, tmp_path):
    study = script("wrong_logs")
    (row,) = study.main(["--out", str(tmp_path), "--logs", "pressures 2 times too large"])
    assert row["learned"]
    assert row["error_mm"] < 0.03


@pytest.mark.parametrize("frames", [1, 3])
def test_late_readings_belong_to_earlier_contacts(script, frames):
    study = script("wrong_logs")
    sound = study.press(study.ms.Scene.load("sphere_noisy"), 0)
    made = study.late(frames)(sound)
    kept = sound.reading_contact + frames < len(sound.time)
    assert (made.reading_contact == sound.reading_contact[kept] + frames).all()
    assert (made.pressure == sound.pressure[kept]).all()
