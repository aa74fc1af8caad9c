"""Progress of long work, reported to a hook: progress(stage, done, total).

The hook is called in the thread of the work, between its steps and never while a file is being
written. What it raises ends the work: KeyboardInterrupt or any other exception reaches the caller,
and no half-written file is left.
"""

from __future__ import annotations

from collections.abc import Callable

Progress = Callable[[str, int, int], None]
"""progress(stage, done, total): `done` of `total` steps of a stage are done. Where the number of
steps is not known before, `total` is what is usual, and changes; at the end of a stage both are
equal."""


class Stage:
    """One stage of long work, whose steps are counted and reported to a hook, if there is one."""

    def __init__(self, progress: Progress | None = None, name: str = "", total: int = 1) -> None:
        """total: the number of steps; where it is not known before, what is usual. The report of 0
        steps is made at once."""
        self.progress, self.name, self.total, self.done = progress, name, total, 0
        self._report()

    def step(self) -> None:
        """One more step is done."""
        self.at(self.done + 1)

    def at(self, done: int) -> None:
        """`done` steps are done."""
        self.done = done
        self._report()

    def expect(self, more: int) -> None:
        """From now on, `more` steps are usual."""
        self.total = self.done + more

    def end(self) -> None:
        """The stage has ended, after however many steps."""
        if self.done != self.total or not self.done:
            self.total = self.done = max(self.done, 1)
            self._report()

    def _report(self) -> None:
        if self.progress is not None:
            self.progress(self.name, self.done, max(self.total, self.done))
