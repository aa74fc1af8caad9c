"""The study of co-activation on one shipped scene: within half a pitch, and the gauge matters."""

import pytest


@pytest.mark.slow
def test_a_shipped_scene_is_laid_out_within_half_a_pitch(script, tmp_path, capsys):
    study = script("coactivation")
    found = study.main(["--data", str(tmp_path), "--scenes", "sphere_noisy"])["scenes"][
        "sphere_noisy"
    ]
    assert found["body"] < 1.0
    assert found["body, middle known"] < 1.0
    assert found["body"] < found["plane"] < 2.5
    assert found["body"] < found["body: sigma"]
    assert "no torso" in capsys.readouterr().out
