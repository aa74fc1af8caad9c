"""What goes wrong in a sweep, for real: after it, the table equals the undisturbed one."""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest
import study_runs

import meshskin as ms
from meshskin.core.errors import OutputError, StudyError

HERE = Path(__file__).parent
POSIX = pytest.mark.skipif(os.name != "posix", reason="signals and limits of POSIX")
LINUX = pytest.mark.skipif(sys.platform != "linux", reason="memory limits of Linux")

SCRIPT = """
import signal
import sys
import meshskin as ms
import study_runs

# a shell's background jobs, and what they start, are born deaf to it
signal.signal(signal.SIGINT, signal.default_int_handler)

def study(marks, sleep):
    grid = {"run.marks": [marks], "run.sleep": [float(sleep)]}
    return ms.Study("s", grid=grid, seeds=12, run=study_runs.slow)

if __name__ == "__main__":
    out, marks, sleep = sys.argv[1:]
    study(marks, sleep).sweep(out, workers=2)
"""


def slow_study(marks, sleep=0.05, seeds=12):
    marks.mkdir(exist_ok=True)
    grid = {"run.marks": [str(marks)], "run.sleep": [sleep]}
    return ms.Study("s", grid=grid, seeds=seeds, run=study_runs.slow)


def start(out, marks, sleep=0.05, **options):
    """The same study in a process of its own."""
    marks.mkdir(exist_ok=True)
    script = out.parent / "script.py"
    script.write_text(SCRIPT)
    path = os.pathsep.join([str(HERE), *sys.path])
    return subprocess.Popen(
        [sys.executable, str(script), str(out), str(marks), str(sleep)],
        env={**os.environ, "PYTHONPATH": path},
        stderr=subprocess.PIPE,
        text=True,
        **options,
    )


def until(condition, seconds=30.0):
    """Wait until the condition holds."""
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end, "it did not come to that"
        time.sleep(0.01)


