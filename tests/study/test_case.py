"""Cases: what they are made of, and what their hash sees."""

import importlib
from dataclasses import replace

import numpy as np
import pytest
import study_runs

import meshskin as ms
from meshskin.core.errors import ConfigError, StudyError, UnknownNameError
from meshskin.core.se3 import transform
from meshskin.study.sweep.base_scene import changed_tables, source_text
from meshskin.study.sweep.case import checked_results, environment, source_digest

NOISE = "effects.gaussian_noise.sigma_relative"


def keys(**options):
    """The keys of a study's cases."""
    return [case.key for case in ms.Study("s", **{"base": "sphere", **options}).cases()]


def test_the_grid_is_the_product_of_its_lists_and_the_seeds():
    study = ms.Study(
        "s", base="sphere", grid={"material.young_kpa": [100, 200], NOISE: [0.01]}, seeds=[3, 5]
    )
    cases = study.cases()
    assert [(c.parameters["material.young_kpa"], c.seed) for c in cases] == [
        (100, 3),
        (100, 5),
        (200, 3),
        (200, 5),
    ]
    assert len({c.key for c in cases}) == 4


def test_several_grids_are_joined_without_duplicate_cases():
    grids = [{"material.young_kpa": [100, 200]}, {"material.young_kpa": [200, 300]}]
    assert keys(grid=grids) == keys(grid={"material.young_kpa": [100, 200, 300]})


def test_the_hash_sees_what_defines_a_case_and_nothing_else():
    base = keys(grid={"material.young_kpa": [200]})
    assert base == keys(), "the value that the scene has anyway"
    assert base == keys(grid={"material.young_kpa": [np.float64(200.0)]}, time_limit=5.0)
    assert base == keys(grid={"method": ["joint"]})
    others = [
        keys(grid={"material.young_kpa": [201]}),
        keys(seeds=[1]),
        keys(method="posegraph"),
        keys(grid={"belief.material.young_kpa": [200]}),
        keys(run=study_runs.plain),
        keys(run=study_runs.plain, version="2"),
        keys(run=study_runs.plain, grid={"run.x": [1]}),
        keys(grid={"effects.gaussian_noise": [True]}),
        keys(base="sphere_noisy"),
    ]
    assert len({*base, *(k for other in others for k in other)}) == 1 + len(others)


def test_the_hash_sees_the_source_of_the_package(tmp_path):
    (tmp_path / "__pycache__").mkdir()
    (tmp_path / "a.py").write_text("x = 1\n")
    before = source_digest.__wrapped__(tmp_path)
    (tmp_path / "__pycache__" / "a.pyc").write_bytes(b"compiled")
    assert source_digest.__wrapped__(tmp_path) == before
    (tmp_path / "a.py").write_text("x = 2\n")
    edited = source_digest.__wrapped__(tmp_path)
    (tmp_path / "a.py").rename(tmp_path / "b.py")
    renamed = source_digest.__wrapped__(tmp_path)
    assert len({before, edited, renamed}) == 3
    (tmp_path / "bodies").mkdir()  # in a wheel, not in a checkout
    (tmp_path / "bodies" / "sphere.toml").write_text("")
    assert source_digest.__wrapped__(tmp_path) == renamed
    assert environment()["source"] == source_digest()


def test_the_hash_sees_the_content_of_files_not_their_place(tmp_path):
    scene = '[body]\nmesh = "b.stl"\n[skin]\ncount = 9\ndisc_radius_mm = 1\n'
    found = []
    for folder, subdivisions in (("one", 1), ("two", 1), ("three", 2)):
        (tmp_path / folder).mkdir()
        (tmp_path / folder / "s.toml").write_text(scene)
        import trimesh

        trimesh.creation.icosphere(subdivisions).export(tmp_path / folder / "b.stl")
        found += keys(base=tmp_path / folder / "s.toml")
    assert found[0] == found[1] != found[2]


@pytest.mark.deep
def test_the_hash_is_the_same_in_another_process():
    import subprocess
    import sys

    code = "import meshskin as ms; print(ms.Study('s', base='sphere', seeds=1).cases()[0].key)"
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.split() == keys(seeds=1)


@pytest.mark.parametrize(
    ("grid", "line"),
    [
        ({"materal.young_kpa": [1]}, "did you mean material"),
        ({"material.yong_kpa": [1]}, "did you mean"),
        ({"material.young": [1]}, "needs a unit"),
        ({"skin.spacing_mm": [-5]}, "above 0"),
        ({"body.radius_mm": [100, 0]}, "above 0"),
        ({"effects.gausian_noise.sigma_relative": [1]}, "did you mean gaussian_noise"),
        ({"effects.gaussian_noise": [3]}, "on or off"),
        ({"belief.materal.young_kpa": [1]}, "did you mean material"),
        ({"material": [3]}, "names no quantity"),
        ({"method": ["join"]}, "did you mean joint"),
        ({"seed": [3]}, "cannot be in the grid"),
        ({"material.young_kpa": 3}, "must be a list"),
        ({"material.young_kpa": []}, "has no values"),
    ],
)
def test_a_grid_that_does_not_fit_the_scene_is_refused_before_anything_runs(grid, line):
    with pytest.raises((ConfigError, UnknownNameError), match=line):
        keys(grid=grid)


def test_a_study_without_a_scene_is_refused_before_anything_runs():
    with pytest.raises(ConfigError, match="has no scene; give it a base"):
        ms.Study("bare", grid={"a": [1]}).cases()


