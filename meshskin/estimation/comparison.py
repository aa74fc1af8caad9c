"""The same recording calibrated by other methods, for comparison with the joint estimate."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

import numpy as np

from ..core.errors import CalibrationError, GraphError
from ..core.progress import Progress, Stage
from .calibrate import Estimation
from .calibration import Calibration

METHODS = (
    "trilateration",
    "three_circles",
    "eq15",
    "posegraph",
    "posegraph_isotropic",
    "posegraph_paper",
    "centroid",
)
"""Methods that are compared with the joint estimate."""
MIN_ALIGNED = 3
"""Least number of taxels that determine the rigid motion between a pose graph and the truth."""


@dataclass
class Comparison:
    """Calibrations by other methods."""

    found: dict[str, Calibration] = field(default_factory=dict)
    """The calibration by each method that gave one."""
    missing: dict[str, str] = field(default_factory=dict)
    """Why each other method gave none."""


def compare_methods(estimation: Estimation, progress: Progress | None = None) -> Comparison:
    """Calibrate by each of METHODS. progress: called after each."""
    comparison, stage = Comparison(), Stage(progress, "compare", len(METHODS))
    for method in METHODS:
        try:
            other = estimation.calibrate(method)
            _check_placed(other, MIN_ALIGNED if method.startswith("posegraph") else 1)
        except (CalibrationError, GraphError) as error:
            comparison.missing[method] = str(error)
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
