"""What the formats of bags have in common: connections, messages, types, and a torn end."""

from __future__ import annotations

import bz2
import sys
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

from ....core.arguments import read_text
from ....core.errors import RecordingError

MSG, IDL, UNDEFINED = "msg", "idl", ""
"""Formats of message definitions."""
ZSTD = b"\x28\xb5\x2f\xfd"
"""First bytes of what zstd compressed; those of CDR are 0 and 0, 1, 2 or 3."""
BEFORE_TEAR = "messages before the tear are read"
"""End of the note on a torn file."""


@dataclass(frozen=True)
class Connection:
    """A topic with its message type and the definition of it."""

    key: int
    """What the messages of the connection are marked with."""
    topic: str
    type: str
    encoding: str
    """Of the messages: "ros1", "cdr" or "json"."""
    definition: str = ""
    format: str = UNDEFINED
    """Of the definition: MSG, IDL or UNDEFINED."""


class Record(NamedTuple):
    """A message as the bag stores it."""

    key: int
    time: int
    """Time of receipt, ns."""
    data: bytes


class Torn(Exception):
    """The end of what can be read of a bag; the text says where and why."""


def read_exactly(stream: BinaryIO, length: int) -> bytes:
    """The next `length` bytes of a stream. Raises Torn if there are fewer."""
    found = stream.read(length)
    if len(found) < length:
        raise Torn
    return found


def _lz4(content: bytes) -> bytes:
    from lz4.frame import LZ4FrameDecompressor

    try:
        return bytes(LZ4FrameDecompressor().decompress(content))
    except RuntimeError as error:
        raise Torn from error


def unpacked_zstd(content: bytes) -> bytes:
    """The content of a chunk or a message, as far as it is there. Raises Torn if it is damaged."""
    if sys.version_info >= (3, 14):
        from compression import zstd
    else:
        from backports import zstd
    try:
        return bytes(zstd.ZstdDecompressor().decompress(content))
    except zstd.ZstdError as error:
        raise Torn from error


def unpacked(content: bytes, codec: str, path: Path, known: Sequence[str], remedy: str) -> bytes:
    """The content of a chunk, as far as it is there; known: its name of no codec, and two others.

    Raises Torn if it is damaged, RecordingError for another codec.
    """
    if codec not in known:
        raise RecordingError(
            f"{path.name} is compressed by a codec that is not read",
            value=codec, limit=f"none, {known[1]} or {known[2]}", remedy=remedy,
        )  # fmt: skip
    if codec == "bz2":
        return bz2.BZ2Decompressor().decompress(content)
    if codec == "lz4":
        return _lz4(content)
    return unpacked_zstd(content) if codec == "zstd" else content


class Bag:
    """Base of open bags."""

    connections: dict[str, Connection]
    """One connection of each topic."""
    counts: dict[str, int]
    """Messages by topic."""
    notes: list[str]
    """What there is to say of the reading."""
    store: Any
    """The types of the messages, of rosbags."""

    @property
    def types(self) -> dict[str, str]:
        """Message type by topic."""
        return {topic: one.type for topic, one in self.connections.items()}

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, int, bytes]]:
        """Topic, time of receipt (ns) and data of the messages of some topics."""
        raise NotImplementedError

    def decoder(self, topic: str) -> Callable[[bytes], Any]:
        """The function that makes messages of the data of a topic; it raises RecordingError."""
        return decoder(self.store, self.connections[topic])

    def has_header(self, topic: str) -> bool:
        """Whether the first field of the messages is a std_msgs/Header."""
        known = self.store.fielddefs.get(self.connections[topic].type, ((), ()))[1][:1]
        return bool(known) and "std_msgs/msg/Header" in str(known[0])


def typestore(connections: Iterable[Connection], files: Collection[Path]) -> Any:
    """The types that connections define, those of .msg files, and, where connections define none,
    those of ROS 2. Raises RecordingError for definitions that cannot be read."""
    from rosbags.typesys import (
        Stores,
        TypesysError,
        get_types_from_idl,
        get_types_from_msg,
        get_typestore,
    )

    connections = list(connections)
    bare = any(one.format == UNDEFINED and one.encoding != "json" for one in connections)
    store = get_typestore(Stores.LATEST if bare else Stores.EMPTY)
    for one in connections:
        try:
            if one.format == MSG:
                register(store, get_types_from_msg(one.definition, one.type))
            elif one.format == IDL:
                for text in one.definition.split("=" * 80 + "\n"):
                    body = text.partition("\n")[2] if text.startswith("IDL: ") else text
                    if body.strip():
                        register(store, get_types_from_idl(body))
        except (TypesysError, ValueError, AssertionError):
            continue  # its messages are refused where they are asked for
    register_files(store, files, {one.type for one in connections})
    return store


