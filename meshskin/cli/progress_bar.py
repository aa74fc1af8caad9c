"""A bar for each stage of a command, on stderr: how far it is, the time left and the pace.

Where stderr is not a terminal, as in continuous integration, each stage is one plain line.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from time import perf_counter
from typing import Any

from tqdm import tqdm

NAMES = {"cases": "case", "cost": "setting", "cross-validate": "fold", "simulate": "path point"}
"""What a step of a stage is, where it has a pace: its steps take about the same time."""
FORMAT = "{desc:14} {percentage:3.0f} % |{bar}| {elapsed}, {remaining} left{pace}{postfix}"


def pace(rate: float | None, name: str) -> str:
    """A rate, 1/s, or its inverse where that is above 1 s; nothing without rate or name."""
    if not rate or not name:
        return ""
    if rate < 1:
        return f", {1 / rate:.2g} s/{name}"
    return f", {rate:,.0f} {name}s/s" if rate >= 10 else f", {rate:.2g} {name}s/s"


class _Bar(tqdm):
    """The bar of a stage in a terminal."""

    monitor_interval = 0  # its thread would keep `Beside` from forking

    @property
    def format_dict(self) -> dict[str, Any]:
        values: dict[str, Any] = super().format_dict
        elapsed, done = values["elapsed"], values["n"] - values["initial"]
        rate = values["rate"] or (done / elapsed if elapsed else None)
        return values | {"pace": pace(rate, NAMES.get(values["prefix"].strip(" :"), ""))}


class _Line:
    """The line of a stage that has ended, where there is no terminal."""

    def __init__(self, name: str) -> None:
        self.name, self.note, self.n, self.total = name, "", 0, 1
        self.began = perf_counter()

    def close(self) -> None:
        if self.n >= self.total:
            seconds = perf_counter() - self.began
            print(f"{self.name:14} {seconds:.1f} s{self.note}", file=sys.stderr, flush=True)


@contextmanager
def bar(quiet: bool) -> Iterator[Callable[..., None] | None]:
    """A hook that shows one stage after the other on stderr; None where `quiet`.

    The time left does not count what a stage had done when it began.
    """
    if quiet:
        yield None
        return
    terminal, shown = sys.stderr.isatty(), dict[str, Any]()

    def progress(stage: str, done: int, total: int, note: str = "") -> None:
        if stage not in shown or done < shown[stage].n:
            close()
            begun = {"initial": done, "desc": stage, "bar_format": FORMAT}
            shown[stage] = _Bar(total=total, **begun) if terminal else _Line(stage)
        one = shown[stage]
        one.total = total
        if terminal:
            one.set_postfix_str(note, refresh=False)
            one.update(done - one.n)
        else:
            one.n, one.note = done, note

    def close() -> None:
        while shown:
            shown.popitem()[1].close()

    try:
        yield progress
    finally:
        close()
