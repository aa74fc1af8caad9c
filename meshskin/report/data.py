"""What a run found, as arrays matched taxel by taxel: what figures, tables and text draw from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.se3 import Array
from .plane import Plane, tangent_plane

if TYPE_CHECKING:
    from ..estimation.calibration import Calibration
    from ..estimation.demonstration import Demonstration
    from ..recording.recording import Recording
    from ..skin.skin import Skin
    from ..study.sensitivity.budget import BudgetReport

NAMES = {
    "joint": "joint maximum likelihood",
    "posegraph": "pose graph",
    "trilateration": "trilateration",
    "three_circles": "three circles",
    "posegraph_isotropic": "pose graph, isotropic",
    "posegraph_paper": "the paper's pose graph",
}
"""Readable names of methods; others keep their own, with spaces for underscores."""


METHODS = {
    "joint": "all readings at once, the taxels on the surface",
    "trilateration": "least squares over all circles on which the readings put a taxel",
    "three_circles": "three of these circles for each taxel",
    "posegraph": "displacements between taxels that were pressed together",
    "posegraph_isotropic": "the same, every direction taken as equally well known",
    "posegraph_paper": "displacements from three circles a taxel, as the paper has it",
}
"""What each method makes of the readings."""
PAPER = (
    "The paper is Cannata, Denei, Mastrogiovanni, Towards automated self-calibration of robot skin "
    "(ICRA 2010)."
)


def readable(method: str) -> str:
    """A method's name for people."""
    return NAMES.get(method, method.replace("_", " "))


@dataclass(frozen=True)
class Iterations:
    """Estimates along the iterations of a pose graph."""

    steps: Array
    """Positions (k, j, 3), m."""
    over: Array
    """What they are drawn over (j, 3), m: the truth, or else their end."""
    known: bool
    """Whether `over` is the truth."""
    demonstration: bool
    """Whether they are the paper's demonstration: perturbed displacements, all at the origin."""

    @classmethod
    def find(
        cls,
        calibrations: Sequence[Calibration],
        truth: Skin | None,
        demonstration: Demonstration | None,
    ) -> Iterations | None:
        """Of the demonstration, or else of the first pose graph that kept its iterates."""
        if demonstration is not None:
            return cls(demonstration.iterates, demonstration.truth, True, True)
        for c in calibrations:
            if has_gauge(c) and c.iterates is not None and len(c.iterates) > 1:
                steps = np.asarray(c.iterates, dtype=float)
                over = None if truth is None else matched(truth.ids, truth.positions, c.ids)
                return cls(steps, steps[-1] if over is None else over, over is not None, False)
        return None


