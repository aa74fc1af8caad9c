"""The study of wrong beliefs with one seed: refused, and mended by declaring the unknown."""

import json

import pytest


@pytest.mark.slow
def test_beliefs(script, tmp_path, capsys):
    found = script("beliefs").main(
        ["--seeds", "1", "--json", str(tmp_path / "x.json"), "--out", str(tmp_path)]
    )
    assert (tmp_path / "beliefs.svg").stat().st_size > 1000
    assert json.loads((tmp_path / "x.json").read_text()) == found
    assert len(found) == 4
    for row in found.values():
        assert row["wrong_refused"] == 1.0
        assert row["declared_refused"] == 0.0
        assert row["declared"] < 1.2 < row["wrong"] * 1.1
        assert row["centroid"] > 2 * row["declared"]
    assert found["indenter 1 mm off"]["wrong"] > 10
    assert "declared" in capsys.readouterr().out
