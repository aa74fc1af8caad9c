"""Shifts of the taxels by leaving out effects, and by coarser levels of the knobs.

They follow from the linearized calibration. At a solution the gradient of the negative log
likelihood is zero. For other readings (or contacts) it is g there, and the estimate moves, to first
order in their difference, by

    shift = -H^-1 g,   H = J^T W J,

over all taxels and the unknowns that they share.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ...core.arrays import Array
from ...effects import Effect
from ...estimation import chart
from ...estimation.calibrate import calibrate
from ...estimation.data.gather import gather
from ...estimation.joint import fault_detection
from ...estimation.joint.joint_estimator import JointEstimator
from ...estimation.joint.parametrization import SurfaceParametrization
from ...recording.recording import Recording
from ...scene.belief import Belief
from ...scene.scene import Scene
from .knobs import SECONDS, TOLERANCES, Knob, Level
from .replay import Halves, Replay

MAX_DISTANCE = 5e-3
"""Distance, m, from its start beyond which a taxel counts as not determined: about the range in
which it responds to a contact."""
MAX_STEPS = 12
"""Most Gauss-Newton steps to a solution."""
STEP_TOLERANCE = 1e-7
"""Step, m, of the taxels below which a solution is found: far below any budget."""


@dataclass(frozen=True)
class Solution:
    """The point at which the calibration is linearized: n taxels and ks shared unknowns."""

    points: Array
    """Positions (n, 3), body frame, m; NaN for a taxel that is not determined."""
    shared: Array
    """Shared unknowns (ks,), in the order of the belief's."""

    @classmethod
    def true(cls, scene: Scene) -> Solution:
        """The true positions: the solution for a scene without effects."""
        return cls(np.asarray(scene.skin.positions), np.zeros(1))

    def solved(self, recording: Recording, belief: Belief) -> Solution:
        """The solution for a recording, by steps from this one, without outlier rejection.

        A taxel that moves by more than MAX_DISTANCE is not determined.
        """
        found = self
        for _ in range(MAX_STEPS):
            move, shared = found.step(recording, belief)
            found = Solution(found.points + move, found.shared + shared)
            away = np.linalg.norm(found.points - self.points, axis=1) > MAX_DISTANCE
            found.points[away] = np.nan
            if not np.nanmax(np.abs(move), initial=0.0) > STEP_TOLERANCE:
                break
        return found

    def step(self, recording: Recording, belief: Belief) -> tuple[Array, Array]:
        """The Gauss-Newton step for a recording: moves (n, 3), m, and shared unknowns (ks,).

        A taxel that is not determined moves by NaN. The belief must declare no unknowns of single
        taxels and no rigid modules. Raises as `gather`.
        """
        data = gather(recording, belief)
        live = np.flatnonzero(np.isfinite(self.points[:, 0]) & (data.counts > 0))
        charts = chart.charts_at(belief.body, self.points[live])
        stuck = np.isin(data.taxel, fault_detection.stuck_taxels(data).rows)
        places = SurfaceParametrization(charts, step=float(np.median(data.radii)))
        run = JointEstimator(data, live, places, np.where(stuck, 0.0, 1.0), iterations=1)
        run.relinearize(places, self.shared, select_anew=True)
        problem, state = run.problem, run.state
        blocks, left = problem.blocks(state), problem.reduce(state)
        shared = np.asarray(-np.linalg.solve(left.hessian, left.gradient), dtype=float)
        gradient = blocks.gradient + blocks.coupling @ shared
        local = -np.linalg.solve(blocks.hessian, gradient[:, :, None])[:, :2, 0]
        local = places.limit_step(np.asarray(local, dtype=float))
        move = np.full_like(self.points, np.nan)
        move[live] = charts.at(local) - self.points[live]  # the body may be another mesh
        return move, shared


def determined_taxels(recording: Recording, belief: Belief) -> np.ndarray:
    """Which taxels (n,) have readings that determine their position: read, and not stuck."""
    data = gather(recording, belief)
    out = np.asarray(data.counts > 0)
    out[fault_detection.stuck_taxels(data).rows] = False
    return out


@dataclass
class EffectShifts:
    """Effects over one half of a replay, in which every run has the same motion and noise."""

    replay: Replay
    halves: Halves
    belief: Belief
    effects: tuple[Effect, ...]
    """All effects that can be on."""
    seeds: Sequence[int]
    recordings: list[Recording] = field(init=False)
    """Recordings with all effects on, one per seed."""
    solutions: list[Solution] = field(init=False)
    """Their solutions, at which the calibration is linearized."""

    def __post_init__(self) -> None:
        self.recordings = [self._recording(self.effects, seed) for seed in self.seeds]
        true = Solution.true(self.replay.scene)
        self.solutions = [true.solved(recording, self.belief) for recording in self.recordings]
        pairs = zip(self.solutions, self.recordings, strict=True)
        self._residual = [solution.step(r, self.belief)[0] for solution, r in pairs]
        self._determined = [determined_taxels(r, self.belief) for r in self.recordings]

    def without(self, off: Iterable[str]) -> tuple[Array, int, float]:
        """What leaving out effects, by name, does: the shift of the taxels of the half
        (seeds, n, 3), m; the number of taxels that are determined only with these effects, or only
        without them, the largest over the seeds; and the part of the readings that are lost,
        negative if there are more.
        """
        kept = tuple(effect for effect in self.effects if effect.name not in set(off))
        rows, shifts, changed, fewer = self.halves.taxels[0], [], 0, 0.0
        for k, seed in enumerate(self.seeds):
            recording, whole = self._recording(kept, seed), self.recordings[k]
            move, _ = self.solutions[k].step(recording, self.belief)
            shifts.append((move - self._residual[k])[rows])
            differs = determined_taxels(recording, self.belief) != self._determined[k]
            changed = max(changed, int(differs[rows].sum()))
            lost = 1.0 - len(recording.pressure) / max(len(whole.pressure), 1)
            fewer += lost / len(self.seeds)
        return np.stack(shifts), changed, fewer

    def _recording(self, effects: tuple[Effect, ...], seed: int) -> Recording:
        return self.replay.recording(effects, seed, self.halves)


def tolerance_knob(shifts: EffectShifts, contacts: float) -> Knob:
    """The solver tolerance as a knob, by full calibrations with everything on.

    contacts: number of contacts of the whole run.
    """
    recording, rows = shifts.recordings[0], shifts.halves.taxels[0]
    readings = len(recording.pressure) / max(len(recording.time), 1) * contacts
    levels = []
    for tolerance in TOLERANCES:
        found = calibrate(recording, shifts.belief, tolerance=tolerance)
        iterations = 1 if found.iterates is None else len(found.iterates)
        seconds = SECONDS["reading"] * readings * iterations
        words, shift = f"{tolerance:g}", found.positions[rows]
        levels.append(Level({"tolerance": tolerance}, reading=seconds, label=words, shift=shift))
    return against_finest("solver tolerance", levels, len(levels) - 1)


def against_finest(name: str, levels: Sequence[Level], declared: int) -> Knob:
    """A knob from levels whose `shift` holds positions or moves: the last is subtracted."""
    finest = levels[-1].shift
    return Knob(name, tuple(replace(x, shift=x.shift - finest) for x in levels), declared)
