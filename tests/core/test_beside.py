"""Work in a forked process: its result, its errors, its end."""

import os
import sys
import time

import pytest

from meshskin.core import beside
from meshskin.core.beside import Beside


@pytest.fixture
def forks(monkeypatch):
    """Fork although other tests may have left an idle thread."""
    if sys.platform != "linux":
        pytest.skip("processes are forked on Linux only")
    monkeypatch.setattr(beside, "can_fork", lambda: True)


@pytest.mark.usefixtures("forks")
def test_work_runs_in_a_process_of_its_own():
    with Beside(os.getpid) as other:
        assert other.result() != os.getpid()
    with Beside(os.getpid, forked=False) as other:
        assert other.result() == os.getpid()


@pytest.mark.usefixtures("forks")
def test_the_process_ends_with_its_context(tmp_path):
    def work():
        time.sleep(1.0)
        (tmp_path / "late").touch()

    with Beside(work), pytest.raises(KeyboardInterrupt):
        raise KeyboardInterrupt
    time.sleep(1.1)
    assert not (tmp_path / "late").exists()


@pytest.mark.usefixtures("forks")
def test_work_that_fails_there_is_done_here(tmp_path):
    here = os.getpid()

    def work():
        if os.getpid() != here:
            os._exit(9)
        return "done"

    def fails():
        raise ValueError("wrong")

    with Beside(work) as other:
        assert other.result() == "done"
    with Beside(fails) as other, pytest.raises(ValueError, match="wrong"):
        other.result()
