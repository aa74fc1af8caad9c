"""Bags with an index, read by rosbags."""

from __future__ import annotations

from collections.abc import Collection, Iterator
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Self

from ....core.errors import RecordingError
from .records import Bag, Connection, Torn, register_files

SUFFIXES = {"ros1": ".bag", "sqlite": ".db3", "mcap": ".mcap"}
"""Suffixes by which rosbags knows the formats."""


def require_rosbags(path: Path) -> None:
    """Raise RecordingError if the package rosbags is not installed."""
    try:
        import rosbags.highlevel  # noqa: F401
    except ImportError as error:
        raise RecordingError(
            f"{path.name} is a bag, which needs rosbags",
            remedy='pip install rosbags, or "meshskin[logs]"',
        ) from error


class IndexedBag(Bag):
    """A bag that rosbags opens, as a context manager.

    Opening and reading raise Torn where rosbags finds it damaged or does not know it.
    """

    def __init__(self, path: Path, format: str, files: Collection[Path]) -> None:
        self.path, self.format, self.files = path, format, files
        self.notes: list[str] = []
        self._stack = ExitStack()

    def __enter__(self) -> Self:
        from rosbags.highlevel import AnyReader
        from rosbags.typesys import Stores, get_typestore

        wanted = SUFFIXES.get(self.format, self.path.suffix)
        path = self.path
        with self._stack:
            if path.is_file() and path.suffix != wanted:
                folder = self._stack.enter_context(TemporaryDirectory())
                path = Path(folder) / f"log{wanted}"
                path.symlink_to(self.path.resolve())
            store = get_typestore(Stores.LATEST)
            register_files(store, self.files, ())
            try:
                self._reader = AnyReader([path], default_typestore=store)
                self._stack.enter_context(self._reader)
            except RecordingError:
                raise
            except Exception as error:  # which errors damaged files raise is not documented
                raise _torn(error) from error
            self.store = self._reader.typestore
            self._take_topics()
            register_files(self.store, self.files, self.types.values())
            self._stack = self._stack.pop_all()
        return self

    def _take_topics(self) -> None:
        encoding = "cdr" if self._reader.is2 else "ros1"
        self.counts, self.connections = {}, {}
        for one in self._reader.connections:
            if not (isinstance(one.topic, str) and isinstance(one.msgtype, str)):
                raise Torn("a topic has no name")
            self.counts[one.topic] = self.counts.get(one.topic, 0) + one.msgcount
            self.connections[one.topic] = Connection(0, one.topic, one.msgtype, encoding)

    def __exit__(self, *error: object) -> None:
        self._stack.close()

    def messages(self, topics: Collection[str]) -> Iterator[tuple[str, int, bytes]]:
        """Topic, time of receipt (ns) and data of the messages of some topics, by time."""
        chosen = [one for one in self._reader.connections if one.topic in topics]
        found = iter(self._reader.messages(chosen)) if chosen else iter(())
        while True:
            try:
                connection, time, data = next(found)
            except StopIteration:
                return
            except Exception as error:  # which errors damaged files raise is not documented
                raise _torn(error) from error
            if data is None:
                raise Torn("a message has no data")
            yield connection.topic, time, data


def _torn(error: Exception) -> Torn:
    return Torn(" ".join(str(error).split()) or type(error).__name__)
