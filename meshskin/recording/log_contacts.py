"""The recording of a log whose contacts are computed from joint angles.

The indenter's centre is known in the body frame, by forward kinematics. Its contact is at the
closest point of the body's smooth surface, displaced along the normal by as much as the centre is
higher or lower than a contact's is, so that the distances of the contact points from the body show
how well body and kinematics agree.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pyarrow as pa

from ..core.arrays import Array, robust_sigma
from ..core.errors import RecordingError
from ..robot.contact_kinematics import JointPath
from .recording import CONTACT_SCHEMA, JOINT_ANGLES, NOMINAL, READING_SCHEMA, Recording
from .skin_log import SkinLog

NOMINAL_FORCE = 1.0
"""Force, N, where neither log nor belief has one: the learned response scales with it."""
SUDDEN = 0.5
"""Change of the force within a frame, relative to it, from which it is not known: half a frame of
error in its time would be a quarter of it."""
MIN_JUDGED = 20
"""Frames in contact from which the median of their forces is judged."""
MAX_MISSING = 0.2
"""Largest share of the taxels whose readings a frame in contact lacks: a frame with fewer is no
contact."""

MAX_NOISE = 0.02
"""Noise of a noisy taxel, relative to its largest reading, from which its readings are left out:
twice the noise that is believed of readings where none is known."""


def joint_path(log: SkinLog, joint_names: tuple[str, ...]) -> JointPath:
    """The path of the joints `joint_names` in a log, by the frames that have them all.

    Raises RecordingError for a joint that the log lacks and for a single frame.
    """
    if joint_names and not log.joint_names:
        raise RecordingError(
            "the log has no joint angles",
            value="no stream of kind joints in its map",
            remedy=f'add a [[stream]] of kind = "joints" with {", ".join(sorted(joint_names))}',
        )
    if lacking := [name for name in joint_names if name not in log.joint_names]:
        raise RecordingError(
            "the log lacks angles of joints between the indenter and the body",
            value=", ".join(lacking),
            limit=f"joints of the log: {', '.join(log.joint_names)}",
            remedy="record them, or correct names in the map",
        )
    angles = log.joint_angles[:, [log.joint_names.index(name) for name in joint_names]]
    known = np.isfinite(angles).all(axis=1)
    if known.sum() < 2:
        fewest = joint_names[int(np.argmin(np.isfinite(angles).sum(axis=0)))] if joint_names else ""
        raise RecordingError(
            "a log needs two frames or more with the angles of all joints of the chain",
            value=f"{known.sum()} of {len(log.time)} frames",
            remedy=f"check the joint {fewest}, which has fewest" if fewest else "",
        )
    return JointPath(log.time[known], angles[known])


def contact_frames(log: SkinLog) -> np.ndarray:
    """Frames (m,) in contact, of which a taxel reads and few readings are missing, and which press
    where forces are known.

    Raises RecordingError without any.
    """
    used = log.in_contact & np.isfinite(log.readings).any(axis=1)
    used &= log.missing.mean(axis=1) <= MAX_MISSING
    if log.force is not None:
        used &= np.isfinite(log.force)
        _check_forces(log.force, used)
        used &= log.force > 0
    if not used.any():
        raise RecordingError(
            "the log has no contact that a taxel reads",
            value=f"{int(log.in_contact.sum())} frames in contact",
            remedy="check the taxels' streams, and the sign of the forces",
        )
    return np.flatnonzero(used)


def _check_forces(force: Array, in_contact: np.ndarray) -> None:
    """Raise RecordingError for forces (n,), N, that pull in most frames in contact (n,), or of
    which these have none."""
    if in_contact.sum() < MIN_JUDGED:
        return
    steps = np.diff(force[np.isfinite(force)])
    noise = robust_sigma(steps) / np.sqrt(2.0)
    middle = float(np.median(force[in_contact]))
    if middle < -noise:
        raise RecordingError(
            "contact forces of the log are negative",
            value=f"{middle:.3g} N in the median of {in_contact.sum()} frames in contact",
            remedy="turn the sign: of the wrench's axis in the map, or of the column of forces",
        )
    if middle <= noise:
        raise RecordingError(
            "the log has no force where taxels are pressed",
            value=f"{middle:.3g} N in the median of {in_contact.sum()} frames in contact",
            limit=f"its noise, {noise:.3g} N",
            remedy="check the wrench's axis in the map, and its clock, or leave the wrench out",
        )


def without_noise(log: SkinLog) -> tuple[SkinLog, np.ndarray]:
    """The log without the readings of taxels whose noise is large against that of others and
    against their readings, and these taxels (t,) bool: an estimate has one noise for all."""
    peak = np.max(log.readings, axis=0, where=np.isfinite(log.readings), initial=0.0)
    noisy = log.noisy & (log.noise > MAX_NOISE * peak)
    return replace(log, readings=np.where(noisy, np.nan, log.readings)), noisy


def typical_force(log: SkinLog) -> float:
    """Median of the forces that press, N, in frames in contact of a log; the nominal one without.

    The clock of the skin is not known yet: forces are judged by `contact_frames` where it is.
    """
    if log.force is None:
        return NOMINAL_FORCE
    pressed = log.force[log.in_contact & (log.force > 0)]
    return float(np.median(pressed)) if len(pressed) else NOMINAL_FORCE


def at_clock(log: SkinLog, offset: float) -> SkinLog:
    """The log with the forces at the times of its contacts, where the stamps of its frames are late
    by `offset`, s: the wrench is on the clock of the joints.

    NaN where the force rises or falls by more than SUDDEN within a frame of the skin.
    """
    if log.force is None or not offset:
        return log
    known = np.isfinite(log.force)
    frame = float(np.median(np.diff(log.time)))
    before, force, after = (
        np.interp(log.time - offset + shift, log.time[known], log.force[known])
        for shift in (-frame, 0.0, frame)
    )
    sign = np.sign(force)  # forces that pull are refused with words of their own
    sudden = np.minimum(sign * before, sign * after) < (1 - SUDDEN) * np.abs(force)
    return replace(log, force=np.where(sudden, np.nan, force))


def recording_of(
    log: SkinLog,
    frames: np.ndarray,
    points: Array,
    normals: Array,
    force: Array,
    readings: str = "raw",
) -> Recording:
    """The recording of the contacts of `frames` (m,) at `points` (m, 3), body frame, m, with the
    outward `normals` (m, 3) there, under forces (m,), N.

    readings: unit of the log's readings, "pressure" or "raw", as `Belief.readings`.
    """
    time = log.time[frames]
    values = log.readings[frames]
    # a missing reading is kept as NaN: left out, it would be a silence
    contact, column = np.nonzero(np.isfinite(values) | log.missing[frames])
    contacts = pa.table([time, *points.T, *normals.T, force], schema=CONTACT_SCHEMA)
    ids = np.asarray(log.taxel_ids)
    schema = READING_SCHEMA.set(1, pa.field("taxel", pa.from_numpy_dtype(ids.dtype)))
    table = pa.table([time[contact], ids[column], values[contact, column]], schema=schema)
    metadata = {"taxel_ids": ids.tolist(), "readings": readings, "source": JOINT_ANGLES}
    if log.force is None:
        metadata["force"] = NOMINAL
    return Recording(contacts, table, metadata)
