"""The verdict on a calibration: a level and its reasons; the checks of a log's columns. judge.py
checks the calibration.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ...contact.disc import disc_mean
from ...core.arrays import Array, means_by_group
from ...recording.recording import JOINT_ANGLES, UNCOMPARED, Recording
from ...scene.belief import RAW
from ..data import delay
from ..data.global_parameters import PRIOR_SIGMAS
from ..data.measurements import Measurements
from ..data.sensor_range import MAX_LOST, unanswered_contacts
from ..learned.contact_correlations import KINDS
from ..result import LearnedResponse, ids_in_words

if TYPE_CHECKING:
    from ..calibration import Calibration

PASS, DOUBT, FAIL = LEVELS = ("PASS", "DOUBT", "FAIL")
"""Levels of a verdict: nothing was found; check before use; do not use."""
Finding = tuple[str, str]  # a level and a sentence
MAX_SCALE = 1.6
"""Factor between the readings and the pressures of the contact model, as a learned response has it,
from which it is a doubt. A layer of the thickness of the patch changes the peak by 1.3."""
MAX_NEGATIVE = 1e-3
"""Fraction of negative or corrupt readings, or of contacts without a positive force that have
readings, up to which they are single accidents, which are left out."""
MAX_LAG = 0.1
"""Typical difference of the times of readings and contacts, in frames, that is a doubt."""
MAX_UNANSWERED = 0.02
"""Fraction of contacts without a reading, next to contacts with one, from which it is a doubt."""
ONE_WAY = 0.5
"""Mean displacement of a taxel's contacts from frame to frame, relative to the mean of its size,
from which the passes over it have one direction: equal passes both ways have 0, 14 in directions by
chance 0.24 +- 0.12."""
MIN_ANSWERED = 0.9
"""Part of the contacts up to which there are readings, below which a clock was set back where
readings are missing, too: the later ones then belong to earlier contacts."""
MIN_CONTACTS = 10
"""Contacts, at least, to judge their columns."""
LAW = 1 / 3
"""Exponent of the radius of a Hertz patch in the force."""
OFFSET_SIGMAS = 6.0
"""Standard deviations, of both indications of an offset of the force, from which it is named."""
MIN_OFFSET = 0.05
"""Least offset that is named, relative to the force."""
MAX_OFFSET = 0.5
"""Largest offset, as `MIN_OFFSET`, that is named: with forces wrong by more than half, the skin
rather has another response."""
RISE_SIGMAS, MIN_RISE = 4.0, 0.01
"""Rise of a learned profile that is named, in standard deviations, and its least excess over these,
relative to the peak."""
MIN_READINGS = 10
"""Readings of the median taxel below which a learned response is a doubt: a taxel has four unknowns
and each contact three. In a Hertz world 0.58 to 0.76 of the error was stated with 4 to 8 readings,
0.94 with 10."""
MAX_ALIKE = 1.5
"""Factor of the variances, by errors that neighbouring contacts share, from which it is a doubt. On
raw meshes the estimated factor was 0.7 to 1.9 times the right one."""
CAUSES = (
    "the contact points are those of a surface whose facets or bumps the believed one lacks",
    "stiffness or thickness of the skin varies over the body",
    "patches are not round, or another response than the learned one",
)
"""Possible cause of shared errors, for each of contact_correlations.KINDS."""
AGREEMENT = 0.1
"""Largest difference of the two signs, relative to their sum: 0.04 with forces 0.3 to 1 N wrong of
3 N on a half-space. On foam, whose exponents are others, the difference is 0.27 and more, and the
offset that these would tell is wrong."""


@dataclass(frozen=True)
class Verdict:
    """Whether a calibration can be relied on."""

    level: str
    """"PASS", "DOUBT" (check the reasons before use) or "FAIL" (do not use)."""
    reasons: tuple[str, ...] = ()
    """What was found, one sentence each with value, limit and next step; the gravest first."""
    untested: tuple[str, ...] = ()
    """Errors that the recording cannot show, in words: the verdict holds if there is none."""

    def with_doubts(self, reasons: tuple[str, ...]) -> Verdict:
        """This verdict with further reasons for doubt."""
        level = DOUBT if reasons and self.level == PASS else self.level
        return replace(self, level=level, reasons=(*self.reasons, *reasons))

    def __str__(self) -> str:
        marks = ("- ", self.reasons), ("not tested: ", self.untested)
        notes = [f"  {mark}{words}" for mark, listed in marks for words in listed]
        return "\n".join([f"verdict: {self.level}", *notes])


def level_of(value: float, limits: tuple[float, float]) -> str:
    """The level of a value by the limits from which it is a doubt, and a failure."""
    return FAIL if value > limits[1] else DOUBT if value > limits[0] else PASS


def doubt(words: str) -> Finding:
    """A reason for doubt."""
    return DOUBT, words


def forces(recording: Recording, calibration: Calibration) -> Iterator[Finding]:
    """Findings on the column of forces."""
    force = recording.force
    if len(force) < MIN_CONTACTS:
        return
    fits = calibration.fit is not None and calibration.fit.good is True
    applied = "presses" in (recording.metadata.get("provenance") or {})  # by ms.press: known
    estimated = not recording.force_measured and calibration.response is not None
    if np.ptp(force) == 0 and not (fits and (applied or estimated)):
        words = (
            f"the force is constant, {force[0]:.3g} N in all {len(force)} contacts: record the "
            "measured force"
        )
        if not estimated:  # a learned response has the scale of the forces already
            words += ', or estimate unknown=("modulus", "force_scale")'
        yield DOUBT, words
    wrong = np.zeros(len(force), dtype=bool)
    wrong[np.unique(recording.reading_contact)] = True
    wrong &= ~(force > 0)
    if wrong.sum() > MAX_NEGATIVE * len(force):
        yield doubt(
            f"the force is not positive in {wrong.sum()} of {len(force)} contacts that have "
            f"readings (limit {MAX_NEGATIVE:.1%}); they were left out: check its sign and offset"
        )


def force_offset(data: Measurements, calibration: Calibration) -> Iterator[Finding]:
    """An offset of the forces, by two indications in the learned response.

    Where F + b is recorded for a force F, the radius of the patch and the total pressure of a
    contact grow with the exponents LAW (1 + b / F) and 1 + b / F of the recorded force. A nonlinear
    sensor changes the total only, a layer the radius only; scatter of the forces reduces both by
    its share of their variance. Raw readings do not show an offset: electronics that compress them
    make the total grow more slowly, as foams do, whose patches grow more slowly.
    """
    if data.belief.readings == RAW:
        return
    radius, total = (calibration.unknowns.get(f"exponents of the {k}") for k in ("radius", "peak"))
    if radius is None or total is None:
        return
    signs = np.array([radius[0] / LAW, total[0]])
    sigma = np.array([radius[1] / LAW, total[1]])
    force, part = float(np.median(data.force)), float(signs.mean())
    scatter = calibration.unknowns["force_scatter"][0] ** 2
    # of forces next to each other: a drift of theirs is estimated
    scatter /= max(float(np.mean(np.diff(np.log(data.force)) ** 2)) / 2, 1e-12)
    small = abs(part) < MIN_OFFSET + 2 * scatter or (abs(signs) < OFFSET_SIGMAS * sigma).any()
    if small or abs(part) > MAX_OFFSET or abs(np.diff(signs)[0]) > AGREEMENT * abs(signs).sum():
        return
    offset = force * part / (1 + part)
    yield doubt(
        f"the forces seem to be {abs(offset):.2g} N too {'large' if offset > 0 else 'small'} at "
        f"{force:.3g} N: patches and pressures grow with exponents of the force that are "
        f"{1 + signs[0]:.3g} and {1 + signs[1]:.3g} times those of the contact model (limit "
        f"{1 + MIN_OFFSET:g}); the learned response allows for it; check the force sensor's zero, "
        'or declare it unknown=("modulus", "force_offset")'
    )


def alike(calibration: Calibration) -> Iterator[Finding]:
    """Errors that neighbouring contacts share, where much of the variances is due to them."""
    response = calibration.response
    if response is None or response.alike_contacts < MAX_ALIKE:
        return
    largest = int(np.argmax(response.alike_parts))
    yield doubt(
        f"errors of {KINDS[largest]} are alike in neighbouring contacts: {CAUSES[largest]}; the "
        f"variances of the positions are widened {response.alike_contacts:.2g} times (limit "
        f"{MAX_ALIKE:g}), which can be too little"
    )


def few_readings(calibration: Calibration) -> Iterator[Finding]:
    """Few readings of each taxel beside the unknowns of a learned response."""
    found = np.isfinite(calibration.positions).all(axis=1)
    if calibration.response is None or not found.any():
        return
    median = float(np.median(calibration.readings[found]))
    if median >= MIN_READINGS:
        return
    raw = calibration.belief is not None and calibration.belief.readings == RAW
    words = (
        f"the learned response rests on {median:g} readings per taxel, {MIN_READINGS} needed: with "
        "so few its standard deviations can be too small; record more contacts"
    ) + ", or believe a contact model" * (not raw)
    yield DOUBT, words


def scale(data: Measurements, calibration: Calibration) -> Iterator[Finding]:
    """The scale of pressures that a learned response corrects: the largest reading of the profile
    against that of the nominal contact model."""
    for response in () if data.belief.readings == RAW else _responses(calibration):
        top = int(np.argmax(response.profile))
        reading = np.interp(response.profile[top], response.level, response.reading)
        believed = data.nominal_peak * disc_mean(0.0, data.disc / float(np.median(data.radii)))
        sigma = response.profile_sigma[top] / response.profile[top]
        value = np.log(reading / believed)
        if not abs(value) < max(np.log(MAX_SCALE), PRIOR_SIGMAS * sigma):
            yield doubt(
                f"the pressures{_of(response)} are {np.exp(value):.2g} times those of the contact "
                f"model (limit: a factor of {MAX_SCALE:g}): the learned response allows for it; "
                "check the scale of pressures and forces, and the layer's thickness"
            )


def _responses(calibration: Calibration) -> tuple[LearnedResponse, ...]:
    """The learned responses of all groups of taxels."""
    return () if calibration.response is None else calibration.response.each


def _of(response: LearnedResponse) -> str:
    """Whose response it is, where groups of taxels have their own."""
    return f" of taxels {ids_in_words(response.taxels)}" if len(response.taxels) else ""


def profile(data: Measurements, calibration: Calibration) -> Iterator[Finding]:
    """A learned profile that rises with the distance from the contact point, which no contact has.

    The profile below the threshold is not judged: nothing is read there.
    """
    for response in _responses(calibration):
        value = np.maximum(response.profile, response.unit * data.threshold)
        sigma = response.profile_sigma
        lowest = np.array([int(np.argmin(value[: k + 1])) for k in range(len(value))])
        rise = value - value[lowest] - RISE_SIGMAS * np.hypot(sigma, sigma[lowest])
        k = int(np.argmax(rise))
        if not rise[k] < MIN_RISE * value.max():
            risen = value[k] - value[lowest[k]]
            near, far = 1e3 * response.distance[[lowest[k], k]]
            yield doubt(
                f"the learned profile{_of(response)} rises by {risen / value.max():.2g} of its "
                f"peak from {near:.2g} to {far:.2g} mm from the contact point (limit {MIN_RISE:g} "
                f"beyond {RISE_SIGMAS:g} standard deviations): patches that are not round, two "
                "contacts, or crosstalk; see its figure"
            )


def pressures(recording: Recording, data: Measurements) -> Iterator[Finding]:
    """Findings on the column of readings."""
    count = max(len(recording.pressure), 1)
    below = (recording.pressure < 0) & (data.belief.readings != RAW)
    negative = int(np.sum(below))
    if negative > MAX_NEGATIVE * count:
        yield doubt(
            f"the pressure is negative in {negative} of {count} readings (limit "
            f"{MAX_NEGATIVE:.1%}); they were left out: remove the offsets of the sensors"
        )
    pressed = np.isin(recording.reading_contact, data.recorded)  # the corrupt ones are of these
    corrupt = len(data.corrupt) - int(np.sum(below & pressed))
    if corrupt > MAX_NEGATIVE * count:
        yield doubt(
            f"{corrupt} of {count} readings are corrupt (limit {MAX_NEGATIVE:.1%}); they were left "
            "out: check the sensor's connection, and whether anything else touches the skin"
        )
    if len(data.pressure) >= MIN_CONTACTS and np.ptp(data.pressure) <= 1e-9 * data.pressure[0]:
        words = (
            f"all pressures are equal, {data.pressure[0]:.4g} Pa in {len(data.pressure)} readings: "
            "record pressures, not contact flags; look for saturation"
        )
        yield FAIL, words
    if data.lost:
        answered = (data.contact.max() + 1) / len(data.points)
        level, cause = DOUBT, ""
        if answered < MIN_ANSWERED:
            level = FAIL
            cause = f"; and, as contacts after {answered:.0%} of the log have none, for a clock of "
            cause += "the readings that was set back"
        words = (
            f"{data.lost:.0%} of the readings are missing where taxels read strongly all around "
            f"(limit {MAX_LOST:.0%}): no silence was taken for a reading below the threshold; look "
            "for readings that were lost on the way, and for contact points that are far off"
        )
        yield level, words + cause
    beside, unanswered = unanswered_contacts(data)
    if unanswered.sum() > MAX_UNANSWERED * beside.sum():
        yield doubt(
            f"no taxel answers {unanswered.sum()} of {beside.sum()} contacts that lie beside "
            f"strongly answered ones (limit {MAX_UNANSWERED:.0%}): look for frames without contact "
            "that have a force, and for wrong contact points"
        )


def clocks(recording: Recording, data: Measurements, calibration: Calibration) -> Iterator[Finding]:
    """Clocks of skin and contacts that were not compared, where all passes over the taxels have one
    direction: a delay then displaces all taxels alike, and no reading shows it."""
    if recording.metadata.get("clock") != UNCOMPARED or not len(data.pressure):
        return
    moved, rows = delay.displacements(data, 1)
    owner, weight = data.taxel[rows], data.pressure[rows] ** 2
    mean = np.linalg.norm(means_by_group(moved, owner, len(data.ids), weight), axis=1)
    size = means_by_group(np.linalg.norm(moved, axis=1), owner, len(data.ids), weight)
    known = size > 0
    if not known.any() or np.median(mean[known] / size[known]) < ONE_WAY:
        return
    sigma = calibration.position_sigma
    typical = float(np.median(mean[known]))
    stated = float(np.median(sigma[np.isfinite(sigma)])) if np.isfinite(sigma).any() else np.inf
    if typical < stated:
        return
    yield doubt(
        "the clock of the skin was not compared with that of the contacts, and these pass the "
        f"taxels in one direction: readings that are 1 frame late displace taxels by "
        f"{1e3 * typical:.2g} mm, which is not in the standard deviations of "
        f"{1e3 * stated:.2g} mm (limit); stroke both ways, press and retract along one path at "
        "five places, or give delay_ms in the map"
    )


def joint_angles(recording: Recording, data: Measurements) -> Iterator[Finding]:
    """Contacts from joint angles, where the belief does not include errors of the joints."""
    if recording.metadata.get("source") != JOINT_ANGLES or data.belief.contact_motion is not None:
        return
    yield doubt(
        "the contact points follow from joint angles, whose errors displace all of them and are "
        "not in the standard deviations: calibrate the log itself (calibrate LOG --map)"
    )


def times(recording: Recording) -> Iterator[Finding]:
    """Findings on the times of the readings."""
    lag: Array = recording.time_lag
    typical = float(np.median(np.abs(lag))) if len(lag) else 0.0
    if typical <= MAX_LAG * recording.frame:
        return
    yield doubt(
        f"the times of the readings are {1e3 * typical:.3g} ms off those of their contacts, in "
        f"frames of {1e3 * recording.frame:.3g} ms (limit {MAX_LAG:g} frames); they were matched "
        "to the nearest: synchronize the clocks"
    )
