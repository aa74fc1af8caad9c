"""The map of a log: which topic holds what, in a TOML file.

    messages = ["tactile_msgs/msg/TactileState.msg"]   # definitions that the bag lacks

    [[stream]]
    topic = "/skin"
    kind = "taxels"
    values = ["data"]
    length = 97
    unit = "count"

Keys are those of `StreamMap`; quantities end in their unit (delay_ms).
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from ..core.arguments import check_integer, check_name, check_path, check_type
from ..core.arrays import Array
from ..core.config import UNITS as SI_UNITS
from ..core.config import check_fields, check_table, from_table, quantity, read_toml, to_table
from ..core.errors import ConfigError, UnknownNameError
from . import field_path
from .stream import CONTACTS, JOINTS, KINDS, POSE, TAXELS, WRENCH, Stream

RECEIPT = "receipt"
"""Value of `time` that takes the time at which the recorder received a message."""
UNITS: dict[str, dict[str, float]] = {
    JOINTS: {"rad": 1.0, "deg": np.pi / 180.0},
    TAXELS: {"count": 1.0, "Pa": 1.0, "kPa": 1e3},
    WRENCH: {"N": 1.0},
    POSE: {"m": 1.0, "mm": 1e-3},
    CONTACTS: {"m": 1.0, "mm": 1e-3},
}
"""Units of the values by kind, with the factor to SI; the first is the default."""
WIDTHS: dict[str, tuple[int, ...]] = {WRENCH: (3, 6), POSE: (7,), CONTACTS: (3, 4, 6, 7)}
"""Lengths that the values of a kind can have."""
WORDS = {
    WRENCH: "force x y z, and torque x y z",
    POSE: "position x y z and quaternion x y z w",
    CONTACTS: "contact point x y z, outward normal x y z where known, and force where known",
}
"""What the values of a kind are, for error messages."""
TIME_UNITS = SI_UNITS["s"] | {"ns": 1e-9}
"""Units of time by name, s."""
POLARITIES = AUTO, RISING, FALLING = ("auto", "rising", "falling")
"""Whether readings rise or fall under pressure; "auto" finds out."""
CONTACT, BODY = POSES = ("contact", "body")
"""What a stream of poses is the pose of."""


@dataclass(frozen=True)
class StreamMap:
    """What one topic is, and where its numbers are."""

    topic: str
    """Name of the topic, port or group of columns."""
    kind: str
    """joints, taxels, wrench, pose or contacts."""
    values: tuple[str, ...] = ()
    """Field paths of the numbers, or columns of a table (* stands for any text); empty: those of
    the message type."""
    names: tuple[str, ...] = ()
    """Joints: their names, or the field path of them in every message; empty: that of the type."""
    length: int | None = None
    """How many numbers a message holds; None: as many as the first one."""
    unit: str = ""
    """Unit of the numbers; empty: rad, count, N or m by kind."""
    time: str = ""
    """Field path of the time, or column of a table; "receipt": when the recorder received it;
    empty: header.stamp where there is one."""
    time_unit: str = "s"
    """Unit of times that are numbers where the name of the field or column has none: s, ms, us or
    ns."""
    delay: float | None = quantity("s", None, least=-60.0, most=60.0)
    """How late the times are against the clock of the robot; None: 0; of taxels, and of
    contacts that are computed from them, that of the first taxels, which is estimated."""
    first_id: int = 0
    """Taxels: id of the first one."""
    ids: tuple[int, ...] = ()
    """Taxels: their ids, where they are not consecutive."""
    polarity: str = AUTO
    """Taxels: whether readings rise or fall under pressure."""
    of: str = CONTACT
    """Pose: of the contact frame, with the origin at the contact point, or of the body."""
    point: tuple[float, float, float] = quantity("m", (0.0, 0.0, 0.0))
    """Pose: contact point in the frame of the pose."""
    axis: tuple[float, float, float] | None = quantity("", None)
    """Pose: outward normal of the body in the frame of the pose, z by default. Wrench: direction of
    the contact force in the frame of the sensor; without one its magnitude is taken."""
    sliding: tuple[str, ...] = ()
    """Joints: names of those that slide, whose values are in m, not in `unit`."""

    def __post_init__(self) -> None:
        check_name("kind of a stream", self.kind, KINDS)
        check_name(f"unit of {self.kind}", self.unit or self.si_unit, list(UNITS[self.kind]))
        check_name("polarity", self.polarity, POLARITIES)
        check_name("pose", self.of, POSES)
        check_name("unit of time", self.time_unit, list(TIME_UNITS))
        check_fields(self)
        if self.axis is not None and not any(self.axis):
            raise ConfigError(f"axis of {self.topic} must not be zero", value=self.axis)
        for name, number in (("length", self.length), ("first_id", self.first_id)):
            if number is not None:
                check_integer(f"{name} of {self.topic}", number, least=int(name == "length"))
        for number in self.ids:
            check_integer(f"ids of {self.topic}", number, least=0)

    @property
    def si_unit(self) -> str:
        """Unit of the values after `factor` is applied."""
        return next(iter(UNITS[self.kind]))

    @property
    def factor(self) -> float:
        """SI units, or counts, per unit of the values."""
        return UNITS[self.kind][self.unit or self.si_unit]

    def factors(self, names: Sequence[str]) -> Array:
        """`factor` of each of the values of these names; 1 for joints that slide.

        Raises UnknownNameError for a joint of `sliding` that is not among them.
        """
        for name in self.sliding:
            check_name(f"joint of {self.topic}", name, names)
        return np.array([1.0 if name in self.sliding else self.factor for name in names])

    def check_length(self, found: int, message: int) -> None:
        """Raise ConfigError unless a message may hold `found` values."""
        widths = WIDTHS.get(self.kind)
        if self.length is not None and found != self.length:
            raise ConfigError(
                f"message {message} of {self.topic} has another length than the map says",
                value=f"{found} values",
                limit=f"length = {self.length}",
                remedy="correct length, or the field path in values",
            )
        if widths is not None and found not in widths:
            raise ConfigError(
                f"message {message} of {self.topic} cannot be a {self.kind}",
                value=f"{found} values",
                limit=f"{' or '.join(map(str, widths))}: {WORDS[self.kind]}",
                remedy="correct kind, or the field paths in values",
            )

    def taxel_ids(self, count: int) -> tuple[str, ...]:
        """The ids of `count` taxels as texts. Raises ConfigError if the map has another number."""
        if self.ids and len(self.ids) != count:
            raise ConfigError(
                f"ids of {self.topic} must be one for each taxel",
                value=f"{len(self.ids)} ids",
                limit=f"{count} values in a message",
            )
        return tuple(map(str, self.ids or range(self.first_id, self.first_id + count)))


Pairs = list[tuple[Stream, StreamMap]]
"""Streams of a log with their maps."""


@dataclass(frozen=True)
class LogMap:
    """The streams of a log that are used, and the message definitions that it lacks."""

    streams: tuple[StreamMap, ...]
    """The streams, at least one; `kind`, `topic` and the other keys of [[stream]]."""
    messages: tuple[Path, ...] = ()
    """.msg files."""

    def __post_init__(self) -> None:
        if not self.streams:
            raise ConfigError("the map names no stream", remedy="add a table [[stream]]")
        for stream in self.streams:
            check_type(StreamMap, stream, "each stream of a map")

    @classmethod
    def load(cls, path: str | Path) -> LogMap:
        """Read a map file. Raises ConfigError, UnknownNameError for keys that do not exist."""
        path = check_path("a map file", path)
        table = read_toml(path)
        for key in table:
            if key not in ("messages", "stream"):
                raise UnknownNameError("key", key, ("messages", "stream"), f" in {path.name}")
        tables, messages = table.get("stream", []), table.get("messages", [])
        if not isinstance(tables, list):
            raise ConfigError("stream must be a list of tables", remedy="write [[stream]]")
        if not isinstance(messages, list) or not all(isinstance(m, str) for m in messages):
            raise ConfigError("messages must be a list of .msg files", value=messages)
        return cls(
            tuple(_stream(entry, k) for k, entry in enumerate(tables)),
            tuple(path.parent / name for name in messages),
        )

    def of(self, kind: str) -> tuple[StreamMap, ...]:
        """The streams of a kind."""
        return tuple(stream for stream in self.streams if stream.kind == kind)

    def to_toml(self) -> str:
        """The map as a TOML file."""
        lines = [f"messages = {json.dumps([str(m) for m in self.messages])}", ""]
        for stream in self.streams:
            lines += ["[[stream]]", *_lines(stream), ""]
        return "\n".join(lines)


def _stream(entry: Any, number: int) -> StreamMap:
    where = f"stream {number + 1}"
    check_table(entry, where)
    if isinstance(entry, Mapping) and "topic" in entry:
        where = f"stream {entry['topic']}"
    stream = from_table(StreamMap, entry, where)
    for path in stream.values:
        if re.fullmatch(r"[\w.\[\]]+", path):  # others may be columns, such as q 1 [deg]
            field_path.parse(path)
    return stream


def _lines(stream: StreamMap) -> list[str]:
    """Lines of TOML of what differs from the defaults, and the unit."""
    usual = {k: v for k, v in to_table(StreamMap("", stream.kind)).items() if k != "kind"}
    written = to_table(replace(stream, unit=stream.unit or stream.si_unit)).items()
    return [f"{k} = {json.dumps(v, ensure_ascii=False)}" for k, v in written if v != usual.get(k)]
