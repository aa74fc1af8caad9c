"""Streams of a log brought to one clock: delays, tare, resampling to the frames of the skin."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..core.arguments import check_type
from ..core.arrays import Array, nearest_rows
from ..core.errors import ConfigError, RecordingError
from ..robot.contact_kinematics import continuous_angles
from ..robot.robot import Robot
from .clock_offset import ClockOffset, estimates, one_clock
from .contact_force import contact_force, force_at_rest
from .log_map import LogMap, Pairs, StreamMap
from .readers.yarp import SKIN_CONTACTS
from .skin_log import SkinLog
from .stream import CONTACTS, JOINTS, TAXELS, WRENCH, Log, Stream, overlap
from .stream_checks import check_single, without_garbage
from .tare import COLUMNS, Tared, tare


@dataclass(frozen=True)
class LogFrames:
    """A log on one clock, with what was found on the way."""

    skin_log: SkinLog
    tared: dict[str, Tared]
    """What the tare of each skin found, by the name of its stream."""
    offsets: tuple[ClockOffset, ...]
    """Estimates of the clock offset, the applied one first; empty where there is none."""
    notes: tuple[str, ...]
    clock_compared: bool = True
    """Whether the clock of the skin is that of the other streams, or its offset is known."""


def log_frames(log: Log, log_map: LogMap, robot: Robot | None = None) -> LogFrames:
    """The streams of a log that was read with `log_map`, at the frames of its first skin.

    robot: of the log, with which the weight that a force sensor carries is found and subtracted.
    Raises ConfigError for a map without taxels and for taxels or joints that occur twice,
    RecordingError for a log that was not read with the map, times that run backwards, streams of
    two publishers, streams that do not overlap in time, and a skin that never answers.
    """
    check_type(Log, log, "a log")
    check_type(LogMap, log_map, "the map of a log")
    pairs, notes = [], [*log.notes]
    for stream, given in paired(log, log_map):
        sound, note = without_garbage(stream)
        pairs.append((sound, given))
        notes += [note] if note else []
    skins = [pair for pair in pairs if pair[1].kind == TAXELS]
    if not skins:
        raise ConfigError("the map names no taxels", remedy='add a stream of kind = "taxels"')
    for stream, _ in pairs:
        stream.check_times()
        check_single(stream)
    overlap([stream for stream, _ in pairs if stream.kind != CONTACTS])
    ids = _ids(skins)
    tared = {s.name: tare(s.times, s.values, m.polarity, s.name) for s, m in skins}
    notes += [note for stream, _ in skins for note in _tare_notes(stream, tared[stream.name])]
    first, given = skins[0]
    offsets = estimates(first.times, tared[first.name], pairs) if given.delay is None else ()
    pairs, moved = one_clock(pairs, offsets)
    notes += moved
    usable = bool(offsets) and offsets[0].usable
    late = offsets[0].offset if usable else given.delay or 0.0
    compared = usable or given.delay is not None or all(_of_skin(s, m) for s, m in pairs)
    if not compared:
        notes.append(_unknown_clock(pairs))
    notes += [
        f"the contacts of {s.name} were computed by the robot from its own map of the taxels: "
        "these cannot be calibrated with them"
        for s, m in pairs
        if m.kind == CONTACTS and s.type == SKIN_CONTACTS
    ]
    pairs = on_clock(pairs, late)
    skins = [pair for pair in pairs if pair[1].kind == TAXELS]
    frames = skins[0][0].times
    frames = frames[_kept(frames, pairs)]
    readings = np.empty((len(frames), len(ids)), dtype=np.float32)
    ends = np.cumsum([len(s.fields) for s, _ in skins])
    for (s, m), part in zip(skins, np.split(readings, ends[:-1], axis=1), strict=True):
        _interpolate(part, frames, s, m, tared[s.name])
    pressed = [tared[s.name].in_contact[nearest_rows(s.times, frames)] for s, _ in skins]
    in_contact = np.any(pressed, axis=0)
    names, angles = _joints(frames, pairs)
    wrenches = [pair for pair in pairs if pair[1].kind == WRENCH]
    force, said = contact_force(frames, in_contact, wrenches, robot, names, angles)
    for stream, given in pairs if force is None else ():
        if given.kind == CONTACTS and "force" in stream.fields:
            said += force_at_rest(frames, in_contact, stream)
    notes += said
    noise = np.concatenate([tared[s.name].noise * m.factor for s, m in skins])
    skin_log = SkinLog(
        frames, names, angles, ids, readings, noise, in_contact, force, late,
        offsets[0].sigma if usable else None,
    )  # fmt: skip
    return LogFrames(skin_log, tared, offsets, tuple(notes), compared)


def _tare_notes(stream: Stream, found: Tared) -> list[str]:
    """What the tare of a skin found, in words."""
    notes = []
    if found.glitches:
        notes.append(
            f"{found.glitches} readings of {stream.name} jump for one frame, farther than a "
            "contact: they are left out"
        )
    if len(found.jumps):
        start = found.jumps[0] - stream.times[0]
        notes.append(
            f"the level of {stream.name} at rest jumps {start:.0f} s after its start and not back: "
            "a contact that was held to the end would look like this"
        )
    return notes


def _unknown_clock(pairs: Pairs) -> str:
    """How a log whose onsets do not tell the clock offset of the skin is read."""
    joints = any(given.kind == JOINTS for _, given in pairs)
    then = "estimated with the taxels by a calibration with the URDF" if joints else "taken as 0"
    return (
        f"the onsets of this log do not tell the clock offset of the skin: it is {then}; for the "
        "onsets, press and retract along one path at five places, record a force, or give delay_ms"
    )


def on_clock(pairs: Pairs, late: float) -> Pairs:
    """The streams on the clock of the robot, without their delays: `late`, s, of those on the clock
    of the skin that have none."""
    out = []
    for stream, given in pairs:
        usual = late if _of_skin(stream, given) else 0.0
        delay = usual if given.delay is None else given.delay
        out.append((replace(stream, times=stream.times - delay), replace(given, delay=0.0)))
    return out


def _of_skin(stream: Stream, given: StreamMap) -> bool:
    """Whether a stream is on the clock of the skin: taxels, and contacts that the robot computes
    from them."""
    return given.kind == TAXELS or stream.type == SKIN_CONTACTS


def paired(log: Log, log_map: LogMap) -> Pairs:
    """The streams of a log with their maps. Raises RecordingError for a log without this map."""
    check_type(Log, log, "log")
    check_type(LogMap, log_map, "log_map")
    if [s.kind for s in log.streams] != [m.kind for m in log_map.streams]:
        raise RecordingError(
            "the log was not read with this map", remedy="give the map to read_log, too"
        )
    return list(zip(log.streams, log_map.streams, strict=True))


def _ids(skins: Pairs) -> NDArray[np.intp]:
    """Ids of the taxels of all skins. Raises ConfigError for a topic or an id that occurs twice."""
    ids, count = np.unique(
        [int(name) for stream, _ in skins for name in stream.fields], return_counts=True
    )
    if np.any(count > 1):
        raise ConfigError(
            "a taxel of the map occurs twice",
            value=f"{ids[np.argmax(count > 1)]} in {', '.join(stream.name for stream, _ in skins)}",
            remedy="give first_id or ids in the map, or leave a stream out",
        )
    names = [stream.name for stream, _ in skins]
    if len(set(names)) < len(names):
        raise ConfigError(
            "the map names two streams of taxels of one topic",
            value=", ".join(names),
            remedy="give all their field paths in values of one stream",
        )
    return np.array([int(name) for stream, _ in skins for name in stream.fields])


def _kept(times: Array, pairs: Pairs) -> NDArray[np.bool_]:
    """Frames that lie within all streams, and in no gap of joints and forces.

    Raises RecordingError if none is left.
    """
    kept = np.append(True, np.diff(times) > 0)  # a message that was recorded twice
    for stream, given in pairs:
        if given.kind in (JOINTS, WRENCH, TAXELS):
            kept &= (times >= stream.times[0]) & (times <= stream.times[-1])
        for gap in stream.gaps if given.kind in (JOINTS, WRENCH) else ():
            kept &= (times <= gap.start) | (times >= gap.end)
    if not kept.any():
        raise RecordingError(
            "no frame of the skin lies within the other streams of the log",
            remedy="check the gaps (meshskin log) and the delays in the map",
        )
    return kept


def _interpolate(
    out: NDArray[np.floating], frames: Array, stream: Stream, given: StreamMap, tared: Tared
) -> None:
    """Write the readings of one skin at the frames to `out` (n, t); NaN in its gaps.

    A few taxels at a time, so that memory stays near that of the readings.
    """
    times = stream.times
    rows = np.clip(np.searchsorted(times, frames), 1, len(times) - 1)
    step = times[rows] - times[rows - 1]
    share = np.divide(frames - times[rows - 1], step, where=step > 0, out=np.zeros_like(frames))
    share = np.clip(share, 0.0, 1.0)[:, None]
    exact = np.flatnonzero(share[:, 0] == 1.0)
    for k in range(0, out.shape[1], COLUMNS):
        part = tared.readings[:, k : k + COLUMNS]
        between = (1 - share) * part[rows - 1] + share * part[rows]
        between[exact] = part[rows[exact]]  # NaN of the frame before does not matter
        out[:, k : k + COLUMNS] = given.factor * between
    for gap in stream.gaps:
        out[(frames > gap.start) & (frames < gap.end)] = np.nan


def _joints(frames: Array, pairs: Pairs) -> tuple[tuple[str, ...], Array]:
    """Names and angles (n, k), rad, of all joints at the frames, NaN in gaps of a joint's own.
    Raises ConfigError for a joint of two streams."""
    names: list[str] = []
    columns: list[Array] = []
    for stream, given in pairs:
        if given.kind != JOINTS:
            continue
        every = (stream.values * given.factors(stream.fields)).T
        for name, values in zip(stream.fields, every, strict=True):
            if name in names:
                raise ConfigError(
                    f"the joint {name} is in two streams",
                    value=", ".join(s.name for s, m in pairs if m.kind == JOINTS),
                    remedy="give other names in the map, or leave a stream out",
                )
            names.append(name)
            columns.append(_joint(frames, stream.times, values))
    angles = np.stack(columns, axis=1) if columns else np.empty((len(frames), 0))
    return tuple(names), angles


def _joint(frames: Array, times: Array, angles: Array) -> Array:
    """Angles (n,), rad, of a joint at the frames; NaN beyond its finite ones and in gaps of theirs:
    a joint may stop while others of its topic go on."""
    known = np.isfinite(angles)
    if known.sum() < 2:
        return np.full(len(frames), np.nan)
    own = Stream("", "", times[known], np.empty((int(known.sum()), 0)))
    out = np.interp(frames, own.times, continuous_angles(angles[known]), left=np.nan, right=np.nan)
    for gap in own.gaps:
        out[(frames > gap.start) & (frames < gap.end)] = np.nan
    return np.asarray(out)
