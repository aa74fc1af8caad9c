"""From a robot's log to a calibrated skin and the unknowns of the robot's kinematics.

Contacts are not given: they follow from joint angles. First the heights of the indenter over the
body tell what they can of the unknowns (heights.py); with what is left of their uncertainty they
enter the joint estimate, with which the readings tell the rest. Contacts are then computed again,
as they do not move linearly with the unknowns.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...core.arguments import check_type
from ...core.arrays import Array
from ...core.errors import CalibrationError, RecordingError, UnconvergedError, warn_left_out
from ...core.progress import Progress
from ...recording.log_contacts import (
    at_clock,
    contact_frames,
    joint_path,
    recording_of,
    typical_force,
    without_noise,
)
from ...recording.recording import Recording
from ...recording.skin_log import NOISY, SkinLog
from ...robot.contact_kinematics import AveragedPath, ContactKinematics, JointPath
from ...scene.belief import RAW, Belief
from ...scene.contact_motion import ContactMotion
from ..calibrate import Estimation
from ..calibration import Calibration
from ..data.patch_shape import fitting, over_patches
from ..learned.start import Former
from ..uncalibrated import unconverged
from .clock import first_offset, timed_by_the_fastest, with_clock
from .heights import Heights, closest_at_scale, depths
from .joint_residuals import joint_residuals
from .log_calibration import AT_REST, LogCalibration
from .mesh_error import MeshError
from .plausible import check_on_body
from .pulled import widened
from .steady import steady, taken

MAX_ROUNDS = 5
"""Largest number of times that contacts are computed anew; two or three are usual."""
LINEAR = 2e-6
"""Median displacement, m, of contacts from where the linear table put them, up to which it holds: a
tenth of the best calibrations' standard deviations."""
TIMED = 1e-3
"""Change of the offset of the clocks, s, from which forces and contacts are chosen anew: a force
that rises to its level in 0.1 s changes by a hundredth of it."""
APART = 2.5e-4
"""Median displacement, m, of the contacts from those of the recording, from which they are computed
anew, and chosen anew where the log has no forces: a tenth of a contact's radius (2.5 mm), up to
which frames are one contact (steady.ALIKE)."""
CLOCK_FITS = 2
"""Fits of the clock and the heights in turn: the delays of joints do not change after the first."""
HEIGHT_FITS = 2
"""Fits of the heights, each with depths at the contacts of the last one: depths change little."""
OFF_FITS = 4
"""Fits of the heights, each without the contacts that the last one leaves off the body."""
TOO_NOISY = f"noise at rest is more than {NOISY:g} times that of most taxels: repair or exchange it"
"""Reason of a taxel whose readings are left out."""


def calibrate_log(
    log: SkinLog, kinematics: ContactKinematics, belief: Belief, progress: Progress | None = None
) -> LogCalibration:
    """Calibrate the skin of a log, and the unknowns of the robot that its contacts follow from.

    belief: the body in its frame, the indenter's radius and the materials; its readings="raw" where
    the log has counts. Forces are the log's, else the reference force at every contact, whose
    errors the learned response estimates. The believed noise of a reading is the least: the joint
    angles have some, too, by which contacts scatter. progress: as of `calibrate`, in each round.
    Taxels that are far noisier than others are left out. An estimate that does not converge gives
    the verdict FAIL, no taxel, and what the heights tell of the robot. Raises RecordingError for a
    log without contacts or without a joint of the chain, CalibrationError where the heights do not
    converge, and otherwise as `calibrate`.
    """
    check_type(SkinLog, log, "what is calibrated")
    check_type(ContactKinematics, kinematics, "kinematics of a log")
    check_type(Belief, belief, "the belief about a log")
    path = joint_path(log, kinematics.chain.joint_names)
    if belief.readings != RAW and log.force is None:
        raise CalibrationError(
            "pressures without forces cannot be calibrated",
            value='readings="pressure", no force in the log',
            remedy='give the belief readings="raw", or a log with forces',
        )
    if belief.force_reference is None:
        belief = replace(belief, force_reference=typical_force(log))
    log, noisy = without_noise(log)
    last, rounds, failure = _last_round(log, kinematics, path, belief, progress)
    heights, x, clock = last.heights, last.x, last.clock
    kinematics, as_believed = heights.model, np.zeros(len(x))
    if clock:
        as_believed[kinematics.columns["clock_offset"]] = -clock
    before = heights.residuals(as_believed)[0]
    after, factor = heights.residuals(x)[0], float(np.exp(x[-3]))
    by_joint = joint_residuals(kinematics, heights.path, heights.time, belief.body, after, x[:-3])
    change = last.change if last.shift > APART else 0.0
    found = widened(with_clock(last.found, clock), last.recording, change)
    left_out = np.isin(found.ids, log.taxel_ids[noisy]) & ~np.isfinite(found.position_sigma)
    found = replace(found, reasons=np.where(left_out, TOO_NOISY, found.reasons))
    result = LogCalibration(
        found, last.recording, kinematics, after, before, rounds, last.unrest, factor, by_joint,
        failure, heights.off,
    )  # fmt: skip
    verdict = None if found.verdict is None else found.verdict.with_doubts(result.contradictions)
    warn_left_out("calibrated", found.reasons_left_out, len(found.ids))
    return replace(result, calibration=replace(found, verdict=verdict))


