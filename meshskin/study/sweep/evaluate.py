"""The default run function of a study: simulate, calibrate, assess."""

from __future__ import annotations

import numpy as np

from ...estimation.calibrate import calibrate
from ...estimation.uncertainty import metrics
from ...simulation.simulate import simulate
from ..sensitivity.budget import budget
from .case import Case

Value = float | int | str | None


def evaluate(case: Case) -> dict[str, Value]:
    """Position errors (mm), Cramér-Rao bound, NEES, verdict, modulus, force, counts of one case.

    The values depend on the case alone and on no clock. The bound is that of a true belief; it is
    0 without noise.
    """
    scene, belief = case.scene, case.belief
    if scene.budget is not None:
        scene = budget(scene, seed=case.seed).scene
    recording = simulate(scene, case.seed)
    found = calibrate(recording, belief, method=case.method)
    # displacements say nothing about the pose of the whole
    errors = metrics.position_errors(found, scene.skin, gauge=case.method.startswith("posegraph"))
    out: dict[str, Value] = {
        "taxels": len(found.ids),
        "touched": int(found.touched.sum()),
        "determined": int(np.isfinite(errors).sum()),
        "contacts": len(recording.time),
        "readings": len(recording.pressure),
    }
    out |= {f"position_error_mm.{k}": v for k, v in metrics.summary_mm(errors).items()}
    located = found.ids[np.isfinite(errors)]
    bound = metrics.bound_mm(recording, scene.belief(), scene.skin, located)
    out |= {f"crlb_mm.{k}": v for k, v in bound.items()}
    nees = metrics.nees(found, scene.skin)
    nees = nees[np.isfinite(nees)]
    out["nees"] = float(nees.mean()) if len(nees) else None
    out["verdict"] = None if found.verdict is None else found.verdict.level
    out["modulus_pa"], out["modulus_sigma_pa"] = found.modulus, found.modulus_sigma
    out["force_mean_n"] = float(recording.force.mean())
    out["force_std_n"] = float(recording.force.std())
    return out
