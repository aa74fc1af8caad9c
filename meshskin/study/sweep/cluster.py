"""An executor of tasks on a Dask cluster.

Every thread of a Dask worker has a worker process of its own (WorkerPool), which enforces time and
memory limits and survives cases that kill their process. The cases of a Dask worker that dies are
run by others; the death of the scheduler ends the sweep, which can be run again. The machines of
the cluster must see the files that the study names, at the same paths.
"""

from __future__ import annotations

import contextlib
import itertools
import queue
import time
import uuid
from collections.abc import Iterable, Iterator
from typing import Any

from ...core.errors import StudyError
from .case import Case, Outcome, environment
from .worker import WorkerSetup
from .worker_pool import WorkerPool, died

try:
    import distributed
except ImportError as error:
    raise StudyError(
        "a scheduler needs dask.distributed", remedy='pip install "meshskin[cluster]"'
    ) from error

TASKS_AHEAD = 3
"""Tasks per thread of the cluster that are submitted at a time, the running one included: no
thread waits for the parent, and few tasks are lost with a scheduler."""
FEWEST_AHEAD = 8
"""Tasks that are submitted while the cluster is small or has no workers yet."""
CONNECT_TIMEOUT = 10.0
"""Time, s, for the scheduler to answer the first call."""
LOST_TIMEOUT = 15.0
"""Time, s, after which a scheduler that does not answer counts as gone."""
POLL_PERIOD = 1.0
"""Time, s, between two queries of the state of the cluster."""


class PoolPlugin(distributed.WorkerPlugin):
    """On each Dask worker: pools of one process, which its threads take and return."""

    def __init__(self, worker_setup: WorkerSetup) -> None:
        self.worker_setup = worker_setup
        self.environment = environment()
        self.name = f"meshskin-{uuid.uuid4().hex[:12]}"

    def setup(self, worker: Any) -> None:
        """Called by Dask when the plugin comes to a worker."""
        found = environment()
        self.differences = [f"{k} {v}" for k, v in found.items() if v != self.environment.get(k)]
        self.idle: queue.SimpleQueue[WorkerPool] = queue.SimpleQueue()
        self.pools: list[WorkerPool] = []

    def teardown(self, worker: Any) -> None:
        """Called by Dask when the plugin or the worker goes."""
        for pool in self.pools:
            pool.close()

    def perform(self, task: Case) -> Outcome | None:
        """The outcome of a task; None if the plugin is removed meanwhile. Raises StudyError."""
        if self.differences:
            raise StudyError(
                "a worker of the cluster has other versions",
                value=", ".join(self.differences),
                remedy="install the same ones: results would differ",
            )
        try:
            pool = self.idle.get_nowait()
        except queue.Empty:
            pool = WorkerPool(self.worker_setup, 1)
            self.pools.append(pool)
        outcome = next(pool.outcomes([task]), None)
        self.idle.put(pool)
        return outcome


def _perform(plugin_name: str, task: Case) -> Outcome | None:
    """Run a task on the Dask worker that calls this."""
    plugin: PoolPlugin | None = distributed.get_worker().plugins.get(plugin_name)
    return None if plugin is None else plugin.perform(task)


class _Client(distributed.Client):
    """A client that is closed explicitly and not by the garbage collector.

    Dask's __del__ closes the client in the thread that collects it. If that is the thread of the
    event loop of the next client, it waits for a lock that the next client holds while it waits
    for that thread.
    """

    def __del__(self) -> None:
        pass


class Cluster:
    """A connection to a Dask scheduler.

    Raises StudyError if no scheduler answers, or its workers cannot import meshskin.
    """

    def __init__(self, setup: WorkerSetup, address: str) -> None:
        self._address = address
        self._plugin = PoolPlugin(setup)
        self._pending: dict[str, tuple[Case, Any]] = {}
        """Tasks and their futures, by the keys of the futures."""
        self._done: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._count = itertools.count()
        self._last_seen = time.monotonic()
        try:
            self._client = _Client(address, timeout=CONNECT_TIMEOUT, set_as_default=False)
        except (OSError, ValueError, AssertionError) as error:
            # AssertionError: Dask's own thread did not start in its 10 s
            raise StudyError(
                "no Dask scheduler answers", value=address, remedy="check --scheduler"
            ) from error

        try:
            self._client.register_plugin(self._plugin, name=self._plugin.name)
        except ImportError as error:
            self._client.close(timeout=2)
            raise StudyError(
                f"workers of the cluster cannot import meshskin: {error}",
                remedy="install it in their environment",
            ) from error

    def close(self) -> None:
        """Cancel what is not done, and close the connection."""
        with contextlib.suppress(OSError, distributed.CancelledError, RuntimeError):
            if self._client.status == "running":
                self._client.cancel([future for _, future in self._pending.values()])
                self._client.unregister_worker_plugin(self._plugin.name)
        self._pending.clear()
        with contextlib.suppress(OSError):
            self._client.close(timeout=2)

    def outcomes(self, tasks: Iterable[Case]) -> Iterator[Outcome]:
        """The outcome of every task, in the order in which they end.

        Raises StudyError if the scheduler goes away or a worker has other versions.
        """
        waiting, polled = iter(tasks), -float("inf")
        while True:
            if time.monotonic() - polled > POLL_PERIOD:
                ahead, polled = self._tasks_ahead(), time.monotonic()
            for task in itertools.islice(waiting, max(ahead - len(self._pending), 0)):
                self._submit(task)
            if not self._pending:
                return
            with contextlib.suppress(queue.Empty):
                future = self._done.get(timeout=POLL_PERIOD)
                task, _ = self._pending.pop(future.key)
                outcome = self._outcome(task, future)
                if outcome is None:
                    self._submit(task)
                else:
                    yield outcome

    def _tasks_ahead(self) -> int:
        """How many tasks to have submitted. Raises StudyError if the scheduler is gone."""
        if self._client.status != "running":
            if time.monotonic() - self._last_seen > LOST_TIMEOUT:
                raise self._gone()
            return 0
        try:
            threads = sum(self._client.nthreads().values())
        except (OSError, TimeoutError):  # the next query tells whether it is gone
            return 0
        self._last_seen = time.monotonic()
        return max(TASKS_AHEAD * threads, FEWEST_AHEAD)

    def _submit(self, task: Case) -> None:
        key = f"{self._plugin.name}-{task.key}-{next(self._count)}"
        future = self._client.submit(_perform, self._plugin.name, task, key=key, pure=False)
        self._pending[key] = task, future
        future.add_done_callback(self._done.put)

    def _outcome(self, task: Case, future: Any) -> Outcome | None:
        """The outcome of a future; None if it was lost with a worker. Raises StudyError."""
        try:
            outcome: Outcome | None = future.result(timeout=LOST_TIMEOUT)
        except distributed.KilledWorker:
            return died(task, self._plugin.worker_setup.limits, None)
        except (distributed.CancelledError, OSError, TimeoutError) as error:
            time.sleep(POLL_PERIOD)  # the client notices the loss of its scheduler a moment later
            if self._client.status != "running":
                raise self._gone() from error
            return None
        if outcome is None:  # another scheduler has taken the place of the first one
            raise self._gone()
        return outcome

    def _gone(self) -> StudyError:
        return StudyError(
            "the Dask scheduler is gone",
            value=self._address,
            remedy="finished cases are kept: start a scheduler and run the study again",
        )