@dataclass(frozen=True)
class ReportData:
    """A calibration and all that is known beside it. Arrays follow the order of calibration.ids."""

    calibration: Calibration
    recording: Recording | None
    truth: Array | None
    """True poses (n, 4, 4); None: no truth."""
    errors: Mapping[str, Array]
    """Position errors (n,), m, of each method against the truth; the calibration's own first."""
    iterations: Iterations | None
    """None: no pose graph kept its iterates."""
    metrics: Mapping[str, Any]
    seconds: Mapping[str, float]
    provenance: Mapping[str, Any]
    estimating: Mapping[str, float] = field(default_factory=dict)
    """Seconds of each method, as far as they were kept; the calibration's own first."""
    ledger: BudgetReport | None = None
    """What an error budget decided, where there was one."""

    @classmethod
    def collect(
        cls,
        calibration: Calibration,
        *,
        recording: Recording | None,
        truth: Skin | None,
        comparisons: Mapping[str, Calibration],
        demonstration: Demonstration | None,
        metrics: Mapping[str, Any],
        seconds: Mapping[str, float],
        provenance: Mapping[str, Any],
    ) -> ReportData:
        """Match truth and comparisons to the calibration's taxels by their ids."""
        true = None if truth is None else matched(truth.ids, truth.poses, calibration.ids)
        errors: dict[str, Array] = {}
        estimating: dict[str, float] = {}
        for name, other in {calibration.method: calibration, **comparisons}.items():
            if truth is not None:
                errors[name] = _errors(other, truth, calibration.ids)
            if "total" in other.seconds:
                estimating[name] = other.seconds["total"]
        return cls(
            calibration,
            recording,
            true,
            errors,
            Iterations.find((calibration, *comparisons.values()), truth, demonstration),
            metrics,
            seconds or {k: v for k, v in calibration.seconds.items() if k != "total"},
            provenance or calibration.provenance,
            estimating,
        )

    @cached_property
    def count(self) -> int:
        """How many taxels the skin has."""
        return len(self.calibration.ids)

    @cached_property
    def touched(self) -> NDArray[np.bool_]:
        """Which taxels gave readings (n,)."""
        return np.asarray(self.calibration.touched, dtype=bool)

    @cached_property
    def covariances(self) -> Array:
        """Covariances (n, 3, 3), m^2, body frame, of the positions along the skin.

        The part along the normal is left out: it says how far the body's surface is trusted, not
        what the readings told. A place that the data did not determine makes the row NaN.
        """
        along = np.asarray(self.calibration.poses, dtype=float)[:, :3, :2]
        cov = np.asarray(self.calibration.covariances, dtype=float)[:, :2, :2]
        good = np.isfinite(cov).all(axis=(1, 2)) & self.located
        out = np.full((self.count, 3, 3), np.nan)
        out[good] = along[good] @ cov[good] @ np.swapaxes(along[good], 1, 2)
        return out

    @cached_property
    def located(self) -> NDArray[np.bool_]:
        """Which taxels have an estimate (n,)."""
        return np.asarray(np.isfinite(self.calibration.positions).all(axis=1))

    @cached_property
    def sigma(self) -> Array:
        """Stated standard deviation along the surface (n,), m; NaN where not determined."""
        sigma = np.asarray(self.calibration.position_sigma, dtype=float)
        return np.where(np.isfinite(sigma), sigma, np.nan)

    @cached_property
    def where(self) -> Array:
        """Where to draw each taxel (n, 3), m: its true place, or else the estimate."""
        return np.asarray(
            self.calibration.positions if self.truth is None else self.truth[:, :3, 3]
        )

    @cached_property
    def plane(self) -> Plane:
        """The tangent plane of all maps."""
        pose = self.calibration.poses if self.truth is None else self.truth
        return tangent_plane(self.where, np.asarray(pose)[:, :3, 2])

    @cached_property
    def disc_radius(self) -> float:
        """Radius of a taxel's disc, m."""
        if self.recording is None:
            return 2e-3
        return float(self.recording.metadata.get("disc_radius_m", 2e-3))

    def error_summary(self, method: str) -> dict[str, float]:
        """Mean, rms and max error (mm) of a method, over the taxels that it found."""
        from ..estimation.uncertainty.metrics import summary_mm

        return summary_mm(self.errors[method])


def matched(ids: ArrayLike, values: ArrayLike, wanted: ArrayLike) -> Array:
    """Rows of `values` (n, ...) for the ids `wanted`; NaN where an id is missing."""
    have, want = np.asarray(ids), np.asarray(wanted)
    v = np.asarray(values, dtype=float)
    out = np.full((len(want), *v.shape[1:]), np.nan)
    row = {int(k): i for i, k in enumerate(have)}
    for i, k in enumerate(want):
        if int(k) in row:
            out[i] = v[row[int(k)]]
    return out


def has_gauge(calibration: Calibration) -> bool:
    """Whether the method leaves the whole's pose free, so that errors count after alignment."""
    return calibration.method.startswith("posegraph")


def _errors(calibration: Calibration, truth: Skin, ids: np.ndarray) -> Array:
    """Distances (n,), m, from the truth for the taxels `ids`; NaN where there is no estimate."""
    from ..estimation.uncertainty.metrics import position_errors

    found = np.isfinite(calibration.positions).all(axis=1).sum()
    gauge = has_gauge(calibration) and found >= 3
    return matched(calibration.ids, position_errors(calibration, truth, gauge), ids)
