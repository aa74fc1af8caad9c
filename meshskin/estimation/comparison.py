"""The same recording calibrated by other methods, for comparison with the joint estimate."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..core.deadline import Deadline
from ..core.errors import CalibrationError, GraphError, OutOfTime
from ..core.progress import Progress, Stage
from ..skin.skin import Skin
from .calibrate import Estimation
from .calibration import Calibration
from .uncertainty import metrics as truth

BASELINE = "centroid"
"""The method that every other one is compared with."""
METHODS = (
    *("trilateration", "three_circles", "eq15"),
    *("posegraph", "posegraph_isotropic", "posegraph_paper", BASELINE),
)
"""Methods that are compared with the joint estimate."""


@dataclass
class Comparison:
    """Calibrations by other methods."""

    found: dict[str, Calibration] = field(default_factory=dict)
    """The calibration by each method that gave one, without a verdict."""
    missing: dict[str, str] = field(default_factory=dict)
    """Why each other method gave none."""
    left_out: tuple[str, ...] = ()
    """Methods that there was no time for."""

    def errors(self, skin: Skin) -> dict[str, dict[str, Any]]:
        """Position errors, mm, of each method against the true skin, or why there are none."""
        errors: dict[str, dict[str, Any]] = {
            method: {"mean": None, "rms": None, "max": None, "why": why}
            for method, why in self.missing.items()
        }
        for method, other in self.found.items():
            # displacements say nothing about the pose of the whole
            gauge = method.startswith("posegraph")
            errors[method] = truth.summary_mm(truth.position_errors(other, skin, gauge=gauge))
        return errors


def worse_than_centroid(errors: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Methods whose mean error, of summaries by method, is above that of the baseline, the centroid
    of contact points; none where that is not known."""
    known = {name: one["mean"] for name, one in errors.items() if one["mean"] is not None}
    baseline = known.get(BASELINE)
    return [name for name, error in known.items() if baseline is not None and error > baseline]


def compare_methods(
    estimation: Estimation,
    progress: Progress | None = None,
    deadline: Deadline | None = None,
    reserve: float = 0.0,
    seconds: Callable[[str], float] = lambda _: 0.0,
) -> Comparison:
    """Calibrate by each of METHODS; those that do not fit before the deadline are left out.

    progress: called after each. reserve: processor seconds that are left to other work; seconds:
    gives those expected of a method.
    """
    comparison, stage = Comparison(), Stage(progress, "compare", len(METHODS))
    deadline = deadline or Deadline()
    for method in METHODS:
        try:
            deadline.check(reserve + seconds(method))
            other = estimation.without_verdict(method, deadline.hook(None, reserve))
            _check_placed(other, truth.MIN_ALIGNED if method.startswith("posegraph") else 1)
        except (CalibrationError, GraphError) as error:
            comparison.missing[method] = str(error)
        except OutOfTime:
            comparison.missing[method] = f"left out: no time within {deadline.seconds:g} s"
            comparison.left_out += (method,)
        else:
            comparison.found[method] = other
        stage.step()
    return comparison


def _check_placed(found: Calibration, fewest: int) -> None:
    """Raise CalibrationError if too few taxels have a position to be compared with the truth."""
    placed = np.isfinite(found.positions).all(axis=1)
    if placed.sum() < fewest:
        reasons = Counter(map(str, np.asarray(found.reasons)[~placed])).most_common(1)
        why = reasons[0][0] if reasons else "there are no more taxels"
        raise CalibrationError(
            f"too few taxels to compare: {why}", value=f"{placed.sum()} placed", limit=fewest
        )
