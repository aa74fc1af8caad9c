"""The data of a report: results of a run as arrays with one row per taxel."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.arrays import Array
from ..estimation.calibration import Calibration
from ..estimation.comparison import worse_than_centroid
from ..estimation.demonstration import Demonstration
from ..estimation.uncertainty.metrics import position_errors, summary_mm
from ..geometry.body import Body
from ..recording.recording import Recording
from ..skin.files.table import DISC_RADIUS
from ..skin.skin import Skin
from .plane import MM, Plane, tangent_plane

if TYPE_CHECKING:
    from ..estimation.cross_validation import CrossValidation

METHOD_NAMES = {
    "joint": "joint maximum likelihood",
    "posegraph": "pose graph",
    "trilateration": "trilateration",
    "three_circles": "three chosen circles",
    "eq15": "eq. 15 as printed",
    "posegraph_isotropic": "pose graph, isotropic",
    "posegraph_paper": "pose graph, three chosen circles",
    "centroid": "centroid of contact points",
    "coactivation": "layout by co-activation",
    "none": "not calibrated",
}
"""Names of methods for people; others keep their own, with spaces for underscores."""
METHOD_DESCRIPTIONS = {
    "joint": "all readings together, with the taxels on the surface",
    "trilateration": "least squares over all circles that the readings of a taxel give",
    "three_circles": "three of these circles per taxel, steep and well separated",
    "eq15": "the paper's: three circles at random, of readings taken as those of points",
    "posegraph": "displacements between taxels that were pressed together",
    "posegraph_isotropic": "these displacements with equal weights in all directions",
    "posegraph_paper": "displacements from three chosen circles, with equal weights",
    "centroid": "mean of a taxel's contact points, weighted by its readings: the baseline",
    "coactivation": "which taxels answer together; the contact points place the whole",
}
"""How each method uses the readings."""
PAPER_REFERENCE = (
    "The paper is Cannata, Denei, Mastrogiovanni, Towards automated self-calibration of robot skin "
    "(ICRA 2010)."
)


def method_name(method: str) -> str:
    """A method's name for people."""
    return METHOD_NAMES.get(method, method.replace("_", " "))


@dataclass(frozen=True)
class Iterations:
    """Estimates along the iterations of a pose graph."""

    positions: Array
    """Positions (k, j, 3), m."""
    reference: Array
    """Positions (j, 3), m, that they are compared with: the truth, or else the last iterate."""
    has_truth: bool
    """Whether `reference` is the truth."""
    is_demonstration: bool
    """Whether this is the paper's demonstration: perturbed displacements, started at the origin."""

    @classmethod
    def find(
        cls,
        calibrations: Iterable[Calibration],
        truth: Skin | None,
        demonstration: Demonstration | None,
    ) -> Iterations | None:
        """Iterates of the demonstration, or else of the first pose graph that kept them."""
        if demonstration is not None:
            return cls(demonstration.iterates, demonstration.truth, True, True)
        for c in calibrations:
            if has_gauge_freedom(c) and c.iterates is not None and len(c.iterates) > 1:
                positions = np.asarray(c.iterates, dtype=float)
                true = None if truth is None else rows_by_id(truth.ids, truth.positions, c.ids)
                reference = positions[-1] if true is None else true
                return cls(positions, reference, true is not None, False)
        return None


