"""Cross-validation: contacts held out whole, localized by the skin calibrated on the others.

It needs no truth: a contact's place is known as well as the robot knows where it was touched.
Contacts near each other in time are nearly copies of each other, so they are held out in blocks of
consecutive contacts, dealt to the folds in turn; on a straight path no taxel reads at both ends of
a block. Blocks of a whole fifth of a recording would leave taxels without any contact.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq

from ..contact import LEARNED
from ..core import arrow
from ..core.arguments import check_integer
from ..core.arrays import Array, median_spacing
from ..core.atomic_io import atomic
from ..core.errors import CalibrationError, reason
from ..core.progress import Progress, Stage
from ..core.value import Value
from ..recording.recording import Recording
from ..scene.belief import RAW, Belief
from .calibrate import calibrate
from .calibration import Calibration
from .data.gather import gather
from .data.raw_readings import in_recorded_unit
from .localization import CalibratedSkin

BLOCK = 2.0
"""Length of a block, in reaches of a contact: no taxel is in reach of two contacts further apart
than that."""
WAYPOINTS = 8
"""Waypoints of a block: it is measured in chords of an eighth."""


@dataclass(frozen=True, eq=False)
class CrossValidation(Value):
    """m pressed contacts, each localized without it; NaN where fewer than three taxels read."""

    points: Array
    """Where the contacts were (m, 3), body frame, m."""
    localized: Array
    """Where their readings put them (m, 3), m."""
    centroids: Array
    """The baseline (m, 3), m: means of the taxels that read, weighted by the readings, on the
    surface."""
    fold: np.ndarray
    """Fold (m,) in which each was held out."""
    log_likelihood: Array
    """Logarithm (m,) of the density of the readings of each contact, in the recorded unit."""
    readings: np.ndarray
    """Number (m,) of these readings."""
    pitch: float
    """Median distance of a taxel from its nearest neighbour, m."""

    @property
    def errors(self) -> Array:
        """Distances (m,), m, between where contacts were and where their readings put them."""
        return np.asarray(np.linalg.norm(self.localized - self.points, axis=1))

    @property
    def centroid_errors(self) -> Array:
        """Errors (m,), m, of the baseline in the same contacts."""
        off = np.linalg.norm(self.centroids - self.points, axis=1)
        return np.where(np.isfinite(self.localized[:, 0]), off, np.nan)

    def metrics(self) -> dict[str, Any]:
        """The numbers as JSON values; lengths in mm, log likelihood per reading."""
        total = int(self.readings.sum())
        mean = float(self.log_likelihood.sum()) / max(total, 1)
        return {
            "folds": int(self.fold.max()) + 1,
            "contacts": len(self.points),
            "localized": int(np.isfinite(self.errors).sum()),
            "error_mm": _summary(self.errors),
            "centroid_error_mm": _summary(self.centroid_errors),
            "taxel_pitch_mm": 1e3 * self.pitch if math.isfinite(self.pitch) else None,
            "readings": total,
            "log_likelihood_per_reading": mean if total else None,
        }

    def save(self, path: str | Path) -> None:
        """Write a Parquet file with a row a contact: its fields, of points as columns x, y and z.
        Raises OutputError."""
        columns: dict[str, np.ndarray] = {}
        for item in fields(self):
            value = np.asarray(getattr(self, item.name))
            if value.ndim == 2:
                columns |= {f"{item.name}_{k}": v for k, v in zip("xyz", value.T, strict=True)}
            else:
                columns[item.name] = np.broadcast_to(value, len(self.points))
        with atomic(path) as temporary:
            pq.write_table(arrow.table(columns), temporary)

    @classmethod
    def load(cls, path: str | Path) -> CrossValidation:
        """Read what `save` wrote. Raises CalibrationError for other files."""
        try:
            table = pq.ParquetFile(path).read()
            column: dict[str, Any] = {
                name: arrow.values(table.column(name)) for name in table.column_names
            }
            place: dict[str, Any] = {
                name: np.column_stack([column.pop(f"{name}_{k}") for k in "xyz"])
                for name in ("points", "localized", "centroids")
            }
            return cls(**place, **column | {"pitch": float(column["pitch"][0])})
        except (OSError, LookupError, TypeError, ValueError) as error:
            raise CalibrationError(
                f"{path} holds no cross-validation", value=reason(error).splitlines()[0],
                remedy="calibrate again with --cross-validate",
            ) from error  # fmt: skip


def _summary(errors: Array) -> dict[str, float | None]:
    """Rms and 95th percentile, mm; None where no contact was localized."""
    errors = 1e3 * errors[np.isfinite(errors)]
    if not len(errors):
        return {"rms": None, "p95": None}
    return {"rms": float(np.sqrt(np.mean(errors**2))), "p95": float(np.quantile(errors, 0.95))}


def cross_validate(
    calibration: Calibration,
    recording: Recording,
    folds: int = 5,
    belief: Belief | None = None,
    progress: Progress | None = None,
) -> CrossValidation:
    """The cross-validation of the method and contact model of a calibration; arguments and errors
    as `Calibration.cross_validate`."""
    folds = check_integer("number of folds", folds, least=2, error=CalibrationError)
    belief = belief or recorded_belief(calibration)
    if calibration.response is not None:
        groups = tuple(other.taxels for other in calibration.response.others)
        belief = replace(belief, contact=LEARNED, response_groups=groups)
    data = gather(recording, belief)
    belief = replace(belief, force_reference=data.belief.force_reference)
    fold = blocks(data.points, BLOCK * float(np.median(data.reach())))
    if fold.max() + 1 < folds:
        raise CalibrationError(
            "too few blocks of contacts to cross-validate",
            value=f"{fold.max() + 1} blocks of {1e3 * BLOCK * np.median(data.reach()):.3g} mm",
            limit=f"{folds} folds",
            remedy="give fewer folds or a recording that covers more of the skin",
        )
    fold, rows = fold % folds, data.recorded
    localized, centroids = np.full(data.points.shape, np.nan), np.full(data.points.shape, np.nan)
    points, likelihood = data.points.copy(), np.zeros(len(data.points))
    count = np.zeros(len(data.points), dtype=int)
    stage = Stage(progress, "cross-validate", folds)
    for k in range(folds):
        held = np.flatnonzero(fold == k)
        others = np.ones(len(recording.time), dtype=bool)
        others[rows[held]] = False
        part, known = subset(recording, belief, others)
        skin = CalibratedSkin.of(calibrate(part, known, calibration.method), data)
        points[held] = skin.data.points[held]
        localized[held] = skin.localize(held)[held]
        centroids[held] = skin.centroids(held)[held]
        found, number = skin.log_likelihoods(held)
        likelihood += found
        count += number
        stage.step()
    return CrossValidation(
        points, localized, centroids, fold, likelihood, count, median_spacing(calibration.positions)
    )


def blocks(points: Array, length: float) -> np.ndarray:
    """Number (m,) of the block of each of the consecutive contacts at `points` (m, 3), m: a block
    ends where the path since it began is longer than `length`, m. The path is measured between
    waypoints, so that scatter of contacts in one place does not lengthen it."""
    out = np.zeros(len(points), dtype=int)
    waypoint, travelled = points[0], 0.0
    for k, point in enumerate(points):
        out[k] = out[k - 1]
        if (step := math.dist(point, waypoint)) > length / WAYPOINTS:
            waypoint, travelled = point, travelled + step
        if travelled > length:
            out[k], travelled = out[k] + 1, 0.0
    return out


def subset(recording: Recording, belief: Belief, keep: np.ndarray) -> tuple[Recording, Belief]:
    """The contacts `keep` (bool) of a recording with their readings, and the belief for these."""
    part = Recording(
        recording.contacts.filter(arrow.column(keep)),
        recording.readings.filter(arrow.column(keep[recording.reading_contact])),
        recording.metadata,
    )
    if belief.headings is not None:
        belief = replace(belief, headings=np.asarray(belief.headings)[keep])
    if belief.contact_motion is not None:
        belief = replace(belief, contact_motion=belief.contact_motion.take(keep))
    return part, belief


def recorded_belief(calibration: Calibration) -> Belief:
    """The belief of a calibration, in the unit of the readings. Raises CalibrationError where it
    has none."""
    belief, response = calibration.belief, calibration.response
    if belief is None or (belief.readings == RAW and response is None):
        raise CalibrationError(
            "the calibration does not know the scene", remedy="give cross_validate a belief"
        )
    return in_recorded_unit(belief, response)


def held_out_in_words(metrics: dict[str, Any]) -> str:
    """The errors of a cross-validation in words."""
    error, baseline = metrics["error_mm"]["rms"], metrics["centroid_error_mm"]["rms"]
    if error is None:
        return "no contact was read by three taxels"
    return (
        f"{metrics['localized']} of {metrics['contacts']} contacts localized to {error:.3g} mm "
        f"rms, {baseline:.3g} by the centroid"
    )
