"""Readings in a unit of their own: polarity, level at rest, threshold, end of the range and scale.

Counts and volts rise or fall with pressure, from a level at rest of each taxel. They are brought to
rise from zero, and scaled such that strong readings are as large as the believed peak pressures, so
that whatever follows works on the order of pascals.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import bdtrc

from ...core.arrays import Array, robust_sigma, spreads_by_group
from ...core.errors import CalibrationError
from ...recording.recording import Recording
from ...scene.belief import RAW, Belief
from ..result import LearnedResponse
from .resolve_belief import contact_model, nominal_patches
from .sensor_range import constant_taxels

DENSE = 0.5
"""Fraction of the contacts from which a taxel that reads in them is read at rest, too."""
NARROWER = 0.8
"""Ratio of the spreads of the contacts in which a taxel reads little and much, below which readings
fall with pressure; sound ones have 1.9 to 18, reversed ones the inverse."""
MIN_SMOOTHED = 20
"""Readings of a taxel, at least, of which those at neighbouring contacts are alike."""
MAX_COMPARED = 64
"""Taxels, about, whose spreads are compared."""
CHANCE = 0.05
"""Probability by chance, below which so many taxels' spreads have a ratio below 1 that readings
fall: 5 of 5 taxels."""
MIN_COMPARED = 5
"""Readings of a taxel, at least, whose spreads are compared."""
REST_SIGMAS = 5.0
"""Threshold above the level at rest, in standard deviations of the readings there."""
MIN_SATURATED = 10, 2e-3
"""Number, and fraction of the readings, that have the largest value, from which it is the end of
the range."""
STRONG = 0.9
"""Quantile of the taxels' strongest readings that is scaled to the believed peak pressure."""


def in_nominal_unit(belief: Belief, response: LearnedResponse | None) -> Belief:
    """A belief about raw readings in the nominal Pa of a learned response; another as it is."""
    return belief if response is None else _scaled(belief, 1.0 / response.unit)


def in_recorded_unit(belief: Belief, response: LearnedResponse | None) -> Belief:
    """The inverse of `in_nominal_unit`."""
    return belief if response is None else _scaled(belief, response.unit)


def _scaled(belief: Belief, unit: float) -> Belief:
    """A belief about raw readings with noise, threshold and end of the range times `unit`."""
    if belief.readings != RAW:
        return belief
    return replace(
        belief,
        threshold=belief.threshold * unit,
        saturation=None if belief.saturation is None else belief.saturation * unit,
        noise_sigma=None if belief.noise_sigma is None else belief.noise_sigma * unit,
    )


def nominal_pressure(
    recording: Recording, belief: Belief, index: np.ndarray, curvature: Array, used: np.ndarray
) -> tuple[Array, Belief, float, bool]:
    """Raw readings as nominal pressures (k,), Pa, NaN where they are, with the belief in the same
    unit, the recorded unit per Pa, and whether the recorded readings fall with pressure.

    index (k,): rows of the taxels; curvature (m, 2), 1/m, at the contacts, of which `used` (m,) are
    pressed. Raises CalibrationError for readings that never change.
    """
    known = np.isfinite(recording.pressure)
    raw = raw_readings(
        recording.pressure[known], recording.reading_contact[known], index[known],
        recording.points, belief,
    )  # fmt: skip
    patches = nominal_patches(contact_model(belief), belief, recording.force[used], curvature[used])
    level, belief, unit = raw.scaled(belief, float(np.median(patches.peak)), index[known])
    pressure = np.full(len(known), np.nan)
    pressure[known] = level
    return pressure, belief, unit, raw.falling


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
        raise _never_change(values)
    rest, dense = levels_at_rest(values, taxel, len(points))
    level, threshold = values - rest[taxel], belief.threshold
    own = dense[taxel]
    falling = falls_with_pressure(values, contact, taxel, points)
    if recorded_at_rest(dense, taxel):
        own &= ~constant_taxels(values, taxel, len(dense))[taxel]
        if not own.any():
            raise _never_change(values)
        level = -level if falling else level
        threshold = threshold or max(_noise_threshold(level[own]), quantum(values))
    else:  # few taxels that read everywhere are stuck, or noisy
        if falling:
            level[~own] = level[~own].max() + quantum(values) - level[~own]
        threshold = threshold or float(level[~own].min()) * (1 - 1e-9)
    saturation = belief.saturation
    largest = level == level.max()
    least = max(MIN_SATURATED[0], MIN_SATURATED[1] * len(level))
    if saturation is None and largest.sum() >= least:
        saturation = float(level.max())
    return RawReadings(level, threshold, saturation, falling)


