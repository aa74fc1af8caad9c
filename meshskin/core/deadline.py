"""The time by which work has to end: checked between its steps, by the hook of its progress."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from time import perf_counter, process_time

from .errors import OutOfTime, StudyError
from .progress import Progress

LEAST_SECONDS = 3.0
"""Least processor time, s, of a run at a pace of 1: packages, the paper's sphere on wide lanes and
a page without figures (3.0 to 3.4 measured; `pytest -m slow tests/study/test_deadline.py`)."""
PACE_SECONDS = 0.5e-3
"""Processor time, s, of the work of `pace` where LEAST_SECONDS was measured."""
IMPORT_SECONDS = 0.9
"""The part of LEAST_SECONDS that importing the packages takes, s."""
OVERTIME = 1.15
"""Part of its time that a run on wide lanes may take, and is refused beyond: a result a little late
is better than none. `pipeline.run` and docs/guides/accuracy_cost.md say so."""
TELLING = 0.5
"""Processor time, s, of a process from which its slowdown tells how long the rest takes."""
REPORT_SECONDS, PAGE_SECONDS, FIGURE_SECONDS = 2.0, 0.3, 0.8
"""Usual processor time, s, of a report with all figures (docs, speed), of metrics and a page
without figures, and of a page with the first one, for which the drawing library is loaded."""


STARTED = 0.17
"""Usual processor time, s, of the interpreter and of the command line until a command begins."""


def command_began() -> tuple[float, float]:
    """Wall and processor time, s, at which the command began that now starts its work."""
    return perf_counter() - STARTED * crowding(), process_time() - STARTED


def crowding() -> float:
    """Factor by which other processes lengthen the time of this one; at least 1.

    The smaller of two: this process's time of running and waiting for a processor over that of
    running, which Linux counts; and the runnable processes per processor, the fewer of now and on
    average over the last minute. 1 where the system does not count them.
    """
    try:
        running, waiting = map(int, Path("/proc/self/schedstat").read_text().split()[:2])
        now = int(Path("/proc/loadavg").read_text().split()[3].partition("/")[0])
        wanting = min(now, os.getloadavg()[0]) / (os.cpu_count() or 1)
        return max(min(1 + waiting / running, wanting), 1.0)
    except (OSError, IndexError, ValueError, ZeroDivisionError):
        return 1.0


def pace() -> float:
    """Factor by which this machine computes slower than the one of LEAST_SECONDS: the shortest of
    30 times of a sum of squares."""
    times = []
    for _ in range(30):
        began = process_time()
        sum(k * k for k in range(10_000))
        times.append(process_time() - began)
    return min(times) / PACE_SECONDS


@contextmanager
def in_time(asked: str, work: str) -> Iterator[None]:
    """Raise StudyError, with the time that was asked for, where `work` within raises OutOfTime."""
    try:
        yield
    except OutOfTime as error:
        raise StudyError(
            "the time is too short",
            value=asked,
            limit=f"{work} takes longer",
            remedy="give more seconds",
        ) from error


@dataclass(frozen=True)
class Deadline:
    """The wall time that work may take."""

    seconds: float = math.inf
    """From `began` to the end, s."""
    began: tuple[float, float] = field(default_factory=lambda: (perf_counter(), process_time()))
    """Wall and processor time at the beginning, s."""

    @property
    def spent(self) -> tuple[float, float]:
        """Wall and processor time since the beginning, s."""
        return perf_counter() - self.began[0], process_time() - self.began[1]

    @property
    def left(self) -> float:
        """Seconds of wall time that are left."""
        return self.seconds - self.spent[0]

    @property
    def slowdown(self) -> float:
        """Wall time over processor time since the beginning, at least 1: other work on the machine
        takes the rest."""
        wall, processor = self.spent
        return max(wall / max(processor, 1e-9), 1.0)

    def check_run(self, processor: float) -> None:
        """Raise StudyError where a run that needs `processor` more seconds, at a pace of 1, cannot
        end in time: from here to there the machine is as crowded as it was, or is."""
        if math.isinf(self.seconds):
            return
        wall, used = self.spent
        slowdown = self.slowdown if used > TELLING else crowding()
        least = wall + processor * pace() * slowdown
        if 0 < OVERTIME * self.seconds < least:
            parts = 10 if least < 100 else 1
            raise StudyError(
                "the time is too short",
                value=f"{self.seconds:g} s",
                limit=f"a run takes {math.ceil(parts * least - 1e-6) / parts:g} s at least",
                remedy="give more seconds",
            )

    def check(self, processor: float = 0.0) -> None:
        """Raise OutOfTime unless there is time for work of `processor` seconds."""
        if self.left < processor * self.slowdown:
            raise OutOfTime("the time is used up", value=f"{self.seconds:g} s")

    def hook(self, progress: Progress | None = None, reserve: float = 0.0) -> Progress:
        """A hook that checks that `reserve` processor seconds are left, and then calls `progress`,
        if there is one."""

        def hook(stage: str, done: int, total: int) -> None:
            self.check(reserve)
            if progress is not None:
                progress(stage, done, total)

        return hook
