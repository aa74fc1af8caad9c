"""Options of `meshskin calibrate` for a robot's own log: the map of its streams, and the indenter
that the robot touched, where contacts follow from joint angles.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from ..core.arguments import check_name
from ..core.errors import ConfigError
from . import body_options
from .belief_options import belief_of
from .log import add_scan, summary
from .options import option, real, refuse

if TYPE_CHECKING:
    from ..core.progress import Progress
    from ..estimation.calibration import Calibration
    from ..estimation.kinematics.log_calibration import LogCalibration
    from ..recording.recording import Recording
    from ..recording.skin_log import SkinLog
    from ..robot.robot import Robot
    from ..scene.belief import Belief

JOINT_OPTIONS = ("carrier", "robot_unknown")
"""Options that only joint angles need."""
NAMES = ("scan", "indenter_mm", *JOINT_OPTIONS)
"""Options that mean nothing without --map."""
CORRECTED = "corrected.urdf"
"""File of the robot with what was estimated of it."""


def add(parser: argparse.ArgumentParser) -> None:
    """Add the options."""
    log = parser.add_argument_group(
        "a robot's log, as RECORDING: a bag, MCAP file, dumper folder, CSV or Parquet"
    )
    map_ = "which stream of the log is what (`meshskin log FILE --write-map MAP`)"
    option(log, "--map MAP", map_, Path)
    add_scan(log)
    option(
        log, "--indenter-mm X Y Z", "centre of the indenter; contacts then follow from the joint "
        "angles of the robot of --urdf and --link", real(), nargs=3,
    )  # fmt: skip
    carrier = "link in whose frame the indenter is at rest (default: the root of the URDF)"
    option(log, "--carrier LINK", carrier)
    option(
        log, "--robot-unknown NAME", "what is estimated of the robot: joint_offset, joint_delay, "
        "indenter_position, clock_offset (default: these four), mount, indenter_radius, mesh_scale",
        nargs="*",
    )  # fmt: skip


@dataclass(frozen=True)
class FromLog:
    """What a robot's log gives."""

    recording: Recording
    belief: Belief
    lines: list[str]
    """What the log shows, for the summary."""
    log: SkinLog | None = None
    """The log on one clock, of --map."""
    joints: LogCalibration | None = None
    """The calibration, where contacts follow from joint angles."""
    robot: Robot | None = None
    """The robot with what was estimated of it, likewise."""

    @property
    def found(self) -> Calibration | None:
        """The calibration of the taxels, where contacts follow from joint angles."""
        return None if self.joints is None else self.joints.calibration


def from_log(options: argparse.Namespace, progress: Progress | None) -> FromLog:
    """The log of --map on one clock, with its contacts; where these follow from joint angles, they
    are calibrated with the taxels. progress: as of `calibrate`. Raises RecordingError,
    ConfigError, CalibrationError.
    """
    from ..recording.from_log import recording_from_log
    from ..recording.log_map import LogMap
    from ..recording.readers import read_log
    from ..recording.resample import log_frames
    from ..robot.robot import Robot

    _check(options)
    log_map = LogMap.load(options.map)
    log = read_log(options.recording, log_map, progress=True, scan=options.scan)
    of_urdf = options.body is not None and not body_options.is_mesh(options.body)
    robot = Robot.from_urdf(options.body, options.folder) if of_urdf else None
    frames = log_frames(log, log_map, robot)
    belief = belief_of(options, frames.skin_log.taxel_ids)
    lines = [*(f"  note: {note}" for note in log.notes), *summary(frames, log)]
    if robot is None or options.indenter_mm is None:
        recording = recording_from_log(log, log_map, frames)
        return FromLog(recording, belief, lines, frames.skin_log)
    found, robot = _calibrate_joints(options, robot, frames.skin_log, belief, progress)
    return FromLog(found.recording, belief, lines + _lines(found), frames.skin_log, found, robot)


def _check(options: argparse.Namespace) -> None:
    """Raise ConfigError for options that miss others."""
    if options.indenter_mm is None:
        what = "contacts from joint angles need the indenter, got {}"
        refuse(options, JOINT_OPTIONS, what, "give --indenter-mm, or leave these options out")
    if options.indenter_mm is not None and (options.body is None or options.link is None):
        raise ConfigError(
            "contacts from joint angles need a robot", remedy="give --urdf FILE and --link LINK"
        )
    if options.indenter_mm is not None and options.method != "joint":
        raise ConfigError(
            "contacts from joint angles need the joint estimate",
            value=f"--method {options.method}",
            remedy="leave --method out",
        )


def _calibrate_joints(
    options: argparse.Namespace,
    robot: Robot,
    log: SkinLog,
    belief: Belief,
    progress: Progress | None,
) -> tuple[LogCalibration, Robot]:
    """The calibration by joint angles, and the robot with what was estimated of it."""
    from ..estimation.kinematics.calibrate_log import calibrate_log
    from ..robot.contact_kinematics import SIGMAS, USUAL

    for name in options.robot_unknown or ():
        check_name("unknown of a robot", name, tuple(SIGMAS))
    unknown = {name: SIGMAS[name] for name in options.robot_unknown or USUAL}
    centre = 1e-3 * np.array(options.indenter_mm)
    kinematics = robot.contact_kinematics(options.link, centre, options.carrier, unknown=unknown)
    found = calibrate_log(log, kinematics, belief, progress)
    return found, found.corrected(robot, options.link)


def _lines(found: LogCalibration) -> list[str]:
    """Lines about the heights of the contacts, and what errors of the joints explain of them."""
    from ..robot.contact_kinematics import JOINT_DELAY

    before, after = found.heights_mm
    model = found.kinematics
    timed = [name for name in model.chain.joint_names if name not in (model.delayed or ())]
    off = [
        f"  {found.off_body} contacts left out: they lie off the body by half an indentation or "
        "more, the others on it (another object or part of the robot pressed the skin?)"
    ]
    against = [f"  delays of joints and clock are against the stamps of {timed[0]}"]
    return [
        f"  contacts lie {before:.3g} mm off the body before the estimate, {after:.2g} mm after it",
        *(off if found.off_body else []),
        *(against if JOINT_DELAY in model.columns and timed else []),
        *(f"  {residual.words}" for residual in found.joint_residuals if residual.words),
    ]
