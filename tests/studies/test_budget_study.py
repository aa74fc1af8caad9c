"""The study of the error budget: its scenes, and, at a small size, whether it keeps its word."""

import json

import numpy as np
import pytest


@pytest.fixture(scope="module")
def study(script):
    return script("budget")


@pytest.mark.deep
def test_random_scenes_are_the_same_every_time(study):
    one, again, other = study.random_scene(9), study.random_scene(9), study.random_scene(10)
    np.testing.assert_array_equal(one.skin.positions, again.skin.positions)
    assert one.candidates == again.candidates
    assert one.candidates != other.candidates
    assert 7 <= len(one.candidates) <= 13


def test_effects_are_drawn_between_a_third_and_three_times_their_size(study):
    rng = np.random.default_rng(0)
    sizes = [study.scaled_effect("body_pose", rng).translation[0] / 5e-4 for _ in range(100)]
    assert 1 / 3 <= min(sizes) < 0.5
    assert 2 < max(sizes) <= 3


@pytest.mark.slow
def test_a_study_continues_from_stored_rows(study, tmp_path, capsys, monkeypatch):
    """Rows of the same budget are kept; another budget measures anew."""
    ran = []

    def row(scene, error):
        ran.append((scene.name, error))
        found = {
            "budget_mm": 1e3 * error,
            "estimate_mm": 0.1,
            "true_mm": 0.1,
            "faster": 4.0,
            "lost": 0,
        }
        return found | {"seconds": 1.0, "off": []}

    monkeypatch.setattr(study, "measure_scene", row)
    asked = ["--scenes", "sphere", "--random", "1", "--first", "9", "--out", str(tmp_path)]
    asked += ["--json", str(tmp_path / "x.json")]
    first = study.main(asked)
    (tmp_path / "x.json").write_text(json.dumps({"random 9": first["random 9"]}))
    assert study.main(asked) == first
    assert [name for name, _ in ran] == ["sphere", "random 9", "sphere"]
    study.main([*asked, "--budget-mm", "0.1"])
    assert len(ran) == 5
    assert "least 4.0 times faster" in capsys.readouterr().out


@pytest.mark.slow
def test_prices_can_be_measured(study, capsys):
    """What the budget reckons with is in proportion to what things take."""
    found = study.main(["--prices"])["prices"]
    assert set(found) == set(study.SECONDS)
    assert all(value > 0 for value in found.values())
    assert capsys.readouterr().out.count("reckoned with") == len(found)


@pytest.mark.slow
def test_the_true_error_is_within_the_budget(study, tmp_path, capsys):
    file = tmp_path / "x.json"
    asked = ["--scenes", "sphere_noisy", "--first", "8", "--random", "2"]
    rows = study.main([*asked, "--out", str(tmp_path), "--json", str(file)])
    assert json.loads(file.read_text()) == rows
    for row in rows.values():
        assert 0.5 < row["estimate_mm"] / row["true_mm"] < 2.0
        assert row["true_mm"] < 1.2 * 0.2
    assert "within a factor of 2: 100 %" in capsys.readouterr().out
    assert (tmp_path / "budget.png").stat().st_size > 10_000
