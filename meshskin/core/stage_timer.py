"""A clock for the stages of a run."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from time import perf_counter, process_time


@dataclass
class Clock:
    """Seconds of every stage."""

    seconds: dict[str, float] = field(default_factory=dict)
    began: tuple[float, float] = field(default_factory=lambda: (perf_counter(), process_time()))
    """On the wall and of the processor."""

    @property
    def processor(self) -> float:
        """Processor seconds since the beginning."""
        return process_time() - self.began[1]

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Measure the time spent inside."""
        start = perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + perf_counter() - start
