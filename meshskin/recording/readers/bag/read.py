"""Streams of a bag: those of a map with their values, or all of them with their times."""

from __future__ import annotations

import struct
from array import array
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ....core.errors import RecordingError, UnknownNameError
from ...message_types import suggestions
from ...stream import Log, Stream, in_order
from ..samples import NANO, Samples
from . import mcap_file, ros1, sqlite_file
from .indexed import IndexedBag, require_rosbags
from .records import BEFORE_TEAR, ZSTD, Bag, ScannedBag, Torn, unpacked_zstd

if TYPE_CHECKING:
    from ...log_map import LogMap, StreamMap

SCANS = {"ros1": ros1.records, "sqlite": sqlite_file.records, "mcap": mcap_file.records}
"""The functions that read records one by one, by format."""
MAGICS = {ros1.MAGIC: "ros1", sqlite_file.MAGIC: "sqlite", mcap_file.MAGIC: "mcap"}
"""First bytes of the formats."""
MAX_DAMAGED = 0.05
"""Share of the messages of a topic so far up to which those that cannot be decoded are left out."""
FIRST = 50
"""Messages of a topic of which the first with values tells what it could be."""
STAMP, STAMP_AT = struct.Struct("<iI"), 4
"""Seconds and nanoseconds of a header, and the byte where they are: in ROS 1 after the sequence
number, in CDR after the encapsulation."""

Could = dict[str, list["StreamMap"]]
"""What the streams could be, by their names."""


def read(
    path: Path,
    log_map: LogMap | None,
    files: Collection[Path] = (),
    *,
    progress: bool = False,
    scan: bool = False,
) -> tuple[Log, Could]:
    """The log in a bag, a file or a folder of ROS 2, and what its streams could be.

    `files`: definitions (.msg) of message types that the bag lacks; `scan`: read a ROS 1 bag that
    was never closed. Raises RecordingError for a bag that cannot be read, a topic that it does not
    have and messages that are not what the map says.
    """
    require_rosbags(path)
    if path.is_file() and format_of(path) == "ros1" and not scan and not ros1.is_closed(path):
        raise RecordingError(
            f"{path.name} has no index: its recording was not closed",
            remedy="run rosbag reindex, or read it record by record with --scan (scan=True)",
        )
    try:
        with IndexedBag(path, format_of(path), files) as bag:
            return _collect(path, bag, log_map, progress)
    except Torn as error:
        reason = str(error)
    parts = [path] if path.is_file() else _storage(path)
    if not parts and (packed := next(path.glob("*.zstd"), None)):
        raise RecordingError(
            f"{path.name} has compressed files and no metadata.yaml", value=packed.name,
            remedy="unpack them with zstd -d",
        )  # fmt: skip
    if not parts:
        raise RecordingError(
            f"{path.name} holds no log: no bag, no data.log of YARP, no CSV or Parquet file",
            remedy="check the path",
        )
    scanned = ScannedBag(parts, SCANS[format_of(parts[0])], files)
    if not scanned.counts:
        note = scanned.notes[0] if scanned.notes else reason
        raise RecordingError(
            f"{path.name} has no readable message: {note.removesuffix(f': {BEFORE_TEAR}')}",
            remedy="copy the file again, or record it again",
        )
    log, could = _collect(path, scanned, log_map, progress)
    notes = log.notes or (f"read record by record, since rosbags says: {reason}",)
    return Log(log.path, log.streams, notes), could


def format_of(path: Path) -> str:
    """ "ros1", "sqlite" or "mcap" by the first bytes of a file; empty for others and folders."""
    if not path.is_file():
        return ""
    with path.open("rb") as stream:
        start = stream.read(16)
    return next((name for magic, name in MAGICS.items() if start.startswith(magic)), "")


def _storage(folder: Path) -> list[Path]:
    """The files of a ROS 2 bag, of one format."""
    files = sorted(path for path in folder.iterdir() if format_of(path) in ("sqlite", "mcap"))
    return [path for path in files if format_of(path) == format_of(files[0])]


