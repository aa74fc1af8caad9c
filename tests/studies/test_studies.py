"""Every study runs at a small size and is pinned to the numbers that it is for."""

import pytest


def test_paper_figures(script, tmp_path, capsys):
    found = script("paper_figures").main(["--out", str(tmp_path), "--seeds", "2"])
    assert {f"fig{k}.{kind}" for k in range(4, 10) for kind in ("png", "svg")} == {
        file.name for file in tmp_path.iterdir()
    }
    assert found["force_n"] == pytest.approx(3.0, rel=1e-3)
    assert found["ideal_mm"] < 1e-3
    assert found["minima"] == 1.0
    # 14 displacements a taxel leave about a fifth of a chained start's error
    assert 0.7 < found["least_improvement"] < 0.9
    assert "fig. 9" in capsys.readouterr().out