@dataclass(frozen=True, eq=False)
class _Round:
    """What one computation of the contacts gave."""

    found: Calibration
    recording: Recording
    heights: Heights
    x: Array
    """(K + 3,): what was found, with the depths and the surface that it leaves to the contacts."""
    clock: float
    """Offset of the clocks, s, by which the contacts were moved before."""
    shift: float
    """Median displacement, m, of the contacts by what was found."""
    moved: float
    """Its part, m, that the linear table does not have."""
    former: Former | None = None
    """The estimate, if another one can begin from it."""
    change: Array | float = 0.0
    """Change (K,) of the unknowns in the round."""

    @property
    def unrest(self) -> float:
        """Displacement, m, that makes another round necessary; 0 where none does."""
        return max(self.moved * (self.moved > LINEAR), self.shift * (self.shift > APART))

    @property
    def at_rest(self) -> bool:
        """Whether `moved` is small against the standard deviations of the taxels."""
        sigma = self.found.position_sigma
        known = sigma[np.isfinite(sigma)]
        return bool(len(known) and self.moved <= AT_REST * np.median(known))


def _last_round(
    log: SkinLog,
    kinematics: ContactKinematics,
    path: JointPath,
    belief: Belief,
    progress: Progress | None,
) -> tuple[_Round, int, str]:
    """The last round that was estimated, the number of rounds, and why the one after it was not.

    A later round begins from other contacts, from which the estimate may fail. What was found
    before then holds, if it displaces its contacts linearly, on the clock that they were chosen on.
    Where none does, and the estimate does not converge, the round has no taxel. Raises
    CalibrationError for other reasons why no round is estimated.
    """
    used, clock, heights, x = _started(log, kinematics, path, belief)
    rounds, moved, shift = 0, np.inf, np.inf
    last: _Round | None = None
    former: Former | None = None
    noise = belief.noise_sigma if belief.readings == RAW else None
    while rounds < MAX_ROUNDS and (moved > LINEAR or shift > APART):
        known = replace(belief, surface_sigma=heights.mesh_error.sigma, noise_sigma=noise)
        try:
            last = _estimated(used, heights, x, clock, known, progress, former)
            x, shift, moved, rounds = last.x, last.shift, last.moved, rounds + 1
            former, found, before = last.former if moved < APART else None, last.found, clock
            # contacts scatter with the noise of the joint angles, and the readings with them
            stated = belief.noise_sigma
            exceeds = stated is None or (found.fit is not None and found.fit.noise > stated)
            if noise is None and not exceeds:
                noise, moved, rounds = belief.noise_sigma, np.inf, rounds - 1
            late = _clock_error(found, log, shift)
            if late and rounds < MAX_ROUNDS:
                last, moved, s = None, np.inf, x[:-3]
                used, clock, heights, x = _started(log, kinematics, path, belief, clock + late)
                if abs(clock - before) <= abs(late) / 2:
                    x = heights.with_surface(s)
        except CalibrationError as error:
            if last is not None and last.at_rest:
                return last, max(rounds, 1), str(error)
            if not isinstance(error, UnconvergedError):
                raise
            return _unestimated(used, heights, x, clock, known, error), rounds + 1, ""
    assert last is not None
    return last, rounds, ""


