"""Checks of values that no plausible scene explains: wrong units are refused with the cause."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from ...contact.reading import same_sheet
from ...core import arrow
from ...core.arrays import Array
from ...core.errors import CalibrationError, RecordingError
from ...geometry.body import Body
from ...geometry.surface.closest_point import Closest
from ...geometry.surface.surface import Facets
from ...recording.recording import Recording
from .corrupt_readings import MIN_READINGS, too_many_corrupt

MAX_DISTANCE = 0.02
"""Largest median distance of the contact points from the believed surface, m: far above any
misplacement that calibration could repair, far below points in mm (3 mm would read as 3 m)."""
SCALES = (1e-3, 1e3, 1e-6, 1e6)
"""Factors between m, mm and um."""
CLOSE = 2e-3
"""Median distance from the surface, m, below which rescaled points are on it, and extent above
which they are not one point: a tenth of MAX_DISTANCE."""
SAMPLES = 100
"""Points that are rescaled, about: enough for a median."""
SINGLE = 6.0
"""Distance or angle from the surface, in upper quartiles of all contacts, above which a contact is
not on it: 7 standard deviations of normal errors."""
MIN_OFF = 0.01, np.radians(2.0)
"""Distance, in radii of the indenter, and angle up to which every contact is on the surface: a
fifth of the indentation, and what the normals of a contact patch differ by anyway."""
MAX_SINGLE = 0.1
"""Fraction of contacts off the surface up to which they are single ones."""
MAX_PRESSURE_RATIO = 30.0
"""Largest ratio of the strongest readings to the believed peak pressure, either way. The peak grows
as E*^(2/3), so that E* may be wrong by a factor of 160; kPa for Pa is a factor of 1000."""
MAX_FORCE_RATIO = 100.0
"""Largest ratio of the median force to the reference force, either way: the smallest mix-up of
units is a factor of 1000."""
PRESSURE_UNITS = {"kPa": 1e-3, "MPa": 1e-6, "bar": 1e-5, "psi": 6894.76**-1}
"""Number that a pressure of 1 Pa has in each unit."""
FORCE_UNITS = {"kN": 1e-3, "mN": 1e3, "uN": 1e6}
"""Number that a force of 1 N has in each unit."""
MATCH = 20.0
"""A unit is named as the cause if it explains the ratio within this factor."""
SET_BACK, MAX_SET_BACK = 10.0, 0.3
"""Frames by which a reading lies behind the one before of its taxel in the table, more than those
that arrive late, from which the clock was set back; and the number of such readings, relative to
those that follow in time: more are rows in another order, whose times may be right."""
REMEDY = "check the units of pressure, force and modulus"
RAW_REMEDY = ', or give readings="raw" (--raw) if they are counts or volts'
"""What else helps where readings are not pressures."""


def check_points(body: Body, points: Array, distance: Array) -> None:
    """Refuse contact points (m, 3) far from the surface: `distance` (m,), m, from it.

    A unit that would put them on the surface is named. Raises CalibrationError.
    """
    typical = float(np.median(np.abs(distance))) if len(distance) else 0.0
    if typical <= MAX_DISTANCE:
        return
    some = points[:: max(len(points) // SAMPLES, 1)]
    on_surface = [
        factor
        for factor in SCALES
        if np.ptp(factor * some, axis=0).max() > CLOSE
        and np.median(np.abs(body.closest(factor * some).distance)) < CLOSE
    ]
    remedy = "check their units (m) and that they are in the body's frame"
    if on_surface:
        remedy = (
            f"times {on_surface[0]:g} they are on it: correct their unit, which a column of a log "
            "names (px_mm, px_um)"
        )
    raise CalibrationError(
        "the contact points are not on the believed body",
        value=f"typically {typical:.3g} m off its surface",
        limit=f"{MAX_DISTANCE} m",
        remedy=remedy,
    )


def off_surface(hit: Closest, normals: Array, radius: float) -> np.ndarray:
    """Single contacts (m,) bool that are not on the believed surface where the others are.

    Their points are off it, or their recorded normals (m, 3) are not its: an indenter (radius, m)
    that rolls over an edge of a mesh, or a wrong frame of a log. None where many contacts are off,
    or errors of all are as large.
    """
    off = np.zeros(len(normals), dtype=bool)
    limits = MIN_OFF[0] * radius, MIN_OFF[1]
    for size, least in zip((np.abs(hit.distance), angles(hit, normals)), limits, strict=True):
        off |= size > max(least, SINGLE * float(np.quantile(size, 0.75)) if len(size) else 0.0)
    return off & (off.mean() <= MAX_SINGLE if len(off) else True)


def on_facets(body: Body, points: Array, normals: Array, radius: float) -> np.ndarray:
    """Which contacts (k,) bool are on a flat face of the believed mesh, with that face's normal.

    The smooth surface leaves the faces of a coarse or noisy mesh by tenths of a millimetre and ten
    degrees. A log that was made on its faces is not off the surface there. radius: of the indenter,
    m. Contacts of which the smooth surface is on another sheet are not on it.
    """
    nearest, facing = Facets(body.facets).closest(points)
    flat = np.linalg.norm(points - nearest, axis=1) <= MIN_OFF[0] * radius
    hit = body.surface.nearest(points)
    turned = np.einsum("ki,ki->k", facing, normals)
    return np.asarray(
        flat & (turned >= np.cos(MIN_OFF[1])) & same_sheet(hit.point - points, normals, hit.normal)
    )


def angles(hit: Closest, normals: Array) -> Array:
    """Angles (m,), rad, of recorded normals (m, 3) and those of the surface; 0 without a normal."""
    length = np.linalg.norm(normals, axis=1)
    with np.errstate(invalid="ignore", divide="ignore"):
        cosine = np.einsum("mi,mi->m", hit.normal, normals) / length
    return np.arccos(np.clip(np.where(length > 0, cosine, 1.0), -1.0, 1.0))


def check_force(force: Array, reference: float) -> None:
    """Refuse forces (m,), N, that differ from the reference, N, as units do."""
    typical = float(np.median(force)) if len(force) else reference
    ratio = typical / reference
    if not 1 / MAX_FORCE_RATIO < ratio < MAX_FORCE_RATIO:
        raise CalibrationError(
            "the forces cannot be in N",
            value=f"typically {typical:.3g}",
            limit=f"the reference force is {reference:.3g} N",
            remedy=_likely_unit(ratio, FORCE_UNITS, "N") + REMEDY,
        )


def check_readings(recorded: object, believed: str) -> None:
    """Refuse readings that are recorded as "raw" and believed to be another unit's."""
    if recorded == "raw" != believed:
        raise CalibrationError(
            "the recording holds raw readings, without a unit",
            value=f'readings="{believed}"',
            remedy='give the belief readings="raw" (--raw), or name the column pressure if it is '
            "in Pa",
        )


