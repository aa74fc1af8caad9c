"""A recording from a log whose contact points are known: poses or contacts beside the taxels."""

from __future__ import annotations

from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from ..core.arrays import Array, Index, nearest_rows, robust_sigma
from ..core.errors import ConfigError, RecordingError
from .contact_force import REST_SIGMAS
from .log_map import BODY, CONTACT, LogMap, Pairs, StreamMap
from .readers.yarp import SKIN_CONTACTS
from .recording import CONTACT_SCHEMA, FROM_TAXELS, QUATERNION, UNCOMPARED, Recording
from .resample import LogFrames, on_clock, paired
from .skin_log import SkinLog
from .stream import CONTACTS, POSE, TAXELS, Log, Stream
from .tare import thresholds

SAME_CONTACT = 2e-3
"""Distance, m, up to which successive contacts within a frame of the skin are one that moves: that
of a stroke of 200 mm/s at 100 Hz; two indenters are farther apart."""


def recording_from_log(log: Log, log_map: LogMap, frames: LogFrames) -> Recording:
    """The contacts and readings of a log that was read with `log_map` and brought to `frames`.

    The contact points are those of a stream of poses or of contacts, in the frame of the body; the
    forces those of the wrench, or of the contacts. Readings in counts make a raw recording, of all
    taxels in every contact. Raises ConfigError for a map without contact points or forces,
    RecordingError for a log without a frame in contact that has both.
    """
    given = frames.skin_log
    pairs = on_clock(paired(log, log_map), given.clock_offset)
    points, normals, force, rotation = _contact_points(pairs, given.time)
    force = given.force if given.force is not None else force
    if force is None:
        raise ConfigError(
            "the log has no contact forces",
            remedy="add a stream of wrenches, or contacts with force",
        )
    # the rows of contacts have no noise at rest: the indenter may touch where no taxel answers
    rest = np.abs(force[~given.in_contact & np.isfinite(force)])
    measured = given.force is not None and len(rest)
    # the median: the indenter may press beside the taxels
    least = REST_SIGMAS * robust_sigma(rest) if measured else 0.0
    used = given.in_contact & np.isfinite(points).all(axis=1) & (force > least)
    if not used.any():
        raise _nothing_used(given, points, force, least)
    columns = [given.time, *points.T, *normals.T, force]
    table = {name: values[used] for name, values in zip(CONTACT_SCHEMA.names, columns, strict=True)}
    if rotation is not None:
        table |= {name: rotation[used, k] for k, name in enumerate(QUATERNION)}
    readings, threshold = _readings(frames, log_map, used)
    metadata: dict[str, Any] = {
        "source": [log.path.name],
        "taxel_ids": given.taxel_ids.tolist(),
        "clock_offset_s": given.clock_offset,
        "clock_sigma_s": given.clock_sigma,
    }
    if any(s.kind == CONTACTS and s.type == SKIN_CONTACTS for s, _ in pairs):
        metadata["contact_points"] = FROM_TAXELS
    if not frames.clock_compared:
        metadata["clock"] = UNCOMPARED
    metadata |= {"readings": "raw"} if threshold is None else {"threshold_pa": threshold}
    return Recording(pa.table(table), readings, metadata)


def _nothing_used(given: SkinLog, points: Array, force: Array, least: float) -> RecordingError:
    """Why no frame has contact, a point (n, 3) and a force (n,) above `least`, N, at once."""
    strong = force[given.in_contact & (np.abs(force) > least)]
    if len(strong) and strong.max() < 0:
        return RecordingError(
            "all contact forces of the log are negative",
            value=f"{strong.min():.3g} to {strong.max():.3g} N",
            remedy="turn the sign: of the wrench's axis in the map, or of the column of forces",
        )
    return RecordingError(
        "no frame of the log has contact, contact point and force at once",
        value=f"{given.in_contact.sum()} frames in contact, "
        f"{np.isfinite(points).all(axis=1).sum()} with a contact point, "
        f"{(force > least).sum()} with a force above {least:.3g} N",
        remedy="check the clocks and the streams of the map",
    )


def _readings(
    frames: LogFrames, log_map: LogMap, used: NDArray[np.bool_]
) -> tuple[pa.Table, float | None]:
    """The table of readings of the used frames, and the pressure, Pa, below which they are left
    out; None for raw ones, which are all kept.

    It is one for all taxels, that of the noisiest, as an estimate takes it. Below that of their own
    noise, readings of noisy taxels are missing, not silences.
    """
    given = frames.skin_log
    pascals = {stream.unit in ("Pa", "kPa") for stream in log_map.of(TAXELS)}
    if len(pascals) > 1:
        raise ConfigError(
            "some taxels of the map are in pascals, others in counts",
            remedy="read them into recordings of their own",
        )
    values, missing, threshold = given.readings[used], given.missing[used], None
    kept = np.isfinite(values)
    if pascals.pop():
        own = thresholds(1, len(given.taxel_ids))[1] * given.noise
        usual = ~given.noisy
        threshold = float(own[usual].max())
        kept &= values > np.maximum(own, threshold)
        values = np.where(kept | usual, values, np.nan)
        missing = missing | ~(kept | usual)
    # a missing reading is kept as NaN: left out, it would be a silence
    row, column = np.nonzero(kept | missing)
    return pa.table(
        {
            "time": given.time[used][row],
            "taxel": given.taxel_ids[column].astype(np.int32),
            "pressure": values[row, column].astype(float),
        }
    ), threshold


