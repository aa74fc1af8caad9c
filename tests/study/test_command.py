"""`meshskin study`, as a user meets it."""

import contextlib
import signal

import pyarrow.parquet as pq
import pytest

from meshskin import cli


@pytest.fixture
def study(tmp_path):
    """Writes a study's file; returns its path."""

    def write(grid, head=""):
        file = tmp_path / "mine.toml"
        file.write_text(f"{head}\n[grid]\n{grid}\n")
        return str(file)

    return write


def test_a_study_is_run_and_run_again(study, tmp_path, capsys):
    file = study("run.x = [1, 2]", 'run = "study_runs:plain"\nseeds = 3')
    for _ in range(2):
        assert cli.main(["study", file, "--out", str(tmp_path / "out"), "--workers", "1"]) == 0
        printed = capsys.readouterr()
        assert "mine: 6 cases, 0 failed" in printed.out
        assert (tmp_path / "out" / "figure.png").stat().st_size > 1000
        assert printed.err.startswith("cases "), "one line for the stage"
    assert pq.read_table(tmp_path / "out" / "table.parquet").num_rows == 6
    assert len((tmp_path / "out" / "table.csv").read_text().splitlines()) == 7


def test_an_interrupted_study_says_that_it_can_be_continued(study, tmp_path, capsys, monkeypatch):
    @contextlib.contextmanager
    def interrupting(quiet):
        def show(stage, done, total, note):
            if done == 2:
                signal.raise_signal(signal.SIGINT)

        yield show

    file = study("run.x = [1, 2]", 'run = "study_runs:plain"\nseeds = 3')
    command = ["study", file, "--out", str(tmp_path / "out"), "--workers", "1"]
    with monkeypatch.context() as patch:
        patch.setattr(cli.study, "bar", interrupting)
        assert cli.main(command) == cli.INTERRUPTED
    said = capsys.readouterr().err.splitlines()
    assert said[0] == (
        f"meshskin: cases that are done are kept in {tmp_path / 'out'}; the same command continues"
    )
    assert cli.main(command) == 0
    assert "mine: 6 cases, 0 failed" in capsys.readouterr().out


@pytest.mark.deep
def test_failed_cases_are_listed_and_the_exit_code_says_so(study, tmp_path, capsys):
    file = study('run.trouble = ["raise"]', 'run = "study_runs:troubled"\nseeds = 3')
    out = str(tmp_path / "out")
    assert cli.main(["study", file, "--out", out]) == 1
    printed = capsys.readouterr()
    assert "3 cases, 1 failed" in printed.out
    assert "ValueError: no such luck" in printed.out
    assert cli.main(["study", file, "--out", out, "--quiet", "--retry"]) == 1
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("grid", "head", "line"),
    [
        ("material.yung_kpa = [1]", 'base = "sphere"', "did you mean young_kpa"),
        ("", 'base = "sfere"', "did you mean sphere"),
        ("", 'bse = "sphere"', "did you mean base"),
        ("run.x = [", 'run = "study_runs:plain"', "not valid TOML"),
    ],
)
def test_a_mistake_is_one_error_line(study, tmp_path, capsys, grid, head, line):
    assert cli.main(["study", study(grid, head), "--out", str(tmp_path / "out")]) == 2
    words = capsys.readouterr().err.strip().splitlines()
    assert len(words) == 1
    assert words[0].startswith("meshskin: ")
    assert line in words[0]


def test_a_missing_file_is_one_error_line(tmp_path, capsys):
    assert cli.main(["study", str(tmp_path / "no.toml"), "--out", str(tmp_path)]) == 2
    assert "cannot read" in capsys.readouterr().err


@pytest.mark.parametrize("head", ['base = "broken.toml"', 'run = "broken.py:case"'])
def test_a_broken_base_or_run_function_is_one_error_line(study, tmp_path, capsys, head):
    (tmp_path / "broken.toml").write_text('extends = "sphere"\neffects = [1]\n')
    (tmp_path / "broken.py").write_text("raise RuntimeError('not\\nhere')\n")
    file = study("effects.gaussian_noise.sigma_relative = [0.01]", head)
    assert cli.main(["study", file, "--out", str(tmp_path / "out")]) == 2
    said = capsys.readouterr().err
    assert "effects must be a list of tables, got [1]" in said or "RuntimeError: not here" in said
    assert said.count("\n") == 1
