"""The study of consistency with few seeds: no unknown is missing or refused; its statistics."""

import json

import numpy as np
import pytest

from meshskin.estimation.data.global_parameters import LEARNED_ONLY, NUISANCE, SIZES


@pytest.fixture(scope="module")
def study(script):
    return script("consistency")


@pytest.mark.deep
def test_one_scene(study, tmp_path, capsys):
    asked = ["--scenes", "offsets", "--seeds", "2", "--json", str(tmp_path / "x.json")]
    found = study.main(asked)
    assert json.loads((tmp_path / "x.json").read_text()) == found
    assert {"position", "tilt", "gain", "offset", "modulus"} < set(found["offsets"])
    assert study.inconsistent(found) == []
    assert "by chance" in capsys.readouterr().out


def test_every_unknown_of_a_physical_contact_model_is_in_a_scene(study):
    learned = set(LEARNED_ONLY)  # studies/foreign_worlds.py has those
    declared = {name for case in study.cases().values() for name in case.belief.get("unknown", ())}
    modules = {name for name in NUISANCE if name.startswith("module")}
    shifts = {"patch_shift"}  # zero on the smooth bodies of these scenes
    assert declared >= {*SIZES, *NUISANCE} - learned - modules - shifts


@pytest.mark.slow
def test_few_seeds(study):
    found = study.main(["--seeds", "3"])
    assert {"position", "tilt", "gain", "offset", "modulus"} < set(found["offsets"])
    assert {"position", "tilt", "spin"} < set(found["modules"])
    assert len([name for name in found["body"] if name.startswith("body_offset")]) == 6
    seen = {name.split()[0] for rows in found.values() for name in rows}
    learned = set(LEARNED_ONLY)  # studies/foreign_worlds.py has those
    assert seen > {*SIZES, *NUISANCE} - learned  # every unknown of a physical contact model
    for name, rows in found.items():
        assert rows["fit"]["false_alarms"] == 0
        # chi-square over its degrees of freedom; the taxels of a seed are correlated, above all in
        # "body", where they share its offset, so that they count as one
        assert rows["position"]["p"] > 1e-3
        if name != "body":
            assert abs(rows["position"]["nees"] - 1) < 0.3
    refused = [words for words in study.inconsistent(found) if "rms" not in words]
    assert refused == []


def test_the_verdict_is_on_all_quantities_together(study):
    def rows(*p):
        return {str(k): {"nees": 1.2, "p": x} for k, x in enumerate(p)} | {"fit": {}}

    assert study.inconsistent({"a": rows(0.03, 0.02, 0.5), "b": rows(0.3)}) == []
    # 0.012 < 0.05 / 4, then 0.016 < 0.05 / 3, then 0.03 > 0.05 / 2
    words = study.inconsistent({"a": rows(0.016, 0.03, 0.5), "b": rows(0.012)})
    assert [w.split(",")[0] for w in words] == ["b: 0", "a: 0"]
    far = {"c": {"fit": {"rms_over_bound": 1.06}}}
    assert study.inconsistent(far) == ["c: rms / bound 1.060"]


def test_correlated_squares_count_as_fewer(study):
    rng = np.random.default_rng(0)
    alone = [rng.normal(size=50) ** 2 for _ in range(400)]
    assert study.design_effect(alone) == pytest.approx(1.0, abs=0.2)
    alike = [np.repeat(rng.normal(size=10) ** 2, 5) for _ in range(400)]
    assert study.design_effect(alike) == pytest.approx(5.0, rel=0.25)
    assert study.design_effect(alike[:9]) == 50


def test_the_band_has_its_stated_probability(study):
    rng, inside, refused = np.random.default_rng(1), 0, 0
    for _ in range(1000):
        row = study.band(float(np.mean(rng.normal(size=40) ** 2)), 40)
        inside += row["low"] < row["nees"] < row["high"]
        refused += row["p"] < 0.05
    assert inside == 1000 - refused
    assert 930 < inside < 970


@pytest.mark.slow
def test_two_hundred_seeds(study):
    found = study.main(["--full"])
    assert study.inconsistent(found) == []
    assert all(rows["fit"]["false_alarms"] <= 0.01 for rows in found.values())
