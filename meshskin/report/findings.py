"""What a run found, as arrays matched taxel by taxel: what figures, tables and text draw from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..se3 import Array, align
from .plane import MM, Plane, tangent_plane

if TYPE_CHECKING:
    from ..estimation.calibration import Calibration
    from ..geometry.skin import Skin
    from ..recording import Recording

NAMES = {
    "joint": "joint maximum likelihood",
    "posegraph": "pose graph",
    "trilateration": "trilateration",
    "three_circles": "three circles",
}
"""Readable names of methods; others keep their own, with spaces for underscores."""


def readable(method: str) -> str:
    """A method's name for people."""
    return NAMES.get(method, method.replace("_", " "))


@dataclass(frozen=True)
class Findings:
    """A calibration and all that is known beside it. Arrays follow the order of calibration.ids."""

    calibration: Calibration
    recording: Recording | None
    truth: Array | None
    """True poses (n, 4, 4), NaN for a taxel that the truth does not hold; None: no truth."""
    errors: Mapping[str, Array]
    """Position errors (n,), m, of each method against the truth; the calibration's own first."""
    iterates: Array | None
    """Positions (k, j, 3), m, along the iterations of the pose graph."""
    iterates_over: Array | None
    """What the iterations are drawn over (j, 3), m: the truth, or else their end."""
    metrics: Mapping[str, Any]
    seconds: Mapping[str, float]
    provenance: Mapping[str, Any]

    @classmethod
    def collect(
        cls,
        calibration: Calibration,
        *,
        recording: Recording | None,
        truth: Skin | None,
        comparisons: Mapping[str, Calibration],
        iterates: ArrayLike | None,
        metrics: Mapping[str, Any],
        seconds: Mapping[str, float],
        provenance: Mapping[str, Any],
    ) -> Findings:
        """Match truth and comparisons to the calibration's taxels by their ids."""
        true = None if truth is None else matched(truth.ids, truth.poses, calibration.ids)
        errors: dict[str, Array] = {}
        for name, other in {calibration.method: calibration, **comparisons}.items():
            if true is not None:
                found = matched(other.ids, other.positions, calibration.ids)
                errors[name] = position_errors(found, true[:, :3, 3], has_gauge(other))
        over = None
        if iterates is not None:
            over = None if truth is None else np.asarray(truth.positions, dtype=float)
        else:
            sources = (calibration, *comparisons.values())
            source = next((c for c in sources if _has_iterates(c)), None)
            if source is not None:
                iterates = source.iterates
                if truth is not None:
                    over = matched(truth.ids, truth.positions, source.ids)
        steps = None if iterates is None else np.asarray(iterates, dtype=float)
        if steps is not None and not len(steps):
            steps = None
        return cls(
            calibration,
            recording,
            true,
            errors,
            steps,
            over if over is not None or steps is None else steps[-1],
            metrics,
            seconds or calibration.seconds,
            provenance or calibration.provenance,
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
        """Position covariances (n, 3, 3), m^2, body frame.

        A direction that the data did not determine (infinite variance) makes the row NaN.
        """
        pose = np.asarray(self.calibration.poses, dtype=float)[:, :3, :3]
        cov = np.asarray(self.calibration.covariances, dtype=float)[:, :3, :3]
        good = np.isfinite(cov).all(axis=(1, 2)) & np.isfinite(pose).all(axis=(1, 2))
        r, c = pose[good], cov[good]
        out = np.full((self.count, 3, 3), np.nan)
        out[good] = r @ c @ np.swapaxes(r, 1, 2)
        return out

    @cached_property
    def sigma(self) -> Array:
        """Stated uncertainty of each position (n,), m: the root of the covariance's trace."""
        return np.asarray(np.sqrt(np.trace(self.covariances, axis1=1, axis2=2)))

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
        e = self.errors[method] * MM
        e = e[np.isfinite(e)]
        if not len(e):
            return dict.fromkeys(("mean", "rms", "max"), float("nan"))
        return {
            "mean": float(e.mean()),
            "rms": float(np.sqrt(np.mean(e**2))),
            "max": float(e.max()),
        }


def _has_iterates(calibration: Calibration) -> bool:
    return calibration.iterates is not None and len(calibration.iterates) > 1


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
    """Whether the whole's pose is free, so that errors are meaningful only after alignment."""
    return calibration.method == "posegraph"


def position_errors(estimate: Array, truth: Array, gauge: bool) -> Array:
    """Distances (n,), m, of estimates (n, 3) from the truth (n, 3), after alignment if `gauge`."""
    good = np.isfinite(estimate).all(axis=1) & np.isfinite(truth).all(axis=1)
    if gauge and good.sum() >= 3:
        pose = align(estimate[good], truth[good])
        estimate = estimate @ pose[:3, :3].T + pose[:3, 3]
    return np.asarray(np.linalg.norm(estimate - truth, axis=1))
