"""The verdict on a calibration: whether its positions and standard deviations can be relied on.

Each check compares something the estimate did not use, or used as a prior, with the data: the test
of fit, E* against the nominal material, the positions against the pressure-weighted means of the
contact points, the contact points against the believed surface, and the columns of the log.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ...core.arrays import Array, sums_by_group

if TYPE_CHECKING:
    from ...recording.recording import Recording
    from ..calibration import Calibration
    from ..data.measurements import Measurements

PASS, DOUBT, FAIL = LEVELS = ("PASS", "DOUBT", "FAIL")
"""Levels of a verdict: nothing found; check before use; do not use."""
MAX_MISFIT = 0.05
"""Residuals beyond the noise, relative to the strong readings, from which a model that does not fit
is a failure: a contact's position by readings that are 5 % wrong is 0.2 mm off in 4 mm."""
STRONG = 0.9
"""Quantile of the readings that stands for the strong ones."""
MODULUS_FACTORS = 3.0, 10.0
"""Factor between the estimated and the nominal E* from which it is a doubt, and a failure. Nominal
values of elastomers by Shore hardness are within a factor of 2; pressures 2 and 4 times wrong move
E* by factors of 2.7 and 17, since the patch, too, has to fit."""
MEAN_SIGMAS = 4.0, 12.0
"""Median distance of the positions from the weighted means of contact points, in standard
deviations of both, from which it is a doubt, and a failure; 1.18 by theory."""
SURFACE_DEPTHS = 0.1, 1.5
"""Typical distance of the contact points from the believed surface, in depths of the indentation,
from which it is a doubt, and a failure: recorded points lie between the undeformed surface and the
indenter's deepest point. The doubt is a tenth of the depth, 0.2 mm for the paper's skin."""
SHIFT_SIGMAS = 5.0
"""Displacement of the contact points, in its standard deviations, from which it is not chance."""
MIN_SPREAD = 1e-3
"""Mean square of the normals' components along a direction from which a displacement along it
changes the distances: 2 degrees."""
MAX_NEGATIVE = 1e-3
"""Fraction of negative or corrupt readings, or of contacts without a positive force that have
readings, up to which they are single accidents, which are left out."""
MAX_LAG = 0.1
"""Time of the readings after their contacts, in frames, from which clocks are in doubt."""
MAX_FAULTY = 0.2
"""Fraction of faulty taxels from which the log is in doubt, not the taxels."""
LATE_FRAMES = 5
"""Largest delay of the readings that is looked for, in frames."""
LATE_GAIN = 0.9
"""Spread of the taxels' contacts with the readings moved to other frames, relative to the present
one, below which they are late."""
MIN_CONTACTS = 10
"""Contacts, at least, to judge their columns."""


@dataclass(frozen=True)
class Verdict:
    """Whether a calibration can be relied on."""

    level: str
    """"PASS", "DOUBT" (check the reasons before use) or "FAIL" (do not use)."""
    reasons: tuple[str, ...] = ()
    """What was found, one sentence each with value, limit and next step; the gravest first."""

    def __str__(self) -> str:
        return "\n".join([f"verdict: {self.level}", *(f"  - {words}" for words in self.reasons)])

    def metrics(self) -> dict[str, Any]:
        """Level and reasons as JSON values."""
        return {"level": self.level, "reasons": list(self.reasons)}


Finding = tuple[str, str]
"""A level and a sentence."""


def judge(recording: Recording, data: Measurements, calibration: Calibration) -> Verdict:
    """The verdict on the calibration of `data`, which were gathered from `recording`."""
    checks: tuple[Callable[[], list[Finding]], ...] = (
        lambda: _fit(data, calibration),
        lambda: _modulus(data, calibration),
        lambda: _surface(recording, data, calibration),
        lambda: _weighted_means(data, calibration),
        lambda: _forces(recording, calibration),
        lambda: _pressures(recording, data),
        lambda: _times(recording),
        lambda: _faults(calibration),
    )
    found = [finding for check in checks for finding in check()]
    found.sort(key=lambda finding: -LEVELS.index(finding[0]))
    return Verdict(found[0][0] if found else PASS, tuple(words for _, words in found))


def _level(value: float, limits: tuple[float, float]) -> str:
    return FAIL if value > limits[1] else DOUBT if value > limits[0] else PASS


