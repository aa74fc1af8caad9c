"""Frames: the contacts at the times when the skin is read, as effects see and change them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np

from ..core.se3 import Array

ClosestPoint = Callable[[Array], tuple[Array, Array]]
"""Centres of the indenter (k, 3), body frame -> foot points on the body (k, 3), outward normals
(k, 3)."""

PressureField = Callable[["Frames", Array], Array]
"""(frames (m), taxel poses (n, 4, 4) in the body frame) -> pressures (m, n), Pa."""


@dataclass(frozen=True)
class Frames:
    """m consecutive contacts in the body frame, SI units."""

    time: Array
    """(m,), increasing."""
    points: Array
    """Contact points (m, 3)."""
    normals: Array
    """Outward normals (m, 3)."""
    force: Array
    """Normal forces (m,)."""
    centres: Array
    """The indenter's centre (m, 3)."""
    curvature: Array
    """Principal curvatures (m, 2), positive where convex, larger first."""
    directions: Array
    """Unit tangents (m, 3) along the first of them."""
    q: Array
    """The robot's configuration (m, k), see Context.pose."""
    foot: ClosestPoint
    """How a contact follows from the indenter's centre."""

    def __len__(self) -> int:
        return len(self.time)

    def moved(self, centres: Array) -> Frames:
        """The contacts that one infers from other centres (m, 3) of the indenter."""
        points, normals = self.foot(centres)
        return replace(self, points=points, normals=normals, centres=centres)

    def rows(self, rows: Any) -> Frames:
        """Some of the frames: a slice, a mask or indices."""
        return self._with({name: getattr(self, name)[rows] for name in COLUMNS})

    def _with(self, columns: dict[str, Any]) -> Frames:
        return replace(self, **columns)

    def followed_by(self, later: Frames) -> Frames:
        """These frames and later ones."""
        columns = {
            name: np.concatenate([getattr(self, name), getattr(later, name)]) for name in COLUMNS
        }
        return later._with(columns)


COLUMNS = tuple(f.name for f in fields(Frames) if f.name != "foot")


@dataclass
class EffectClock:
    """The time that effects live in, over runs whose own times all begin anew."""

    start: float = 0.0
    """Of the present run, s."""
    now: float = 0.0
    """Of the last frame so far, s."""

    def to_effect_time(self, frames: Frames) -> Frames:
        """The frames in the effects' time."""
        time = frames.time + self.start
        self.now = float(max(self.now, time.max(initial=0.0)))
        return replace(frames, time=time)


@dataclass
class FrameHistory:
    """The last frames of the batches before, so that one may look back over a seam."""

    span: float
    """How far back one looks, s."""
    period: float
    """Time between frames, s: where more lies between two, the contact was lost."""
    known: Frames | None = field(default=None, init=False)

    def extend(self, frames: Frames) -> None:
        """Take the next frames (once more is no harm), and forget what will not be asked for."""
        if self.known is not None and len(frames) and frames.time[-1] <= self.known.time[-1]:
            return
        known = frames if self.known is None else self.known.followed_by(frames)
        if len(frames):
            first = np.searchsorted(known.time, frames.time[0] - self.span - 1.5 * self.period)
            known = known.rows(slice(max(int(first) - 1, 0), None))
        self.known = known

    def at(self, time: Array) -> Frames:
        """The contacts at other times (k,), interpolated linearly between frames.

        Before the first contact, and where the contact was lost, the next one is taken.
        """
        known = self.known
        assert known is not None, "extend comes first"
        # a time that is a frame's own but for rounding is not after it
        after = np.searchsorted(known.time, time - 1e-6 * self.period)
        after = np.clip(after, 0, len(known) - 1)
        before = np.maximum(after - 1, 0)
        step = known.time[after] - known.time[before]
        whole = (step > 1.5 * self.period) | (step <= 0)
        part = np.where(whole, 1.0, (time - known.time[before]) / np.where(whole, 1.0, step))
        late, early = known.rows(after), known.rows(before)

        def blend(name: str) -> Array:
            a, b = getattr(early, name), getattr(late, name)
            weight = np.clip(part, 0.0, 1.0).reshape(-1, *[1] * (a.ndim - 1))
            return np.asarray(b + (1.0 - weight) * (a - b))

        columns = {name: blend(name) for name in COLUMNS}
        columns["normals"] /= np.linalg.norm(columns["normals"], axis=1)[:, None]
        columns["directions"] = _blended(early, late, np.clip(part, 0.0, 1.0), columns["normals"])
        return known._with(columns | {"time": time})


def _blended(early: Frames, late: Frames, part: Array, normals: Array) -> Array:
    """Unit tangents (k, 3) between those of two frames, which are known but for their sign."""
    a, b = early.directions, late.directions
    a = np.where(np.einsum("kj,kj->k", a, b)[:, None] < 0.0, -a, a)
    between = b + (1.0 - part)[:, None] * (a - b)
    between = between - np.einsum("kj,kj->k", between, normals)[:, None] * normals
    return np.asarray(between / np.linalg.norm(between, axis=1)[:, None])
