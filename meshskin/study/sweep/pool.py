"""Worker processes on this machine, watched: what dies or hangs is replaced, its case tried again.

No pool of the standard library outlives a worker that is killed, and none has a time limit.
"""

from __future__ import annotations

import contextlib
import os
import queue
import signal
import subprocess
import sys
import threading
import time
from collections import Counter, deque
from collections.abc import Iterable, Iterator
from types import TracebackType
from typing import Any

from ...core.errors import StudyError
from .outcome import DIED, MEMORY, TIMEOUT, Limits, Outcome
from .worker import Ready, Setup, Task, main, receive, send

ATTEMPTS = 3
"""How often a case is tried whose worker dies."""
GRACE = 5.0
"""Time for an ended process to go, s."""
_ONE_THREAD = dict.fromkeys(
    ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "VECLIB_MAXIMUM_THREADS"), "1"
)


class _Gone:
    """A worker has ended."""


class _Late:
    """A worker's time is up."""


class Worker:
    """One worker process, and the thread that reads what it says."""

    def __init__(self, setup: Setup, inbox: queue.SimpleQueue[tuple[Worker, Any]]) -> None:
        self.ready = False
        self.task: Task | None = None
        self.deadline = float("inf")
        self._process = subprocess.Popen(
            [sys.executable, "-P", "-c", f"from {main.__module__} import main; main()"],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            env=_environment(),
            process_group=0 if os.name == "posix" else None,  # Ctrl-C is for the parent
        )
        threading.Thread(target=self._read, args=(inbox,), daemon=True).start()
        self._send(setup)

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def start(self, task: Task, limit: float | None) -> None:
        """Begin a case."""
        self.task = task
        self.deadline = float("inf") if limit is None else time.monotonic() + limit
        self._send(task)

    def finish(self) -> Task | None:
        """The case it was at; it has none now."""
        task, self.task, self.deadline = self.task, None, float("inf")
        return task

    def kill(self, gone: bool = False) -> int:
        """End it, and what it started, at once; the exit code, negative for a signal.

        gone: it is ending by itself; its own exit code is wanted.
        """
        if gone:
            self._let_go()
        with contextlib.suppress(ProcessLookupError, PermissionError):
            if os.name == "posix":
                os.killpg(self.pid, signal.SIGKILL)
            else:
                self._process.kill()
        try:
            code = self._process.wait(GRACE)
        except subprocess.TimeoutExpired:  # held by the kernel: it goes when the kernel lets it
            code = -signal.SIGKILL
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):
            self._process.stdin.close()
        return code

    def _let_go(self) -> None:
        """Wait until it has ended by itself, but leave its id in use: its children have it too."""
        if not hasattr(os, "waitid"):
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(GRACE)
            return
        end, look = time.monotonic() + GRACE, os.WEXITED | os.WNOWAIT | os.WNOHANG
        while os.waitid(os.P_PID, self.pid, look) is None and time.monotonic() < end:
            time.sleep(0.002)

    def _send(self, message: object) -> None:
        assert self._process.stdin is not None
        with contextlib.suppress(OSError):  # it is dead: its end is noticed by the reading thread
            send(self._process.stdin, message)

    def _read(self, inbox: queue.SimpleQueue[tuple[Worker, Any]]) -> None:
        assert self._process.stdout is not None
        try:
            with self._process.stdout as line, contextlib.suppress(EOFError, OSError):
                while True:
                    inbox.put((self, receive(line)))
        finally:
            inbox.put((self, _Gone()))