def levels_at_rest(values: Array, taxel: np.ndarray, contacts: int) -> tuple[Array, np.ndarray]:
    """Level at rest (n,) of the taxels whose readings `values` (k,) are recorded at rest, too, 0 of
    the others; and which these are (n,) bool. Where most taxels are not, one that reads everywhere
    drifts; only what never changes is then its level at rest."""
    n = int(taxel.max(initial=-1)) + 1
    count = np.bincount(taxel, minlength=n)
    dense = count > DENSE * contacts
    if not recorded_at_rest(dense, taxel):
        dense &= constant_taxels(values, taxel, n)
    order = np.lexsort((values, taxel))
    middle = np.minimum(np.cumsum(count) - count + count // 2, len(values) - 1)
    return np.where(dense, values[order][middle], 0.0), dense


def recorded_at_rest(dense: np.ndarray, taxel: np.ndarray) -> bool:
    """Whether most taxels that have readings, of taxels (k,), are read at rest, too: `dense` (n,).

    A few that read everywhere are stuck, or noisy.
    """
    seen = np.bincount(taxel, minlength=len(dense)) > 0
    return bool(np.sum(dense[seen]) > 0.5 * np.sum(seen))


def check_pressures(pressure: Array, contact: np.ndarray, taxel: np.ndarray, points: Array) -> None:
    """Refuse pressures (k,), Pa, of taxels (k,) in contacts (k,) at `points` (m, 3), m, that fall
    where they are pressed, and those of taxels that are read at rest, too, if they never change.

    Raises CalibrationError.
    """
    dense = levels_at_rest(pressure, taxel, len(points))[1]
    if recorded_at_rest(dense, taxel) and constant_taxels(pressure, taxel, len(dense))[dense].all():
        raise _never_change(pressure)
    if falls_with_pressure(pressure, contact, taxel, points):
        raise CalibrationError(
            "the pressures fall where the skin is pressed",
            value="the contacts of a taxel's smallest readings lie closer together than those of "
            "its largest",
            remedy='give readings="raw" (--raw) if they are counts or volts, or turn their sign',
        )


def _never_change(values: Array) -> CalibrationError:
    return CalibrationError(
        "the readings never change",
        value=f"{values[0]:.6g} in {len(values)} readings",
        remedy="check the skin's wiring",
    )


def pressures_above_rest(
    pressure: Array, taxel: np.ndarray, contacts: int, threshold: float
) -> tuple[Array, float]:
    """Pressures (k,) without the level at rest of taxels that are recorded at rest, too, and the
    threshold above it."""
    rest, dense = levels_at_rest(pressure, taxel, contacts)
    level, own = pressure - rest[taxel], dense[taxel]
    own &= ~constant_taxels(pressure, taxel, len(dense))[taxel]
    found = _noise_threshold(level[own]) if recorded_at_rest(dense, taxel) and own.any() else 0.0
    return level, threshold or found


def _noise_threshold(level: Array) -> float:
    """Threshold of readings whose `level` (k,) is relative to that at rest, where most are."""
    return REST_SIGMAS * robust_sigma(level)


def falls_with_pressure(
    values: Array, contact: np.ndarray, taxel: np.ndarray, points: Array
) -> bool:
    """Whether the readings `values` (k,) of taxels (k,) in contacts (k,) at `points` (m, 3), m,
    fall where a taxel is pressed: the contacts that press it lie together.

    Contacts are weighted by the fourth power of what a reading is above a taxel's least, and below
    its largest one: noise at rest then counts for little. Outlying readings, which would have the
    largest weights, are replaced by those at the nearest contacts. Median of the taxels; a few do
    not show it.
    """
    order = np.random.default_rng(0).permutation(int(taxel.max(initial=-1)) + 1)
    few = (order < MAX_COMPARED)[taxel]
    values, contact, taxel = values[few], contact[few], taxel[few]
    values = _without_outlying(values, points[contact], taxel)
    n = int(taxel.max(initial=-1)) + 1
    low, high = np.full(n, np.inf), np.full(n, -np.inf)
    np.minimum.at(low, taxel, values)
    np.maximum.at(high, taxel, values)
    count = np.bincount(taxel, minlength=n)
    saturated = np.bincount(taxel, values == high[taxel], n) > count / 2
    saturated &= count <= DENSE * len(points)  # else the largest value is that at rest
    compared = (count >= MIN_COMPARED) & (high > low) & ~saturated
    if not compared.any():
        return False
    used = compared[taxel]
    values, at, taxel = values[used], points[contact[used]], taxel[used]
    above = (values - low[taxel]) / (high - low)[taxel]
    little, much = (
        np.sqrt(spreads_by_group(at, taxel, weight)) for weight in ((1 - above) ** 4, above**4)
    )
    ratio = little / np.maximum(much, 1e-12)
    chance = bdtrc(int(np.sum(ratio < 1)) - 1, len(ratio), 0.5)
    return bool(np.median(ratio) < NARROWER and chance < CHANCE)


def _without_outlying(values: Array, points: Array, taxel: np.ndarray) -> Array:
    """Readings (k,) of taxels (k,) in contacts at `points` (k, 3), m: medians of each one and those
    of the same taxel in the two nearest contacts, where it has many."""
    many = np.bincount(taxel)[taxel] >= MIN_SMOOTHED
    if not many.any():
        return values
    apart = 10 * float(np.ptp(points, axis=0).max()) + 1.0
    where = np.column_stack([points, apart * taxel])
    near = cKDTree(where).query(where, k=3)[1]
    return np.where(many, np.median(values[near], axis=1), values)


def quantum(values: Array) -> float:
    """The least difference of two readings; for continuous readings nearly 0."""
    steps = np.diff(np.unique(values))
    return float(steps.min()) if len(steps) else 0.0
