"""Readings in a unit of their own: polarity, level at rest, threshold, end of the range and scale.

Counts and volts rise or fall with pressure, from a level at rest of each taxel. They are brought to
rise from zero, and scaled such that strong readings are as large as the believed peak pressures, so
that whatever follows works on the order of pascals.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ...contact import ContactModel
from ...core.arrays import Array, sums_by_group
from ...core.errors import CalibrationError

if TYPE_CHECKING:
    from ...recording.recording import Recording
    from ...scene.belief import Belief

DENSE = 0.5
"""Fraction of the contacts from which a taxel that reads in them is read at rest, too."""
SKEWED = 2.0
"""Ratio of the excursions below and above the level at rest from which readings fall with pressure.
Noise alone has a ratio of 1; pressed taxels, of 10 and more one way or the other."""
RISING_OUTWARD = 0.3
"""Correlation of a taxel's readings with the distance of the contact from the middle of its
contacts, above which readings fall with pressure; that of sound ones is -0.5 to -0.9."""
REST_SIGMAS = 5.0
"""Threshold above the level at rest, in standard deviations of the readings there."""
MIN_SATURATED = 10, 2e-3
"""Number, and fraction of the readings, that have the largest value, from which it is the end of
the range."""
STRONG = 0.9
"""Quantile of the taxels' strongest readings that is scaled to the believed peak pressure."""
MAD = 0.6745
"""Median absolute value of a standard normal variable."""


def nominal_pressure(
    recording: Recording, belief: Belief, index: np.ndarray, curvature: Array, used: np.ndarray
) -> tuple[Array, Belief, float]:
    """Raw readings as nominal pressures (k,), Pa, with the belief in the same unit, and the
    recorded unit per Pa.

    index (k,): rows of the taxels; curvature (m, 2), 1/m, at the contacts, of which `used` (m,) are
    pressed. Raises CalibrationError for readings that never change.
    """
    raw = raw_readings(
        recording.pressure, recording.reading_contact, index, recording.points, belief
    )
    material = belief.material
    peak = (
        ContactModel(belief.contact, material.poisson, material.thickness)
        .patches(
            force=recording.force[used],
            curvature=curvature[used],
            indenter_radius=belief.indenter.radius,
            effective_modulus=material.effective_modulus,
        )
        .peak
    )
    return raw.scaled(belief, float(np.median(peak)), index)


@dataclass(frozen=True)
class RawReadings:
    """Readings that rise from zero with pressure, in the recording's unit."""

    level: Array
    """(k,)."""
    threshold: float
    """Levels up to this are silence."""
    saturation: float | None
    """End of the range; None: not reached."""
    falling: bool
    """Whether the recorded readings fall with pressure."""

    def scaled(self, belief: Belief, peak: float, taxel: np.ndarray) -> tuple[Array, Belief, float]:
        """The levels (k,) of taxels (k,) and the belief in nominal pascals, and the levels per
        nominal pascal; `peak`, Pa: the typical peak pressure of the believed contacts."""
        strongest = np.zeros(int(taxel.max()) + 1)
        np.maximum.at(strongest, taxel, self.level)
        strongest = strongest[strongest > self.threshold]
        if not len(strongest):
            raise CalibrationError(
                "no reading differs from the level at rest",
                value=f"{len(self.level)} readings within {self.threshold:.4g} of it",
                remedy="check the skin's wiring and the times of readings and contacts",
            )
        unit = float(np.quantile(strongest, STRONG)) / peak
        noise = belief.noise_sigma
        return (
            self.level / unit,
            replace(
                belief,
                threshold=self.threshold / unit,
                saturation=None if self.saturation is None else self.saturation / unit,
                noise_sigma=None if noise is None else noise / unit,
            ),
            unit,
        )