class Crew:
    """Some workers; a context manager that leaves none behind."""

    def __init__(self, setup: Setup, size: int) -> None:
        self._setup, self._size = setup, size
        self._workers: set[Worker] = set()
        self._inbox: queue.SimpleQueue[tuple[Worker, Any]] = queue.SimpleQueue()
        self._idle: list[Worker] = []
        self._stillborn = 0

    def __enter__(self) -> Crew:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """End all workers; another thread that waits for outcomes gets no more."""
        workers, self._workers, self._idle = self._workers, set(), []
        for worker in workers:
            worker.kill()

    @property
    def pids(self) -> list[int]:
        """Process ids of the workers."""
        return [worker.pid for worker in self._workers]

    def outcomes(self, tasks: Iterable[Task]) -> Iterator[Outcome]:
        """The outcome of every task, in the order in which they end.

        A case is given three attempts if its worker dies; one that runs out of its time is ended.
        Raises StudyError if workers cannot start.
        """
        waiting, again, deaths = iter(tasks), deque[Task](), Counter[str]()
        while True:
            self._hire(waiting, again)
            if not any(worker.task for worker in self._workers) and not again:
                return
            for worker, message in self._messages():
                outcome = self._heard(worker, message, again, deaths)
                self._hire(waiting, again)  # before the outcome is dealt with: no worker waits
                if outcome is not None:
                    yield outcome

    def _hire(self, waiting: Iterator[Task], again: deque[Task]) -> None:
        """Give idle workers work, and start others while there is more."""
        while self._idle or len(self._workers) < self._size:
            task = again.popleft() if again else next(waiting, None)
            if task is None:
                return
            if self._idle:
                self._idle.pop().start(task, self._setup.limits.seconds)
            else:
                worker = Worker(self._setup, self._inbox)
                self._workers.add(worker)
                worker.task = task  # it begins when the worker is ready

    def _messages(self) -> list[tuple[Worker, Any]]:
        """The next message, or the workers whose time is up."""
        nearest = min(worker.deadline for worker in self._workers)
        try:
            wait = None if nearest == float("inf") else max(nearest - time.monotonic(), 0.0)
            return [self._inbox.get(timeout=wait)]
        except queue.Empty:
            now = time.monotonic()
            return [(worker, _Late()) for worker in self._workers if worker.deadline <= now]

    def _heard(
        self, worker: Worker, message: Any, again: deque[Task], deaths: Counter[str]
    ) -> Outcome | None:
        """Deal with a message; the outcome of a case, if it ended."""
        limits = self._setup.limits
        if worker not in self._workers:  # the last words of one that was killed
            return None
        if isinstance(message, Outcome):
            worker.finish()
            if message.reason == MEMORY:  # what a process does after that is not to be trusted
                self._dismiss(worker)
            else:
                self._idle.append(worker)
            return message
        task = worker.finish()
        if isinstance(message, Ready):
            if message.error:
                raise StudyError(message.error)
            self._stillborn, worker.ready = 0, True
            assert task is not None
            worker.start(task, limits.seconds)
            return None
        code = self._dismiss(worker, gone=isinstance(message, _Gone))
        if isinstance(message, _Late):
            assert task is not None
            return late(task, limits)
        if not worker.ready:
            self._stillborn += 1
            if self._stillborn >= ATTEMPTS:
                raise StudyError(
                    "workers cannot start",
                    value=f"exit code {code}",
                    remedy='read above what they say; a script needs if __name__ == "__main__":',
                )
        if task is None:
            return None
        deaths[task.key] += worker.ready
        if deaths[task.key] < ATTEMPTS:
            again.append(task)
            return None
        return died(task, limits, code)

    def _dismiss(self, worker: Worker, gone: bool = False) -> int:
        """End a worker; its exit code."""
        self._workers.discard(worker)
        if worker in self._idle:
            self._idle.remove(worker)
        return worker.kill(gone)


def late(task: Task, limits: Limits) -> Outcome:
    """The outcome of a case that ran out of time."""
    error = f"out of time, limit: {limits.seconds:g} s"
    return Outcome(
        task.key, reason=TIMEOUT, error=error, seconds=limits.seconds or 0.0, limits=limits
    )


def died(task: Task, limits: Limits, code: int | None) -> Outcome:
    """The outcome of a case whose worker ended by itself, attempt by attempt."""
    error = f"its worker died {ATTEMPTS} times"
    if code is not None:
        error += f", signal {-code}" if code < 0 else f", exit code {code}"
    return Outcome(task.key, reason=DIED, error=error, limits=limits)


def _environment() -> dict[str, str]:
    """The environment of a worker: this one's modules, one thread, one order of sets."""
    path = os.pathsep.join(os.path.abspath(p) for p in sys.path)
    return {**os.environ, **_ONE_THREAD, "PYTHONPATH": path, "PYTHONHASHSEED": "0"}
