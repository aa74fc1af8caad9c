"""Measurements from a recording under a belief: what is read, in which unit, what is refused."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ... import contact
from ...core.arrays import Array
from ...core.errors import CalibrationError, ContactError
from ...geometry.surface.closest_point import Closest
from ...recording.recording import Recording
from ...scene.belief import RAW, Belief
from . import corrupt_readings, unit_checks
from .delay import without_delay
from .global_parameters import declared_parameters
from .measurements import Measurements
from .patch_shape import in_hollows, over_edges, over_patches
from .raw_readings import check_pressures, nominal_pressure, pressures_above_rest
from .registration import registered
from .resolve_belief import (
    MAX_INVALID,
    contact_model,
    nominal_patches,
    resolve_belief,
    valid_contacts,
)
from .sensor_range import (
    check_answered,
    check_disc,
    common_end,
    constant_taxels,
    ends_of_range,
    lost_readings,
)

STIFFER = 3.0
"""Factor on Young's modulus at which a contact model must hold for a response to be learned in its
place: the factor on E* from which the verdict doubts. Wider contacts are errors of units."""


def gather(recording: Recording, belief: Belief, repeated: bool = False) -> Measurements:
    """The measurements of a recording under a belief.

    repeated: whether contacts count that repeat an earlier one to the last digit, as those of
    several passes that were simulated without noise do.

    Contacts without force (approach) have no patch and are left out, with their readings; so are a
    few corrupt readings, those of taxels that are stuck for a while, and spikes of taxels that
    nothing touches (`corrupt_readings.py`). Raises RecordingError for contacts that are not finite
    and for many such readings, a clock that was set back, taxels read twice in a contact;
    CalibrationError for no readings, wrong units, unknown taxel ids and headings of another shape;
    ContactError where the contact model leaves its range.
    """
    unit_checks.check_finite(recording)
    unit_checks.check_readings(recording.metadata.get("readings"), belief.readings)
    index = taxel_rows(recording.reading_taxel, np.asarray(belief.taxel_ids))
    unit_checks.check_unique(recording, index, len(belief.taxel_ids))
    unit_checks.check_clock(recording, index)
    headings = _headings(recording, belief)
    learned = belief.readings == RAW or belief.contact == contact.LEARNED
    if learned:
        belief = replace(belief, contact=contact.LEARNED)
    belief, points, hit = _on_body(recording, belief, learned)
    selected, belief = _pressed(recording, belief, index, points, hit, repeated)
    unit_checks.check_force(recording.force[selected.used], belief.force_reference or 1.0)
    selected.leave_out_invalid(belief, points, hit, learned)
    data = _measurements(selected, belief, points, hit, headings, learned)
    motion = data.belief.contact_motion
    if motion is None or "clock_offset" not in motion.labels:
        data = without_delay(data)
    check_answered(data)
    check_disc(data)
    lost, ended = lost_readings(data)
    return replace(data, lost=lost, ended=ended)


def _measurements(
    selected: _Selection,
    belief: Belief,
    points: Array,
    hit: Closest,
    headings: Array | None,
    learned: bool,
) -> Measurements:
    """The measurements of the contacts that are selected, without readings below the threshold.

    points (m, 3), m, hit and headings (m, 3, 3) are those of all contacts.
    """
    recording, used, n = selected.recording, selected.used, len(belief.taxel_ids)
    hit, force, row = hit.take(used), recording.force[used], np.cumsum(used) - 1
    model = contact_model(belief)
    patches = nominal_patches(model, belief, force, hit.curvature)
    if not learned:
        unit_checks.check_pressure(selected.pressures, selected.taxels, patches.peak)
    elif belief.readings != RAW:  # raw readings are above their levels at rest already
        belief = selected.above_rest(belief)
    selected.leave_out_faint(belief, float(np.median(patches.first)) + belief.disc_radius)
    pressure, taxel = selected.pressures, selected.taxels
    motion = belief.contact_motion and belief.contact_motion.take(used)
    reference, peak = belief.force_reference or 1.0, float(np.median(patches.peak))
    ends = ends_of_range(pressure, taxel, n)
    saturation = belief.saturation or common_end(ends, np.bincount(taxel, minlength=n))
    return Measurements(
        belief=belief,
        points=points[used],
        normals=hit.normal,
        directions=hit.direction,
        curvature=hit.curvature,
        force=force,
        force_measured=recording.force_measured,
        patches=patches,
        model=model,
        contact=row[selected.contacts],
        taxel=taxel,
        pressure=pressure,
        noise=belief.noise_sigma,
        threshold=max(belief.threshold, float(pressure.min())),
        saturation=saturation,
        ends=np.minimum(ends, saturation),
        constant=constant_taxels(recording.pressure, selected.index, n),
        falling=selected.falling,
        parameters=declared_parameters(belief.unknown, belief.priors, reference, peak, motion),
        learned=learned,
        unit=selected.unit,
        headings=None if headings is None else headings[used],
        unevenness=np.empty(0) if learned else over_edges(belief, hit, force),
        time=recording.time[used],
        recorded=np.flatnonzero(used),
        left_out=selected.invalid,
        strays=selected.strays,
        corrupt=np.column_stack([row[recording.reading_contact], selected.index])[selected.corrupt],
    )


@dataclass
class _Selection:
    """The contacts and readings of a recording that count; narrowed step by step."""

    recording: Recording
    index: np.ndarray
    """Row (k,) of the taxel of each reading."""
    pressure: Array
    """(k,) Pa, or in the unit of raw readings."""
    used: np.ndarray
    """Contacts (m,) bool."""
    read: np.ndarray
    """Readings (k,) bool."""
    corrupt: np.ndarray
    """Readings (k,) bool that are left out as corrupt."""
    unit: float = 1.0
    """Of the readings, Pa."""
    falling: bool = False
    """Whether readings fall under pressure."""
    invalid: int = 0
    """Contacts left out at which the contact model does not hold."""
    strays: int = 0
    """Contacts left out that are off the surface."""

    @property
    def pressures(self) -> Array:
        """Pressures of the readings that count."""
        return self.pressure[self.read]

    @property
    def taxels(self) -> np.ndarray:
        """Rows of the taxels of the readings that count."""
        return self.index[self.read]

    @property
    def contacts(self) -> np.ndarray:
        """Contacts of the readings that count."""
        return self.recording.reading_contact[self.read]

    def leave_out_invalid(self, belief: Belief, points: Array, hit: Closest, learned: bool) -> None:
        """Leave out contacts at which the model does not hold, and those off the surface; points
        (m, 3), m, and hit: of all contacts."""
        recording, radius, used = self.recording, belief.indenter.radius, self.used
        if learned:  # which needs no valid model, but a single contact point
            tight = in_hollows(hit.take(used), radius)
            valid = ~tight | (tight.mean() <= MAX_INVALID)
        else:
            valid = valid_contacts(recording.force[used], hit.curvature[used], belief)
        off = unit_checks.off_surface(hit.take(used), recording.normals[used], radius)
        if off.any():
            at = points[used][off], recording.normals[used][off]
            off[off] = ~unit_checks.on_facets(belief.body, *at, radius)
        self.invalid, self.strays = int(np.sum(~valid)), int(np.sum(off))
        used[used] = valid & ~off
        of_used = used[recording.reading_contact]
        if belief.readings != RAW:  # raw readings fluctuate about their level at rest
            self.corrupt |= self.pressure < 0
        self.read &= of_used
        self.corrupt &= of_used

    def above_rest(self, belief: Belief) -> Belief:
        """Subtract the levels at rest of pressures; the belief with the threshold above them."""
        level, threshold = pressures_above_rest(
            self.pressures, self.taxels, int(self.used.sum()), belief.threshold
        )
        self.pressure = self.pressure.copy()
        self.pressure[self.read] = level
        return replace(belief, threshold=threshold)

    def leave_out_faint(self, belief: Belief, reach: float) -> None:
        """Leave out readings below the threshold, and those of taxels that are stuck for a while.

        reach: distance, m, from which a taxel does not respond to a contact.
        """
        self.read &= self.pressure > belief.threshold
        at = self.recording.points[self.contacts]
        stuck = corrupt_readings.stuck_readings(self.pressures, self.taxels, at, reach)
        self.corrupt[self.read] = stuck
        self.read &= ~self.corrupt
        row, points = np.cumsum(self.used) - 1, self.recording.points[self.used]
        spikes = corrupt_readings.spikes(
            self.pressures, self.taxels, row[self.contacts], points, belief.threshold, reach
        )
        self.corrupt[self.read] = spikes
        self.read &= ~self.corrupt
        _require_readings(self.read, self.recording, self.used)


def _pressed(
    recording: Recording,
    belief: Belief,
    index: np.ndarray,
    points: Array,
    hit: Closest,
    repeated: bool,
) -> tuple[_Selection, Belief]:
    """The contacts with a force and their readings that are not corrupt, and the belief with what
    raw readings tell of threshold and saturation; repeated: as of `gather`."""
    pressure, unit, falling, used = recording.pressure, 1.0, False, recording.force > 0
    if belief.readings == RAW and used.any() and np.isfinite(pressure).any():
        pressure, belief, unit, falling = nominal_pressure(
            recording, belief, index, hit.curvature, used
        )
    if not repeated:
        used = used & ~corrupt_readings.repeated_frames(recording)
    corrupt = corrupt_readings.corrupt_readings(pressure, index)
    read = used[recording.reading_contact] & (pressure > 0) & ~corrupt
    _require_readings(read, recording, used)
    selected = _Selection(recording, index, pressure, used, read, corrupt, unit, falling)
    if belief.readings != RAW:
        check_pressures(selected.pressures, selected.contacts, selected.taxels, points)
    return selected, belief


def _on_body(recording: Recording, belief: Belief, learned: bool) -> tuple[Belief, Array, Closest]:
    """The belief with a contact model and an unknown body offset as a contact motion, and the
    contact points (m, 3), m, and the surface points closest to them where the body then is."""
    points = recording.points
    hit = belief.body.closest(points)
    unit_checks.check_points(belief.body, points, hit.distance)
    if "body_offset" in belief.unknown:
        belief, points = registered(belief, points, recording.force > 0)
        hit = belief.body.closest(points)
    if learned:
        hit = over_patches(belief, hit, recording.force)
    return resolve_belief(belief, recording), points, hit


def gather_or_learn(recording: Recording, belief: Belief) -> tuple[Measurements, str]:
    """The measurements, for a learned response where contact "auto" finds no model that holds but
    would at STIFFER times Young's modulus; and why no model holds, "" where one does.

    Raises as `gather`.
    """
    try:
        return gather(recording, belief), ""
    except ContactError as error:
        stiffer = replace(belief.material, young=STIFFER * belief.material.young)
        if belief.contact != contact.AUTO or not holds(
            recording, replace(belief, material=stiffer)
        ):
            raise
        return gather(recording, replace(belief, contact=contact.LEARNED)), str(error)


def holds(recording: Recording, belief: Belief) -> bool:
    """Whether a contact model, that of the belief, holds in the recording's contacts."""
    try:
        resolve_belief(belief, recording)
    except ContactError:
        return False
    return True


