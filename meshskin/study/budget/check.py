"""The truth of an estimate: two worlds, calibrated in full under the same belief."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from time import process_time
from typing import TYPE_CHECKING

import numpy as np

from ...estimation.calibrate import calibrate
from ...estimation.solve import AT_REST
from ...physics.effects import Noise
from ..cost.numerics import held_route
from .choose import size
from .ledger import Check
from .rehearsal import Halves, Rehearsal

if TYPE_CHECKING:
    from ...motion.path import Path
    from ...scene import Belief, Scene


def paired(everything: Scene, chosen: Scene) -> tuple[Scene, Scene]:
    """Both scenes without the white noise that they have in common.

    At another time step the same draws fall on other contacts, and would move the taxels though
    nothing was left out.
    """
    common = {e.name for e in chosen.effects if isinstance(e, Noise)}

    def quiet(scene: Scene) -> Scene:
        return scene.with_(effects=tuple(e for e in scene.effects if e.name not in common))

    return quiet(everything), quiet(chosen)


def compare(
    everything: Scene,
    chosen: Scene,
    belief: Belief,
    path: Path,
    halves: Halves,
    seeds: Iterable[int],
    tolerance: float,
) -> Check:
    """Everything on against what was chosen, over the half kept aside. Raises as simulation and
    calibration do. tolerance: at which the calibration of what was chosen may rest.
    """
    seconds, positions = [], []
    for scene, rest in zip(paired(everything, chosen), (AT_REST, tolerance), strict=True):
        begin = process_time()
        # a body of its own: fitting its surface counts
        fresh = scene.with_(body=replace(scene.body))
        held_route(fresh)  # a run plans a path of its own
        rehearsal = Rehearsal.of(fresh, path)
        found = []
        for seed in seeds:
            recording = rehearsal.recording(scene.effects, seed, halves, 1)
            found.append(calibrate(recording, belief, tolerance=rest).positions)
        positions.append(np.stack(found))
        seconds.append(process_time() - begin)
    shift = (positions[1] - positions[0])[:, halves.taxels[1]]
    taxels = int(np.isfinite(shift[..., 0]).sum()) // max(len(shift), 1)
    return Check(size(shift), taxels, (seconds[0], seconds[1]))
