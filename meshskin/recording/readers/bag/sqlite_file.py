"""Records of a ROS 2 bag in SQLite, one by one: of a database that is torn."""

from __future__ import annotations

import shutil
import sqlite3
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

from .records import IDL, MSG, UNDEFINED, Connection, Record, Torn

MAGIC = b"SQLite format 3\0"
PAGE_SIZE_AT, LARGEST_PAGE = 16, 65536
"""Where the header has the size of a page, 2 bytes, and what a size of 1 means."""
FORMATS = {"ros2msg": MSG, "ros2idl": IDL}
"""Format of definitions by their encoding."""


def records(path: Path) -> Iterator[Connection | Record]:
    """Connections and messages in the order of recording. Raises Torn where the file is damaged."""
    count = 0
    with _whole_pages(path) as file, closing(_open(file)) as database:
        try:
            # SQLite opens a file that is shorter than its header says with this setting only
            database.execute("PRAGMA writable_schema = ON")
            definitions = _definitions(database)
            for key, topic, kind, encoding in database.execute(
                "SELECT id, name, type, serialization_format FROM topics"
            ):
                if None in (topic, kind, encoding):
                    raise sqlite3.DatabaseError("a topic has no name")
                yield Connection(key, topic, kind, encoding, *definitions.get(kind, ()))
            for key, time, data in database.execute(
                "SELECT topic_id, timestamp, data FROM messages NOT INDEXED"
            ):
                if None in (key, time, data):
                    raise sqlite3.DatabaseError("a message has no data")
                yield Record(key, time, data)
                count += 1
        except sqlite3.DatabaseError as error:
            raise Torn(f"after message {count} ({error})") from error


def _open(path: Path) -> sqlite3.Connection:
    return sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro&immutable=1", uri=True)


@contextmanager
def _whole_pages(path: Path) -> Iterator[Path]:
    """The file, or a copy without its last page if that is torn: SQLite would take the missing
    bytes for zeros, and so read wrong messages."""
    with path.open("rb") as source:
        source.seek(PAGE_SIZE_AT)
        page = int.from_bytes(source.read(2), "big")
        page = LARGEST_PAGE if page == 1 else page
        excess = path.stat().st_size % page if page else 0
        if not excess:
            yield path
            return
        with TemporaryDirectory() as folder:
            copy = Path(folder) / "whole.db3"
            source.seek(0)
            with copy.open("wb") as target:
                shutil.copyfileobj(source, target)
                target.truncate(path.stat().st_size - excess)
            yield copy


def _definitions(database: sqlite3.Connection) -> dict[str, tuple[str, str]]:
    """Definition and its format by message type; bags before ROS 2 Iron have none."""
    query = "SELECT topic_type, encoded_message_definition, encoding FROM message_definitions"
    try:
        found = list(database.execute(query))
    except sqlite3.OperationalError:
        return {}
    return {kind: (text, FORMATS.get(encoding, UNDEFINED)) for kind, text, encoding in found}
