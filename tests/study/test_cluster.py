"""Sweeps on a Dask cluster, with faults for real."""

import gc
import os
import signal
import subprocess
import sys
import threading
from pathlib import Path

import pytest
import study_runs

import meshskin as ms
from meshskin.core.errors import StudyError

from .test_faults import slow_study, until

HERE = Path(__file__).parent


@pytest.fixture
def dask():
    """Starts processes of a Dask cluster; ends them after the test."""
    pytest.importorskip("distributed", reason="needs dask[distributed]")
    started = []
    path = os.pathsep.join([str(HERE), *sys.path])

    def start(*arguments):
        command = [sys.executable, "-m", "distributed.cli." + arguments[0], *arguments[1:]]
        process = subprocess.Popen(
            command,
            env={**os.environ, "PYTHONPATH": path},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        started.append(process)
        return process

    yield start
    for process in started:
        process.kill()
        process.wait()


def scheduler(dask, tmp_path):
    """A scheduler's process and address."""
    import json

    file = tmp_path / "scheduler.json"
    process = dask(
        "dask_scheduler",
        "--scheduler-file", str(file), "--host", "127.0.0.1", "--port", "0", "--no-dashboard",
    )  # fmt: skip
    until(file.exists)
    return process, json.loads(file.read_text())["address"]


def worker(dask, address, nanny="--no-nanny"):
    """A Dask worker with one thread; with a nanny, it is a daemonic process."""
    return dask("dask_worker", address, "--nthreads", "1", nanny, "--no-dashboard")


@pytest.mark.slow
def test_a_cluster_gives_the_same_table(dask, tmp_path):
    _, address = scheduler(dask, tmp_path)
    for nanny in ("--nanny", "--no-nanny"):
        worker(dask, address, nanny)
    for grid, limits in (({"run.x": [0.5]}, {}), ({"run.trouble": ["hang"]}, {"time_limit": 0.5})):
        run = study_runs.troubled if limits else study_runs.plain
        study = ms.Study("s", grid=grid, seeds=6, run=run, **limits)
        there = study.sweep(tmp_path / f"a{limits}", scheduler=address)
        assert there.equals(study.sweep(tmp_path / f"b{limits}", workers=2))
    assert there.column("status").to_pylist().count("failed") == 1


@pytest.mark.slow
def test_cases_of_a_killed_dask_worker_are_run_again(dask, tmp_path):
    _, address = scheduler(dask, tmp_path)
    workers = [worker(dask, address) for _ in range(2)]
    study = slow_study(tmp_path / "marks", sleep=0.1, seeds=16)

    def killer(state):
        if state.done == 5:
            workers[0].send_signal(signal.SIGKILL)

    table = study.sweep(tmp_path / "a", scheduler=address, progress=killer)
    assert table.column("status").to_pylist() == ["done"] * 16
    study.sweep(tmp_path / "b", workers=2)
    one, other = (tmp_path / folder / "table.parquet" for folder in "ab")
    assert one.read_bytes() == other.read_bytes()


@pytest.mark.slow
def test_a_killed_scheduler_is_one_error_line_and_a_second_run_resumes(dask, tmp_path):
    process, address = scheduler(dask, tmp_path)
    worker(dask, address)
    study = slow_study(tmp_path / "marks", sleep=0.1, seeds=16)

    def killer(state):
        if state.done == 5:
            process.send_signal(signal.SIGKILL)

    with pytest.raises(StudyError, match="scheduler is gone"):
        study.sweep(tmp_path / "a", scheduler=address, progress=killer)
    states = []
    study.sweep(tmp_path / "a", workers=2, progress=states.append)
    assert states[0].kept >= 5
    study.sweep(tmp_path / "b", workers=2)
    one, other = (tmp_path / folder / "table.parquet" for folder in "ab")
    assert one.read_bytes() == other.read_bytes()


@pytest.mark.deep
def test_a_missing_scheduler_is_one_error_line(tmp_path, monkeypatch):
    pytest.importorskip("distributed", reason="needs dask[distributed]")
    monkeypatch.setattr("meshskin.study.sweep.cluster.CONNECT_TIMEOUT", 1.0)
    study = ms.Study("s", run=study_runs.plain)
    for address in ("nonsense://x", "tcp://127.0.0.1:1"):
        with pytest.raises(StudyError, match="no Dask scheduler answers"):
            study.sweep(tmp_path / "out", scheduler=address)


def test_a_failed_client_is_collected_without_waiting_for_a_lock():
    """Garbage is collected in any thread, that of the next client's loop, too."""
    utils = pytest.importorskip("distributed.utils", reason="needs dask[distributed]")
    from meshskin.study.sweep import cluster

    with pytest.raises(StudyError, match="no Dask scheduler answers"):
        cluster.Cluster(None, "nonsense://x")
    with utils.LoopRunner._lock:  # a client that starts holds it
        thread = threading.Thread(target=gc.collect, daemon=True)
        thread.start()
        thread.join(10)
        assert not thread.is_alive()


def test_without_dask_the_error_names_the_pip_command(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "distributed", None)
    monkeypatch.delitem(sys.modules, "meshskin.study.sweep.cluster", raising=False)
    with pytest.raises(StudyError, match=r'pip install "meshskin\[cluster\]"'):
        ms.Study("s", run=study_runs.plain).sweep(tmp_path / "out", scheduler="tcp://x:1")
