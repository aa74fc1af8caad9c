"""Records of an MCAP file, one by one: of a file that is torn, or without the profile of ROS 2.

A record is an operation code, 8 bits, the length of its content, 64 bits, and the content; a chunk
holds records, compressed or not (https://mcap.dev/spec).
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO

from .records import IDL, MSG, UNDEFINED, Connection, Record, Torn, read_exactly, unpacked

MAGIC = b"\x89MCAP0\r\n"
FOOTER, SCHEMA, CHANNEL, MESSAGE, CHUNK, DATA_END = 0x02, 0x03, 0x04, 0x05, 0x06, 0x0F
"""Operation codes of the records that are read, and of those after the data."""
FORMATS = {"ros2msg": MSG, "ros1msg": MSG, "ros2idl": IDL, "omgidl": IDL}
"""Format of definitions by the encoding of a schema."""
CODECS, REMEDY = ("", "lz4", "zstd"), "compress it anew (mcap compress --compression zstd)"
DAMAGED = (Torn, KeyError, ValueError, struct.error, OSError, OverflowError)
"""What reading damaged records raises."""
_RECORD, _MESSAGE = struct.Struct("<BQ"), struct.Struct("<HIQQ")
_CHUNK, _TEXT, _SIZE = struct.Struct("<QQQI"), struct.Struct("<I"), struct.Struct("<Q")

Schemas = dict[int, tuple[str, str, bytes]]
"""Name, encoding and data of the schemas by their number."""


def records(path: Path) -> Iterator[Connection | Record | Torn]:
    """Connections and messages in the order of the file, and Torn for a chunk that is damaged.

    Raises Torn where the file ends before its footer or is damaged, RecordingError for a
    compression that is not read.
    """
    schemas: Schemas = {}
    size = path.stat().st_size
    with path.open("rb") as stream:
        stream.seek(len(MAGIC))
        while True:
            start = stream.tell()
            try:
                code, length = _RECORD.unpack(read_exactly(stream, _RECORD.size))
                if code in (FOOTER, DATA_END):
                    return
                if code == CHUNK:
                    try:
                        yield from _chunk(stream, length, schemas, path)
                    except DAMAGED:
                        if stream.seek(start + _RECORD.size + length) >= size:
                            raise
                        yield Torn(f"chunk at byte {start} of {size}")
                elif code in (SCHEMA, CHANNEL, MESSAGE):
                    if (one := _record(code, read_exactly(stream, length), schemas)) is not None:
                        yield one
                elif stream.seek(length, 1) > size:
                    raise Torn
            except DAMAGED as error:
                raise Torn(f"in the record from byte {start} to the end at {size}") from error


def _chunk(
    stream: BinaryIO, length: int, schemas: Schemas, path: Path
) -> Iterator[Connection | Record]:
    """The records of a chunk, as far as they are there. Raises Torn where it ends early."""
    _, _, length_unpacked, checksum = _CHUNK.unpack(read_exactly(stream, _CHUNK.size))
    name = _text(stream)
    (packed,) = _SIZE.unpack(read_exactly(stream, _SIZE.size))
    if _CHUNK.size + _TEXT.size + len(name) + _SIZE.size + packed != length:
        raise Torn
    content = unpacked(stream.read(packed), name, path, CODECS, REMEDY)
    whole = len(content) == length_unpacked
    if whole and checksum and zlib.crc32(content) != checksum:
        raise Torn
    inner = BytesIO(content)
    while inner.tell() < len(content):
        code, size = _RECORD.unpack(read_exactly(inner, _RECORD.size))
        if (one := _record(code, read_exactly(inner, size), schemas)) is not None:
            yield one
    if not whole:
        raise Torn


def _record(code: int, content: bytes, schemas: Schemas) -> Connection | Record | None:
    """A connection or a message; None for a schema, which is kept, and for other records."""
    if code == MESSAGE:
        key, _, time, _ = _MESSAGE.unpack_from(content)
        return Record(key, time, content[_MESSAGE.size :])
    stream = BytesIO(content)
    if code not in (SCHEMA, CHANNEL):
        return None
    key = int.from_bytes(stream.read(2), "little")
    if code == SCHEMA:
        name, encoding = _text(stream), _text(stream)
        (length,) = _TEXT.unpack(read_exactly(stream, _TEXT.size))
        schemas[key] = name, encoding, read_exactly(stream, length)
        return None
    schema = int.from_bytes(stream.read(2), "little")
    name, encoding, data = schemas.get(schema, ("", "", b""))
    if encoding == "ros1msg" and "/msg/" not in name:
        name = name.replace("/", "/msg/")
    form = FORMATS.get(encoding, UNDEFINED)
    topic, of_messages = _text(stream), _text(stream)
    return Connection(key, topic, name, of_messages, data.decode() if form else "", form)


def _text(stream: BinaryIO) -> str:
    return read_exactly(stream, _TEXT.unpack(read_exactly(stream, _TEXT.size))[0]).decode()
