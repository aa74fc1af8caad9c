"""Sweeps: the same table whatever the workers, and only what is new is run."""

import json
import os

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
import study_runs

import meshskin as ms
from meshskin.core.errors import ConfigError, StudyError
from meshskin.study.sweep.evaluate import evaluate

X = {"run.x": [0.5, 1.5]}


def marked(study_folder):
    """How often each case was run, by the marks that `study_runs.slow` leaves."""
    return len(list(study_folder.iterdir()))


@pytest.mark.deep
def test_the_table_does_not_depend_on_the_workers_bit_for_bit(tmp_path):
    study = ms.Study("s", grid=X, seeds=10, run=study_runs.plain)
    files = []
    for workers in (1, 3):
        table = study.sweep(tmp_path / str(workers), workers=workers)
        files.append((tmp_path / str(workers) / "table.parquet").read_bytes())
    assert files[0] == files[1]
    assert table.column("status").to_pylist() == ["done"] * 20
    expected = [np.sin(x * (1 + seed)) for x in X["run.x"] for seed in range(10)]
    assert table.column("y").to_pylist() == pytest.approx(expected, rel=1e-15)
    assert table.column("seed").to_pylist() == [*range(10)] * 2


@pytest.mark.slow
def test_scenes_give_the_same_numbers_in_any_process(out):
    grid = {"skin.count": [12], "method": ["joint", "posegraph"]}
    study = ms.Study("s", base="sphere_noisy", grid=grid)
    table = study.sweep(out, workers=1)
    here = evaluate(study.cases()[0])
    row = table.to_pylist()[0]
    assert {name: row[name] for name in here} == here
    assert row["status"] == "done"
    assert row["determined"] == 12
    assert row["verdict"] == "PASS"
    errors = table.column("position_error_mm.mean").to_pylist()
    assert 0 < errors[0] < errors[1] < 2, "the joint estimate is better than the pose graph"
    assert row["crlb_mm.mean"] / 2 < errors[0] < 2 * row["crlb_mm.mean"]


@pytest.mark.slow
def test_a_scene_made_in_python_gives_the_numbers_of_its_file(tmp_path):
    file = tmp_path / "few.toml"
    file.write_text('extends = "sphere_noisy"\n[skin]\ncount = 12\n')
    grid = {"material.young_kpa": [250], "exploration.lane_spacing_mm": [7]}
    rows = []
    for k, base in enumerate((file, ms.Scene.load(file))):
        (row,) = ms.Study("s", base=base, grid=grid).sweep(tmp_path / str(k)).to_pylist()
        rows.append({name: value for name, value in row.items() if name != "key"})
    assert rows[0] == rows[1]
    assert rows[0]["status"] == "done"


@pytest.mark.deep
def test_a_second_run_runs_only_the_cases_that_changed(out, tmp_path):
    (tmp_path / "marks").mkdir()
    own = {"run.marks": [str(tmp_path / "marks")], "run.sleep": [0.0]}

    def sweep(seeds=3, **grid):
        return ms.Study("s", grid=own | grid, seeds=seeds, run=study_runs.slow).sweep(out)

    first = sweep(**{"run.x": [1, 2]})
    assert marked(tmp_path / "marks") == 6
    assert sweep(**{"run.x": [1, 2]}).equals(first)
    assert marked(tmp_path / "marks") == 6
    sweep(**{"run.x": [1, 2, 3]})
    assert marked(tmp_path / "marks") == 9
    sweep(seeds=4, **{"run.x": [1, 2, 3]})
    assert marked(tmp_path / "marks") == 12
    assert sweep(**{"run.x": [1, 2]}).equals(first), "the others' results are kept, not shown"


@pytest.mark.deep
def test_tables_are_read_by_pandas_polars_and_duckdb(out):
    table = ms.Study("s", grid=X, seeds=3, run=study_runs.plain).sweep(out)
    path = out / "table.parquet"
    expected = table.column("y").to_pylist()
    assert pd.read_parquet(path)["y"].tolist() == expected
    assert pq.read_table(path).equals(table)
    assert len(pq.read_table(out / "times.parquet").column("seconds")) == 6
    polars = pytest.importorskip("polars")
    assert polars.read_parquet(path)["y"].to_list() == expected
    duckdb = pytest.importorskip("duckdb")
    rows = duckdb.sql(f"select y from '{path}' where seed = 1").fetchall()
    assert [y for (y,) in rows] == [expected[1], expected[4]]


def test_progress_counts_and_the_manifest_says_what_it_is(out):
    states = []
    study = ms.Study("s", grid=X, seeds=2, run=study_runs.plain)
    study.sweep(out, progress=states.append)
    assert [state.done for state in states] == [0, 1, 2, 3, 4]
    study.sweep(out, progress=states.append)
    assert (states[-1].kept, states[-1].done, states[-1].failed) == (4, 4, 0)
    manifest = json.loads((out / "study.json").read_text())
    assert manifest["cases"] == 4
    assert manifest["grid"] == [X]
    assert manifest["run"] == "study_runs:plain"