def _collect(path: Path, bag: Bag, log_map: LogMap | None, progress: bool) -> tuple[Log, Could]:
    if log_map is None:
        return _times(path, bag, progress)
    for stream in log_map.streams:
        if stream.topic not in bag.types:
            raise UnknownNameError("topic", stream.topic, bag.types, f" in {path.name}")
    every = [Samples(one, bag.types[one.topic], bag.counts[one.topic]) for one in log_map.streams]
    samples: dict[str, list[Samples]] = {}
    for one in every:
        samples.setdefault(one.map.topic, []).append(one)
    decoders = {topic: bag.decoder(topic) for topic in samples}
    damaged = dict.fromkeys(samples, 0)
    for topic, time, data in _shown(bag, samples, path, progress):
        try:
            message = decoders[topic](data)
        except RecordingError:
            damaged[topic] += 1
            if damaged[topic] > MAX_DAMAGED * samples[topic][0].messages:
                raise  # not damage, but another type
            continue
        for one in samples[topic]:
            one.add(message, time)
    left_out = [
        f"{count} messages of {topic} cannot be decoded: they are damaged, and left out"
        for topic, count in damaged.items()
        if count
    ]
    left_out += [
        f"{one.empty} messages of {one.map.topic} hold no {one.map.kind}: they are left out"
        for one in every
        if one.empty
    ]
    return Log(path, tuple(in_order(one.stream()) for one in every), (*bag.notes, *left_out)), {}


def _times(path: Path, bag: Bag, progress: bool) -> tuple[Log, Could]:
    """The times of all topics, and what their first messages could be."""
    times = {topic: array("d") for topic in bag.types}
    could: dict[str, list[StreamMap] | None] = {}
    headers = {topic for topic in bag.types if bag.has_header(topic)}
    for topic, receipt, data in _shown(bag, times, path, progress):
        if topic not in could and _stamp(data) == 0.0:
            headers.discard(topic)
        if len(times[topic]) < FIRST and could.get(topic, []) == []:  # the first may be empty
            could[topic] = _suggest(bag, topic, data)
        stamp = _stamp(data) if topic in headers else NANO * receipt
        times[topic].append(stamp)
    streams = tuple(
        in_order(Stream(topic, bag.types[topic], np.array(own), np.empty((len(own), 0))))
        for topic, own in sorted(times.items())
    )
    return Log(path, streams, tuple(bag.notes)), {t: maps or [] for t, maps in could.items()}


def _suggest(bag: Bag, topic: str, data: bytes) -> list[StreamMap] | None:
    """What a topic could be by a message of it; None, with a note, if it cannot be decoded."""
    try:
        message: Any = bag.decoder(topic)(data)
    except RecordingError as error:
        bag.notes.append(str(error))
        return None
    return suggestions(topic, bag.types[topic], message)


def _stamp(data: bytes) -> float:
    """The time in the header of a message of ROS 1 or in CDR, little-endian, s."""
    if len(data) < STAMP_AT + STAMP.size:
        return 0.0
    second, nano = STAMP.unpack_from(data, STAMP_AT)
    return float(second + NANO * nano)


def _shown(
    bag: Bag, topics: Collection[str], path: Path, progress: bool
) -> Iterator[tuple[str, int, bytes]]:
    """The messages of topics, counted by a progress bar in terminals."""
    from tqdm import tqdm

    total = sum(bag.counts[topic] for topic in topics)
    hidden = None if progress else True  # None: hidden where stderr is not a terminal
    for topic, time, data in tqdm(
        bag.messages(topics), path.name, total, leave=False, unit=" messages", disable=hidden
    ):
        packed = data[: len(ZSTD)] == ZSTD  # of which rosbags knows by metadata.yaml alone
        yield topic, time, unpacked_zstd(data) if packed else data
