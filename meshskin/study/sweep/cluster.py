"""A Dask cluster as the hands of a study.

Every thread of a Dask worker has a process of its own for the cases, watched as on one machine:
time and memory limits, and cases that kill their process, are dealt with there. A Dask worker that
dies leaves its cases to others; a scheduler that dies ends the sweep, which can be run again. The
machines of the cluster must see the files that the study names, at the same paths.
"""

from __future__ import annotations

import contextlib
import itertools
import queue
import time
import uuid
from collections.abc import Iterable, Iterator
from types import TracebackType
from typing import Any

from ...core.errors import StudyError
from ...core.provenance import versions
from .outcome import Outcome
from .pool import Crew, died
from .worker import Setup, Task

try:
    import distributed
except ImportError as error:
    raise StudyError(
        "a scheduler needs dask.distributed", remedy='pip install "meshskin[cluster]"'
    ) from error

AHEAD = 3
"""Cases on their way to each thread of the cluster, the one at work included."""
LEAST = 8
"""Cases on their way while the cluster is small, or has no workers yet."""
CONNECT = 10.0
"""Time for the scheduler to answer at first, s."""
PATIENCE = 15.0
"""Time that the scheduler may be out of reach, s."""
LOOK = 1.0
"""Time between two looks at the cluster, s."""


class Bench(distributed.WorkerPlugin):
    """On each Dask worker: crews of one process, taken by its threads and put back."""

    def __init__(self, orders: Setup) -> None:
        self.orders = orders
        self.wanted = versions()
        self.name = f"meshskin-{uuid.uuid4().hex[:12]}"

    def setup(self, worker: Any) -> None:
        """Called by Dask when the plugin comes to a worker."""
        found = versions()
        self.differs = [f"{k} {v}" for k, v in found.items() if v != self.wanted.get(k)]
        self.idle: queue.SimpleQueue[Crew] = queue.SimpleQueue()
        self.crews: list[Crew] = []

    def teardown(self, worker: Any) -> None:
        """Called by Dask when the plugin or the worker goes."""
        for crew in self.crews:
            crew.close()

    def perform(self, task: Task) -> Outcome | None:
        """The outcome of a task; None if the plugin goes meanwhile. Raises StudyError."""
        if self.differs:
            raise StudyError(
                "a worker of the cluster has other versions",
                value=", ".join(self.differs),
                remedy="install the same ones: results would differ",
            )
        try:
            crew = self.idle.get_nowait()
        except queue.Empty:
            crew = Crew(self.orders, 1)
            self.crews.append(crew)
        outcome = next(crew.outcomes([task]), None)
        self.idle.put(crew)
        return outcome


def _perform(bench: str, task: Task) -> Outcome | None:
    """Runs on a Dask worker."""
    plugin: Bench | None = distributed.get_worker().plugins.get(bench)
    return None if plugin is None else plugin.perform(task)


class _Client(distributed.Client):
    """A client that is closed by hand only.

    Dask's closes itself as garbage, in whatever thread that is collected: in the one of the next
    client's loop it waits for a lock that the next client holds while it waits for that thread.
    """

    def __del__(self) -> None:
        pass


class Cluster:
    """A connection to a Dask scheduler; a context manager that takes back what is not done.

    Raises StudyError where no scheduler answers, or its workers cannot import meshskin.
    """

    def __init__(self, setup: Setup, address: str) -> None:
        self._address = address
        self._bench = Bench(setup)
        self._pending: dict[str, tuple[Task, Any]] = {}
        self._done: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._count = itertools.count()
        self._last_seen = time.monotonic()
        try:
            self._client = _Client(address, timeout=CONNECT, set_as_default=False)
        except (OSError, ValueError, AssertionError) as error:
            # AssertionError: Dask's own thread did not start in its 10 s
            raise StudyError(
                "no Dask scheduler answers", value=address, remedy="check --scheduler"
            ) from error

    def __enter__(self) -> Cluster:
        try:
            self._client.register_plugin(self._bench, name=self._bench.name)
        except ImportError as error:
            self._client.close(timeout=2)
            raise StudyError(
                f"workers of the cluster cannot import meshskin: {error}",
                remedy="install it in their environment",
            ) from error
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        with contextlib.suppress(OSError, distributed.CancelledError, RuntimeError):
            if self._client.status == "running":
                self._client.cancel([future for _, future in self._pending.values()])
                self._client.unregister_worker_plugin(self._bench.name)
        self._pending.clear()
        with contextlib.suppress(OSError):
            self._client.close(timeout=2)

    def outcomes(self, tasks: Iterable[Task]) -> Iterator[Outcome]:
        """The outcome of every task, in the order in which they end.

        Raises StudyError if the scheduler goes away or a worker has other versions.
        """
        waiting, looked = iter(tasks), -float("inf")
        while True:
            if time.monotonic() - looked > LOOK:
                ahead, looked = self._ahead(), time.monotonic()
            for task in itertools.islice(waiting, max(ahead - len(self._pending), 0)):
                self._submit(task)
            if not self._pending:
                return
            with contextlib.suppress(queue.Empty):
                future = self._done.get(timeout=LOOK)
                task, _ = self._pending.pop(future.key)
                outcome = self._outcome(task, future)
                if outcome is None:
                    self._submit(task)
                else:
                    yield outcome

    def _ahead(self) -> int:
        """How many cases to have on their way. Raises StudyError if the scheduler is gone."""
        if self._client.status != "running":
            if time.monotonic() - self._last_seen > PATIENCE:
                raise self._gone()
            return 0
        try:
            threads = sum(self._client.nthreads().values())
        except (OSError, TimeoutError):  # the next look shows whether it is gone
            return 0
        self._last_seen = time.monotonic()
        return max(AHEAD * threads, LEAST)

    def _submit(self, task: Task) -> None:
        key = f"{self._bench.name}-{task.key}-{next(self._count)}"
        future = self._client.submit(_perform, self._bench.name, task, key=key, pure=False)
        self._pending[key] = task, future
        future.add_done_callback(self._done.put)

    def _outcome(self, task: Task, future: Any) -> Outcome | None:
        """What a finished future says; None if its result went with a worker. Raises StudyError."""
        try:
            outcome: Outcome | None = future.result(timeout=PATIENCE)
        except distributed.KilledWorker:
            return died(task, self._bench.orders.limits, None)
        except (distributed.CancelledError, OSError, TimeoutError) as error:
            time.sleep(LOOK)  # a client that lost its scheduler knows of it a moment later
            if self._client.status != "running":
                raise self._gone() from error
            return None
        if outcome is None:  # another scheduler has taken the place of the first
            raise self._gone()
        return outcome

    def _gone(self) -> StudyError:
        return StudyError(
            "the Dask scheduler is gone",
            value=self._address,
            remedy="what is done is kept: start a scheduler and run again",
        )
