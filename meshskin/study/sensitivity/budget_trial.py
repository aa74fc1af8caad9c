"""The trial of a scene: what everything is, what each part of it is worth, and the verdict."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

from ...core.se3 import Array
from ...effects import Effect
from ...exploration.plan import plan_exploration
from .budget_report import BudgetReport, Check, Entry
from .knobs import Knob, finest_step, knobs
from .replay import Replay
from .screening import screened
from .selection import Item, left_out, size
from .shifts import Effects, Rehearsed, tolerance

if TYPE_CHECKING:
    from ...scene.scene import Scene


class Trial:
    """A scene on trial."""

    def __init__(
        self,
        scene: Scene,
        effects: tuple[Effect, ...],
        budget: float,
        seeds: Sequence[int],
        progress: Callable[[str, int, int], None] | None = None,
    ) -> None:
        self.scene, self.effects, self.budget = scene, effects, budget
        self.screened = screened(effects, scene.context(seeds[0]), budget)
        self.path = plan_exploration(finest_step(scene)).path
        """What all explore alike, so that it is not the exploration that differs."""
        run = Replay.of(scene, self.path)
        self.halves = run.halves()
        self.frames = run.frames_in_all
        ladders = knobs(scene.with_(effects=effects), run.steps_in_all, self.frames)
        total = sum(len(knob.rungs) for knob in ladders) + len(effects) + 1
        done = 0

        def told() -> None:
            nonlocal done
            done += 1
            if progress is not None:
                progress("budget", done, total)

        self.belief = scene.with_(effects=effects).belief()
        """What the owner knows: of all effects, and of the scene as it is declared."""
        self.knobs: list[tuple[Knob, list[Array]]] = []
        """Each knob, and the shifts of its settings against its finest."""
        for knob in ladders:
            rehearsed = Rehearsed.of(knob, run, self.path, self.halves, told)
            self.knobs.append(rehearsed.judged(self.belief, self.halves.taxels[0]))
        finest = {k: v for knob, _ in self.knobs for k, v in knob.rungs[-1].changes.items()}
        self.everything = scene.with_(effects=effects, budget=None, **finest)
        self.trial = Effects(run, self.halves, self.belief, effects, seeds)
        self.resting = tolerance(self.trial, self.frames)
        """The solver's tolerance, a knob of the calibration."""
        told()
        self.changed: dict[str, int] = {}
        """Taxels that answer or fall silent for leaving an effect out."""
        cells = self.frames * len(scene.skin.ids)
        self.seconds = {effect.name: effect.cost * cells for effect in effects}
        """What an effect costs in the whole run: what it states, and what the readings cost that it
        adds or takes away."""
        items: list[Item] = []
        for effect in effects:
            if effect.name not in self.screened:
                items.append(self._effect(effect))
            told()
        for knob, shifts in (*self.knobs, self.resting):
            items += steps_of(knob, shifts, len(seeds))
        self.items = tuple(items)

    def _effect(self, effect: Effect) -> Item:
        name = effect.name
        without = self.trial.without(self._with_dependants(name))
        self.changed[name] = without.changed
        self.seconds[name] += without.fewer * self.resting[0].rungs[0].seconds
        required = tuple(n for n in effect.requires if n not in self.screened)
        return Item(name, without.shift, self.seconds[name], required)

    def _with_dependants(self, name: str) -> set[str]:
        """The effect and those that require it."""
        out, before = {name}, set[str]()
        while out != before:
            before = set(out)
            out |= {e.name for e in self.effects if before & set(e.requires)}
        return out

    def forced(self, limit: float) -> dict[str, str]:
        """What is on in any case, and why."""
        out = {}
        for effect in self.effects:
            if self.changed.get(effect.name):
                out[effect.name] = (
                    f"{self.changed[effect.name]} of {len(self.halves.taxels[0])} taxels answer "
                    "with it or without it only"
                )
        for item in self.items:
            if item.name in out:
                continue
            if size(item.shift) > limit:
                out[item.name] = "alone more than may be left out"
            elif item.seconds <= 0.0:
                out[item.name] = "saves more readings to be calibrated than it costs"
        return out

    def joint(self, on: Iterable[str]) -> Array:
        """How leaving out all but `on` moves the taxels, effects tried together."""
        on = set(on)
        off = {e.name for e in self.effects if e.name not in on}
        steps = [item for item in self.items if ":" in item.name]
        return self.trial.without(off).shift + left_out(on, steps)

    def scene_of(self, on: Iterable[str]) -> Scene:
        """The scene with these items on."""
        on = set(on)
        changes: dict[str, object] = {}
        for knob, _ in self.knobs:
            changes |= knob.rungs[rung(knob, on)].changes
        effects = tuple(e for e in self.effects if e.name in on)
        return self.scene.with_(effects=effects, budget=None, **changes)

    def tolerance_of(self, on: Iterable[str]) -> float:
        """The solver's tolerance with these items on."""
        knob, _ = self.resting
        return float(knob.rungs[rung(knob, on)].changes["tolerance"])

    def ledger(
        self, on: Iterable[str], rest: Array, check: Check, limit: float, refused: Mapping[str, str]
    ) -> BudgetReport:
        """What was decided."""
        on, forced = set(on), self.forced(limit)
        shifts = {item.name: size(item.shift) for item in self.items}
        entries = []
        for effect in self.effects:
            name, seconds = effect.name, self.seconds[effect.name]
            if name in self.screened:
                why = "screened: its bound is negligible"
                entries.append(Entry(name, "off", False, self.screened[name], seconds, why))
                continue
            if name in on:
                why = forced.get(name, "takes most off the rest for its seconds")
            else:
                why = "the budget bears it"
            setting = "on" if name in on else "off"
            entries.append(Entry(name, setting, name in on, shifts[name], seconds, why))
        entries.sort(key=lambda entry: -entry.shift)
        entries += [entry_of(knob, shifts, on) for knob, shifts in (*self.knobs, self.resting)]
        entries += [Entry(name, "off", False, 0.0, 0.0, why) for name, why in refused.items()]
        return BudgetReport(
            budget=self.budget,
            entries=tuple(entries),
            estimate=size(rest),
            check=check,
            scene=self.scene_of(on),
            everything=self.everything,
            belief=replace(self.belief, body=self.scene_of(on).body),
            tolerance=self.tolerance_of(on),
        )