def test_effects_are_changed_added_and_removed():
    noise = {"kind": "gaussian_noise", "sigma_relative": 0.01}
    assert changed_tables({}, {NOISE: 0.01})["effects"] == [noise]
    with_noise = {"effects": [noise]}
    assert changed_tables(with_noise, {NOISE: 0.02})["effects"][0]["sigma_relative"] == 0.02
    assert changed_tables(with_noise, {"effects.gaussian_noise": False})["effects"] == []
    added = changed_tables({}, {"effects.gaussian_noise": True})
    assert added["effects"] == [{"kind": "gaussian_noise"}]
    assert noise["sigma_relative"] == 0.01, "the base is as it was"


def test_parameters_reach_the_scene_and_the_belief():
    grid = {
        "material.young_mpa": [0.3],
        "skin.count": [12],
        "belief.material.young_kpa": [250],
        NOISE: [0.03],
        "run.x": [7],
    }
    (case,) = ms.Study("s", base="sphere", grid=grid).cases()
    assert case.scene.material.young == pytest.approx(0.3e6)
    assert len(case.scene.skin.ids) == 12
    assert case.scene.effects[0].sigma_relative == 0.03
    assert case.belief.material.young == pytest.approx(0.25e6)
    assert case.own == {"x": 7}


def test_a_scene_made_in_python_can_be_the_base(sphere):
    import pickle

    finer = ms.Body.sphere(0.1, faces=20_480)
    study = ms.Study("s", base=sphere, grid={"material.young_kpa": [200, 300], NOISE: [0.01]})
    first, second = study.cases()
    assert second.scene.material.young == pytest.approx(300e3)
    assert second.scene.skin is sphere.skin
    assert first.key != second.key
    again = pickle.loads(pickle.dumps(first.base))
    assert again.identity(first.parameters) == first.base.identity(first.parameters)
    np.testing.assert_array_equal(
        again.scene({}).body.closest([[0.0, 0.02, 0.13]]).point,
        sphere.body.closest([[0.0, 0.02, 0.13]]).point,
    )
    raised = sphere.with_(arm=sphere.arm.with_base(transform(np.eye(3), [0.0, 0.0, 0.1])))
    assert ms.Study("s", base=raised, grid=study.grid).cases()[0].key != first.key
    for body in (replace(sphere.body, degree=3), replace(sphere.body, robot_mesh=finer.mesh)):
        other = ms.Study("s", base=sphere.with_(body=body), grid=study.grid)
        assert other.cases()[0].key != first.key, "degree and facets change results"
    with pytest.raises(ConfigError, match="keeps its skin"):
        ms.Study("s", base=sphere, grid={"skin.spacing_mm": [5]}).cases()


def test_results_of_a_run_function_are_checked():
    assert checked_results({"a": np.float64(1.5), "b": np.int32(2), "c": None, "d": True}, {}) == {
        "a": 1.5,
        "b": 2,
        "c": None,
        "d": True,
    }
    assert isinstance(checked_results({"big": 2**70}, {})["big"], float)
    for bad in ([1.0], {"a": [1, 2]}, {"a": np.zeros(3)}, {"seed": 1}, {"p": 1}):
        with pytest.raises(StudyError):
            checked_results(bad, {"p": 3})


@pytest.mark.parametrize("options", [{"time_limit": 0}, {"memory_limit": -1}, {"seeds": [-1]}])
def test_limits_and_seeds_are_checked(options):
    with pytest.raises(ConfigError):
        ms.Study("s", **options)
    with pytest.raises(ConfigError, match="no cases"):
        ms.Study("s", seeds=0).cases()


OWN = """
from dataclasses import dataclass
from meshskin.effects import BaseEffect

@dataclass(frozen=True)
class Scaled(BaseEffect, stage="transducer", cost=1e-9):
    factor: float = 2.0

    def bound(self, context):
        return 1e-3

    def build(self, context):
        return lambda pressures, frames: self.factor * pressures
"""


def test_a_study_changes_an_effect_of_the_program_and_knows_its_source(
    sphere, tmp_path, monkeypatch
):
    monkeypatch.syspath_prepend(str(tmp_path))
    found = []
    for k, text in enumerate((OWN, OWN.replace("self.factor *", "-self.factor *"), OWN)):
        (tmp_path / f"own_{k}.py").write_text(text)
        own = importlib.import_module(f"own_{k}")
        study = ms.Study(
            "s", base=sphere.with_(effects=(own.Scaled(),)), grid={"effects.scaled.factor": [3.0]}
        )
        found += study.cases()
    assert found[0].scene.effects[0].factor == 3.0
    assert found[0].key == found[2].key != found[1].key


@pytest.mark.parametrize("base", ["object", "file"])
def test_an_effect_that_the_grid_adds_is_known_by_its_source(sphere, tmp_path, monkeypatch, base):
    monkeypatch.syspath_prepend(str(tmp_path))
    keys = []
    for k, text in enumerate((OWN, OWN.replace("self.factor *", "-self.factor *"), OWN)):
        name = f"added_{base}_{k}"
        (tmp_path / f"{name}.py").write_text(text.replace("Scaled", "Added"))
        importlib.import_module(name)
        study = ms.Study(
            "s", base=sphere if base == "object" else "sphere", grid={"effects.added.factor": [3.0]}
        )
        keys += [case.key for case in study.cases()]
    assert keys[0] == keys[2] != keys[1]


def test_the_source_of_a_class_without_a_file_is_that_of_its_functions():
    """As of a class in a cell of a notebook, whose module is __main__."""

    class Cell:
        def build(self):
            return 1

    Cell.__module__ = "__main__"
    assert source_text(Cell).strip().startswith("def build")
