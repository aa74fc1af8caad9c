"""A worker process: gets cases, sends outcomes, until its parent closes the line or is gone.

    python -P -c "from meshskin.study.sweep.worker import main; main()"

Frames on stdin and stdout: four bytes of length, a pickle. First comes the Setup, then cases, one
at a time; back come one Ready and outcomes. What cases print goes to
stderr. No case outlives the parent.
"""

from __future__ import annotations

import ctypes
import os
import pickle
import queue
import signal
import struct
import sys
import threading
import time
import traceback
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from ...core.errors import StudyError
from .base import Base
from .case import Case, Run, checked
from .outcome import MEMORY, RAISED, Limits, Outcome
from .reference import Reference

_LENGTH = struct.Struct("<I")
_PR_SET_PDEATHSIG = 1


@dataclass(frozen=True)
class Ready:
    """A worker's first word: it has its imports, or why it has not."""

    error: str | None = None


@dataclass(frozen=True)
class Setup:
    """What a worker needs once."""

    run: Reference
    base: Base
    limits: Limits


@dataclass(frozen=True)
class Task:
    """A case on its way to a worker, without what the Setup has brought."""

    key: str
    parameters: Mapping[str, Any]
    seed: int
    method: str

    @classmethod
    def of(cls, case: Case) -> Task:
        """The task of a case."""
        return cls(case.key, case.parameters, case.seed, case.method)

    def case(self, base: Base) -> Case:
        """The case again."""
        return Case(self.key, self.parameters, self.seed, self.method, base)


def send(line: IO[bytes], message: object) -> None:
    """Write a frame. Raises OSError where the other end is gone."""
    data = pickle.dumps(message)
    line.write(_LENGTH.pack(len(data)) + data)
    line.flush()


def receive(line: IO[bytes]) -> Any:
    """Read a frame. Raises EOFError where the line is closed, or was cut within a frame."""
    head = line.read(_LENGTH.size)
    if len(head) < _LENGTH.size:
        raise EOFError
    (length,) = _LENGTH.unpack(head)
    data = line.read(length)
    if len(data) < length:
        raise EOFError
    return pickle.loads(data)


def main() -> None:
    """Work until the line is closed."""
    _die_with_parent()
    answers = os.fdopen(os.dup(1), "wb")
    orders = os.fdopen(os.dup(0), "rb")
    os.dup2(2, 1)  # what cases print must not get among the frames
    with open(os.devnull, "rb") as nothing:
        os.dup2(nothing.fileno(), 0)
    inbox: queue.SimpleQueue[Any] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(orders, inbox), daemon=True).start()
    setup: Setup = inbox.get()
    try:
        run = setup.run.load()
    except StudyError as error:
        send(answers, Ready(str(error)))
        return
    send(answers, Ready())
    while True:
        task: Task = inbox.get()
        send(answers, perform(task.case(setup.base), run, setup.limits))


def perform(case: Case, run: Run, limits: Limits) -> Outcome:
    """Run a case; whatever it raises becomes part of the outcome."""
    begin = time.perf_counter()
    values: dict[str, Any] = {}
    reason = error = trace = None
    try:
        with _memory(limits.memory):
            values = checked(run(case), case.parameters)
    except Exception as problem:  # a case may fail in any way: the others must go on
        text = " ".join(str(problem).split())
        if isinstance(problem, MemoryError) or "bad_alloc" in text:
            reason, error = MEMORY, _memory_error(limits)
        else:
            reason, trace = RAISED, traceback.format_exc()
            error = f"{type(problem).__name__}: {text}" if text else type(problem).__name__
    return Outcome(case.key, values, reason, error, trace, time.perf_counter() - begin, limits)


def _memory_error(limits: Limits) -> str:
    if limits.memory is None:
        return "out of memory"
    return f"out of memory, limit: {limits.memory / 1e6:g} MB"


@contextmanager
def _memory(limit: float | None) -> Iterator[None]:
    """Let this process hold at most `limit` bytes of data inside; Linux only."""
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


def _listen(orders: IO[bytes], inbox: queue.SimpleQueue[Any]) -> None:
    """Pass orders on; end the process at once when the parent is gone, even within a case."""
    while True:
        try:
            inbox.put(receive(orders))
        except EOFError:
            os._exit(0)


def _die_with_parent() -> None:
    """On Linux: be killed with the parent, even in compiled code that lets no thread run.

    And be the first to go when the machine is out of memory, not the parent.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)
        Path("/proc/self/oom_score_adj").write_text("1000")