@dataclass(frozen=True)
class ReportData:
    """A calibration and what belongs to it. Arrays have the order of calibration.ids."""

    calibration: Calibration
    recording: Recording | None = None
    """What was calibrated."""
    truth: Skin | None = None
    """The true skin of a simulation; without it the report gives the stated uncertainty in place of
    errors."""
    comparisons: Mapping[str, Calibration] = field(default_factory=dict)
    """Calibrations of the recording by other methods."""
    demonstration: Demonstration | None = None
    """The pose graph from the origin; without it, the first pose graph that kept its iterates is
    shown."""
    metrics: Mapping[str, Any] = field(default_factory=dict)
    """As in metrics.json."""
    seconds: Mapping[str, float] = field(default_factory=dict)
    """Seconds of each stage of the run; by default those of the calibration."""
    provenance: Mapping[str, Any] = field(default_factory=dict)
    """By default that of the calibration."""
    body: Body | None = None
    validation: CrossValidation | None = None
    """What `Calibration.cross_validate` gave."""

    def __post_init__(self) -> None:
        seconds = self.seconds or self.calibration.seconds
        stages = {k: v for k, v in seconds.items() if k not in ("total", "all")}  # their sums
        object.__setattr__(self, "seconds", stages)
        object.__setattr__(self, "provenance", self.provenance or self.calibration.provenance)

    @cached_property
    def methods(self) -> Mapping[str, Calibration]:
        """The calibration by each method, the calibration's own first."""
        return {self.calibration.method: self.calibration, **self.comparisons}

    @cached_property
    def true_poses(self) -> Array | None:
        """True poses (n, 4, 4); None if unknown."""
        if self.truth is None:
            return None
        return rows_by_id(self.truth.ids, self.truth.poses, self.calibration.ids)

    @cached_property
    def shown_poses(self) -> Array:
        """Poses (n, 4, 4) at which taxels are drawn: the true ones, or else the estimates."""
        return np.asarray(self.calibration.poses if self.true_poses is None else self.true_poses)

    @cached_property
    def errors(self) -> Mapping[str, Array]:
        """Position errors (n,), m, of each method; empty without truth."""
        if self.truth is None:
            return {}
        ids = self.calibration.ids
        return {name: _errors(found, self.truth, ids) for name, found in self.methods.items()}

    @cached_property
    def method_seconds(self) -> Mapping[str, float]:
        """Seconds of each method, where known."""
        return {k: c.seconds["total"] for k, c in self.methods.items() if "total" in c.seconds}

    @cached_property
    def iterations(self) -> Iterations | None:
        """None if no pose graph kept its iterates."""
        return Iterations.find(self.methods.values(), self.truth, self.demonstration)

    @cached_property
    def count(self) -> int:
        """Number of taxels of the skin."""
        return len(self.calibration.ids)

    @cached_property
    def touched(self) -> NDArray[np.bool_]:
        """Which taxels gave readings (n,)."""
        return np.asarray(self.calibration.touched, dtype=bool)

    @cached_property
    def covariances(self) -> Array:
        """Covariances (n, 3, 3), m^2, body frame, of the positions along the skin.

        The part along the normal is left out: it follows from the trust in the body's surface, not
        from the readings. Rows of positions that the data did not determine are NaN.
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
        """Stated standard deviation of the position (n,), m; NaN where not determined."""
        sigma = np.asarray(self.calibration.position_sigma, dtype=float)
        return np.where(np.isfinite(sigma), sigma, np.nan)

    @cached_property
    def residuals(self) -> Array:
        """Root mean square residual of the readings of each taxel (n,), relative to that of the
        median taxel; NaN where unknown, and of all without degrees of freedom."""
        r = np.sqrt(np.where(self.located, np.asarray(self.calibration.chi2, dtype=float), np.nan))
        median = float(np.median(r[np.isfinite(r)])) if np.isfinite(r).any() else 0.0
        return r / median if median > 0 else np.full(self.count, np.nan)

    @cached_property
    def finite_sigma_mm(self) -> Array:
        """`sigma` of the taxels that were determined, mm."""
        return np.asarray(self.sigma[np.isfinite(self.sigma)] * MM)

    @property
    def bound_mm(self) -> float | None:
        """Cramér-Rao bound on the mean position error, mm; None if unknown."""
        bound = (self.metrics.get("crlb_mm") or {}).get("mean")
        return None if bound is None else float(bound)

    @property
    def main_errors(self) -> dict[str, float]:
        """Mean, rms and max error (mm) of the calibration: from the metrics, or else computed."""
        given = self.metrics.get("position_error_mm")
        return dict(given) if given else self.error_summary(self.calibration.method)

    @property
    def worse_than_centroid(self) -> list[str]:
        """Methods whose mean error is above the baseline's; none where it is not known."""
        return worse_than_centroid({name: self.error_summary(name) for name in self.errors})

    @property
    def display_positions(self) -> Array:
        """Position (n, 3), m, at which each taxel is drawn."""
        return self.shown_poses[:, :3, 3]

    @cached_property
    def plane(self) -> Plane:
        """The tangent plane of all maps."""
        return tangent_plane(self.display_positions, self.shown_poses[:, :3, 2])

    @cached_property
    def disc_radius(self) -> float:
        """Radius of a taxel's disc, m."""
        if self.recording is None:
            return DISC_RADIUS
        return float(self.recording.metadata.get("disc_radius_m", DISC_RADIUS))

    def error_summary(self, method: str) -> dict[str, float]:
        """Mean, rms and max error (mm) of a method, over the taxels that it located."""
        return summary_mm(self.errors[method])


def rows_by_id(ids: ArrayLike, values: ArrayLike, wanted: ArrayLike) -> Array:
    """Rows of `values` (n, ...) for the ids `wanted`; NaN where an id is missing."""
    v, row = np.asarray(values, dtype=float), {int(k): i for i, k in enumerate(np.asarray(ids))}
    missing = np.full((1, *v.shape[1:]), np.nan)
    rows = [row.get(int(k), -1) for k in np.asarray(wanted)]
    return np.concatenate([v, missing])[np.array(rows, dtype=int)]


def has_gauge_freedom(calibration: Calibration) -> bool:
    """Whether the method does not determine the pose of the whole: errors are after alignment."""
    return calibration.method.startswith("posegraph")


def _errors(calibration: Calibration, truth: Skin, ids: np.ndarray) -> Array:
    """Distances (n,), m, from the truth for the taxels `ids`; NaN where there is no estimate."""
    found = np.isfinite(calibration.positions).all(axis=1).sum()
    gauge = has_gauge_freedom(calibration) and found >= 3
    return rows_by_id(calibration.ids, position_errors(calibration, truth, gauge), ids)