def raw_readings(
    values: Array, contact: np.ndarray, taxel: np.ndarray, points: Array, belief: Belief
) -> RawReadings:
    """The readings of `values` (k,) of taxels (k,), rows, in contacts (k,) at `points` (m, 3), m.

    Raises CalibrationError for readings that never change.
    """
    if len(values) and np.ptp(values) == 0:
        raise CalibrationError(
            "the readings never change", value=f"{values[0]:.6g} in {len(values)} readings",
            remedy="check the skin's wiring",
        )  # fmt: skip
    rest, dense = levels_at_rest(values, taxel, len(points))
    level, threshold = values - rest[taxel], belief.threshold
    if dense.any():
        own = dense[taxel]
        falling = _skewness(level[own], taxel[own]) < 1 / SKEWED
        level = -level if falling else level
        threshold = threshold or max(_noise_threshold(level[own]), _quantum(values))
    else:
        falling = _rises_outward(level, contact, taxel, points)
        if falling:
            level = level.max() + _quantum(values) - level
        threshold = threshold or float(level.min()) * (1 - 1e-9)
    saturation = belief.saturation
    largest = level == level.max()
    least = max(MIN_SATURATED[0], MIN_SATURATED[1] * len(level))
    if saturation is None and largest.sum() >= least:
        saturation = float(level.max())
    return RawReadings(level, threshold, saturation, falling)


def levels_at_rest(values: Array, taxel: np.ndarray, contacts: int) -> tuple[Array, np.ndarray]:
    """Level at rest (n,) of the taxels whose readings `values` (k,) are recorded at rest, too, 0 of
    the others; and which these are (n,) bool."""
    n = int(taxel.max(initial=-1)) + 1
    count = np.bincount(taxel, minlength=n)
    dense = count > DENSE * contacts
    order = np.lexsort((values, taxel))
    middle = np.minimum(np.cumsum(count) - count + count // 2, len(values) - 1)
    return np.where(dense, values[order][middle], 0.0), dense


def pressures_above_rest(
    pressure: Array, taxel: np.ndarray, contacts: int, threshold: float
) -> tuple[Array, float]:
    """Pressures (k,) without the level at rest of taxels that are recorded at rest, too, and the
    threshold above it."""
    rest, dense = levels_at_rest(pressure, taxel, contacts)
    level, own = pressure - rest[taxel], dense[taxel]
    return level, threshold or (_noise_threshold(level[own]) if own.any() else 0.0)


def _noise_threshold(level: Array) -> float:
    """Threshold of readings whose `level` (k,) is relative to that at rest, where most are."""
    return REST_SIGMAS * float(np.median(np.abs(level))) / MAD


def _skewness(level: Array, taxel: np.ndarray) -> float:
    """Excursions above the level at rest relative to those below, median of the taxels."""
    n = int(taxel.max()) + 1
    above, below = np.zeros(n), np.zeros(n)
    np.maximum.at(above, taxel, level)
    np.maximum.at(below, taxel, -level)
    seen = np.bincount(taxel, minlength=n) > 0
    return float(np.median(above[seen] / np.maximum(below[seen], 1e-300)))


def _rises_outward(level: Array, contact: np.ndarray, taxel: np.ndarray, points: Array) -> bool:
    """Whether taxels read most in the outermost of their contacts."""
    n = int(taxel.max()) + 1
    count = np.maximum(np.bincount(taxel, minlength=n), 1)
    centre = sums_by_group(points[contact], taxel, n) / count[:, None]
    off = np.linalg.norm(points[contact] - centre[taxel], axis=1)

    def centred(x: Array) -> Array:
        return np.asarray(x - (np.bincount(taxel, x, n) / count)[taxel])

    a, b = centred(level), centred(off)
    scale = np.sqrt(np.bincount(taxel, a**2, n) * np.bincount(taxel, b**2, n))
    many = (count >= 5) & (scale > 0)
    correlation = np.bincount(taxel, a * b, n)[many] / scale[many]
    return bool(len(correlation) and np.median(correlation) > RISING_OUTWARD)


def _quantum(values: Array) -> float:
    """The least difference of two readings; for continuous readings nearly 0."""
    steps = np.diff(np.unique(values))
    return float(steps.min()) if len(steps) else 0.0
