"""What a log holds: its streams of samples, their rates, spans and gaps."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import Array
from ..core.errors import RecordingError, UnknownNameError
from ..core.value import Value

JOINTS, TAXELS, WRENCH, POSE, CONTACTS = KINDS = ("joints", "taxels", "wrench", "pose", "contacts")
"""What a stream can be."""
GAP_PERIODS = 5.0
"""Median periods between two samples from which they have a gap between them: loaded computers
deliver samples up to about three periods late."""
MAX_LATE = 0.1
"""Time, s, by which a message may arrive after one that was stamped later: executors and networks
delay by some tens of ms, and clocks that are set back go back by more or are off by as little."""


class Gap(NamedTuple):
    """A time without samples, from the last sample before it to the first one after it, s."""

    start: float
    end: float


@dataclass(frozen=True, eq=False)
class Stream(Value):
    """Samples of one topic, port or group of columns.

    A stream that no map names holds the times alone: values (n, 0).
    """

    name: str
    """Name of the topic, port or group."""
    type: str
    """Type of the messages; empty for tables."""
    times: Array
    """Times (n,), s. Contacts repeat a time, one row each."""
    values: NDArray[np.number]
    """Values (n, k), in the number type of the messages."""
    fields: tuple[str, ...] = ()
    """Names of the k columns: of joints the joint, of taxels the id."""
    kind: str = ""
    """One of KINDS; empty without a map."""
    unit: str = ""
    """Unit of the values."""

    def __repr__(self) -> str:
        kind = f", {self.kind}" if self.kind else ""
        return f"<Stream {self.name}{kind}: {len(self)} samples of {len(self.fields)} values>"

    def __len__(self) -> int:
        return len(self.times)

    @property
    def span(self) -> tuple[float, float]:
        """Times of the first and the last sample, s; NaN for an empty stream."""
        if not len(self):
            return np.nan, np.nan
        return float(self.times.min()), float(self.times.max())

    @cached_property
    def _paced(self) -> Array:
        """Times, s, of the samples that recur: of joints in messages of their own, of one joint."""
        if self.kind != JOINTS or not self.values.size or np.isfinite(self.values).all():
            return self.times
        known = np.isfinite(self.values)
        return self.times[known[:, np.argmax(known.sum(axis=0))]]

    @cached_property
    def period(self) -> float:
        """Median time from one sample to the next that has another time, s; 0 for fewer than two
        times. Joints in messages of their own count as one."""
        steps = np.diff(self._paced)
        steps = steps[steps > 0]
        return float(np.median(steps)) if len(steps) else 0.0

    @property
    def rate(self) -> float:
        """Samples a second by the median period, 1/s; 0 for fewer than two times."""
        return 1.0 / self.period if self.period else 0.0

    @cached_property
    def gaps(self) -> tuple[Gap, ...]:
        """Times between samples that are longer than GAP_PERIODS periods; contacts have none."""
        if not self.period or self.kind == CONTACTS:
            return ()
        times = self._paced
        rows = np.flatnonzero(np.diff(times) > GAP_PERIODS * self.period)
        return tuple(Gap(float(times[k]), float(times[k + 1])) for k in rows)

    @property
    def backward(self) -> int | None:
        """Row of the first sample that is earlier than the one before it; None if there is none."""
        rows = np.flatnonzero(np.diff(self.times) < 0)
        return int(rows[0]) + 1 if len(rows) else None

    def check_times(self) -> None:
        """Raise RecordingError if there are no samples or the time runs backwards."""
        if not len(self):
            raise RecordingError(
                f"{self.name} has no samples", remedy="check the map and the length of the log"
            )
        if (row := self.backward) is not None:
            received = "/" in self.type  # lines and rows have no time of receipt
            raise RecordingError(
                f"the time of {self.name} runs backwards",
                value=f"{self.times[row]:.6f} s after {self.times[row - 1]:.6f} s in message {row}",
                remedy='take the time of receipt (time = "receipt" in the map), or cut the log'
                if received
                else "cut the log there",
            )


def in_order(stream: Stream) -> Stream:
    """The samples by their times, where none is more than MAX_LATE behind one before it: messages
    are recorded as they arrive. Others, of a clock that was set back, stay as they are."""
    if stream.backward is None or np.any(
        np.maximum.accumulate(stream.times) - stream.times > MAX_LATE
    ):
        return stream
    rows = np.argsort(stream.times, kind="stable")
    return replace(stream, times=stream.times[rows], values=stream.values[rows])


@dataclass(frozen=True)
class Log:
    """The streams of one log: those of a map in its order, or all of them."""

    path: Path
    """The file or folder."""
    streams: tuple[Stream, ...]
    notes: tuple[str, ...] = ()
    """What the reader has to say, such as where the file is torn."""

    def __repr__(self) -> str:
        return f"<Log {self.path.name}: {len(self.streams)} streams>"

    def __getitem__(self, name: str) -> Stream:
        """The stream of that name. Raises UnknownNameError with the nearest names."""
        for stream in self.streams:
            if stream.name == name:
                return stream
        raise UnknownNameError("stream", name, [stream.name for stream in self.streams])

    @property
    def gaps(self) -> dict[str, tuple[Gap, ...]]:
        """Gaps by the name of the stream."""
        return {stream.name: stream.gaps for stream in self.streams}

    @property
    def spans(self) -> dict[str, tuple[float, float]]:
        """Times of the first and last sample, s, by the name of the stream."""
        return {stream.name: stream.span for stream in self.streams}


def contact_fields(width: int) -> tuple[str, ...]:
    """Names of the columns of contacts with 3, 4, 6 or 7 values: point, normal, force."""
    names = ("px", "py", "pz", "nx", "ny", "nz", "force")
    return names[:width] if width != 4 else (*names[:3], "force")


def overlap(streams: Sequence[Stream]) -> tuple[float, float]:
    """The time, s, from which and to which all streams have samples.

    Raises RecordingError if there is none.
    """
    last_start = max(streams, key=lambda stream: stream.span[0])
    first_end = min(streams, key=lambda stream: stream.span[1])
    start, end = last_start.span[0], first_end.span[1]
    if not start < end:
        raise RecordingError(
            "streams of the log do not overlap in time",
            value=f"{last_start.name} from {start:.3f} s, {first_end.name} to {end:.3f} s",
            remedy="check the clocks: a known difference is delay_s in the map, the unit of a "
            "field of time is time_unit",
        )
    return start, end