def test_the_table_of_an_unfinished_study_says_what_is_missing(out):
    small = ms.Study("s", grid=X, seeds=1, run=study_runs.plain)
    small.sweep(out)
    large = ms.Study("s", grid=X, seeds=2, run=study_runs.plain)
    assert large.table(out).column("status").to_pylist() == ["done", "missing", "done", "missing"]


def test_output_of_a_case_goes_to_standard_error(out, capfd):
    table = ms.Study("s", seeds=3, run=study_runs.chatty).sweep(out, workers=1)
    assert table.column("status").to_pylist() == ["done"] * 3
    assert "child" in capfd.readouterr().err


def test_workers_have_one_thread_and_a_fixed_hash_seed(out):
    table = ms.Study("s", seeds=6, run=study_runs.surroundings).sweep(out, workers=3)
    assert set(table.column("threads").to_pylist()) == {"1"}
    assert len(set(table.column("hashes").to_pylist())) == 1
    assert set(table.column("parent").to_pylist()) == {os.getpid()}


def test_a_function_that_workers_cannot_import_is_refused(out):
    def inner(case):
        return {}

    for run in (inner, lambda case: {}):
        with pytest.raises(StudyError, match="cannot import the run function"):
            ms.Study("s", run=run).sweep(out)
    with pytest.raises(ConfigError, match="at least 1"):
        ms.Study("s", run=study_runs.plain).sweep(out, workers=0)


def test_a_study_is_a_toml_file(tmp_path):
    (tmp_path / "mine.toml").write_text('extends = "sphere"\n[material]\nyoung_kpa = 150\n')
    (tmp_path / "study.toml").write_text(
        'base = "mine.toml"\nseeds = [4, 5]\ntime_limit_s = 60\nmemory_limit_mb = 900\n'
        "[grid]\nskin.count = [10, 20]\n"
        '"effects.gaussian_noise.sigma_relative" = [0.01]\nmethod = ["joint", "trilateration"]\n'
    )
    study = ms.Study.load(tmp_path / "study.toml")
    cases = study.cases()
    assert (study.name, study.time_limit, study.memory_limit) == ("study", 60.0, 9e8)
    assert len(cases) == 8
    assert cases[0].scene.material.young == pytest.approx(150e3)
    assert [*cases[0].parameters] == ["skin.count", "effects.gaussian_noise.sigma_relative"]
    (tmp_path / "study.toml").write_text('run = "study_runs:plain"\n[[grid]]\nrun.x = [1]\n')
    assert ms.Study.load(tmp_path / "study.toml").run is study_runs.plain
    for text, line in [
        ("[gird]\n", "did you mean grid"),
        ("seeds = 3\n", "lacks grid"),
        ('seeds = "many"\n[grid]\n', "number or a list"),
        ("grid = 3\n", "must be a table"),
        ('run = "plain"\n[grid]\n', "package.module:function"),
        ('run = "no_such:plain"\n[grid]\n', "cannot import"),
        ('run = "study_runs:no"\n[grid]\n', "no function no"),
        ("time_limit_s = -1\n[grid]\n", "above 0"),
    ]:
        (tmp_path / "study.toml").write_text(text)
        with pytest.raises((ConfigError, StudyError), match=line):
            ms.Study.load(tmp_path / "study.toml")


@pytest.mark.deep
def test_a_run_function_can_be_in_a_file_next_to_the_study(tmp_path, out):
    (tmp_path / "mine.py").write_text("def run(case):\n    return {'y': 2 * case.own['x']}\n")
    file = tmp_path / "study.toml"
    file.write_text('run = "mine.py:run"\n[grid]\nrun.x = [1, 2]\n')
    before = ms.Study.load(file)
    table = before.sweep(out)
    assert table.column("y").to_pylist() == [2, 4]
    (tmp_path / "mine.py").write_text("def run(case):\n    return {'y': 30 * case.own['x']}\n")
    after = ms.Study.load(file)
    assert after.cases()[0].key != table.column("key").to_pylist()[0]
    assert after.sweep(out).column("y").to_pylist() == [30, 60]
    file.write_text('run = "none.py:run"\n[grid]\n')
    with pytest.raises(StudyError, match="cannot read the script"):
        ms.Study.load(file)


def test_numpy_arrays_can_be_in_a_grid(out):
    study = ms.Study(
        "s", grid={"run.x": np.linspace(0, 1, 3)}, seeds=np.arange(2), run=study_runs.plain
    )
    plain = ms.Study("s", grid={"run.x": [0.0, 0.5, 1.0]}, seeds=2, run=study_runs.plain)
    assert [c.key for c in study.cases()] == [c.key for c in plain.cases()]
    assert study.sweep(out).column("run.x").to_pylist() == [0.0, 0.0, 0.5, 0.5, 1.0, 1.0]


def test_the_shipped_study_has_its_cases():
    from pathlib import Path

    study = ms.Study.load(Path(__file__).parents[2] / "studies" / "noise.toml")
    assert len(study.cases()) == 45


@pytest.mark.parametrize("seeds", [2.5, "12", None])
def test_invalid_seeds_are_refused(seeds):
    with pytest.raises(ConfigError, match="seeds must be whole numbers, or their number, got"):
        ms.Study("s", grid=X, seeds=seeds, run=study_runs.plain)