def alive(pid):
    """Whether a process is there and no zombie."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


def pids(marks):
    return {int(mark.name.split(".")[1]) for mark in marks.iterdir()}


def results(out):
    return list(out.glob("results/*/*.json"))


def rows(table):
    return {row["seed"]: row for row in table.to_pylist()}


@POSIX
@pytest.mark.slow
def test_cases_of_a_killed_worker_are_run_again(tmp_path):
    marks = tmp_path / "marks"
    study = slow_study(marks)
    killed = []

    def killer(state):
        if state.done in (2, 6):
            victim = max(pids(marks) - set(killed))
            killed.append(victim)
            os.kill(victim, signal.SIGKILL)

    table = study.sweep(tmp_path / "a", workers=2, progress=killer)
    assert len(killed) == 2
    assert set(table.column("status").to_pylist()) == {"done"}
    study.sweep(tmp_path / "b", workers=1)
    one, other = (tmp_path / folder / "table.parquet" for folder in "ab")
    assert one.read_bytes() == other.read_bytes()


@pytest.mark.slow
@LINUX
def test_workers_die_with_a_killed_parent_and_a_second_run_resumes(tmp_path):
    out, marks = tmp_path / "a", tmp_path / "marks"
    parent = start(out, marks, sleep=0.1)
    until(lambda: len(results(out)) >= 3)
    parent.kill()
    parent.communicate()
    workers = pids(marks)
    until(lambda: not any(map(alive, workers)), seconds=5)
    assert not (out / "table.parquet").exists()
    before = {file: file.read_bytes() for file in results(out)}
    assert 3 <= len(before) < 12
    study = slow_study(marks, sleep=0.1)
    study.sweep(out)
    assert all(file.read_bytes() == text for file, text in before.items()), "none is run twice"
    study.sweep(tmp_path / "b", workers=1)
    assert (out / "table.parquet").read_bytes() == (tmp_path / "b/table.parquet").read_bytes()
    assert not list(out.rglob("*.part"))


@LINUX
@pytest.mark.slow
def test_hanging_workers_die_with_a_killed_parent(tmp_path):
    code = (
        "import meshskin as ms, study_runs\n"
        "grid = {'run.trouble': [TROUBLE], 'run.mark': [MARK]}\n"
        "ms.Study('s', grid=grid, seeds=[2], run=study_runs.troubled)"
        f".sweep({str(tmp_path / 'out')!r}, workers=1)"
    )
    path = os.pathsep.join([str(HERE), *sys.path])
    mark = tmp_path / "mark"
    for trouble in ("hang", "hang in C"):
        given = f"TROUBLE, MARK = {trouble!r}, {str(mark)!r}\n"
        env = {**os.environ, "PYTHONPATH": path}
        parent = subprocess.Popen([sys.executable, "-c", given + code], env=env)
        children = Path(f"/proc/{parent.pid}/task/{parent.pid}/children")
        until(lambda: mark.exists())
        workers = children.read_text().split()
        assert str(int(mark.read_text())) in workers
        parent.kill()
        parent.wait()
        until(lambda pids=workers: not any(map(alive, pids)), seconds=5)
        mark.unlink()


@pytest.mark.deep
@POSIX
def test_an_interrupted_run_leaves_no_worker_and_no_temporary_file(tmp_path):
    out, marks = tmp_path / "a", tmp_path / "marks"
    parent = start(out, marks, sleep=0.2)
    until(lambda: len(results(out)) >= 2)
    parent.send_signal(signal.SIGINT)
    _, words = parent.communicate(timeout=20)
    assert "KeyboardInterrupt" in words
    until(lambda: not any(map(alive, pids(marks))), seconds=5)
    assert not list(out.rglob("*.part"))


@pytest.mark.deep
@pytest.mark.parametrize(
    ("trouble", "limits", "error"),
    [
        ("raise", {}, "ValueError: no such luck"),
        ("type", {}, "StudyError: the result 'y' must be a number or text, got object"),
        pytest.param(
            "hang", {"time_limit": 0.5}, "out of time, limit: 0.5 s", marks=pytest.mark.slow
        ),
        ("hang in C", {"time_limit": 0.5}, "out of time, limit: 0.5 s"),
        ("child", {"time_limit": 0.5}, "out of time, limit: 0.5 s"),
        pytest.param(
            "memory",
            {"memory_limit": 6e8},
            "out of memory, limit: 600 MB",
            marks=[LINUX, pytest.mark.slow],
        ),
        pytest.param("kill", {}, "its worker died 3 times, signal 9", marks=POSIX),
        pytest.param("exit 7", {}, "its worker died 3 times, exit code 7", marks=pytest.mark.slow),
        pytest.param("exit 0", {}, "its worker died 3 times, exit code 0", marks=pytest.mark.slow),
        ("sys.exit", {}, "SystemExit: 5"),
    ],
)
def test_a_failed_case_is_a_row_and_the_others_are_done(out, trouble, limits, error):
    study = ms.Study(
        "s", grid={"run.trouble": [trouble]}, seeds=5, run=study_runs.troubled, **limits
    )
    table = study.sweep(out, workers=2)
    found = rows(table)
    assert found[2]["status"] == "failed"
    assert found[2]["error"] == error
    assert found[2]["y"] is None
    assert [found[k]["status"] for k in (0, 1, 3, 4)] == ["done"] * 4
    assert study.sweep(out).equals(table)


def test_the_traceback_is_kept(out):
    study = ms.Study("s", grid={"run.trouble": ["raise"]}, seeds=[2], run=study_runs.troubled)
    (key,) = study.sweep(out).column("key").to_pylist()
    assert "study_runs.py" in (out / "results" / key[:2] / f"{key}.json").read_text()


@pytest.mark.slow
def test_failed_cases_are_run_again_on_demand_or_with_more_time(out):
    states = []

    def sweep(limit, **options):
        grid = {"run.trouble": ["hang"]}
        study = ms.Study("s", grid=grid, seeds=3, run=study_runs.troubled, time_limit=limit)
        states.clear()
        study.sweep(out, progress=states.append, **options)
        return len(states) - 1

    runs = [sweep(0.2), sweep(0.2), sweep(0.1), sweep(0.3), sweep(0.3, retry=True)]
    assert runs == [3, 0, 0, 1, 1]


@pytest.mark.deep
@POSIX
def test_a_case_whose_worker_dies_once_is_tried_again(out, tmp_path):
    (tmp_path / "marks").mkdir()
    grid = {"run.marks": [str(tmp_path / "marks")]}
    table = ms.Study("s", grid=grid, seeds=4, run=study_runs.killed_once).sweep(out, workers=2)
    assert table.column("status").to_pylist() == ["done"] * 4


@pytest.mark.deep
@POSIX
def test_a_full_disk_is_one_error_line_and_finished_cases_are_kept(tmp_path):
    """The limit on file sizes fails a write as a full disk does, with another number."""
    import resource

    study, out = slow_study(tmp_path / "marks", sleep=0.0), tmp_path / "a"

    def limit(state):
        if state.done == 4:
            resource.setrlimit(resource.RLIMIT_FSIZE, (60, before[1]))

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    try:
        with pytest.raises(OutputError, match="free space"):
            study.sweep(out, workers=2, progress=limit)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert len(results(out)) == 4
    assert not list(out.rglob("*.part"))
    table = study.sweep(out)
    assert table.equals(study.sweep(tmp_path / "b"))


@pytest.mark.deep
@LINUX
@pytest.mark.skipif(not hasattr(os, "geteuid") or os.geteuid() != 0, reason="mounting needs root")
def test_a_disk_that_is_really_full(tmp_path):
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(disk)]
    if subprocess.run(mount, capture_output=True).returncode:
        pytest.skip("mounting is not allowed here")
    try:
        study = slow_study(tmp_path / "marks", sleep=0.0, seeds=30)
        with pytest.raises(OutputError, match="No space left"):
            study.sweep(disk / "out", workers=2)
        kept = len(results(disk / "out"))
        assert 0 < kept < 30
        subprocess.run(["mount", "-o", "remount,size=8m", str(disk)], check=True)
        states = []
        table = study.sweep(disk / "out", progress=states.append)
        assert states[0].kept == kept
        assert table.equals(study.sweep(tmp_path / "b"))
    finally:
        subprocess.run(["umount", str(disk)], check=True)


@pytest.mark.slow
def test_a_second_run_on_the_same_folder_is_refused(tmp_path):
    out, marks = tmp_path / "a", tmp_path / "marks"
    first = start(out, marks, sleep=0.2)
    until(lambda: len(results(out)) >= 1)
    with pytest.raises(StudyError, match=f"another run is writing .* process {first.pid} on"):
        slow_study(marks, sleep=0.2).sweep(out)
    assert first.communicate(timeout=30)[1] == ""
    assert first.returncode == 0
    assert len(results(out)) == 12


def test_an_incomplete_result_is_run_again(tmp_path):
    study, out = slow_study(tmp_path / "marks", sleep=0.0), tmp_path / "a"
    study.sweep(out)
    whole = (out / "table.parquet").read_bytes()
    first, second, third, *_ = results(out)
    first.write_bytes(first.read_bytes()[:-20])
    second.write_bytes(b"")
    third.write_bytes(b"\xff" * 300)
    states = []
    study.sweep(out, progress=states.append)
    assert states[0].kept == 9
    assert (out / "table.parquet").read_bytes() == whole


@pytest.mark.slow
def test_workers_that_cannot_start_end_the_sweep(out, tmp_path, monkeypatch):
    (tmp_path / "broken_runs.py").write_text("def run(case):\n    return {}\n")
    monkeypatch.syspath_prepend(tmp_path)
    import broken_runs

    for text, message in (
        ("import os; os._exit(3)", "workers cannot start"),
        ("raise SystemExit(3)", "cannot import the run function .* got SystemExit: 3"),
        ("", "no function run in broken_runs"),
    ):
        (tmp_path / "broken_runs.py").write_text(text)
        with pytest.raises(StudyError, match=message):
            ms.Study("s", run=broken_runs.run).sweep(out, workers=1)


@pytest.mark.slow
def test_a_script_without_main_guard_is_refused(tmp_path):
    script = tmp_path / "script.py"
    text = "import meshskin as ms\ndef mine(case):\n    return {'y': case.seed}\n"
    study = "ms.Study('s', seeds=2, run=mine)"
    sweep = f"print(*{study}.sweep({str(tmp_path / 'out')!r})['y'].to_pylist())\n"
    outputs = []
    for guard in ("if True:\n", 'if __name__ == "__main__":\n'):
        script.write_text(text + guard + "    " + sweep)
        command = [sys.executable, str(script)]
        env = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
        outputs.append(subprocess.run(command, capture_output=True, text=True, env=env))
    assert outputs[0].returncode == 1
    assert 'under if __name__ == "__main__"' in outputs[0].stderr.splitlines()[-1]
    assert outputs[1].returncode == 0
    assert outputs[1].stdout.split() == ["0", "1"]


def test_no_thread_and_no_process_is_left(out):
    before = threading.active_count()
    ms.Study("s", seeds=3, run=study_runs.plain).sweep(out, workers=3)
    until(lambda: threading.active_count() == before, seconds=5)
    if sys.platform == "linux":
        children = Path(f"/proc/{os.getpid()}/task/{os.getpid()}/children").read_text().split()
        commands = [Path(f"/proc/{pid}/cmdline").read_text() for pid in children]
        assert not [c for c in commands if "spawn_main" in c]


@pytest.mark.slow
def test_a_task_that_is_lost_with_its_worker_is_given_out_again(out, monkeypatch):
    """As by a worker that dies between taking a task and saying so: its future never ends."""
    from concurrent.futures import Future

    from meshskin.study.sweep import worker_pool

    schedule, lost = worker_pool.pebble.ProcessPool.schedule, []

    def losing(self, function, **options):
        if not lost:
            lost.append(Future())
            return lost[0]
        return schedule(self, function, **options)

    monkeypatch.setattr(worker_pool.pebble.ProcessPool, "schedule", losing)
    monkeypatch.setattr(worker_pool, "MAX_IDLE", 4.0)
    study = ms.Study("s", grid={"run.trouble": [""]}, seeds=3, run=study_runs.troubled)
    found = rows(study.sweep(out, workers=2))
    assert lost
    assert [found[seed]["status"] for seed in range(3)] == ["done"] * 3
