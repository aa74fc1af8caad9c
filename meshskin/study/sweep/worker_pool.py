"""A pool of worker processes on this machine that survives killed and hanging workers.

pebble.ProcessPool starts the workers, replaces those that end, and enforces time limits. Added
here, because pebble leaves it to its caller:

- a case whose worker ended is tried again, and a pool that broke is started again;
- what a case has started ends with its worker (a process group each), and workers end with their
  parent, even if that is killed (worker.py);
- a worker that ends with exit code 0 within a case is reported: pebble waits for it forever;
- workers start with one thread, one hash seed, and from daemonic processes (Dask's workers) too.
"""

from __future__ import annotations

import os
import queue
import signal
import threading
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from concurrent.futures import CancelledError
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from multiprocessing import current_process
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any

import pebble

from ...core.errors import StudyError
from .case import DIED, TIMEOUT, Case, Limits, Outcome
from .worker import RETIRED, WorkerSetup, initialize, perform

MAX_IDLE = 60.0
"""Time, s, for which a worker is free while a task waits, after which the task is lost: to start a
worker takes some seconds, on a machine with much other work ten times as long."""
ATTEMPTS = 3
"""How often a case is tried whose worker ends, and a pool is started whose workers cannot start.
A worker may be killed from outside (once, or twice by bad luck); a case that kills its worker does
so every time."""
TASKS_AHEAD = 4
"""Tasks per worker that are handed to the pool at a time: no worker waits while the parent writes a
result, and the tasks of a long study are not all held in memory."""
ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "VECLIB_MAXIMUM_THREADS": "1",
    "PYTHONHASHSEED": "0",
}
"""Environment of a worker: the processes are the parallelism, and the order of sets is fixed."""
_CLEAN_EXIT = 1000
"""Stands for exit code 0, which pebble takes for the end of a worker that has no task."""
_start_lock = threading.Lock()


class WorkerProcess(SpawnProcess):
    """A process that leads a group and that is killed together with it."""

    def start(self) -> None:
        """Start the process in a worker's environment."""
        with _start_lock, _worker_environment():
            super().start()

    def terminate(self) -> None:
        """Kill the process and what it has started, at once."""
        super().kill()
        self._kill_group()

    def is_alive(self) -> bool:
        """Whether the process runs; what a dead one has left behind is killed."""
        alive = super().is_alive()
        if not alive:
            self._kill_group()
        return alive

    @property
    def exitcode(self) -> int | None:
        """Exit code; negative for a signal, _CLEAN_EXIT for 0, None while it runs."""
        code = super().exitcode
        return _CLEAN_EXIT if code == 0 else code

    def _kill_group(self) -> None:
        if os.name == "posix" and self.pid is not None:
            with suppress(ProcessLookupError, PermissionError):
                os.killpg(self.pid, signal.SIGKILL)


class WorkerContext(SpawnContext):
    """A multiprocessing context whose processes are workers."""

    Process = WorkerProcess


@contextmanager
def _worker_environment() -> Iterator[None]:
    """What a process that is started here inherits: ENVIRONMENT, and Ctrl-C blocked.

    Ctrl-C is for the parent, which then ends its workers. multiprocessing refuses children of a
    daemonic process because they could outlive it; workers die with their parent.
    """
    before = {name: os.environ.get(name) for name in ENVIRONMENT}
    config: dict[str, Any] = current_process()._config  # type: ignore[attr-defined]
    daemon = config.pop("daemon", None)
    mask = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT}) if os.name == "posix" else None
    os.environ.update(ENVIRONMENT)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value
        if mask is not None:
            signal.pthread_sigmask(signal.SIG_SETMASK, mask)
        if daemon is not None:
            config["daemon"] = daemon


