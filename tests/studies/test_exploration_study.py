"""The study of exploration at a small size, pinned to what it is for."""

import json

import pytest


@pytest.mark.slow
def test_exploration(script, tmp_path, capsys):
    asked = ["--pitch-mm", "6.5", "--count", "24", "--seeds", "1"]
    found = script("exploration").main(
        [*asked, "--out", str(tmp_path), "--json", str(tmp_path / "x.json")]
    )
    assert json.loads((tmp_path / "x.json").read_text()) == found
    assert (tmp_path / "exploration.png").stat().st_size > 10_000
    row = found["6.5"]
    assert row["worst_ratio_low"] <= row["worst_ratio"] <= row["worst_ratio_high"]
    # one seed and a small skin: the luck of a mean of 24 errors is some 15 %
    assert 0.3 < row["ratio"] < 0.85
    assert 0.4 < row["worst_ratio"] < 0.7
    # without the luck: above what no choice of contacts is below
    assert 0.4 < row["floor"] < row["expected_ratio"] < 0.7
    assert "at equal mean error" in capsys.readouterr().out
