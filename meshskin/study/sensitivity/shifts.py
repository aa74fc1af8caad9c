"""Shifts: how far the taxels move for leaving out effects, or for a coarser setting of a knob."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from ...core.errors import ContactError, ReachError, SimulationError
from ...core.se3 import Array
from ...effects import Effect
from ...estimation.calibrate import calibrate
from .knobs import SECONDS, TOLERANCES, Knob, Rung
from .linearized import Solution, answering
from .replay import Halves, Replay

if TYPE_CHECKING:
    from ...exploration.path import Path
    from ...recording.recording import Recording
    from ...scene.belief import Belief
    from ...scene.scene import Scene


@dataclass(frozen=True)
class Without:
    """What leaving effects out does."""

    shift: Array
    """How it moves the taxels of the half (seeds, n, 3), m."""
    changed: int
    """How many of them answer without these effects and not with them, or the other way (most of a
    seed)."""
    fewer: float
    """Part of the readings that are gone; negative where there are more."""


@dataclass
class Effects:
    """Effects on trial, over one half of a rehearsal: every run shares motion and noise."""

    rehearsal: Replay
    halves: Halves
    belief: Belief
    every: tuple[Effect, ...]
    """All that can be on."""
    seeds: Sequence[int]
    solutions: list[Solution] = field(init=False)
    """Of each seed, with everything on."""
    whole: list[Recording] = field(init=False)
    """Of each seed, with everything on."""

    def __post_init__(self) -> None:
        self.whole = whole = [self._recording(self.every, seed) for seed in self.seeds]
        true = Solution.true(self.rehearsal.scene)
        self.solutions = [true.solved(recording, self.belief) for recording in whole]
        pairs = zip(self.solutions, whole, strict=True)
        steps = [solution.step(recording, self.belief) for solution, recording in pairs]
        self._at_rest = [step.move for step in steps]
        self._answering = [answering(recording, self.belief) for recording in whole]

    def without(self, off: Iterable[str]) -> Without:
        """What leaving effects out does."""
        left = tuple(effect for effect in self.every if effect.name not in set(off))
        rows, shifts, changed, fewer = self.halves.taxels[0], [], 0, 0.0
        for k, seed in enumerate(self.seeds):
            recording = self._recording(left, seed)
            step = self.solutions[k].step(recording, self.belief)
            shifts.append((step.move - self._at_rest[k])[rows])
            answers = answering(recording, self.belief) != self._answering[k]
            changed = max(changed, int(answers[rows].sum()))
            there = self.whole[k]
            few = 1.0 - len(recording.pressure) / max(len(there.pressure), 1)
            fewer += few / len(self.seeds)
        return Without(np.stack(shifts), changed, fewer)

    def _recording(self, effects: tuple[Effect, ...], seed: int) -> Recording:
        return self.rehearsal.recording(effects, seed, self.halves)


def tolerance(trial: Effects, contacts: float) -> tuple[Knob, list[Array]]:
    """The tolerance as a knob, and how each of its settings moves the taxels (n, 3), m.

    By full calibrations with everything on; contacts: of the whole run.
    """
    recording, rows = trial.whole[0], trial.halves.taxels[0]
    readings = len(recording.pressure) / max(len(recording.time), 1) * contacts
    rungs, places = [], []
    for rest in TOLERANCES:
        found = calibrate(recording, trial.belief, tolerance=rest)
        turns = 1 if found.iterates is None else len(found.iterates)
        seconds = SECONDS["reading"] * readings * turns
        rungs.append(Rung(f"{rest:g}", {"tolerance": rest}, seconds))
        places.append(found.positions[rows])
    knob = Knob("solver tolerance", tuple(rungs), len(rungs) - 1)
    return knob, [place - places[-1] for place in places]


@dataclass(frozen=True)
class Rehearsed:
    """A knob whose settings have been run, without effects."""

    knob: Knob
    recordings: tuple[Recording, ...]
    """Of the half, one a setting."""
    scenes: tuple[Scene, ...]

    @classmethod
    def of(
        cls, knob: Knob, own: Replay, path: Path, halves: Halves, told: Callable[[], None]
    ) -> Rehearsed:
        """Run a knob's settings along a path, `own` being that of the scene; those that cannot be
        run are left out (a time step may be too long for the touch).
        """
        kept: list[tuple[Rung, Recording, Scene]] = []
        for rung in knob.rungs:
            scene = own.scene.with_(**rung.changes)
            try:
                run = own if rung is knob.rungs[knob.declared] else Replay.of(scene, path)
            except (SimulationError, ReachError, ContactError):
                continue
            finally:
                told()
            kept.append((rung, run.recording((), 0, halves), scene))
        rungs, recordings, scenes = zip(*kept, strict=True)
        declared = rungs.index(knob.rungs[knob.declared])
        return cls(Knob(knob.name, rungs, declared), recordings, scenes)

    def judged(self, belief: Belief, taxels: np.ndarray) -> tuple[Knob, list[Array]]:
        """The knob, and how each of its settings moves the taxels against the finest (n, 3), m.

        Without the others than the scene's own under which the contact model does not hold.
        """
        solution = Solution.true(self.scenes[0])
        rungs, moves = [], []
        for rung, recording, scene in zip(
            self.knob.rungs, self.recordings, self.scenes, strict=True
        ):
            try:
                step = solution.step(recording, replace(belief, body=scene.body))
            except ContactError:
                if rung is self.knob.rungs[self.knob.declared]:
                    raise
                continue
            rungs.append(rung)
            moves.append(step.move[taxels])
        declared = rungs.index(self.knob.rungs[self.knob.declared])
        knob = Knob(self.knob.name, tuple(rungs), declared)
        return knob, [move - moves[-1] for move in moves]
