"""What runs in a worker process: `initialize` once, then `perform` for each case."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
import time
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pebble

from ...core.errors import StudyError
from .base_scene import BaseScene
from .case import MEMORY, RAISED, Case, Limits, Outcome, RunFunction, checked_results
from .function_reference import FunctionReference

RETIRED = 86
"""Exit code of a worker that ends because its last case ran out of memory. Any code that neither
Python nor a signal uses would do."""
LOCK_TIMEOUT = 5.0
"""Time, s, that a worker waits for the lock of the pool's pipe, which is held for milliseconds. If
a worker is killed while it holds the lock, the others end after twice this time, and the pool is
started again; pebble's default of 60 s would delay a study by two minutes."""
_PR_SET_PDEATHSIG = 1


@dataclass(frozen=True)
class WorkerSetup:
    """What every worker needs once, whatever its cases."""

    run: FunctionReference
    base: BaseScene
    limits: Limits


@dataclass
class _Worker:
    """The state of this worker process."""

    setup: WorkerSetup
    run: RunFunction | None = None
    error: str = ""
    """Why the run function cannot be imported."""
    out_of_memory: bool = False


_workers: list[_Worker] = []
"""The worker of this process; None outside worker processes."""


def initialize(setup: WorkerSetup) -> None:
    """Prepare a new worker process: process group, standard streams and the run function."""
    if os.name == "posix":
        os.setpgid(0, 0)  # the pool ends the whole group: the worker and what its cases started
    _die_with_parent()
    pebble.CONSTS.channel_lock_timeout = LOCK_TIMEOUT
    os.dup2(2, 1)  # standard output is the caller's; cases print to standard error
    worker = _Worker(setup)
    try:
        worker.run = setup.run.load()
    except StudyError as error:
        worker.error = str(error)
    _workers[:] = [worker]


def perform(case: Case) -> Outcome:
    """Run a case, sent without its base, in this worker.

    Raises StudyError if the run function could not be imported.
    """
    (worker,) = _workers
    if worker.out_of_memory:  # a process is not reliable after that: another one takes the case
        os._exit(RETIRED)
    if worker.run is None:
        raise StudyError(worker.error)
    case = replace(case, base=worker.setup.base)
    outcome = run_case(case, worker.run, worker.setup.limits)
    worker.out_of_memory = outcome.reason == MEMORY
    return outcome


def run_case(case: Case, run: RunFunction, limits: Limits) -> Outcome:
    """Run a case; an exception becomes part of the outcome."""
    begin = time.perf_counter()
    values: dict[str, Any] = {}
    reason = error = trace = None
    try:
        with _memory_limit(limits.memory):
            values = checked_results(run(case), case.parameters)
    except (Exception, SystemExit) as problem:  # one failed case must not end the study
        text = " ".join(str(problem).split())
        if isinstance(problem, MemoryError) or "bad_alloc" in text:
            reason, error = MEMORY, "out of memory"
            if limits.memory is not None:
                error += f", limit: {limits.memory / 1e6:g} MB"
        else:
            reason, trace = RAISED, traceback.format_exc()
            error = f"{type(problem).__name__}: {text}" if text else type(problem).__name__
    return Outcome(case.key, values, reason, error, trace, time.perf_counter() - begin, limits)


@contextmanager
def _memory_limit(limit: float | None) -> Iterator[None]:
    """Limit the data segment of this process to `limit` bytes (Linux only)."""
    if limit is None or sys.platform != "linux":
        yield
        return
    import resource

    before = resource.getrlimit(resource.RLIMIT_DATA)
    resource.setrlimit(resource.RLIMIT_DATA, (int(limit), before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_DATA, before)


def _die_with_parent() -> None:
    """On Linux, be killed with the parent, and before the parent where memory runs out.

    The kernel does this even while compiled code keeps the interpreter from running.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        Path("/proc/self/oom_score_adj").write_text("1000")
