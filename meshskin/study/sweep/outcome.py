"""What became of a case."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

DONE, FAILED = "done", "failed"
RAISED, TIMEOUT, MEMORY, DIED = "raised", "timeout", "memory", "died"


@dataclass(frozen=True)
class Limits:
    """What one case may use."""

    seconds: float | None = None
    """Wall time, s; None: no limit."""
    memory: float | None = None
    """Data of the worker process, bytes; None: no limit."""


@dataclass(frozen=True)
class Outcome:
    """The result of a case, or why there is none."""

    key: str
    """Of the case."""
    values: Mapping[str, Any] = field(default_factory=dict)
    """What the run function returned; empty where it failed."""
    reason: str | None = None
    """None if done, else one of RAISED, TIMEOUT, MEMORY, DIED."""
    error: str | None = None
    """One line; None if done."""
    trace: str | None = None
    """The traceback of a case that raised."""
    seconds: float = 0.0
    """Wall time in the worker, s."""
    limits: Limits = field(default_factory=Limits)
    """What it was allowed."""

    @property
    def status(self) -> str:
        """DONE or FAILED."""
        return DONE if self.reason is None else FAILED

    def settled(self, limits: Limits) -> bool:
        """Whether running the case again under `limits` would only say the same.

        A case that ran out of time or memory may do better with more of it; a worker that died may
        have been killed from outside.
        """
        if self.reason == TIMEOUT:
            return _no_more(limits.seconds, self.limits.seconds)
        if self.reason == MEMORY:
            return _no_more(limits.memory, self.limits.memory)
        return self.reason != DIED


def _no_more(now: float | None, before: float | None) -> bool:
    return before is None or (now is not None and now <= before)