def _estimated(
    log: SkinLog,
    heights: Heights,
    x: Array,
    clock: float,
    belief: Belief,
    progress: Progress | None,
    former: Former | None,
) -> _Round:
    """The round with the contacts at x (K + 3,). former: the estimate of the round before, if this
    one can begin from it."""
    kinematics, path, time, s = heights.model, heights.path, heights.time, x[:-3]
    estimation = _estimation(log, heights, x, belief, former)
    found = estimation.calibrate(progress=progress)
    values = np.array([found.unknowns[label][0] for label in kinematics.labels])
    centres, slopes = kinematics.centres(path, time, s)
    shift = kinematics.centres(path, time, values)[0] - centres
    moved = shift - slopes @ (values - s)
    apart, left = (float(np.median(np.linalg.norm(part, axis=1))) for part in (shift, moved))
    x = heights.with_surface(values)
    former, change = estimation.last, values - s
    return _Round(found, estimation.recording, heights, x, clock, apart, left, former, change)


def _unestimated(
    log: SkinLog, heights: Heights, x: Array, clock: float, belief: Belief, error: CalibrationError
) -> _Round:
    """The round whose estimate does not converge: no taxel, and the unknowns by the heights."""
    estimation = _estimation(log, heights, x, belief)
    recording, motion = estimation.recording, estimation.belief.contact_motion
    assert motion is not None
    found = unconverged(recording, estimation.belief, error)
    return _Round(found, recording, heights, np.append(motion.mean, x[-3:]), clock, 0.0, 0.0)


def _estimation(
    log: SkinLog, heights: Heights, x: Array, belief: Belief, former: Former | None = None
) -> Estimation:
    """The estimators on the contacts at x (K + 3,)."""
    kinematics, path, time, s = heights.model, heights.path, heights.time, x[:-3]
    told = heights.known
    assert told is not None
    centres, slopes = kinematics.centres(path, time, s)
    u = np.linalg.pinv(told.root) @ (s - told.mean)
    motion = ContactMotion(kinematics.labels, kinematics.sigma, slopes, told.mean, told.root, u)
    scale, hit = closest_at_scale(kinematics, belief.body, centres, s)
    off = scale * hit.point + heights.residuals(x)[0][:, None] * hit.normal
    frames, force = np.arange(len(log.time)), _forces(log, belief)
    recording = recording_of(log, frames, off, hit.normal, force, belief.readings)
    return Estimation(recording, _corrected(belief, kinematics, s, motion), former=former)


def _corrected(
    belief: Belief, kinematics: ContactKinematics, s: Array, motion: ContactMotion
) -> Belief:
    """The belief with the body's scale and the indenter's radius of s (K,), and its motion."""
    scale = float(np.exp(kinematics.value("mesh_scale", s)))
    body = belief.body
    if scale != 1.0:  # about the origin of its frame
        mesh = body.mesh.copy()
        mesh.apply_scale(scale)
        body = replace(body, mesh=mesh, exact=None, robot_mesh=None)
    radius = belief.indenter.radius + kinematics.value("indenter_radius", s)
    indenter = replace(belief.indenter, radius=radius)
    return replace(belief, body=body, indenter=indenter, contact_motion=motion)


def _clock_error(found: Calibration, log: SkinLog, shift: float) -> float:
    """Error of the clock, s, for which contacts are chosen anew; 0 where they need not be. shift:
    median displacement of the contacts, m."""
    late, sigma = found.unknowns.get("clock_offset", (0.0, 0.0))
    changed = shift > APART if log.force is None else abs(late) > TIMED
    return late if changed and abs(late) > sigma else 0.0


