"""From a robot's log to a calibrated skin and the unknowns of the robot's kinematics.

Contacts are not given: they follow from joint angles. First the heights of the indenter over the
body tell what they can of the unknowns (heights.py); with what is left of their uncertainty they
enter the joint estimate, with which the readings tell the rest. Contacts are then computed again,
as they do not move linearly with the unknowns.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from ...core.arguments import check_type
from ...core.arrays import Array
from ...core.errors import CalibrationError, RecordingError, warn_left_out
from ...core.notebook import Card
from ...core.progress import Progress
from ...core.se3 import inverse
from ...core.value import Value
from ...geometry.body import Body
from ...recording.log_contacts import contact_frames, joint_path, recording_of
from ...recording.recording import Recording
from ...recording.skin_log import SkinLog
from ...robot.contact_kinematics import ContactKinematics, JointPath
from ...scene.belief import RAW, Belief
from ...scene.contact_motion import ContactMotion
from ..calibrate import calibrate
from ..calibration import Calibration
from ..data.patch_shape import fitting, over_patches
from .clock import first_offset
from .heights import Heights, depths, surface_heights, timed_by_the_fastest
from .joint_residuals import JointResidual, joint_residuals
from .mesh_error import MeshError
from .plausible import check_on_body
from .steady import steady

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

    from ...robot.robot import Robot

MAX_ROUNDS = 5
"""Largest number of times that contacts are computed anew; two or three are usual."""
LINEAR = 2e-6
"""Median displacement, m, of contacts from where the linear table put them, up to which it holds: a
tenth of the best calibrations' standard deviations."""
NOMINAL_FORCE = 1.0
"""Force, N, where neither log nor belief has one: the learned response scales with it."""
SURPRISE = 3.5
"""Standard deviations before any measurement beyond which an unknown contradicts what was believed:
one of 20 sound ones is with a probability of 1 %."""
MIN_CHANCE = 0.01
"""Probability of all unknowns together, under what was believed of them, from which they contradict
it: about that of one beyond SURPRISE."""
MAX_DEPTH_FACTOR = 2.2
"""Depth of the indentations, relative to that under the believed material and force, or its
inverse, from which the indenter's height is in doubt: beyond 3^(2/3) = 2.08, the depth under an E*
or a force that is wrong by a factor of 3, from which the verdict doubts E*."""
CLOCK_FITS = 2
"""Fits of the clock and the heights in turn: the delays of joints do not change after the first."""
HEIGHT_FITS = 2
"""Fits of the heights, each with depths at the contacts of the last one: depths change little."""


