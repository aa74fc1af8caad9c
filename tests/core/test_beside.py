"""Work in forked processes: its result, its errors, its end."""

import os
import subprocess
import sys
import time

import pytest

from meshskin.core import beside
from meshskin.core.beside import Beside


def nothing():
    pass


def late(path):
    time.sleep(1.0)
    path.touch()


def done_at(here):
    if os.getpid() != here:
        os._exit(9)
    return "done"


def fails():
    raise ValueError("wrong")


@pytest.fixture
def forks(monkeypatch):
    """Fork although other tests may have left an idle thread."""
    if sys.platform != "linux":
        pytest.skip("processes are forked on Linux only")
    monkeypatch.setattr(beside, "can_fork", lambda: True)


@pytest.mark.usefixtures("forks")
def test_work_runs_in_a_process_of_its_own():
    with Beside(nothing) as other:
        assert other.submit(os.getpid)() != os.getpid()
    with Beside(nothing, forked=False) as other:
        assert other.submit(os.getpid)() == os.getpid()


@pytest.mark.usefixtures("forks")
def test_the_process_is_prepared_and_ends_with_its_context(tmp_path):
    with Beside((tmp_path / "ready").touch) as other, pytest.raises(KeyboardInterrupt):
        assert other.submit(abs, -1)() == 1
        other.submit(late, tmp_path / "late")
        raise KeyboardInterrupt
    time.sleep(1.1)
    assert (tmp_path / "ready").exists()
    assert not (tmp_path / "late").exists()


@pytest.mark.usefixtures("forks")
def test_work_that_fails_there_is_done_here():
    with Beside(nothing) as other:
        assert other.submit(done_at, os.getpid())() == "done"
        assert other.submit(os.getpid)() == os.getpid()  # none is left
    with Beside(fails) as other:
        assert other.submit(abs, -1)() == 1
    with Beside(nothing) as other, pytest.raises(ValueError, match="wrong"):
        other.submit(fails)()


@pytest.mark.skipif(sys.platform != "linux", reason="processes are forked on Linux only")
def test_the_processes_end_with_a_parent_that_is_killed():
    code = (
        "import os, signal; from meshskin.core import beside; beside.can_fork = lambda: True\n"
        "other = beside.Beside(int); print(other.submit(os.getpid)(), flush=True)\n"
        "os.kill(os.getpid(), signal.SIGKILL)"
    )
    child = int(subprocess.run([sys.executable, "-c", code], capture_output=True).stdout)
    for _ in range(100):
        try:
            os.kill(child, 0)
        except ProcessLookupError:
            return
        time.sleep(0.05)
    pytest.fail(f"process {child} outlives its parent")
