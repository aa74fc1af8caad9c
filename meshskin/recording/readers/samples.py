"""Rows of numbers taken from the messages of one topic, as the map says where they are."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from ...core.errors import MeshskinError, RecordingError
from .. import field_path
from ..log_map import RECEIPT, TIME_UNITS, StreamMap
from ..message_types import KNOWN, NAME_PATHS, default_paths, short
from ..stream import CONTACTS, JOINTS, POSE, TAXELS, WRENCH, Stream, contact_fields
from .column_names import split_unit

FIRST_ROWS = 1024
"""Rows allocated for a topic whose number of messages is unknown; they grow by half."""
NANO = 1e-9


def seconds(stamp: Any, path: str, unit: float = 1.0) -> float:
    """A ROS time stamp, or a number of times `unit`, s, as s. Raises RecordingError for anything
    else."""
    if hasattr(stamp, "nanosec"):
        return float(stamp.sec + NANO * stamp.nanosec)
    try:
        return float(stamp * unit)
    except (TypeError, ValueError) as error:
        raise RecordingError(f"the field {path} must be a time", value=repr(stamp)[:40]) from error


class Samples:
    """Times and values of one stream, row by row, in arrays that grow.

    Joints are sorted into columns by their names, of which every message may have others.
    """

    def __init__(self, stream: StreamMap, message_type: str, expected: int | None) -> None:
        self.map = stream
        self.type = message_type
        paths = stream.values or default_paths(message_type, stream.kind)
        if not paths:
            raise RecordingError(
                f"{stream.topic} has messages of the wrong type for {stream.kind}",
                value=message_type,
                remedy="correct kind, or say in values which fields hold the numbers",
            )
        known = KNOWN.get(short(message_type), ("",))[0]
        if stream.kind == JOINTS and known in (WRENCH, POSE, CONTACTS):
            raise RecordingError(
                f"{stream.topic} has messages of the wrong type for joints", value=message_type,
                remedy=f'write kind = "{known}" in the map, or remove the stream',
            )  # fmt: skip
        self.paths = [(path, field_path.getter(path)) for path in paths]
        self.selects = any(field_path.selects(path) for path in paths)
        heads = {field_path.parse(path)[0] for path in paths}
        self._lists = [name for name, inside in heads if inside == "[]" and stream.kind == TAXELS]
        self._sensors: dict[str, tuple[str, ...]] = {}
        self._sizes: tuple[int, ...] = ()
        self.count = self.messages = 0
        self.empty = 0
        """Messages of joints or taxels without any, which are left out."""
        self.expected = expected
        self.times = np.empty(expected or FIRST_ROWS)
        self.values = np.empty((0, 0))
        self.fields: list[str] = []
        self._columns: dict[tuple[str, ...], np.ndarray] = {}
        self._time = None if stream.time in ("", RECEIPT) else field_path.getter(stream.time)
        unit = split_unit(stream.time.rpartition(".")[2])[1]
        self._time_unit = TIME_UNITS.get(unit, TIME_UNITS[stream.time_unit])
        self._header = stream.time == ""
        self._names: field_path.Getter | None = None
        self._plain: Callable[[Any], Any] | None = None

    def add(self, message: Any, receipt: int) -> None:
        """Append the numbers of a message received at `receipt`, ns.

        Raises RecordingError or ConfigError, naming the message, if they are not what the map says.
        """
        try:
            if self._plain is not None:
                row = self._plain(message)
            else:
                for name in self._lists:
                    self._order_sensors(message, name)
                parts = [field_path.numbers(get(message), path) for path, get in self.paths]
                if self.selects and not any(map(len, parts)):
                    return
                self._check_selected(tuple(map(len, parts)))
                row = parts[0] if len(parts) == 1 else np.concatenate(parts)
            if not len(row) and self.map.kind in (JOINTS, TAXELS):
                self.empty += 1  # a state of velocities alone, a sensor that has not started
                return
            time = self._when(message, receipt)
        except MeshskinError as error:
            raise RecordingError(
                f"message {self.messages} of {self.map.topic}, a {self.type}: {error}"
            ) from error
        if self.map.kind == CONTACTS:
            self._add_contacts(parts, time)
        elif self.map.kind == JOINTS:
            self._add_joints(message, row, time)
        else:
            self._append(row, time)
        if not self.messages and self.map.kind != CONTACTS:
            self._plain = field_path.plain_getter([path for path, _ in self.paths], message)
        self.messages += 1

    def _order_sensors(self, message: Any, name: str) -> None:
        """Put the elements of a list that have names into the order of the first message.

        Raises RecordingError for other names than there.
        """
        every = message[name] if isinstance(message, dict) else getattr(message, name, ())
        labels = tuple(
            str(part.get("name", "") if isinstance(part, dict) else getattr(part, "name", ""))
            for part in every
        )
        first = self._sensors.setdefault(name, labels)
        if labels == first or len(set(first)) < len(first):
            return
        if sorted(labels) != sorted(first):
            raise RecordingError(
                f"{name} has other elements than in the messages before",
                value=", ".join(labels), limit=", ".join(first),
                remedy=f'map one of them at a time: values = ["{name}[name={first[0]}]. ..."]',
            )  # fmt: skip
        ordered = [every[labels.index(label)] for label in first]
        if isinstance(message, dict):
            message[name] = ordered
        else:
            setattr(message, name, ordered)

    def _check_selected(self, sizes: tuple[int, ...]) -> None:
        """Raise RecordingError where paths that select elements find other ones than before."""
        self._sizes = self._sizes or sizes
        if self.selects and self.map.kind != CONTACTS and sizes != self._sizes:
            paths = ", ".join(path for path, _ in self.paths)
            raise RecordingError(
                f"{paths} find other numbers of values than before", value=sizes, limit=self._sizes,
                remedy="map one of them at a time, or leave out what is not in every message",
            )  # fmt: skip

    def _when(self, message: Any, receipt: int) -> float:
        if self._time is not None:
            found = self._time(message)
            if len(found) != 1:
                raise RecordingError("the time of a message must be one", value=f"{len(found)}")
            return seconds(found[0], self.map.time, self._time_unit)
        if self._header and (header := getattr(message, "header", None)) is not None:
            stamp = seconds(header.stamp, "header.stamp")
            if self.messages == 0 and stamp == 0.0:
                self._header = False  # the publisher does not fill it in
            else:
                return stamp
        return NANO * receipt

    def _add_contacts(self, parts: list[np.ndarray], time: float) -> None:
        """One row for each contact of the message."""
        lengths = {path: len(part) for part, (path, _) in zip(parts, self.paths, strict=True)}
        if len(set(lengths.values())) > 1:
            raise RecordingError(
                f"message {self.messages} of {self.map.topic} has columns of different lengths",
                value=", ".join(f"{count} of {path}" for path, count in lengths.items()),
            )
        for row in zip(*parts, strict=True):
            self._append(np.array(row), time)

    def _add_joints(self, message: Any, values: np.ndarray, time: float) -> None:
        names = self._joint_names(message, len(values))
        self.map.check_length(len(values), self.messages)
        if names not in self._columns or len(names) != len(values):
            if len(names) != len(values) or len(set(names)) < len(names) or "" in names:
                known = {*names} - {""}
                raise RecordingError(
                    f"message {self.messages} of {self.map.topic} needs one name for each joint",
                    value=f"{len(names)} names, {len(known)} of them different",
                    limit=f"{len(values)} positions",
                    remedy="remove the message from the log"
                    if self.messages
                    else "give the names of the joints in names",
                )
            new = [name for name in names if name not in self.fields]
            self.fields += new
            wider = np.full((len(self.times), len(self.fields)), np.nan)
            wider[: self.count, : self.values.shape[1]] = self.values[: self.count]
            self.values = wider
            self._columns[names] = np.array([self.fields.index(name) for name in names])
        self._grow()
        self.values[self.count] = np.nan
        self.values[self.count, self._columns[names]] = values
        self.times[self.count] = time
        self.count += 1

    def _joint_names(self, message: Any, count: int) -> tuple[str, ...]:
        """The names of the joints of a message: of the map, of a field, or numbers."""
        given = self.map.names or tuple(filter(None, [NAME_PATHS.get(short(self.type))]))
        if not self.messages and len(given) == 1:
            top = field_path.parse(given[0])[0][0]
            if top in field_path.fields(message):
                self._names = field_path.getter(given[0])
        if self._names is not None:
            found = self._names(message)
            return tuple(found if isinstance(found[0], str) else found[0]) if found else ()
        return given or tuple(f"joint_{k}" for k in range(count))

    def _append(self, row: Any, time: float) -> None:
        if not len(row):
            raise RecordingError(
                f"message {self.messages} of {self.map.topic} holds no values",
                remedy="correct the field paths in values",
            )
        if not self.count:
            self.map.check_length(len(row), self.messages)
            self.values = np.empty((len(self.times), len(row)), row.dtype)
            self.fields = list(self._labels(len(row)))
        elif len(row) != (before := self.values.shape[1]):
            path = self.paths[0][0]
            alone = len(self.paths) == 1 and "[" not in path
            path = f"{path}[:{min(before, len(row))}]" if alone else "sensors[0].values"
            raise RecordingError(
                f"message {self.messages} of {self.map.topic} has another length than those before",
                value=f"{len(row)} values",
                limit=f"{before} values",
                remedy=f"give a field path whose length does not change, such as {path}, and that "
                "length",
            )
        self._grow()
        self.values[self.count] = row
        self.times[self.count] = time
        self.count += 1

    def _labels(self, count: int) -> tuple[str, ...]:
        """Names of the columns: ids of taxels, the ends of the paths, or numbers."""
        if self.map.kind == TAXELS:
            return self.map.taxel_ids(count)
        if self.map.kind == CONTACTS:
            return contact_fields(count)
        if len(self.paths) == count:
            return tuple(".".join(path.split(".")[-2:]) for path, _ in self.paths)
        return tuple(map(str, range(count)))

    def _grow(self) -> None:
        if self.count == len(self.times):
            rows = max(FIRST_ROWS, 3 * self.count // 2)
            self.times = np.resize(self.times, rows)
            wider = np.empty((rows, self.values.shape[1]), self.values.dtype)
            wider[: self.count] = self.values[: self.count]
            self.values = wider

    def stream(self) -> Stream:
        """What was appended. Raises RecordingError if all messages were empty."""
        if self.empty and not self.count:
            raise RecordingError(
                f"message 0 of {self.map.topic} holds no values, nor do others",
                value=f"{self.empty} messages",
                remedy="correct the field paths in values",
            )
        return Stream(
            self.map.topic,
            self.type,
            self.times[: self.count],
            self.values[: self.count],
            tuple(self.fields),
            self.map.kind,
            self.map.unit or self.map.si_unit,
        )