def _contact_points(pairs: Pairs, time: Array) -> tuple[Array, Array, Array | None, Array | None]:
    """Contact points (n, 3), m, normals (n, 3) and forces (n,), NaN where unknown, at the frames,
    and the rotation of the body as quaternions w x y z (n, 4).

    Forces are None without contacts that have them, rotations without poses of the body.
    """
    contacts = [pair for pair in pairs if pair[1].kind == CONTACTS]
    poses = {
        of: [p for p in pairs if p[1].kind == POSE and p[1].of == of] for of in (CONTACT, BODY)
    }
    if len(contacts) + len(poses[CONTACT]) != 1 or len(poses[BODY]) > 1:
        raise ConfigError(
            "the map must name one stream of contact points, and at most one of the body's poses",
            value=f"{len(contacts)} of contacts, {len(poses[CONTACT])} of contact poses, "
            f"{len(poses[BODY])} of body poses",
            remedy='add a stream of kind = "contacts", or "pose" with of = "contact"; contacts '
            "from joint angles need --indenter-mm with --urdf and --link (ms.calibrate_log)",
        )
    if contacts:
        return (*_of_contacts(*contacts[0], time), None)
    stream, given = poses[CONTACT][0]
    at, turn = _pose_at(stream, given, time)
    axis = np.array(given.axis or (0.0, 0.0, 1.0))
    points = at + turn.apply(np.array(given.point))
    normals = turn.apply(axis / np.linalg.norm(axis))
    if not poses[BODY]:
        return points, normals, None, None
    origin, body = _pose_at(*poses[BODY][0], time)
    quaternion = body.as_quat()[:, [3, 0, 1, 2]]
    return body.inv().apply(points - origin), body.inv().apply(normals), None, quaternion


def _of_contacts(
    stream: Stream, given: StreamMap, time: Array
) -> tuple[Array, Array, Array | None]:
    """Point, normal and force of the contact nearest to each time, within half a frame; NaN where
    there is none, or more than one."""
    times = stream.times
    half = 0.5 * float(np.median(np.diff(time))) if len(time) > 1 else 0.0
    first, last = np.searchsorted(times, time - half), np.searchsorted(times, time + half)
    columns = {name: k for k, name in enumerate(stream.fields)}

    def column(name: str) -> Array:
        out = np.full(len(time), np.nan)
        if name in columns:
            out[single] = stream.values[near[single], columns[name]]
        return out

    place = [columns[name] for name in ("px", "py", "pz")]
    every = np.asarray(stream.values[:, place] * given.factor, dtype=float)
    near, single = first, last - first == 1
    if len(times) > 1:
        near = nearest_rows(times, time)
        single = _alone(every, times, first, last)
    points = np.stack([column(name) for name in ("px", "py", "pz")], axis=1) * given.factor
    normals = np.stack([column(name) for name in ("nx", "ny", "nz")], axis=1)
    return points, normals, column("force") if "force" in columns else None


def _alone(points: Array, times: Array, first: Index, last: Index) -> NDArray[np.bool_]:
    """Whether there are contacts in the rows from `first` (n,) up to `last` (n,), all of one that
    moves: their points (k, 3), m, are at rising `times` (k,), s, within SAME_CONTACT of the one
    before."""
    other = np.linalg.norm(np.diff(points, axis=0), axis=1) > SAME_CONTACT
    others = np.append(0, np.cumsum(other | (np.diff(times) == 0)))
    some = last > first
    rows = np.where(some, first, 0), np.where(some, last - 1, 0)
    return np.asarray(some & (others[rows[0]] == others[rows[1]]))


def _pose_at(stream: Stream, given: StreamMap, time: Array) -> tuple[Array, Any]:
    """Positions (n, 3), m, and rotations at the times, interpolated; NaN positions in gaps.

    Raises RecordingError for a quaternion that is not one.
    """
    from scipy.spatial.transform import Rotation, Slerp

    known = np.append(True, np.diff(stream.times) > 0)
    times, values = stream.times[known], stream.values[known].astype(float)
    norm = np.linalg.norm(values[:, 3:], axis=1)
    if not np.all(np.abs(norm - 1) < 1e-3):
        row = int(np.argmax(~(np.abs(norm - 1) < 1e-3)))
        raise RecordingError(
            f"orientations of {stream.name} must be unit quaternions",
            value=f"norm {norm[row]:g} in message {row}",
            limit="1 within 1e-3",
            remedy="check the field paths in values: position x y z, quaternion x y z w",
        )
    inside = (time >= times[0]) & (time <= times[-1])
    for gap in stream.gaps:
        inside &= (time <= gap.start) | (time >= gap.end)
    at = np.full((len(time), 3), np.nan)
    for k in range(3):
        at[inside, k] = given.factor * np.interp(time[inside], times, values[:, k])
    turn = Slerp(times, Rotation.from_quat(values[:, 3:]))(np.clip(time, times[0], times[-1]))
    return at, turn
