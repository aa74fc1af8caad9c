"""Whether the joints of a log are those of a robot, and within its limits."""

from __future__ import annotations

import difflib
from collections.abc import Iterator

import numpy as np

from ..core.errors import RecordingError, UnknownNameError
from ..robot.robot import SLIDING, Robot
from .log_map import Pairs, StreamMap
from .stream import JOINTS, Stream

BEYOND = 0.1
"""Angle, rad, or length, m, up to which a joint may pass its limits: zeros are some degrees off."""
WRONG_UNIT = 3.0
"""Distance beyond the limits, in their range, from which angles in deg are taken for rad: robots
stop within their limits."""


def check_joints(pairs: Pairs, robot: Robot) -> Iterator[str]:
    """Lines about the joints of the streams beside those of the robot.

    Raises UnknownNameError for a stream of which the robot has no joint, RecordingError for angles
    that can be no rad.
    """
    file = robot.path.name
    moving = {joint.name: joint for joint in robot.tree.joints if joint.kind != "fixed"}
    held: set[str] = set()
    for stream, given in pairs:
        if given.kind != JOINTS:
            continue
        known = [name for name in stream.fields if name in moving]
        if stream.fields and not known:
            raise UnknownNameError(
                "joint",
                stream.fields[0],
                moving,
                f" of {stream.name} in {file}; the map's key "
                "names gives the joints in the order of the columns",
            )
        held.update(known)
        yield f"{stream.name}: {len(known)} of {len(stream.fields)} joints are in {file}"
        for name in stream.fields:
            if name not in moving:
                lower = {own.lower(): own for own in moving}
                near = difflib.get_close_matches(name.lower(), lower, 1)
                said = f" (did you mean {lower[near[0]]}?)" if near else ""
                yield f"joint {name} of {stream.name} is not in {file}{said}"
        yield from _beyond(stream, given, robot)
    if missing := [name for name in robot.joint_names if name not in held]:
        yield f"joints of {file} that the log lacks: {', '.join(missing)}"


def _beyond(stream: Stream, given: StreamMap, robot: Robot) -> Iterator[str]:
    """Lines about joints that pass their limits. Raises RecordingError where deg explain them."""
    joints = {joint.name: joint for joint in robot.tree.joints}
    values = stream.values * given.factors(stream.fields)
    for name, angles in zip(stream.fields, values.T, strict=True):
        joint = joints.get(name)
        if joint is None or not {"lower", "upper"} <= set(joint.limits):
            continue
        if not np.isfinite(angles).any():
            continue
        low, high = joint.limits["lower"], joint.limits["upper"]
        least, most = float(np.nanmin(angles)), float(np.nanmax(angles))
        beyond = max(low - least, most - high)
        slides = joint.kind in SLIDING
        if high <= low or beyond <= BEYOND:
            continue
        unit = "m" if slides else "rad"
        value, limit = f"{least:.3g} to {most:.3g} {unit}", f"{low:.3g} to {high:.3g} {unit}"
        in_degrees = not slides and given.factor == 1.0 and beyond > WRONG_UNIT * (high - low)
        if in_degrees:
            raise RecordingError(
                f"angles of the joint {name} of {stream.name} cannot be in rad",
                value=value, limit=f"{limit} in {robot.path.name}",
                remedy='write unit = "deg" in the map, or correct names',
            )  # fmt: skip
        yield f"joint {name} goes from {value}, its limits in {robot.path.name} are {limit}"