def _fit(data: Measurements, calibration: Calibration) -> list[Finding]:
    """The test of fit; where it fails, whether late readings are the cause."""
    fit = calibration.fit
    if fit is None:
        words = (
            f"the method {calibration.method} has no test of fit: compare with the verdict of "
            'method="joint"'
        )
        return [(DOUBT, words)]
    if fit.good is not False:
        return []
    beyond = fit.noise * max(fit.reduced - 1.0, 0.0) ** 0.5
    severe = beyond > MAX_MISFIT * float(np.quantile(data.pressure, STRONG))
    found = [(FAIL if severe else DOUBT, fit.words)]
    frames = late_frames(data)
    if frames:
        count = "1 frame" if abs(frames) == 1 else f"{abs(frames)} frames"
        words = (
            f"the readings are {count} too {'late' if frames > 0 else 'early'}: moved "
            "by that, the contacts that each taxel responds to lie closer together; correct the "
            "times of the readings"
        )
        found.append((DOUBT, words))
    return found


def late_frames(data: Measurements) -> int:
    """Number of frames by which the readings come too late; negative: too early, 0: neither.

    The contacts that a taxel responds to, weighted by pressure squared, spread least at the true
    delay.
    """
    weight, n = data.pressure**2, len(data.ids)

    def spread(frames: int) -> float:
        row = data.contact - frames
        inside = (row >= 0) & (row < len(data.points))
        points, w, own = data.points[row[inside]], weight[inside], data.taxel[inside]
        total = np.bincount(own, w, n)
        mean = sums_by_group(w[:, None] * points, own, n) / np.maximum(total, 1e-300)[:, None]
        square = np.bincount(own, w * np.sum((points - mean[own]) ** 2, axis=1), n)
        return float(np.median((square / np.maximum(total, 1e-300))[total > 0]))

    at = {k: spread(k) for k in range(-LATE_FRAMES, LATE_FRAMES + 1)}
    best = min(at, key=lambda k: at[k])
    return best if at[best] < LATE_GAIN * at[0] else 0


def _modulus(data: Measurements, calibration: Calibration) -> list[Finding]:
    if calibration.modulus is None or calibration.modulus_sigma is None:
        return []
    ratio = calibration.modulus / data.modulus
    level = _level(max(ratio, 1 / ratio), MODULUS_FACTORS)
    if level == PASS:
        return []
    words = (
        f"E* is {calibration.modulus / 1e3:.3g} kPa, {ratio:.3g} times the nominal "
        f"{data.modulus / 1e3:.3g} kPa (limit: a factor of {MODULUS_FACTORS[0]:g}): check the "
        "scale of pressures and forces, the indenter's radius and the nominal Young's modulus"
    )
    return [(level, words)]


def _surface(recording: Recording, data: Measurements, calibration: Calibration) -> list[Finding]:
    """Distances of the recorded contact points from the believed surface.

    An offset of body or indenter that was estimated may explain them.
    """
    rows = np.flatnonzero(recording.force > 0)
    if not len(rows):
        return []
    hit = data.body.closest(recording.points[rows])
    distance, median = hit.distance, float(np.median(hit.distance))
    typical, shift = float(np.median(np.abs(distance))), _shift(distance, hit.normal)
    depth = float(np.median(data.radii**2 * (data.curvature.mean(axis=1) + 1 / _radius(data))))
    moved = [
        abs(value)
        for label, (value, _) in calibration.unknowns.items()
        if label.split()[0] in ("body_offset", "indenter_offset") and "rotation" not in label
    ]
    size = max(typical, float(np.linalg.norm(shift)))
    level = _level(max(size - 2 * max(moved, default=0.0), 0.0) / depth, SURFACE_DEPTHS)
    if level == PASS:
        return []
    side = "above" if median > 0 else "below"
    where = f"{side} the believed surface" if abs(median) > 0.5 * typical else "off the surface"
    words = (
        f"contact points lie {1e3 * typical:.3g} mm {where} in the median, and on it best if moved "
        f"by ({', '.join(f'{-1e3 * x:.2g}' for x in shift)}) mm (limit "
        f"{1e3 * SURFACE_DEPTHS[0] * depth:.2g} mm, a tenth of the indentation): check the body's "
        "scale and frame, the indenter's position and its radius, or declare body_offset or "
        "indenter_offset unknown"
    )
    return [(level, words)]


def _shift(distance: Array, normals: Array) -> Array:
    """The displacement (3,), m, of contact points that explains their distances (m,), m, from a
    surface with normals (m, 3); zero where it is within SHIFT_SIGMAS of chance.
    """
    value, vectors = np.linalg.eigh(normals.T @ normals)
    good = value > MIN_SPREAD * len(normals)
    basis = vectors[:, good] / np.sqrt(value[good])
    along = basis.T @ (normals.T @ distance)
    rest = float(np.sum(distance**2) - np.sum(along**2)) / max(len(distance) - 3, 1)
    along[np.abs(along) < SHIFT_SIGMAS * np.sqrt(max(rest, 0.0))] = 0.0
    return np.asarray(basis @ along)


def _radius(data: Measurements) -> float:
    return float(data.belief.indenter.radius)


