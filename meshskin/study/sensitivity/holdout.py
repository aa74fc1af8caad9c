"""The truth of an estimate: two worlds, calibrated in full under the same belief."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from time import process_time
from typing import TYPE_CHECKING

import numpy as np

from ...core.se3 import Array
from ...effects import NoiseEffect
from ...estimation.calibrate import calibrate
from ...estimation.joint.newton import NEWTON_TOLERANCE
from ...exploration.plan import plan_exploration
from .budget_report import Check
from .replay import Halves, Replay
from .selection import size

if TYPE_CHECKING:
    from ...effects import Effect
    from ...exploration.path import Path
    from ...scene.belief import Belief
    from ...scene.scene import Scene


def paired(everything: Scene, chosen: Scene) -> tuple[Scene, Scene]:
    """Both scenes without the white noise that they have in common.

    At another time step the same draws fall on other contacts, and would move the taxels though
    nothing was left out.
    """
    common = {e.name for e in chosen.effects if isinstance(e, NoiseEffect)}

    def quiet(scene: Scene) -> Scene:
        return scene.with_(effects=tuple(e for e in scene.effects if e.name not in common))

    return quiet(everything), quiet(chosen)


@dataclass
class Holdout:
    """Contacts and seeds that no estimate has seen, for checks."""

    everything: Scene
    belief: Belief
    path: Path
    halves: Halves
    """The second one is kept aside."""
    seeds: Sequence[int]
    _known: dict[tuple[Effect, ...], tuple[Array, float]] = field(default_factory=dict, repr=False)
    """What everything on gave, by what of it was on."""

    def check(self, chosen: Scene, tolerance: float) -> Check:
        """Everything on against what was chosen, whose calibration may rest at `tolerance`.

        Raises as simulation and calibration do.
        """
        every, chosen = paired(self.everything, chosen)
        if every.effects not in self._known:
            self._known[every.effects] = self._calibrated(every, NEWTON_TOLERANCE)
        truth, slow = self._known[every.effects]
        found, fast = self._calibrated(chosen, tolerance)
        shift = (found - truth)[:, self.halves.taxels[1]]
        taxels = int(np.isfinite(shift[..., 0]).sum()) // max(len(shift), 1)
        known, there = (np.isfinite(x[:, self.halves.taxels[1], 0]) for x in (truth, found))
        return Check(size(shift), taxels, int((known & ~there).sum()), (slow, fast))

    def _calibrated(self, scene: Scene, tolerance: float) -> tuple[Array, float]:
        """Positions (seeds, n, 3), and the processor seconds of a run for them."""
        begin = process_time()
        # a body of its own: fitting its surface counts
        fresh = scene.with_(body=replace(scene.body))
        plan_exploration(fresh)  # a run plans a path of its own
        rehearsal = Replay.of(fresh, self.path)
        found = []
        for seed in self.seeds:
            recording = rehearsal.recording(scene.effects, seed, self.halves, 1)
            found.append(calibrate(recording, self.belief, tolerance=tolerance).positions)
        return np.stack(found), process_time() - begin