class WorkerPool:
    """Some workers; `close` leaves none behind."""

    def __init__(self, setup: WorkerSetup, size: int) -> None:
        self._setup, self._size = setup, size
        self._pool: pebble.ProcessPool | None = None
        self._running: dict[Any, Case] = {}
        """Tasks that the pool has, by their futures."""
        self._ended: queue.SimpleQueue[Any] = queue.SimpleQueue()
        """Futures as they end; None when the pool is closed."""

    def close(self) -> None:
        """End all workers; `outcomes` in another thread yields no more."""
        self._ended.put(None)
        self._stop()

    def _stop(self) -> None:
        pool, self._pool = self._pool, None
        if pool is not None:
            pool.stop()
            pool.join()

    def outcomes(self, tasks: Iterable[Case]) -> Iterator[Outcome]:
        """The outcome of every task, in the order in which they end.

        A case whose worker ends is tried ATTEMPTS times; one that exceeds its time limit is ended.
        Raises StudyError if the workers cannot start or cannot import the run function.
        """
        waiting, again = iter(tasks), deque[Case]()
        deaths, broken = Counter[str](), 0
        while True:
            try:
                self._fill(waiting, again)
                if not self._running:
                    return
                future = self._next_ended()
                if future is None:
                    return
                task = self._running.pop(future, None)
                if task is None:  # of a pool that has been replaced
                    continue
                outcome = self._outcome(task, future, deaths)
            except BrokenProcessPool as error:
                broken += 1
                if broken == ATTEMPTS:
                    raise StudyError("workers cannot start", remedy=_START_REMEDY) from error
                self._stop()
                again.extend(self._running.values())
                self._running.clear()
                continue
            if outcome is None:
                again.append(task)
            else:
                broken = 0
                yield outcome

    def _next_ended(self) -> Any:
        """The next future that ends. Raises BrokenProcessPool where none does though workers are
        free: a worker that dies between taking a task and saying so takes it along."""
        idle = False
        while True:
            try:
                return self._ended.get(timeout=MAX_IDLE / 2)
            except queue.Empty:
                running = sum(future.running() for future in self._running)
                free = running < min(self._size, len(self._running))
                if idle and free:
                    raise BrokenProcessPool("a task was lost") from None
                idle = free

    def _fill(self, waiting: Iterator[Case], again: deque[Case]) -> None:
        """Hand tasks to the pool until it has enough. Raises BrokenProcessPool."""
        while len(self._running) < TASKS_AHEAD * self._size:
            task = again.popleft() if again else next(waiting, None)
            if task is None:
                return
            try:
                if self._pool is None:
                    self._pool = pebble.ProcessPool(
                        self._size,
                        initializer=initialize,
                        initargs=(self._setup,),
                        context=WorkerContext(),
                    )
                future = self._pool.schedule(
                    perform, args=(task,), timeout=self._setup.limits.seconds
                )
            except RuntimeError as error:  # pebble's word for a pool that is broken or closed
                again.appendleft(task)
                raise BrokenProcessPool(str(error)) from error
            self._running[future] = task
            future.add_done_callback(self._ended.put)

    def _outcome(self, task: Case, future: Any, deaths: Counter[str]) -> Outcome | None:
        """The outcome of a task that ended; None if it is to be tried again.

        Raises BrokenProcessPool, StudyError.
        """
        limits = self._setup.limits
        try:
            outcome: Outcome = future.result()
            return outcome
        except pebble.ProcessExpired as error:
            if error.exitcode == RETIRED:
                return None
            deaths[task.key] += 1
            if deaths[task.key] < ATTEMPTS:
                return None
            return died(task, limits, 0 if error.exitcode == _CLEAN_EXIT else error.exitcode)
        except TimeoutError:
            late = f"out of time, limit: {limits.seconds:g} s"
            return Outcome(task.key, {}, TIMEOUT, late, None, limits.seconds or 0.0, limits)
        except BrokenProcessPool:
            self._running[future] = task
            raise
        except CancelledError:
            return None


_START_REMEDY = (
    'read their messages above; a script must start the study under if __name__ == "__main__":'
)


def died(task: Case, limits: Limits, code: int | None) -> Outcome:
    """The outcome of a case whose worker ended in every attempt, with an exit code if known."""
    error = f"its worker died {ATTEMPTS} times"
    if code is not None:
        error += f", signal {-code}" if code < 0 else f", exit code {code}"
    return Outcome(task.key, reason=DIED, error=error, limits=limits)
