"""The study of effects at a small size, pinned to what it is for."""

import json

import pytest


@pytest.mark.slow
def test_one_effect(script, tmp_path):
    asked = ["--seeds", "1", "--effects", "friction", "--json", str(tmp_path / "x.json")]
    found = script("effects").main([*asked, "--out", str(tmp_path)])
    assert json.loads((tmp_path / "x.json").read_text()) == found
    assert found["friction"]["shift_mm"] == pytest.approx(0.164, rel=0.1)
    assert found["friction"]["largest_mm"] <= found["friction"]["bound_mm"]


@pytest.mark.slow
def test_effects(script, tmp_path, capsys):
    names = ["body_pose", "friction"]
    asked = ["--seeds", "1", "--pairs", "--effects", *names, "--json", str(tmp_path / "x.json")]
    found = script("effects").main([*asked, "--out", str(tmp_path)])
    assert json.loads((tmp_path / "x.json").read_text()) == found
    for name in ("effects", "effect_pairs"):
        assert (tmp_path / f"{name}.png").stat().st_size > 10_000
    assert found["(none)"]["error_mm"] == pytest.approx(0.0092, rel=0.2)
    # the foot moves by R / (R + r) of the centre: 0.5 mm less an eighth, on the sphere
    assert found["body_pose"]["shift_mm"] == pytest.approx(0.459, rel=0.02)
    assert found["friction"]["shift_mm"] == pytest.approx(0.164, rel=0.1)
    for name in names:
        assert found[name]["largest_mm"] <= found[name]["bound_mm"]
    assert found["friction"]["chi2"] > 20 > 2 > found["body_pose"]["chi2"]
    assert found["body_pose+friction"]["excess_mm"] < 0.02
    assert "pairs that add up worst" in capsys.readouterr().out


@pytest.mark.slow
def test_quantisation_at_two_resolutions(script, tmp_path):
    """The shift is proportional to the step, 1/64 with 6 bits more; variants are not paired."""
    names = ["body_pose", "quantisation", "quantisation_16"]
    asked = ["--seeds", "1", "--pairs", "--effects", *names]
    found = script("effects").main([*asked, "--out", str(tmp_path)])
    assert 0 < found["quantisation_16"]["shift_mm"] < found["quantisation"]["shift_mm"] / 50
    assert "quantisation+quantisation_16" not in found


@pytest.mark.slow
def test_pairs_that_do_not_add_up(script, tmp_path):
    """Sampling hides among outlying readings, unless the model is off anyway (see the study)."""
    asked = ["--seeds", "1", "--pairs", "--effects", "sampling", "capacitive"]
    found = script("effects").main([*asked, "--out", str(tmp_path)])
    both = found["sampling+capacitive"]
    assert found["sampling"]["left_out"] == pytest.approx(22.7, abs=1.0)
    assert found["capacitive"]["left_out"] == 0.0
    assert both["left_out"] < 8.0
    assert found["sampling"]["median_mm"] == pytest.approx(0.014, rel=0.15)
    assert both["median_mm"] == pytest.approx(0.053, rel=0.15)
    assert both["excess_mm"] == pytest.approx(0.040, rel=0.15)
    assert both["excess_from_all_mm"] < 0.1 * both["median_mm"]