def steps_of(knob: Knob, shifts: Sequence[Array], seeds: int) -> list[Item]:
    """One item for each step up a knob's ladder."""
    items = []
    for k, (low, high) in enumerate(pairwise(knob.rungs)):
        shift = np.broadcast_to(shifts[k] - shifts[k + 1], (seeds, *shifts[k].shape))
        seconds = max(high.seconds - low.seconds, 1e-9)
        below = (_step(knob, k - 1),) if k else ()
        items.append(Item(_step(knob, k), shift, seconds, below))
    return items


def rung(knob: Knob, on: Iterable[str]) -> int:
    """How far up its ladder a knob is with these items on."""
    on = set(on)
    return sum(_step(knob, k) in on for k in range(len(knob.rungs) - 1))


def entry_of(knob: Knob, shifts: Sequence[Array], on: Iterable[str]) -> Entry:
    """The entry of a knob."""
    k, moves = rung(knob, on), [size(shift) for shift in shifts]
    tried = zip(knob.rungs, moves, strict=True)
    why = ", ".join(f"{r.label} {1e3 * move:.2g} mm" for r, move in tried)
    return Entry(knob.name, knob.rungs[k].label, True, moves[k], knob.rungs[k].seconds, why)


def _step(knob: Knob, k: int) -> str:
    """Name of the step from a knob's setting k to the next."""
    return f"{knob.name}:{k}"
