"""The study of the tuning at a small size: without an arm, readings 4 ms late."""

import json

import pytest


@pytest.mark.slow
def test_tuning(script, tmp_path, capsys):
    small = ["--scenes", "sphere", "--quasi-static", "--delay", "4", "--distance", "5"]
    rest = ["--points", "2", "--out", str(tmp_path), "--json", str(tmp_path / "found.json")]
    found = script("tuning").main([*small, *rest])
    assert json.loads((tmp_path / "found.json").read_text()) == found
    sphere, trade = found["sphere"], found["trade"]
    before, after = sphere["settling_ms"]
    assert after <= 0.5 * before
    assert sphere["overshoot"][1] <= sphere["overshoot"][0] + 2e-5
    assert sphere["cvodes_settling_ms"] == sphere["settling_ms"]  # there is no arm to integrate
    own, *allowed = found["overshoot"]
    assert own["settling_ms"] == before
    assert allowed[0]["settling_ms"] >= allowed[-1]["settling_ms"]
    assert sphere["time_s"][1] < 0.5 * sphere["time_s"][0]
    assert sphere["difference"] < 0.02
    assert "overshoot" in sphere["binding"]
    assert trade[0]["time_s"] <= trade[1]["time_s"] + 1e-3
    assert trade[1]["force_error"] <= 1.01 * trade[0]["force_error"]
    assert all(row["simulated_error"] <= 1.1 * row["force_error"] + 1e-3 for row in trade)
    assert {"fig4_tuned_sphere.png", "tuning_trade.png"} <= {f.name for f in tmp_path.iterdir()}
    assert "predicted and simulated force agree" in capsys.readouterr().out
