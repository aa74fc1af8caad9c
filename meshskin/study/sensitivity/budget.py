"""The error budget: which effects a scene needs, and how finely it must be computed.

1. Effects whose own bounds are negligible are left out (selection.screened).
2. The shift of the taxels without each other effect, and at each coarser level of each knob, is
   estimated by one Gauss-Newton step from the solution with everything on (shifts).
3. Effects and levels are chosen by the shift that they remove per second, until the rest fits the
   budget, all of it together (selection.choose).
4. The choice is checked against everything on, over contacts and seeds kept aside (replay.Holdout).
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from numbers import Real
from typing import Any

import numpy as np

from ...core.arguments import check_type
from ...core.arrays import Array
from ...core.errors import ConfigError, ContactError, ReachError, SimulationError
from ...core.progress import Progress, Stage
from ...effects import Effect
from ...exploration.plan import plan_exploration
from ...scene.file import BUDGET
from ...scene.scene import Scene
from .budget_report import BudgetReport, Check, Entry
from .knobs import Knob, Level, mesh_bodies, scene_knobs, time_steps
from .replay import Holdout, Replay
from .selection import (
    NEGLIGIBLE,
    Item,
    candidates,
    choose,
    closure,
    left_out,
    mean_length,
    screened,
)
from .setting import with_changes
from .shifts import EffectShifts, Solution, against_finest, tolerance_knob

MARGIN = 0.7
"""Part of the budget that the estimate may take: the errors over other contacts and seeds differ
from it (`python studies/budget.py`: by less than a factor of 2)."""
SEEDS, HOLDOUT_SEEDS = 2, 1
"""Number of seeds that are tried, and of seeds kept aside for the check."""
CHECKS = 8
"""Most checks. After one that exceeds the budget, or exceeds the estimate by far, or loses a taxel,
more is added; each lowers the limit by the factor by which it was exceeded."""


def budget(
    scene: Scene,
    taxel_error: float | None = None,
    *,
    seed: int = 0,
    progress: Progress | None = None,
) -> BudgetReport:
    """Choose effects, contact model, mesh and time step such that the rest moves taxels little.

    taxel_error: mean shift, m, of the calibrated taxels by all that is left out; by default the
    scene's own `budget`, or 0.2 mm. The choice is among the scene's effects and its `candidates`
    (by default every registered effect), contact models, meshes of a primitive, time steps and
    tolerances of the calibration. The belief of the owner is the same throughout. seed: the first
    of the seeds that are tried. Raises ConfigError for a budget that is not positive; otherwise as
    `simulate` and `calibrate`.
    """
    check_type(Scene, scene, "the scene of a budget")
    if taxel_error is None:
        taxel_error = BUDGET if scene.budget is None else scene.budget
    check_type(Real, taxel_error, "an error budget")
    if not (math.isfinite(taxel_error) and taxel_error > 0):
        raise ConfigError(
            "an error budget must be positive",
            value=f"{1e3 * taxel_error:g} mm",
            limit="above 0 mm",
            remedy="to have everything on, simulate the scene without a budget",
        )
    effects, refused = candidates(scene, seed)
    trial = BudgetTrial(scene, effects, taxel_error, range(seed, seed + SEEDS), progress)
    aside, limit = range(seed + SEEDS, seed + SEEDS + HOLDOUT_SEEDS), MARGIN * taxel_error
    holdout = Holdout(trial.everything, trial.belief, trial.path, trial.halves, aside)
    stage = Stage(progress, "check", CHECKS)
    for _ in range(CHECKS):
        on, rest = choose(trial.items, limit, trial.forced(limit), trial.joint_shift)
        estimate = mean_length(rest)
        check = holdout.check(trial.scene_with(on), trial.tolerance_with(on))
        stage.step()
        confirmed = check.shift <= max(2.0 * estimate, NEGLIGIBLE * taxel_error)
        fits = check.shift <= taxel_error and check.lost == 0
        if (fits and confirmed) or len(on) == len(trial.items):
            break
        limit = MARGIN * min(limit, estimate) / max(check.shift / taxel_error, 1.0)
    stage.end()
    return trial.report(on, estimate, check, limit, refused)


class BudgetTrial:
    """The trial of a scene: everything on, and the worth of each part of it."""

    def __init__(
        self,
        scene: Scene,
        effects: tuple[Effect, ...],
        budget: float,
        seeds: Sequence[int],
        progress: Progress | None = None,
    ) -> None:
        self.scene, self.effects, self.budget = scene, effects, budget
        self.screened = screened(effects, scene.context(seeds[0]), budget)
        self.path = plan_exploration(with_changes(scene, {"dt": time_steps(scene)[-1]})).path
        """Path of all runs, so that their explorations do not differ."""
        replay = Replay.of(scene, self.path)
        self.halves, self.frames = replay.halves(), replay.frames_in_all
        self._bodies = mesh_bodies(scene)
        self.belief = scene.with_(effects=effects).belief()
        """Belief with all effects, of the scene as it is declared."""
        knobs = scene_knobs(
            scene.with_(effects=effects), self._bodies, replay.steps_in_all, self.frames
        )
        total = sum(len(knob.levels) for knob in knobs) + len(effects) + 1
        stage = Stage(progress, "budget", total)
        self.knobs = tuple(self._measured(knob, replay, stage) for knob in knobs)
        finest = {k: v for knob in self.knobs for k, v in knob.levels[-1].changes.items()}
        self.everything = self._changed(finest).with_(effects=effects, budget=None)
        """The scene with all effects, at the finest levels."""
        self.shifts = EffectShifts(replay, self.halves, self.belief, effects, seeds)
        self.tolerance = tolerance_knob(self.shifts, self.frames)
        stage.step()
        self.changed: dict[str, int] = {}
        """Taxels that are determined only with an effect, or only without it, by its name."""
        cells = self.frames * len(scene.skin.ids)
        self.seconds = {effect.name: effect.cost * cells for effect in effects}
        """Seconds of an effect in the whole run: what it states, and those of the readings that it
        adds or removes."""
        items: list[Item] = []
        for effect in effects:
            if effect.name not in self.screened:
                items.append(self._effect_item(effect))
            stage.step()
        for knob in (*self.knobs, self.tolerance):
            items += _knob_items(knob, len(seeds))
        self.items = tuple(items)

    def _changed(self, changes: Mapping[str, Any]) -> Scene:
        """The scene with the changes of a level."""
        scene = with_changes(self.scene, changes)
        return scene.with_(body=self._bodies[changes["faces"]]) if "faces" in changes else scene

    def _measured(self, knob: Knob, replay: Replay, stage: Stage) -> Knob:
        """A knob with the shifts of its levels, measured along the path without effects.

        replay: of the scene's own level; stage: called after each level. Levels that cannot be run
        (a time step may be too long for the touch), or under which the contact model does not hold,
        are left out.
        """
        solution, levels = Solution.true(replay.scene), list[Level]()
        for k, level in enumerate(knob.levels):
            own, scene = k == knob.declared, self._changed(level.changes)
            try:
                run = replay if own else Replay.of(scene, self.path)
            except (SimulationError, ReachError, ContactError):
                continue
            finally:
                stage.step()
            recording = run.recording((), 0, self.halves)
            try:
                move, _ = solution.step(recording, replace(self.belief, body=scene.body))
            except ContactError:
                if own:
                    raise
                continue
            if own:
                declared = len(levels)
            levels.append(replace(level, shift=move[self.halves.taxels[0]]))
        return against_finest(knob.name, levels, declared)

    def _effect_item(self, effect: Effect) -> Item:
        name = effect.name
        dependants = {
            e.name: [o.name for o in self.effects if e.name in o.requires] for e in self.effects
        }
        shift, self.changed[name], fewer = self.shifts.without(closure([name], dependants))
        self.seconds[name] += fewer * self.tolerance.levels[0].seconds
        required = tuple(n for n in effect.requires if n not in self.screened)
        return Item(name, shift, self.seconds[name], required)

    def forced(self, limit: float) -> dict[str, str]:
        """The items that are on in any case, with the reason."""
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
            if mean_length(item.shift) > limit:
                out[item.name] = f"moves taxels by more than the {1e3 * limit:.2g} mm planned for"
            elif item.seconds <= 0.0:
                out[item.name] = "saves more readings to be calibrated than it costs"
        return out

    def joint_shift(self, on: Iterable[str]) -> Array:
        """The shift of the taxels without all items but `on`, the effects tried together."""
        on = set(on)
        off = {e.name for e in self.effects if e.name not in on}
        steps = [item for item in self.items if ":" in item.name]
        return self.shifts.without(off)[0] + left_out(on, steps)

    def scene_with(self, on: Iterable[str]) -> Scene:
        """The scene with these items on."""
        on = set(on)
        changes: dict[str, Any] = {}
        for knob in self.knobs:
            changes |= knob.levels[_level(knob, on)].changes
        effects = tuple(e for e in self.effects if e.name in on)
        return self._changed(changes).with_(effects=effects, budget=None)

    def tolerance_with(self, on: Iterable[str]) -> float:
        """The tolerance of the calibration with these items on."""
        level = self.tolerance.levels[_level(self.tolerance, on)]
        return float(level.changes["tolerance"])

    def report(
        self, on: Iterable[str], estimate: float, check: Check, limit: float,
        refused: Mapping[str, str],
    ) -> BudgetReport:  # fmt: skip
        """The decision and its reasons."""
        on, forced = set(on), self.forced(limit)
        shifts = self.screened | {item.name: mean_length(item.shift) for item in self.items}
        entries = []
        for effect in self.effects:
            name, why = effect.name, "negligible within the budget"
            if name in self.screened:
                why = "screened: its bound is negligible"
            elif name in on:
                why = forced.get(name, "largest reduction of the shift for its seconds")
            setting = "on" if name in on else "off"
            entries.append(Entry(name, setting, name in on, shifts[name], self.seconds[name], why))
        entries.sort(key=lambda entry: -entry.shift)
        entries += [_knob_entry(knob, on) for knob in (*self.knobs, self.tolerance)]
        entries += [Entry(name, "off", False, 0.0, 0.0, why) for name, why in refused.items()]
        scene = self.scene_with(on)
        return BudgetReport(
            budget=self.budget,
            entries=tuple(entries),
            estimate=estimate,
            check=check,
            scene=scene,
            everything=self.everything,
            belief=replace(self.belief, body=scene.body),
            tolerance=self.tolerance_with(on),
        )


def _knob_items(knob: Knob, seeds: int) -> list[Item]:
    """One item for each step from a level of a knob to the next finer one."""
    items = []
    for k, (low, high) in enumerate(pairwise(knob.levels)):
        shift = np.broadcast_to(low.shift - high.shift, (seeds, *low.shift.shape))
        seconds = max(high.seconds - low.seconds, 1e-9)
        coarser = (_step_name(knob, k - 1),) if k else ()
        items.append(Item(_step_name(knob, k), shift, seconds, coarser))
    return items


def _level(knob: Knob, on: Iterable[str]) -> int:
    """Index of the level of a knob with these items on."""
    on = set(on)
    return sum(_step_name(knob, k) in on for k in range(len(knob.levels) - 1))


def _knob_entry(knob: Knob, on: Iterable[str]) -> Entry:
    """The entry of a knob in the report."""
    k, moves = _level(knob, on), [mean_length(level.shift) for level in knob.levels]
    tried = zip(knob.levels, moves, strict=True)
    why = ", ".join(f"{level.label} {1e3 * move:.2g} mm" for level, move in tried)
    chosen = knob.levels[k]
    return Entry(knob.name, chosen.label, True, moves[k], chosen.seconds, why)


def _step_name(knob: Knob, k: int) -> str:
    """Name of the item that is the step from level k of a knob to the next."""
    return f"{knob.name}:{k}"
