"""The study of NAO's self-touch, with few splits, beside the published figures."""

import pytest

from ..real_data import DATA, needs_nao


@needs_nao
@pytest.mark.slow
def test_the_published_protocol_on_nao(script, tmp_path, capsys):
    """Published: 14.25 mm train, 15.73 mm test, on one split, with mounts free alone."""
    study = script("self_touch")
    study.CASES = study.CASES[:4]
    asked = ["--data", str(DATA), "--splits", "3", "--pairs", "leftArm_torso"]
    found = study.main([*asked, "--out", str(tmp_path)])
    selected, nearest, mounts, patches = found["leftArm_torso"]
    assert selected["train"] < 14.3
    assert selected["test"] < 15.7
    assert nearest["before"] == pytest.approx(18.2, abs=0.1)
    assert nearest["test"] < 14.0
    assert mounts["size"] == pytest.approx((1.0, 1.0))
    assert mounts["test"] < 10.0
    assert patches["train"] < mounts["train"]
    assert "22.34   14.25" in capsys.readouterr().out
    assert (tmp_path / "self_touch.png").stat().st_size > 10_000


def test_without_data_the_study_says_so(script, tmp_path, capsys):
    assert script("self_touch").main(["--data", str(tmp_path)]) == {}
    assert "is not there" in capsys.readouterr().out
