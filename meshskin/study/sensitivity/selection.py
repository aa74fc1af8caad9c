"""Selection of what a scene needs: candidate effects, screening by bounds, and choice by cost.

Items (effects, and steps from one level of a knob to the next finer one) are added by the shift
that they remove per second, until the rest is within the limit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from ... import effects
from ...core.arrays import Array
from ...core.errors import MeshskinError
from ...effects import Context, Effect
from ...scene.scene import Scene

NEGLIGIBLE = 0.05
"""Part of the budget that all effects that are screened out may take together, by their bounds:
small against the 0.7 that the estimate may take (budget.MARGIN)."""


@dataclass(frozen=True)
class Item:
    """An effect, or the step from one level of a knob to the next finer one."""

    name: str
    shift: Array
    """Shift of the taxels (seeds, n, 3), m, without it; NaN for a taxel that is not judged."""
    seconds: float
    """Seconds that it costs in the whole run."""
    requires: tuple[str, ...] = ()
    """Items that must be on with it."""


def candidates(scene: Scene, seed: int = 0) -> tuple[tuple[Effect, ...], dict[str, str]]:
    """The effects from which a budget chooses, in order, and why each other one is refused.

    They are the scene's effects, then its `candidates` or, if it has none, all registered effects
    with their defaults. Of effects that exclude each other the first one is taken. An effect that
    cannot be built in the scene (encoders without joints), or lacks what it requires, is refused.
    """
    context, taken, refused = scene.context(seed), list(scene.effects), {}
    listed = effects.registered() if scene.candidates is None else scene.candidates
    for effect in listed:
        names = {e.name for e in taken}
        if effect.name in names:
            continue
        excluded = (e.name for e in taken if e.name in effect.excludes or effect.name in e.excludes)
        rival = next(excluded, None)
        if rival is not None:
            refused[effect.name] = f"excluded by {rival}"
            continue
        try:
            effect.build(context)
        except MeshskinError as error:
            refused[effect.name] = str(error)
            continue
        taken.append(effect)
    while lacking := [e for e in taken if not set(e.requires) <= {other.name for other in taken}]:
        for effect in lacking:
            taken.remove(effect)
            refused[effect.name] = f"requires {', '.join(effect.requires)}"
    return effects.ordered(taken), refused


def screened(candidates: Iterable[Effect], context: Context, budget: float) -> dict[str, float]:
    """Effects that can be left out without a trial, with their bounds, m.

    They are those of the smallest bounds whose sum is at most NEGLIGIBLE of the budget, except what
    an effect that is not screened out requires.
    """
    candidates = tuple(candidates)
    out: dict[str, float] = {}
    for effect in sorted(candidates, key=lambda e: e.bound(context)):
        bound = effect.bound(context)
        if sum(out.values()) + bound > NEGLIGIBLE * budget:
            break
        out[effect.name] = bound
    while wanted := {n for e in candidates if e.name not in out for n in e.requires} & set(out):
        for name in wanted:
            del out[name]
    return out


def mean_length(shift: Array) -> float:
    """Mean length, m, of shifts (..., 3) over those that are finite; 0 if there are none."""
    length = np.linalg.norm(shift, axis=-1)
    known = length[np.isfinite(length)]
    return float(known.mean()) if len(known) else 0.0


def choose(
    items: Sequence[Item],
    limit: float,
    forced: Iterable[str],
    joint: Callable[[frozenset[str]], Array],
) -> tuple[frozenset[str], Array]:
    """Names of the items to be on, and the shift of the taxels without the others.

    Items are added by the shift that they remove per second of their cost, until the rest is at
    most `limit`, m; then those that are not needed are removed again, the most expensive first. If
    shifts do not add up, as `joint` tells, the shift (seeds, n, 3), m, with some items on and all
    others left out, more items are added. `forced` items are always on.
    """
    forced = with_required(forced, items)
    on = _prune(_grow(forced, items, limit), items, forced, limit)
    while True:
        rest = joint(on)
        if mean_length(rest) <= limit or len(on) == len(items):
            return on, rest
        on |= _most_useful(on, items, rest)


def left_out(on: Iterable[str], items: Sequence[Item]) -> Array:
    """The sum of the shifts of the items that are off."""
    on = set(on)
    return np.asarray(sum((item.shift for item in items if item.name not in on), np.zeros(3)))


def _grow(on: frozenset[str], items: Sequence[Item], limit: float) -> frozenset[str]:
    """`on` and the most useful items, until the sum of the other shifts is within the limit."""
    while len(on) < len(items) and mean_length(rest := left_out(on, items)) > limit:
        on |= _most_useful(on, items, rest)
    return on


def _most_useful(on: frozenset[str], items: Sequence[Item], rest: Array) -> frozenset[str]:
    """The item that removes most of `rest` per second, with what it requires.

    If no item removes any, because parts cancel each other: the largest one per second.
    """

    def rates(item: Item) -> tuple[float, float]:
        new = with_required([item.name], items) - on
        parts = [other for other in items if other.name in new]
        off = rest - sum((other.shift for other in parts), np.zeros(3))
        seconds = sum(other.seconds for other in parts)
        return (mean_length(rest) - mean_length(off)) / seconds, mean_length(item.shift) / seconds

    known = {item.name: rates(item) for item in items if item.name not in on}
    by = 0 if any(rate[0] > 0 for rate in known.values()) else 1
    return with_required([max(known, key=lambda name: known[name][by])], items)


def _prune(
    on: frozenset[str], items: Sequence[Item], forced: frozenset[str], limit: float
) -> frozenset[str]:
    """`on` without the items that the limit does not need, the most expensive removed first."""
    for item in sorted(items, key=lambda item: -item.seconds):
        needed = {item.name} & forced or any(
            item.name in other.requires for other in items if other.name in on
        )
        without = on - {item.name}
        if item.name in on and not needed and mean_length(left_out(without, items)) <= limit:
            on = without
    return on


def with_required(names: Iterable[str], items: Sequence[Item]) -> frozenset[str]:
    """The names with all that they require."""
    return closure(names, {item.name: item.requires for item in items})


def closure(names: Iterable[str], links: Mapping[str, Iterable[str]]) -> frozenset[str]:
    """The names with all that they are linked with, directly or not."""
    out, new = frozenset[str](), frozenset(names)
    while new:
        out |= new
        new = frozenset(other for name in new for other in links[name]) - out
    return out