@dataclass(frozen=True, eq=False)
class LogCalibration(Value, Card):
    """A calibrated skin, and what the log told of the robot."""

    calibration: Calibration
    """The skin; the robot's unknowns are among `calibration.unknowns`."""
    recording: Recording
    """The contacts as they were last computed, with the readings."""
    kinematics: ContactKinematics
    """What was believed of the robot, with the declared unknowns."""
    heights: Array
    """Heights (m,), m, of the indenter over those of a contact, at the estimate."""
    heights_before: Array
    """Heights (m,), m, over those of a contact, with all unknowns zero."""
    rounds: int
    """Number of times that the contacts were computed."""
    depth_factor: float = 1.0
    """Depth of the indentations, relative to that under the believed material and force."""
    joint_residuals: tuple[JointResidual, ...] = ()
    """What an error of each joint that varies with its angle would explain of `heights`."""

    def facts(self) -> dict[str, str]:
        """The facts of the calibration, and what the log told of the robot, for a notebook."""
        before, after = self.heights_mm
        heights = f"{before:.3g} mm off the body before, {after:.2g} mm after the estimate"
        facts = {**self.calibration.facts(), "contacts": heights}
        return facts | ({"surprises": "; ".join(self.surprises)} if self.surprises else {})

    @property
    def heights_mm(self) -> tuple[float, float]:
        """Medians of the heights without signs, mm, before the estimate and after it."""
        before, after = np.abs(self.heights_before), np.abs(self.heights)
        return 1e3 * float(np.median(before)), 1e3 * float(np.median(after))

    def plot(self, ax: Axes | None = None) -> Figure:
        """Draw the calibrated skin: `Calibration.plot`."""
        return self.calibration.plot(ax)

    @property
    def unknowns(self) -> Mapping[str, tuple[float, float]]:
        """Value and standard deviation of each of the robot's unknowns, by
        `ContactKinematics.labels`, in SI units and rad."""
        found = self.calibration.unknowns
        return {label: found[label] for label in self.kinematics.labels}

    @property
    def joint_offsets(self) -> Mapping[str, tuple[float, float]]:
        """What to add to the reading of each joint, by its name, with the standard deviation, rad
        (m where it slides)."""
        names = self.kinematics.chain.joint_names
        labels = {name: f"joint_offset {name}" for name in names}
        return {n: self.unknowns[label] for n, label in labels.items() if label in self.unknowns}

    @property
    def mount(self) -> Array:
        """Estimated T_link_body (4, 4)."""
        return self.kinematics.mount_at(self._values)

    @property
    def _values(self) -> Array:
        return np.array([value for value, _ in self.unknowns.values()])

    def corrected(self, robot: Robot, link: str) -> Robot:
        """The robot with its joints' offsets, and with the shapes of the `link` that carries the
        body at the estimated mount and size. Raises UnknownNameError, ArmError."""
        offsets = {name: value for name, (value, _) in self.joint_offsets.items()}
        robot = robot.with_joint_offsets(offsets)
        if not {"mount", "mesh_scale"} & self.kinematics.columns.keys():
            return robot
        scale = float(np.exp(self.kinematics.value("mesh_scale", self._values)))
        pose = self.mount @ inverse(self.kinematics.mount)
        # the body is scaled about the origin of its own frame, the shapes about that of the link's
        pose[:3, 3] = self.mount[:3, 3] - scale * pose[:3, :3] @ self.kinematics.mount[:3, 3]
        return robot.with_moved_shapes(link, pose, scale)

    def metrics(self) -> dict[str, Any]:
        """Heights of the contacts and residuals by joint as JSON values."""
        before, after = self.heights_mm
        offsets = self.joint_offsets
        joints = {
            found.joint: {
                "offset_rad": list(offsets[found.joint]) if found.joint in offsets else None,
                "error_rad": found.error,
                "explained": found.explained,
                "chance": found.chance,
            }
            for found in self.joint_residuals
        }
        return {"height_before_mm": before, "height_mm": after, "joints": joints}

    def _chance(self, sigma: Mapping[str, float]) -> float:
        """Probability that unknowns of the standard deviations believed are farther from zero."""
        from scipy.special import gammaincc

        square = sum((value / sigma[label]) ** 2 for label, (value, _) in self.unknowns.items())
        return float(gammaincc(len(sigma) / 2, square / 2)) if sigma else 1.0

    @property
    def surprises(self) -> tuple[str, ...]:
        """Unknowns that are farther from zero than was believed of them, in words: a wrong standard
        deviation, or an error that is not declared and that they stand in for."""
        sigma = dict(zip(self.kinematics.labels, self.kinematics.sigma, strict=True))
        found = [
            f"{label} is {value:.3g}, {abs(value) / sigma[label]:.2g} times its believed standard "
            f"deviation of {sigma[label]:.3g}"
            for label, (value, _) in self.unknowns.items()
            if abs(value) > SURPRISE * sigma[label]
        ]
        if not found and (chance := self._chance(sigma)) < MIN_CHANCE:
            far = sorted(
                self.unknowns, key=lambda label: -abs(self.unknowns[label][0]) / sigma[label]
            )
            found.append(
                "the robot's unknowns together are farther from what was believed than their "
                f"standard deviations allow, p = {chance:.1g} (limit {MIN_CHANCE:g}), most of all "
                f"{' and '.join(far[:2])}: joints stamped at different times, or an error that is "
                "not declared, would look like this"
            )
        if not 1 / MAX_DEPTH_FACTOR < self.depth_factor < MAX_DEPTH_FACTOR:
            found.append(
                f"indentations are {self.depth_factor:.2g} times as deep as believed (limit: a "
                f"factor of {MAX_DEPTH_FACTOR:g}): an error of the indenter's height or radius "
                "would look like this; check both, the force and Young's modulus"
            )
        return tuple(found)