def check_pressure(pressure: Array, taxel: np.ndarray, peaks: Array) -> None:
    """Refuse readings (k,), Pa, of the taxels (k,) that no plausible modulus explains.

    peaks (m,), Pa: the peak pressures of the believed contacts.
    """
    if not len(pressure):
        return
    strongest = np.zeros(int(taxel.max()) + 1)
    np.maximum.at(strongest, taxel, pressure)
    counted = np.bincount(taxel) >= MIN_READINGS
    if not counted.any():
        return
    typical, expected = float(np.median(strongest[counted])), float(np.median(peaks))
    ratio = typical / expected
    if not 1 / MAX_PRESSURE_RATIO < ratio < MAX_PRESSURE_RATIO:
        raise CalibrationError(
            "the pressures cannot be in Pa",
            value=f"a taxel's strongest reading is typically {typical:.3g}",
            limit=f"the believed contacts peak at {expected:.3g} Pa",
            remedy=_likely_unit(ratio, PRESSURE_UNITS, "Pa") + REMEDY + RAW_REMEDY,
        )


def _likely_unit(ratio: float, units: Mapping[str, float], expected: str) -> str:
    """The unit that explains a value `ratio` times the expected one, in words; "" for none."""
    near = min(units, key=lambda name: abs(np.log(ratio / units[name])))
    match = 1 / MATCH < ratio / units[near] < MATCH
    return f"they look like {near} taken for {expected}; " if match else ""


def check_finite(recording: Recording) -> None:
    """Refuse contacts that are not finite, and many such readings."""
    columns = {"contact point": recording.points.sum(axis=1), "force": recording.force}
    if too_many_corrupt(~np.isfinite(recording.pressure)):
        columns["pressure"] = recording.pressure
    for what, values in columns.items():
        bad = np.flatnonzero(~np.isfinite(values))
        if len(bad):
            table = "readings" if what == "pressure" else "contacts"
            raise RecordingError(
                f"a {what} is not finite",
                value=f"{values[bad[0]]} in row {bad[0]} of {table}, {len(bad)} in all",
                remedy="drop those rows or repair the log",
            )


def check_clock(recording: Recording, index: np.ndarray) -> None:
    """Refuse readings of taxels (k,) whose clock was set back in the course of the recording: the
    later ones would belong to earlier contacts."""
    time = arrow.values(recording.readings.column("time"))
    order = np.argsort(index, kind="stable")
    step, same = np.diff(time[order]), np.diff(index[order]) == 0
    back = same & (step < -SET_BACK * recording.frame)
    if not 0 < back.sum() <= MAX_SET_BACK * np.sum(same & (step > 0)):
        return
    row = int(order[1:][back].min())
    raise RecordingError(
        "the clock of the readings was set back",
        value=f"{time[:row].max():g} s, then {time[row]:g} s in row {row} of readings",
        remedy="add the time that is missing to those from there on, or cut the log there",
    )


def check_unique(recording: Recording, index: np.ndarray, taxels: int) -> None:
    """Refuse a taxel that is read twice in one contact: a copy would count as independent noise."""
    number = recording.reading_contact * taxels + index
    if np.all(np.diff(number) > 0):
        return
    _, first, count = np.unique(number, return_index=True, return_counts=True)
    if len(first) < len(number):
        k = int(first[np.argmax(count > 1)])
        raise RecordingError(
            "a taxel is read twice in one contact",
            value=f"taxel {recording.reading_taxel[k]} at "
            f"{recording.time[recording.reading_contact[k]]:g} s, {np.sum(count > 1)} in all",
            remedy="drop the copies",
        )
