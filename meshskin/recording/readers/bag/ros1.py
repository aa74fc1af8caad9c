"""Records of a ROS 1 bag (format 2.0), one by one: of a bag whose index is lost.

A record is a header of fields name=value and data, each preceded by its length, 32 bits, little
endian (http://wiki.ros.org/Bags/Format/2.0).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from .records import MSG, Connection, Record, Torn, read_exactly, unpacked

MAGIC = b"#ROSBAG V2.0\n"
MESSAGE, CHUNK, CONNECTION = 2, 5, 7
"""Values of the field `op` of the records that are read."""
_LENGTH, _TIME, _POSITION = struct.Struct("<I"), struct.Struct("<II"), struct.Struct("<Q")
DAMAGED = (Torn, KeyError, IndexError, ValueError, struct.error, OSError)
"""What reading damaged records raises."""
CODECS, REMEDY = ("none", "bz2", "lz4"), "decompress it (rosbag decompress)"
_SECOND = 10**9
"""Nanoseconds."""


def is_closed(path: Path) -> bool:
    """Whether the recorder closed the bag and so wrote where its index is."""
    with path.open("rb") as stream:
        stream.seek(len(MAGIC))
        try:
            header = _header(stream)
        except Torn:
            return True  # torn in its first record
    return _POSITION.unpack(header.get("index_pos", bytes(8)))[0] != 0


def records(path: Path) -> Iterator[Connection | Record | Torn]:
    """Connections and messages in the order of the file, and Torn for a chunk that is damaged.

    Raises Torn where the file ends within a record or is damaged beyond it, RecordingError for a
    compression that is not read.
    """
    size = path.stat().st_size
    with path.open("rb") as stream:
        stream.seek(len(MAGIC))
        while stream.tell() < size:
            start = stream.tell()
            try:
                header = _header(stream)
                operation = header["op"][0]
                length = _LENGTH.unpack(read_exactly(stream, 4))[0]
                if operation == CHUNK:
                    content = stream.read(length)
                    try:
                        codec = header["compression"].decode()
                        yield from _chunk(unpacked(content, codec, path, CODECS, REMEDY))
                    except DAMAGED:
                        if len(content) < length:
                            raise
                        yield Torn(f"chunk at byte {start} of {size}")
                    if len(content) < length:
                        raise Torn
                elif operation in (CONNECTION, MESSAGE):
                    yield _record(operation, header, read_exactly(stream, length))
                else:
                    stream.seek(length, 1)
            except DAMAGED as error:
                raise Torn(f"in the record from byte {start} to the end at {size}") from error


def _chunk(content: bytes) -> Iterator[Connection | Record]:
    """The records of a chunk. Raises Torn where it ends within one."""
    stream = BytesIO(content)
    while stream.tell() < len(content):
        header = _header(stream)
        data = read_exactly(stream, _LENGTH.unpack(read_exactly(stream, 4))[0])
        if header["op"][0] in (CONNECTION, MESSAGE):
            yield _record(header["op"][0], header, data)


def _record(operation: int, header: dict[str, bytes], data: bytes) -> Connection | Record:
    key = _LENGTH.unpack(header["conn"])[0]
    if operation == MESSAGE:
        second, nano = _TIME.unpack(header["time"])
        return Record(key, second * _SECOND + nano, data)
    about = _fields(data)
    package, _, name = about["type"].decode().partition("/")
    return Connection(
        key,
        header["topic"].decode(),
        f"{package}/msg/{name.removeprefix('msg/')}",
        "ros1",
        about["message_definition"].decode(),
        MSG,
    )


def _header(stream: BinaryIO) -> dict[str, bytes]:
    return _fields(read_exactly(stream, _LENGTH.unpack(read_exactly(stream, 4))[0]))


def _fields(data: bytes) -> dict[str, bytes]:
    """The fields name=value of a header."""
    found, at = {}, 0
    while at < len(data):
        (length,) = _LENGTH.unpack_from(data, at)
        name, _, value = data[at + 4 : at + 4 + length].partition(b"=")
        found[name.decode()] = value
        at += 4 + length
    return found
