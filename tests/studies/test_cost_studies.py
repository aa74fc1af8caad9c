"""Studies of accuracy against time and of the skin's design, at a small size."""

import json

import pytest


@pytest.mark.slow
def test_accuracy_cost(script, tmp_path, capsys):
    asked = ["--scenes", "sphere_noisy", "--knobs", "dt", "--asked"]
    found = script("accuracy_cost").main([*asked, "--out", str(tmp_path)])["sphere_noisy"]
    # the estimate is efficient, and the mean of 80 taxels scatters by 6 % about its bound
    assert found["error_mm"] == pytest.approx(found["bound_mm"], rel=0.2)
    assert 0 < found["numerical_mm"] < 0.1 * found["bound_mm"], "the step is far below the noise"
    assert max(found["routes_mm"].values()) < 0.004
    assert 0 < found["cheapest_seconds"]["0.1"] <= found["seconds"]
    assert found["cheapest_seconds"]["0.01"] is None, "the step alone does not get there"
    for name in ("accuracy_cost", "accuracy_cost_sphere_noisy"):
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000
    assert "fastest setting" in capsys.readouterr().out


def test_measurements_are_stored(script, tmp_path):
    """A resumed study measures nothing again, unless it is asked for something else."""
    module, ran = script("accuracy_cost"), []

    def measure():
        ran.append(1)
        return {"x": float("nan"), "n": len(ran)}

    file = tmp_path / "out" / "x.json"
    assert module.stored_or_measured(file, {"seeds": 1}, True, measure)["n"] == 1
    assert module.stored_or_measured(file, {"seeds": 1}, True, measure)["n"] == 1
    assert module.stored_or_measured(file, {"seeds": 3}, True, measure)["n"] == 2
    assert module.stored_or_measured(file, {"seeds": 3}, False, measure)["n"] == 3


@pytest.mark.slow
def test_skin_design(script, tmp_path, capsys):
    asked = ["--seeds", "1", "--only", "thickness_mm"]
    file = tmp_path / "x.json"
    module = script("skin_design")
    module.VALUES = {"thickness_mm": (3.0, 20.0)}
    found = module.main([*asked, "--out", str(tmp_path), "--json", str(file)])
    assert json.loads(file.read_text()) == found
    thin, thick = found["thickness_mm"]
    assert thin["thick_mm"] > 1.1 * thin["joint_mm"], "a thin layer is no half-space"
    assert thick["thick_mm"] == pytest.approx(thick["joint_mm"], rel=0.02)
    for row in (thin, thick):
        assert row["joint_mm"] == pytest.approx(row["bound_mm"], rel=0.2)
    assert (tmp_path / "skin_design.png").stat().st_size > 10_000
    assert "as if thick" in capsys.readouterr().out
