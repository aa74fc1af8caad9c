"""The error budget: which effects a scene calls for, and how finely it must be computed.

screen  effects whose own bounds are negligible are left out
try     how far the taxels move for leaving out each of the others, and for each coarser setting
        of the knobs, by one Gauss-Newton step from the solution with everything on
choose  by millimetres per second, until the rest fits the budget, all of it together
check   with everything on, in full, over contacts and seeds kept aside
"""

from __future__ import annotations

import math
from collections.abc import Callable
from numbers import Real

from ...core.arguments import check_type
from ...core.errors import ConfigError
from ...scene.scene import Scene
from .budget_report import BudgetReport, Check, Entry
from .budget_trial import Trial
from .candidates import candidates
from .holdout import Holdout
from .screening import NEGLIGIBLE
from .selection import choose, size

__all__ = ["DEFAULT", "BudgetReport", "Check", "Entry", "budget"]

DEFAULT = 0.2e-3
"""Taxel error, m, that may be left out, where neither call nor scene says."""
MARGIN = 0.7
"""Part of the budget that the estimate may take: other contacts and seeds give other errors."""
SEEDS, ASIDE = 2, 1
"""Seeds that are tried, and seeds kept aside for the check."""
CHECKS = 8
"""Most checks: after one that exceeds the budget, or the estimate by far, or loses a taxel, more
is added."""

Progress = Callable[[str, int, int], None]


def budget(
    scene: Scene,
    taxel_error: float | None = None,
    *,
    seed: int = 0,
    progress: Progress | None = None,
) -> BudgetReport:
    """Decide what a scene calls for, so that what is left out moves the taxels little enough.

    taxel_error, m: how far the calibrated taxels may be off, on average, for all that is left out;
    by default the scene's own `budget`, or 0.2 mm. Chosen among are the scene's effects and its
    `candidates` (by default every registered effect), contact models, meshes of a primitive, and
    time steps. What the owner believes is the same throughout. seed: the first of the seeds that
    are tried. Raises ConfigError for a budget that is not positive, else as `simulate` and
    `calibrate`.
    """
    check_type(Scene, scene, "what is budgeted")
    if taxel_error is None:
        taxel_error = DEFAULT if scene.budget is None else scene.budget
    check_type(Real, taxel_error, "an error budget")
    if not (math.isfinite(taxel_error) and taxel_error > 0):
        raise ConfigError(
            "an error budget must be positive",
            value=f"{1e3 * taxel_error:g} mm",
            limit="above 0 mm",
            remedy="to have everything on, simulate the scene without a budget",
        )
    effects, refused = candidates(scene, seed)
    trial = Trial(scene, effects, taxel_error, range(seed, seed + SEEDS), progress)
    aside, limit = range(seed + SEEDS, seed + SEEDS + ASIDE), MARGIN * taxel_error
    kept = Holdout(trial.everything, trial.belief, trial.path, trial.halves, aside)
    for _ in range(CHECKS):
        on, rest = choose(trial.items, limit, trial.forced(limit), trial.joint)
        check = kept.check(trial.scene_of(on), trial.tolerance_of(on))
        believed = check.shift <= max(2.0 * size(rest), NEGLIGIBLE * taxel_error)
        fits = check.shift <= taxel_error and check.lost == 0
        if (fits and believed) or len(on) == len(trial.items):
            break
        limit = MARGIN * min(limit, size(rest)) / max(check.shift / taxel_error, 1.0)
    return trial.ledger(on, rest, check, limit, refused)
