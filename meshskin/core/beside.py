"""Work in a forked process beside this one: two cores draw figures and compare methods at once.

A fork has all data of this process at once, which a worker of `study.sweep` would have to load.
Only files and a small result come back. concurrent.futures and pebble fork a worker before they
take its work, and so would pickle the data.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable
from contextlib import suppress
from typing import Generic, TypeVar

T = TypeVar("T")
PATIENCE = 60.0
"""Seconds that a result is waited for before the work is done anew: in a fork, a lock that a thread
of a library held is never released."""


def can_fork() -> bool:
    """Whether a forked process has a core of its own, and no lock of a thread that it lacks."""
    return (
        sys.platform == "linux"
        and len(os.sched_getaffinity(0)) > 1
        and threading.active_count() == 1
        and multiprocessing.parent_process() is None
    )


class Beside(Generic[T]):
    """Context in which `work` runs beside this process; its end ends the work.

    Where no process can be forked, it fails or gives no result within PATIENCE, `result` does the
    work in this process, where its errors are raised. The result has to be picklable. forked: False
    for work that is not worth it.
    """

    def __init__(self, work: Callable[[], T], forked: bool = True) -> None:
        self._work, self._child = work, 0
        if not (forked and can_fork()):
            return
        self._results, sender = multiprocessing.Pipe(duplex=False)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", DeprecationWarning)  # idle threads of BLAS
            self._child = os.fork()
        if not self._child:
            try:
                sender.send(work())
            finally:
                os._exit(0)  # neither exit handlers nor buffers of the parent
        sender.close()

    def result(self) -> T:
        """What the work returns, once it is done."""
        if self._child and self._results.poll(PATIENCE):
            with suppress(EOFError):  # it failed
                found: T = self._results.recv()
                return found
        return self._work()

    def __enter__(self) -> Beside[T]:
        return self

    def __exit__(self, *error: object) -> None:
        if self._child:
            os.kill(self._child, signal.SIGKILL)
            os.waitpid(self._child, 0)
            self._results.close()
