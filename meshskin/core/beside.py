"""Work in a forked process beside this one: two cores draw figures and compare methods at once.

It is forked before there is work, and imports what that needs while this process computes.
"""

from __future__ import annotations

import multiprocessing
import os
import signal
import sys
import threading
import warnings
from collections.abc import Callable
from concurrent.futures import BrokenExecutor, ProcessPoolExecutor
from functools import partial
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
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


class Beside:
    """Context of a forked process, which ends with it, calls `prepare` and then does the work.

    Where none can be forked, it fails or gives no result within PATIENCE, work is done in this
    process when its result is asked for. forked: False for work that is not worth it.
    """

    def __init__(self, prepare: Callable[[], object], forked: bool = True) -> None:
        self._pool, before = None, multiprocessing.active_children()
        if forked and can_fork():
            context = multiprocessing.get_context("fork")
            self._pool = ProcessPoolExecutor(1, context, _begin, (prepare,))
            with warnings.catch_warnings():
                warnings.simplefilter("ignore", DeprecationWarning)  # idle threads of BLAS
                self._pool.submit(int)  # forks
        self._children = set(multiprocessing.active_children()) - set(before)

    def submit(self, work: Callable[P, T], *args: P.args, **options: P.kwargs) -> Callable[[], T]:
        """Begin work; what is returned gives its result, or raises its error, once it is done.

        Work, arguments and result have to be picklable.
        """
        here = partial(work, *args, **options)
        if self._pool is None:
            return here

        def result() -> T:
            try:
                return future.result(PATIENCE)
            except (BrokenExecutor, TimeoutError):
                return here()

        try:
            future = self._pool.submit(work, *args, **options)
        except BrokenExecutor:
            return here
        return result

    def __enter__(self) -> Beside:
        return self

    def __exit__(self, *error: object) -> None:
        for child in self._children:
            child.kill()
        if self._pool is not None:
            self._pool.shutdown()


def _begin(prepare: Callable[[], object]) -> None:
    """Prepare a forked process, which ends with this one and leaves interruptions to it."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    prepare()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)