def register(store: Any, types: Any) -> None:
    """Add types that the store does not have."""
    store.register({name: fields for name, fields in types.items() if name not in store.fielddefs})


def register_files(store: Any, files: Collection[Path], wanted: Collection[str]) -> None:
    """Add the types of .msg files, and the standard ones that they may consist of.

    The package is that of a wanted type of the same name, or the folder of the file (or of its
    folder msg). Raises RecordingError for a file that cannot be read.
    """
    from rosbags.typesys import Stores, TypesysError, get_types_from_msg, get_typestore

    for file in files:
        folder = file.resolve().parent
        package = folder.parent.name if folder.name == "msg" else folder.name
        name = next(
            (one for one in sorted(wanted) if one.rpartition("/")[2] == file.stem),
            f"{package}/msg/{file.stem}",
        )
        text = read_text("the message definition", file, error=RecordingError)
        try:
            register(store, get_types_from_msg(text, name))
        except TypesysError as error:
            raise RecordingError(
                f"{file} is not a message definition: {error}", remedy="give a .msg file of ROS"
            ) from error
    if files:
        register(store, get_typestore(Stores.LATEST).fielddefs)


def decoder(store: Any, connection: Connection) -> Callable[[bytes], Any]:
    """The function that makes messages of the data of a connection; it raises RecordingError.

    Raises RecordingError for an encoding that is not read and a type that is not defined.
    """
    import json

    topic, kind = connection.topic, connection.type
    if connection.encoding not in ("cdr", "ros1", "json"):
        raise RecordingError(
            f"messages of {topic} have an encoding that is not read",
            value=connection.encoding,
            limit="cdr, ros1 or json",
        )
    if connection.encoding != "json" and kind not in store.fielddefs:
        raise RecordingError(
            f"the bag does not define the message type of {topic}",
            value=kind,
            remedy="give its .msg file (--messages, or messages in the map)",
        )
    read = store.deserialize_cdr if connection.encoding == "cdr" else store.deserialize_ros1

    def decode(data: bytes) -> Any:
        try:
            return json.loads(data) if connection.encoding == "json" else read(data, kind)
        except Exception as error:  # what rosbags raises for data of another type is not documented
            raise RecordingError(
                f"a message of {topic} cannot be decoded as {kind or connection.encoding}",
                value=f"{type(error).__name__}, {len(data)} bytes",
                remedy="check that the .msg file is the one of the recording",
            ) from error

    return decode


class ScannedBag(Bag):
    """A bag whose records are read one by one, in the order of the file, up to a torn end."""

    def __init__(self, paths: Collection[Path], records: Any, files: Collection[Path]) -> None:
        self.paths, self.records = paths, records
        self.notes: list[str] = []
        self._by_key: dict[tuple[Path, int], Connection] = {}
        self.counts: dict[str, int] = {}
        for path, one in self._all():
            if isinstance(one, Connection):
                self._by_key[path, one.key] = one
                self.counts.setdefault(one.topic, 0)
            elif connection := self._by_key.get((path, one.key)):
                self.counts[connection.topic] += 1
        self.connections = {one.topic: one for one in self._by_key.values()}
        self.store = typestore(self._by_key.values(), files)

    def _all(self) -> Iterator[tuple[Path, Connection | Record]]:
        """Connections and messages; no message that is the last one before damage, whose data may
        be damaged, too."""
        self.notes.clear()
        for path in self.paths:
            last: Record | None = None
            try:
                for one in self.records(path):
                    if isinstance(one, Torn):
                        self.notes.append(
                            f"{path.name} is damaged: the {one} is left out from there"
                        )
                        last = None
                        continue
                    if last is not None:
                        yield path, last
                    last = one if isinstance(one, Record) else None
                    if last is None:
                        yield path, one
            except Torn as end:
                self.notes.append(f"{path.name} is torn {end}: {BEFORE_TEAR}")
            else:
                if last is not None:
                    yield path, last

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, int, bytes]]:
        """Topic, time of receipt (ns) and data of the messages of some topics."""
        for path, one in self._all():
            if isinstance(one, Record):
                connection = self._by_key.get((path, one.key))
                if connection is not None and connection.topic in topics:
                    yield connection.topic, one.time, one.data
