"""What is needed: items added by millimetres per second until the rest fits the budget."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from ...core.se3 import Array

Joint = Callable[[frozenset[str]], Array]
"""How leaving out all but these items moves the taxels (seeds, n, 3), m."""


@dataclass(frozen=True)
class Item:
    """An effect, or the step from one setting of a knob to the next finer one."""

    name: str
    shift: Array
    """How leaving it out moves the taxels (seeds, n, 3), m; NaN where a taxel is not judged."""
    seconds: float
    """What it costs in the whole run."""
    requires: tuple[str, ...] = ()
    """Items that must be on with it."""


def size(shift: Array) -> float:
    """Mean length, m, of shifts (..., 3) over those that are numbers; 0 for none."""
    length = np.linalg.norm(shift, axis=-1)
    known = length[np.isfinite(length)]
    return float(known.mean()) if len(known) else 0.0


def choose(
    items: Sequence[Item], limit: float, forced: Iterable[str], joint: Joint
) -> tuple[frozenset[str], Array]:
    """Names of the items to be on, and how leaving out the rest moves the taxels.

    Added by how much of the rest each takes off for a second of its cost, until the rest moves the
    taxels by at most `limit`, m; then those that turn out not to be needed are taken out again, the
    most expensive first. Where shifts do not add up, which `joint` tells, more is added, one after
    the other. `forced` items are on anyway.
    """
    forced = together(forced, items)
    on = pruned(grown(forced, items, limit), items, forced, limit)
    while True:
        rest = joint(on)
        if size(rest) <= limit or len(on) == len(items):
            return on, rest
        on |= added(on, items, rest)


def left_out(on: Iterable[str], items: Sequence[Item]) -> Array:
    """The sum of the shifts of what is off."""
    on = set(on)
    return np.asarray(sum((item.shift for item in items if item.name not in on), np.zeros(3)))


def grown(on: frozenset[str], items: Sequence[Item], limit: float) -> frozenset[str]:
    """`on` with what takes off most of the rest in a second, again and again, while it is too much:
    by the sum of the shifts.
    """
    while len(on) < len(items) and size(rest := left_out(on, items)) > limit:
        on |= added(on, items, rest)
    return on


def added(on: frozenset[str], items: Sequence[Item], rest: Array) -> frozenset[str]:
    """What takes off most of `rest` in a second, with what it requires.

    Where nothing takes anything off, for parts cancel each other, the largest for its seconds.
    """

    def rates(item: Item) -> tuple[float, float]:
        new = together([item.name], items) - on
        parts = [other for other in items if other.name in new]
        off = rest - sum((other.shift for other in parts), np.zeros(3))
        seconds = sum(other.seconds for other in parts)
        return (size(rest) - size(off)) / seconds, size(item.shift) / seconds

    known = {item.name: rates(item) for item in items if item.name not in on}
    by = 0 if any(rate[0] > 0 for rate in known.values()) else 1
    return together([max(known, key=lambda name: known[name][by])], items)


def pruned(
    on: frozenset[str], items: Sequence[Item], forced: frozenset[str], limit: float
) -> frozenset[str]:
    """`on` without what the budget can do without, the most expensive first."""
    for item in sorted(items, key=lambda item: -item.seconds):
        needed = {item.name} & forced or any(
            item.name in other.requires for other in items if other.name in on
        )
        if item.name in on and not needed and size(left_out(on - {item.name}, items)) <= limit:
            on = on - {item.name}
    return on


def together(names: Iterable[str], items: Sequence[Item]) -> frozenset[str]:
    """The names with all that they require."""
    requires = {item.name: item.requires for item in items}
    out, new = frozenset[str](), frozenset(names)
    while new:
        out |= new
        new = frozenset(other for name in new for other in requires[name]) - out
    return out
