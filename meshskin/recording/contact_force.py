"""The force of a contact from that of a sensor, which has a level at rest and carries a weight.

    f = b + w Q R(q)^T z

b is the level of the sensor, w the weight of what it carries: of the tool beyond a wrist, or of all
that follows a sensor in an arm. The vertical z is in the frame of a link by its rotation R(q), at
joint angles q, and in that of the sensor by Q, as it is mounted on the link; Q turns over, too,
where the sensor counts forces with the other sign. w, Q and the link follow from the force at rest.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import Array, nearest_rows, robust_sigma
from ..core.config import STANDARD_GRAVITY
from ..core.errors import ArmError, ConfigError, RecordingError
from ..robot.chain import Chain
from ..robot.contact_kinematics import JOINT_OFFSET, SIGMAS
from ..robot.robot import Robot
from .log_map import StreamMap
from .stream import Stream
from .tare import BLOCK, MIN_REST, at_rest, blocks

REST_SIGMAS = 3.0
"""Force in standard deviations of its noise at rest, up to which it counts as zero."""
MAX_FRAMES = 2000
"""Frames at rest, evenly chosen, from which the weight is found: arms take seconds from one posture
to the next, and the noise of their mean is far below that of a frame."""
REWEIGHTINGS = 10
"""Fits of the weight with frames weighted by their residuals of the last one: the arm accelerates
in some, in others the indenter presses beside the taxels."""
ZERO_FITS = 3
"""Fits of the zeros of the joints: another one moves those of a degree by 0.02 degrees at most."""
VERTICALS = np.eye(3)[[2, 0, 1]]
"""Axes of the root's frame that are tried as the vertical: of a robot on a floor or a ceiling, and
on walls."""
EXPLAINED = 0.8
"""Median force that is left at rest with a weight, relative to that without, up to which there is
one: noise has 1, as the weight has 4 parameters and the frames are hundreds."""
UNEXPLAINED = 0.5
"""Median force at rest, N, from which it is said that it is not explained: a sixth of the 3 N that
explorations press with, which a learned response takes for noise of the force."""


def contact_force(
    frames: Array,
    in_contact: NDArray[np.bool_],
    wrenches: Sequence[tuple[Stream, StreamMap]],
    robot: Robot | None,
    joint_names: Sequence[str],
    angles: Array,
) -> tuple[Array | None, list[str]]:
    """Contact force (n,), N, at the frames, None without a wrench, and notes on the weight.

    angles (n, k), rad, of the joints of the log. The level at rest is that of the frames without
    contact about it. Forces are NaN where angles that the weight follows from are. Raises
    RecordingError if no frames are at rest, ConfigError for two wrenches.
    """
    if not wrenches:
        return None, []
    if len(wrenches) > 1:
        raise ConfigError(
            "the map names two wrenches", value=", ".join(stream.name for stream, _ in wrenches),
            remedy="leave one out",
        )  # fmt: skip
    stream, given = wrenches[0]
    forces = given.factor * stream.values[:, :3]
    measured = np.stack([np.interp(frames, stream.times, part) for part in forces.T], axis=1)
    rest, level = _rest_level(frames, measured, in_contact, stream.name)
    force, left = measured - level, _typical(measured - level, rest)
    notes = []
    if robot is not None and (found := _weight(robot, joint_names, angles, measured, rest)):
        link, turned, mass = found
        other, unknown = measured - turned, np.isnan(turned).any(axis=1)
        other -= _rest_level(frames, other, in_contact | unknown, stream.name)[1]
        if _typical(other, rest & ~unknown) < EXPLAINED * left:
            force, left = other, _typical(other, rest & ~unknown)
            notes.append(
                f"{stream.name} carries {mass:.3g} kg that turn with the link {link}: their weight "
                "is subtracted"
            )
    if left > UNEXPLAINED:
        why = "the weight of a tool that turns with the arm would look like this"
        notes.append(
            f"{stream.name} is {left:.2g} N off its level at rest in the median: {why}"
            + (", which a calibration with the URDF subtracts" if robot is None else "")
        )
    if given.axis is None:
        return np.asarray(np.linalg.norm(force, axis=1)), notes
    axis = np.array(given.axis) / np.linalg.norm(given.axis)
    return np.asarray(force @ axis), notes


def _typical(force: Array, rest: NDArray[np.bool_]) -> float:
    """Median of the magnitudes of forces (n, 3), N, at rest."""
    return float(np.median(np.linalg.norm(force[rest], axis=1)))


def _weight(
    robot: Robot, joint_names: Sequence[str], angles: Array, force: Array, rest: NDArray[np.bool_]
) -> tuple[str, Array, float] | None:
    """The link with which a weight turns that explains the forces (n, 3), N, at rest best, the
    forces (n, 3), N, of that weight, NaN where angles are missing, and its mass, kg; None where
    the log has the joints of no link.
    """
    best = None
    for joint in robot.tree.joints:
        if joint.kind == "fixed":
            continue
        try:
            chain = robot.chain(joint.child, robot.root)
        except ArmError:  # beyond a joint of a kind that chains do not have
            continue
        if not set(chain.joint_names) <= set(joint_names):
            continue
        columns = np.array([list(joint_names).index(name) for name in chain.joint_names])
        used = np.flatnonzero(rest & np.isfinite(angles[:, columns]).all(axis=1))
        used = used[:: 1 + len(used) // MAX_FRAMES]
        if not len(used):
            continue
        turn = chain.poses(angles[np.ix_(used, columns)])[:, :3, :3]
        for vertical in VERTICALS:
            map_, left, _ = _fitted(turn @ vertical, force[used])
            if best is None or left < best[0]:
                best = left, joint.child, chain, columns, map_, vertical
    if best is None:
        return None
    _, link, chain, columns, _, vertical = best
    known = np.isfinite(angles[:, columns]).all(axis=1)
    used = np.flatnonzero(rest & known)
    used = used[:: 1 + len(used) // MAX_FRAMES]
    q = angles[:, columns]
    zeros, vertical, map_ = _with_zeros(chain, q[used], vertical, force[used])
    turned = np.full(force.shape, np.nan)
    turned[known] = chain.poses(q[known] + zeros)[:, :3, :3] @ vertical @ map_.T
    return link, turned, float(np.linalg.norm(map_, 2)) / STANDARD_GRAVITY


def _with_zeros(
    chain: Chain, angles: Array, vertical: Array, force: Array
) -> tuple[Array, Array, Array]:
    """Errors (k,), rad, of the zeros of the joints, the vertical (3,) in the root's frame and
    w Q (3, 3), N, by forces (n, 3), N, at angles (n, k): zeros that are a degree off turn a weight
    of 8 N by 0.14 N, of which w Q takes a part.

    Gauss-Newton with the prior of the joints' offsets, which holds what the weight does not tell.
    """
    count, across = angles.shape[1], np.stack([np.roll(vertical, 1), np.roll(vertical, 2)])
    # of the zeros, of the vertical, and of the rotation and the size of w Q, which is fitted anew
    precision = np.repeat([SIGMAS[JOINT_OFFSET] ** -2, 0.0], [count + 2, 4])
    x = np.zeros(count + 2)
    for step in range(ZERO_FITS + 1):
        zeros, upright = x[:count], vertical + x[count:] @ across
        turn = chain.poses(angles + zeros)[:, :3, :3]
        map_, middle, weight = _fitted(turn @ upright, force)
        if step == ZERO_FITS:
            break
        load = turn @ upright @ map_.T
        spins = np.swapaxes(chain.jacobian(angles + zeros)[:, 3:], 1, 2)
        turned = np.cross(spins, (turn @ upright)[:, None])
        tilted = across @ np.swapaxes(turn, 1, 2)
        slopes = [turned @ map_.T, tilted @ map_.T, np.cross(np.eye(3), load[:, None])]
        jacobian = np.concatenate([*slopes, load[:, None]], axis=1)
        jacobian -= np.average(jacobian, axis=0, weights=weight)
        left = force - load
        left -= np.average(left, axis=0, weights=weight)
        scaled = 3 * weight[:, None, None] / max(middle, 1e-300) ** 2 * jacobian
        hessian = np.einsum("nic,njc->ij", scaled, jacobian) + np.diag(precision)
        gradient = np.einsum("nic,nc->i", scaled, left) - precision * np.append(x, np.zeros(4))
        x = x + np.linalg.solve(hessian, gradient)[:-4]
    return zeros, upright, map_


def _fitted(up: Array, force: Array) -> tuple[Array, float, Array]:
    """w Q (3, 3), N, of the forces (n, 3) of a weight in the directions `up` (n, 3) of a link, the
    median force, N, that it leaves, and the weights (n,) of the frames: orthogonal Procrustes with
    a scale, reweighted."""
    weight = np.ones(len(up))
    for _ in range(REWEIGHTINGS):
        x = up - np.average(up, axis=0, weights=weight)
        y = force - np.average(force, axis=0, weights=weight)
        left, size, right = np.linalg.svd((weight[:, None] * y).T @ x)
        map_ = size.sum() / max(np.sum(weight[:, None] * x**2), 1e-300) * (left @ right)
        apart = np.linalg.norm(y - x @ map_.T, axis=1)
        middle = float(np.median(apart))
        weight = middle / np.maximum(apart, middle) if middle else weight
    return map_, middle, weight


def force_at_rest(frames: Array, in_contact: NDArray[np.bool_], stream: Stream) -> list[str]:
    """The note on contacts whose force is not zero where no taxel answers, if it is not."""
    row = nearest_rows(frames, stream.times)
    within = (stream.times >= frames[0]) & (stream.times <= frames[-1])
    force = stream.values[within & ~in_contact[row], stream.fields.index("force")]
    force = force[np.isfinite(force)]
    if len(force) < max(MIN_REST * len(stream), 1):
        return []
    level = float(np.median(force))
    if abs(level) <= REST_SIGMAS * robust_sigma(force - level):
        return []
    return [
        f"the force of {stream.name} is {level:.3g} N in the median of {len(force)} rows in which "
        "no taxel answers; if nothing was touched in them, subtract this level at rest"
    ]


def _rest_level(
    frames: Array, values: Array, in_contact: NDArray[np.bool_], name: str
) -> tuple[NDArray[np.bool_], Array]:
    """The frames (n,) at rest, and the medians (n, k) of the values there in blocks of time, linear
    between them.

    The median, as the indenter may press beside the taxels, and as the skin's stamps may be late.
    Raises RecordingError where no block has enough frames without contact.
    """
    edges = blocks(frames)
    block = np.repeat(np.arange(len(edges) - 1), np.diff(edges))
    for rest in (at_rest(frames, in_contact), ~in_contact):
        count = np.bincount(block)
        quiet = np.bincount(block[rest], minlength=len(count))
        known = np.flatnonzero((quiet > 0) & (quiet >= MIN_REST * count))
        if len(known):
            break
    else:
        raise RecordingError(
            f"the level of {name} at rest is not known: the skin is in contact all the time",
            value=f"{np.mean(~in_contact):.0%} of {len(frames)} frames without contact",
            limit=f"{MIN_REST:.0%} of {BLOCK:g} s",
            remedy=f"lift off for a second at the start of a log, or leave {name} out of the map",
        )
    at = [rest & (block == k) for k in known]
    middle = np.array([frames[rows].mean() for rows in at])
    levels = np.array([np.median(values[rows], axis=0) for rows in at])
    columns = [np.interp(frames, middle, level) for level in levels.T]
    return rest, np.stack(columns, axis=1)