def _headings(recording: Recording, belief: Belief) -> Array | None:
    """Rotations (m, 3, 3), world from body, of the belief, else of the recording."""
    if belief.headings is None:
        return recording.headings
    headings, shape = np.asarray(belief.headings), (len(recording.time), 3, 3)
    if headings.shape != shape:
        raise CalibrationError(
            "belief.headings must have one rotation for each contact of the recording",
            value=f"shape {headings.shape}",
            limit=f"shape {shape}",
        )
    return headings


def _require_readings(read: np.ndarray, recording: Recording, pressed: np.ndarray) -> None:
    if not np.any(pressed) and len(recording.force):
        raise CalibrationError(
            "no contact is pressed",
            value=f"{len(recording.force)} forces of at most {recording.force.max():.4g} N",
            limit="above 0 N",
            remedy="a force is positive where it presses: check its sign",
        )
    if not np.any(read):
        raise CalibrationError(
            "the recording has no readings of a pressed contact",
            value=f"{len(recording.pressure)} readings of at most "
            f"{recording.pressure.max(initial=0.0):.4g} Pa, {np.sum(pressed)} pressed contacts",
            remedy="check the threshold and the skin's wiring",
        )


def taxel_rows(taxels: np.ndarray, ids: np.ndarray) -> np.ndarray:
    """Row in `ids` of each taxel id. Raises CalibrationError for ids that are not there."""
    order = np.argsort(ids, kind="stable")
    row = np.minimum(np.searchsorted(ids[order], taxels), len(ids) - 1)
    index = order[row]
    unknown = np.unique(taxels[ids[index] != taxels])
    if len(unknown):
        raise CalibrationError(
            "the recording has taxels that the belief does not know",
            value=f"ids {', '.join(map(str, unknown[:5]))}{' ...' if len(unknown) > 5 else ''}",
            limit=f"{len(ids)} ids from {ids.min()} to {ids.max()}",
            remedy="use the skin that was recorded",
        )
    return index