def calibrate_log(
    log: SkinLog,
    kinematics: ContactKinematics,
    belief: Belief,
    progress: Progress | None = None,
) -> LogCalibration:
    """Calibrate the skin of a log, and the unknowns of the robot that its contacts follow from.

    belief: the body in its frame, the indenter's radius and the materials; its readings="raw" where
    the log has counts. Forces are the log's, else the reference force at every contact, whose
    errors the learned response estimates. progress: as of `calibrate`, in each round.
    Raises UnknownNameError for a joint that the log lacks,
    RecordingError for a log without contacts, CalibrationError where the heights do not converge,
    and as `calibrate`.
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
    reference = belief.force_reference
    if reference is None:
        pressed = [] if log.force is None else log.force[contact_frames(log)]
        reference = float(np.median(pressed)) if len(pressed) else NOMINAL_FORCE
    belief = replace(belief, force_reference=reference)
    log, clock, heights, x = _started(log, kinematics, path, belief, reference)
    belief = replace(belief, surface_sigma=heights.mesh_error.sigma)
    kinematics, time, force = heights.model, heights.time, _forces(log, reference)
    frames = np.arange(len(log.time))
    as_believed = np.zeros(len(x))
    if clock:
        as_believed[kinematics.columns["clock_offset"]] = -clock
    before = heights.residuals(as_believed)[0]
    rounds, moved = 0, np.full((1, 3), np.inf)
    while rounds < MAX_ROUNDS and float(np.median(np.linalg.norm(moved, axis=1))) > LINEAR:
        rounds += 1
        told, s = heights.linearized(x), x[:-1]
        centres, slopes = kinematics.centres(path, time, s)
        u = np.linalg.pinv(told.root) @ (s - told.mean)
        motion = ContactMotion(kinematics.labels, kinematics.sigma, slopes, told.mean, told.root, u)
        _, points, normals = surface_heights(kinematics, belief.body, centres, s)
        off = points + told.residuals[:, None] * normals
        recording = recording_of(log, frames, off, normals, force, belief.readings)
        corrected = _corrected(belief, kinematics, s, motion)
        found = calibrate(recording, corrected, progress=progress)
        values = np.array([found.unknowns[label][0] for label in kinematics.labels])
        moved = kinematics.centres(path, time, values)[0] - centres - slopes @ (values - s)
        x = heights.with_depth(values)
    after, factor = heights.residuals(x)[0], float(np.exp(x[-1]))
    by_joint = joint_residuals(kinematics, path, time, belief.body, after, x[:-1])
    found = _with_clock(found, clock)
    result = LogCalibration(found, recording, kinematics, after, before, rounds, factor, by_joint)
    verdict = None if found.verdict is None else found.verdict.with_doubts(result.surprises)
    warn_left_out("calibrated", found.reasons_left_out, len(found.ids))
    return replace(result, calibration=replace(found, verdict=verdict))


def _with_clock(found: Calibration, clock: float) -> Calibration:
    """The calibration with the offset of the clocks, s, that its contacts were moved by before."""
    if not clock:
        return found
    value, sigma = found.unknowns["clock_offset"]
    return replace(found, unknowns={**found.unknowns, "clock_offset": (value + clock, sigma)})


def _started(
    log: SkinLog, kinematics: ContactKinematics, path: JointPath, belief: Belief, reference: float
) -> tuple[SkinLog, float, Heights, Array]:
    """The log of the steady contacts, the first offset of the clocks, s, their heights on that
    clock, and x (K + 1,) that meets these. reference: force, N, where the log has none.

    Delays of the joints, which the heights tell, and the clock displace contacts alike: the offset
    of the clocks is sought again at the delays.
    """
    contacts, clock, timed = contact_frames(log), 0.0, kinematics
    where = belief.body, belief.indenter.radius
    check_on_body(kinematics, path, log.time[contacts], *where, named=True)
    s = np.zeros(len(kinematics.labels))
    for _ in range(CLOCK_FITS):
        stamps, readings = log.time[contacts], log.readings[contacts]
        further = first_offset(timed, path, stamps - clock, readings, s)
        if s.any() and not further:
            break
        clock += further
        frames = contacts[path.covers(stamps - clock)]
        if not len(frames):
            raise RecordingError(
                "no contact lies in a time of which all joint angles are known",
                value=f"joint angles from {path.time[0]:.3f} to {path.time[-1]:.3f} s",
                remedy="check the joints' streams for gaps (meshskin log), and the clocks",
            )
        check_on_body(kinematics, path, log.time[frames] - clock, *where, named=False)
        centres = timed.centres(path, log.time[frames] - clock, s)[0]
        above = surface_heights(timed, belief.body, centres, s)[0]
        depth = float(depths(belief, np.zeros((1, 2)), np.array([reference]))[0])
        used = steady(log, frames, centres, above, depth, belief.indenter.radius)
        time, force = used.time - clock, _forces(used, reference)
        timed = timed_by_the_fastest(kinematics, path, time, belief.body)
        heights, x = _heights(timed, path, time, belief, force)
        s = x[:-1]
    return used, clock, heights, x


def _forces(log: SkinLog, reference: float) -> Array:
    """Forces (n,), N, of the frames of a log: its own, or the reference."""
    return np.full(len(log.time), reference) if log.force is None else log.force


def _heights(
    kinematics: ContactKinematics,
    path: JointPath,
    time: Array,
    belief: Belief,
    force: Array,
) -> tuple[Heights, Array]:
    """The heights of the contacts, and x (K + 1,) that meets them."""
    x = np.zeros(len(kinematics.labels) + 1)
    for _ in range(HEIGHT_FITS):
        centres, _ = kinematics.centres(path, time, x[:-1])
        hit = over_patches(belief, belief.body.closest(centres), force)
        hit = fitting(hit, belief.indenter.radius)  # before the fit, contacts are anywhere
        depth = depths(belief, hit.curvature, force)
        error = MeshError.of(belief.body, hit, belief.surface_sigma)
        heights = Heights(kinematics, path, time, belief.body, belief.indenter.radius, depth, error)
        x = heights.fit(x)
    return heights, x


def _corrected(
    belief: Belief, kinematics: ContactKinematics, s: Array, motion: ContactMotion
) -> Belief:
    """The belief with the body's scale and the indenter's radius of s (K,), and its motion."""
    scale = float(np.exp(kinematics.value("mesh_scale", s)))
    radius = belief.indenter.radius + kinematics.value("indenter_radius", s)
    return replace(
        belief,
        body=belief.body if scale == 1.0 else _scaled(belief.body, scale),
        indenter=replace(belief.indenter, radius=radius),
        contact_motion=motion,
    )


def _scaled(body: Body, scale: float) -> Body:
    """The body with its mesh scaled about the origin of its frame."""
    mesh = body.mesh.copy()
    mesh.apply_scale(scale)
    return replace(body, mesh=mesh, exact=None, robot_mesh=None)