def _weighted_means(data: Measurements, calibration: Calibration) -> list[Finding]:
    """Positions against the pressure-weighted mean of contact points, over all taxels."""
    means = calibration.contact_centroids
    if means is None:
        return []
    weight, n = data.pressure**2, len(data.ids)
    total = np.maximum(np.bincount(data.taxel, weight, n), 1e-300)
    off = data.points[data.contact] - means[data.taxel]
    near = np.linalg.norm(off, axis=1) < 1.5 * data.reach()[data.contact]
    square = np.where(near, (weight / total[data.taxel]) ** 2 * np.sum(off**2, axis=1), 0.0)
    spread = np.bincount(data.taxel, square, n)
    apart = np.linalg.norm(calibration.positions - means, axis=1)
    sigma = np.sqrt((spread + calibration.position_sigma**2) / 2)
    seen = np.isfinite(apart) & np.isfinite(sigma) & (data.counts >= 5) & (sigma > 0)
    if seen.sum() < 3:
        return []
    typical = float(np.median(apart[seen] / sigma[seen]))
    level = _level(typical, MEAN_SIGMAS)
    if level == PASS:
        return []
    words = (
        f"positions are {1e3 * np.median(apart[seen]):.2g} mm from the pressure-weighted means of "
        f"their contact points, {typical:.2g} times what both standard deviations allow (limit "
        f"{MEAN_SIGMAS[0]:g}): check the contact model and the scale of pressures and forces"
    )
    return [(level, words)]


def _forces(recording: Recording, calibration: Calibration) -> list[Finding]:
    force, found = recording.force, []
    if len(force) < MIN_CONTACTS:
        return []
    fits = calibration.fit is not None and calibration.fit.good is True
    applied = "presses" in (recording.metadata.get("provenance") or {})  # by ms.press: known
    if np.ptp(force) == 0 and not (fits and applied):
        words = (
            f"the force is constant, {force[0]:.3g} N in all {len(force)} contacts: record the "
            'measured force, or estimate unknown=("modulus", "force_scale")'
        )
        found.append((DOUBT, words))
    wrong = np.zeros(len(force), dtype=bool)
    wrong[np.unique(recording.reading_contact)] = True
    wrong &= ~(force > 0)
    if wrong.sum() > MAX_NEGATIVE * len(force):
        words = (
            f"the force is not positive in {wrong.sum()} of {len(force)} contacts that have "
            f"readings (limit {MAX_NEGATIVE:.1%}); they were left out: check its sign and offset"
        )
        found.append((DOUBT, words))
    return found


def _pressures(recording: Recording, data: Measurements) -> list[Finding]:
    found, count = [], max(len(recording.pressure), 1)
    negative = int(np.sum(recording.pressure < 0))
    if negative > MAX_NEGATIVE * count:
        words = (
            f"the pressure is negative in {negative} of {count} readings (limit "
            f"{MAX_NEGATIVE:.1%}); they were left out: remove the offsets of the sensors"
        )
        found.append((DOUBT, words))
    corrupt = len(data.corrupt) - negative
    if corrupt > MAX_NEGATIVE * count:
        words = (
            f"{corrupt} of {count} readings are corrupt (limit {MAX_NEGATIVE:.1%}); they were left "
            "out: check the sensor's connection"
        )
        found.append((DOUBT, words))
    if len(data.pressure) >= MIN_CONTACTS and np.ptp(data.pressure) <= 1e-9 * data.pressure[0]:
        words = (
            f"all pressures are equal, {data.pressure[0]:.4g} Pa in {len(data.pressure)} readings: "
            "record pressures, not contact flags; look for saturation"
        )
        found.append((FAIL, words))
    return found


def _times(recording: Recording) -> list[Finding]:
    lag: Array = recording.time_lag
    typical = float(np.median(np.abs(lag))) if len(lag) else 0.0
    if typical <= MAX_LAG * recording.frame:
        return []
    words = (
        f"the times of the readings are {1e3 * typical:.3g} ms off those of their contacts, in "
        f"frames of {1e3 * recording.frame:.3g} ms (limit {MAX_LAG:g} frames); they were matched "
        "to the nearest: synchronize the clocks"
    )
    return [(DOUBT, words)]


def _faults(calibration: Calibration) -> list[Finding]:
    if calibration.faults is None:
        return []
    touched = np.asarray(calibration.touched, dtype=bool)
    faulty = np.array([bool(words) for words in calibration.faults]) & touched
    if faulty.sum() <= MAX_FAULTY * touched.sum():
        return []
    words = (
        f"{faulty.sum()} of {touched.sum()} taxels have faults (limit {MAX_FAULTY:.0%}): so many "
        "point to the log or the contact model; see the faults of the taxels"
    )
    return [(DOUBT, words)]