def _started(
    log: SkinLog, kinematics: ContactKinematics, path: JointPath, belief: Belief, clock: float = 0.0
) -> tuple[SkinLog, float, Heights, Array]:
    """The log of the steady contacts, the first offset of the clocks, s, their heights on that
    clock, and x (K + 3,) that meets these. clock: an offset, s, to begin with.

    Delays of the joints, which the heights tell, and the clock displace contacts alike: the offset
    of the clocks is sought again at the delays. Forces are those at the times of the contacts.
    """
    answers, timed = contact_frames(replace(log, force=None)), kinematics
    where = belief.body, belief.indenter.radius
    check_on_body(kinematics, path, log.time[answers] - clock, *where, named=True)
    s = np.zeros(len(kinematics.labels))
    for _ in range(CLOCK_FITS):
        stamps, readings = log.time[answers], log.readings[answers]
        further = first_offset(timed, path, stamps - clock, readings, s)
        if s.any() and not further:
            break
        clock += further
        on_clock = at_clock(log, clock)
        contacts = contact_frames(on_clock)
        frames = contacts[path.covers(log.time[contacts] - clock)]
        if not len(frames):
            raise RecordingError(
                "no contact lies in a time of which all joint angles are known",
                value=f"joint angles from {path.time[0]:.3f} to {path.time[-1]:.3f} s",
                remedy="check the joints' streams for gaps (meshskin log), and the clocks",
            )
        check_on_body(kinematics, path, log.time[frames] - clock, *where, named=False)
        centres = timed.centres(path, log.time[frames] - clock, s)[0]
        scale, hit = closest_at_scale(timed, belief.body, centres, s)
        reference = np.array([belief.force_reference], dtype=float)
        depth = float(depths(belief, np.zeros((1, 2)), reference)[0])
        used, means = steady(
            on_clock, path, frames, centres, scale * hit.distance, depth, belief.indenter.radius
        )
        timed = timed_by_the_fastest(kinematics, means, used.time - clock, belief.body)
        begin = on_clock.time[[touch.start for touch in on_clock.contacts]]
        touch = np.searchsorted(begin, used.time, side="right")
        used, heights, x = _heights(timed, used, means, clock, belief, touch)
        s = x[:-3]
    return used, clock, heights, x


def _forces(log: SkinLog, belief: Belief) -> Array:
    """Forces (n,), N, of the frames of a log: its own, or the reference."""
    return np.full(len(log.time), belief.force_reference) if log.force is None else log.force


def _heights(
    kinematics: ContactKinematics,
    log: SkinLog,
    path: AveragedPath,
    clock: float,
    belief: Belief,
    touch: np.ndarray,
) -> tuple[SkinLog, Heights, Array]:
    """The contacts of a log that are on the body, their heights, and x (K + 3,) that meets these;
    path: theirs; clock: its offset, s; touch (m,): as of Heights."""
    x, total = np.zeros(len(kinematics.labels) + 3), len(log.time)
    for fits in range(1, OFF_FITS + 1):
        time, force = log.time - clock, _forces(log, belief)
        for _ in range(HEIGHT_FITS):
            centres, _ = kinematics.centres(path, time, x[:-3])
            hit = over_patches(belief, belief.body.closest(centres), force)
            hit = fitting(hit, belief.indenter.radius)  # before the fit, contacts are anywhere
            depth = depths(belief, hit.curvature, force)
            error = MeshError.of(belief.body, hit, belief.surface_sigma)
            left_out = total - len(time)
            heights = Heights(
                kinematics, path, time, belief.body, belief.indenter.radius, depth, error, touch,
                force, left_out,
            )  # fmt: skip
            x = heights.fit(x)
        kept = heights.on_body(x)
        if kept.all() or fits == OFF_FITS:
            break
        (log, path), touch = taken(log, path, kept), touch[kept]
    return log, replace(heights, known=heights.linearized(x)), x
