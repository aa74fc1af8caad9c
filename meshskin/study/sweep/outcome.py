"""The outcome of a case, and the limits under which it ran."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

DONE, FAILED = "done", "failed"
RAISED, TIMEOUT, MEMORY, DIED = "raised", "timeout", "memory", "died"


@dataclass(frozen=True)
class Limits:
    """Resources that one case may use."""

    seconds: float | None = None
    """Wall time, s; None: no limit."""
    memory: float | None = None
    """Data segment of the worker process, bytes; None: no limit."""


@dataclass(frozen=True)
class Outcome:
    """The result of a case, or the reason why there is none."""

    key: str
    """Key of the case."""
    values: Mapping[str, Any] = field(default_factory=dict)
    """Results of the run function; empty if it failed."""
    reason: str | None = None
    """None if done; otherwise RAISED, TIMEOUT, MEMORY or DIED."""
    error: str | None = None
    """Error message in one line; None if done."""
    trace: str | None = None
    """Traceback of a case that raised an exception."""
    seconds: float = 0.0
    """Wall time in the worker, s."""
    limits: Limits = field(default_factory=Limits)
    """Limits under which the case ran."""

    @property
    def status(self) -> str:
        """DONE or FAILED."""
        return DONE if self.reason is None else FAILED

    def is_final(self, limits: Limits) -> bool:
        """Whether running the case again under `limits` would give the same outcome.

        A case that ran out of time or memory may succeed with more of it; a worker that died may
        have been killed from outside.
        """
        if self.reason == TIMEOUT:
            return _not_larger(limits.seconds, self.limits.seconds)
        if self.reason == MEMORY:
            return _not_larger(limits.memory, self.limits.memory)
        return self.reason != DIED


def _not_larger(now: float | None, before: float | None) -> bool:
    return before is None or (now is not None and now <= before)
