"""Frames: the contacts at the times when the skin is read, which effects transform."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from ..core.arrays import Array

ClosestPoint = Callable[[Array], tuple[Array, Array]]
"""Centres of the indenter (k, 3), body frame, m -> closest points of the body (k, 3), m, and
outward normals (k, 3)."""

PressureField = Callable[["Frames", Array], Array]
"""(m frames, taxel poses (n, 4, 4) in the body frame) -> pressures (m, n), Pa."""

MAX_FRAME_GAP = 1.5
"""Time between two frames, in periods, above which the contact was lost between them: half a period
is left for jitter, and one missing frame makes two periods."""


@dataclass(frozen=True)
class Frames:
    """m consecutive contacts in the body frame, SI units."""

    time: Array
    """Times (m,), increasing, s."""
    points: Array
    """Contact points (m, 3), m."""
    normals: Array
    """Outward unit normals (m, 3)."""
    force: Array
    """Normal forces (m,), N."""
    centres: Array
    """Centres of the indenter (m, 3), m."""
    curvature: Array
    """Principal curvatures (m, 2), 1/m, positive where convex, larger first."""
    directions: Array
    """Unit tangents (m, 3) along the first principal direction."""
    q: Array
    """Configurations of the robot (m, k), see Context.pose."""
    closest_point: ClosestPoint
    """Computes a contact from the centre of the indenter."""

    def __len__(self) -> int:
        return len(self.time)

    def with_centres(self, centres: Array) -> Frames:
        """The contacts computed from other centres (m, 3) of the indenter, m."""
        points, normals = self.closest_point(centres)
        return replace(self, points=points, normals=normals, centres=centres)

    def rows(self, rows: Any) -> Frames:
        """Some of the frames: a slice, a mask or indices."""
        columns: dict[str, Any] = {name: getattr(self, name)[rows] for name in COLUMNS}
        return replace(self, **columns)

    def append(self, later: Frames) -> Frames:
        """These frames followed by `later` ones."""
        columns: dict[str, Any] = {
            name: np.concatenate([getattr(self, name), getattr(later, name)]) for name in COLUMNS
        }
        return replace(later, **columns)


COLUMNS = tuple(f.name for f in fields(Frames) if f.name != "closest_point")
"""Fields of Frames that are arrays with one row per frame."""


@dataclass
class EffectClock:
    """Time since the first run; the frames of each run have times that start at zero."""

    run_start: float = 0.0
    """Start of the present run, s."""
    last_time: float = 0.0
    """Time of the last frame so far, s."""

    def to_effect_time(self, frames: Frames) -> Frames:
        """The frames with times since the first run."""
        time = frames.time + self.run_start
        self.last_time = float(max(self.last_time, time.max(initial=0.0)))
        return replace(frames, time=time)


@dataclass
class FrameHistory:
    """The most recent frames of earlier batches, for effects that look back in time."""

    span: float
    """Longest time that an effect looks back, s."""
    period: float
    """Time between frames, s."""
    frames: Frames | None = field(default=None, init=False)

    def append(self, frames: Frames) -> None:
        """Add the next frames, and drop those that are too old; known frames are ignored."""
        if self.frames is not None and len(frames) and frames.time[-1] <= self.frames.time[-1]:
            return
        known = frames if self.frames is None else self.frames.append(frames)
        if len(frames):
            oldest = frames.time[0] - self.span - MAX_FRAME_GAP * self.period
            first = np.searchsorted(known.time, oldest)
            known = known.rows(slice(max(int(first) - 1, 0), None))
        self.frames = known

    def interpolate(self, time: Array) -> Frames:
        """The contacts at other times (k,), s, interpolated linearly between frames.

        Before the first contact, and where the contact was lost, the next frame is taken.
        """
        known = self.frames
        assert known is not None, "append must be called first"
        # a time that exceeds a frame's own time by rounding belongs to that frame
        after = np.searchsorted(known.time, time - 1e-6 * self.period)
        after = np.clip(after, 0, len(known) - 1)
        before = np.maximum(after - 1, 0)
        step = known.time[after] - known.time[before]
        use_next = (step > MAX_FRAME_GAP * self.period) | (step <= 0)
        part = np.where(use_next, 1.0, (time - known.time[before]) / np.where(use_next, 1.0, step))
        weight = np.clip(part, 0.0, 1.0)
        late, early = known.rows(after), known.rows(before)

        def blend(name: str) -> Array:
            a, b = getattr(early, name), getattr(late, name)
            return np.asarray(b + (1.0 - weight.reshape(-1, *[1] * (a.ndim - 1))) * (a - b))

        columns: dict[str, Any] = {name: blend(name) for name in COLUMNS}
        columns["normals"] /= np.linalg.norm(columns["normals"], axis=1)[:, None]
        columns["directions"] = _blend_directions(early, late, weight, columns["normals"])
        return replace(known, **columns | {"time": time})


def _blend_directions(early: Frames, late: Frames, weight: Array, normals: Array) -> Array:
    """Unit tangents (k, 3) between those of two frames, whose signs are arbitrary."""
    a, b = early.directions, late.directions
    a = np.where(np.einsum("kj,kj->k", a, b)[:, None] < 0.0, -a, a)
    between = b + (1.0 - weight)[:, None] * (a - b)
    between = between - np.einsum("kj,kj->k", between, normals)[:, None] * normals
    return np.asarray(between / np.linalg.norm(between, axis=1)[:, None])
