"""The holdout check of a budget: two scenes, calibrated in full over unused contacts and seeds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import numpy as np

from ...core.arrays import Array
from ...effects import NoiseEffect
from ...estimation.calibrate import calibrate
from ...estimation.joint.reduced_nlp import NEWTON_TOLERANCE
from ...exploration.plan import plan_exploration
from .budget_report import Check
from .replay import Halves, Replay
from .selection import mean_length
from .trial import timed

if TYPE_CHECKING:
    from ...effects import Effect
    from ...exploration.path import Path
    from ...scene.belief import Belief
    from ...scene.scene import Scene


def without_common_noise(everything: Scene, chosen: Scene) -> tuple[Scene, Scene]:
    """Both scenes without the white noise that they have in common.

    At another time step the same random numbers fall on other contacts; they would move the taxels
    although nothing was left out.
    """
    common = {e.name for e in chosen.effects if isinstance(e, NoiseEffect)}
    quiet = [
        scene.with_(effects=tuple(e for e in scene.effects if e.name not in common))
        for scene in (everything, chosen)
    ]
    return quiet[0], quiet[1]


@dataclass
class Holdout:
    """Contacts and seeds that no estimate has used."""

    everything: Scene
    """The scene with everything on."""
    belief: Belief
    path: Path
    halves: Halves
    """The second half is kept aside."""
    seeds: Sequence[int]
    _known: dict[tuple[Effect, ...], tuple[Array, float]] = field(default_factory=dict, repr=False)
    """Positions and seconds with everything on, by the effects of it that were on."""

    def check(self, chosen: Scene, tolerance: float) -> Check:
        """Compare everything on with a chosen scene, whose calibration stops at `tolerance`.

        Raises as `simulate` and `calibrate`.
        """
        every, chosen = without_common_noise(self.everything, chosen)
        if every.effects not in self._known:
            self._known[every.effects] = self._calibrated(every, NEWTON_TOLERANCE)
        truth, slow = self._known[every.effects]
        found, fast = self._calibrated(chosen, tolerance)
        shift = (found - truth)[:, self.halves.taxels[1]]
        taxels = int(np.isfinite(shift[..., 0]).sum()) // max(len(shift), 1)
        known, there = (np.isfinite(x[:, self.halves.taxels[1], 0]) for x in (truth, found))
        return Check(mean_length(shift), taxels, int((known & ~there).sum()), (slow, fast))

    def _calibrated(self, scene: Scene, tolerance: float) -> tuple[Array, float]:
        """Positions (seeds, n, 3), m, and the processor seconds of a run for them."""

        def work() -> Array:
            fresh = scene.with_(body=replace(scene.body))  # so that the fit of its surface counts
            plan_exploration(fresh)  # a run plans its own path
            replay = Replay.of(fresh, self.path)
            recordings = [replay.recording(scene.effects, s, self.halves, 1) for s in self.seeds]
            found = [calibrate(r, self.belief, tolerance=tolerance) for r in recordings]
            return np.stack([calibration.positions for calibration in found])

        return timed(work)
