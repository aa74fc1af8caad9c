"""The exploration path: poses of the body over the indenter at every step, and the plan around it.

A path consists of segments. Within a segment the contact point slides over the skin; between two
segments the body is lifted off. Each segment of an arm starts from a stated posture.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from pathlib import Path as FilePath
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from ..core.arrays import Array
from ..core.atomic_io import atomic
from ..core.errors import ConfigError
from ..core.notebook import Card, Tabular
from ..core.se3 import log_so3
from ..core.value import Value
from ..geometry.body import Body
from ..scene.scene import Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

ROWS = ("points", "normals", "poses", "twists", "faces")
"""Fields of a path with one row per sample."""
SEGMENT_ROWS = ("postures", "forces")
"""Fields of a path with one row per segment."""


@dataclass(frozen=True, eq=False)
class Path(Value):
    """A path of the body over the indenter, sampled every `dt`."""

    dt: float
    """Sampling period, s."""
    points: Array
    """Contact points (k, 3), body frame, m."""
    normals: Array
    """Outward normals (k, 3) at the contact points, body frame."""
    poses: Array
    """T_w_b (k, 4, 4) at the reference depth."""
    twists: Array
    """Velocity of the body's origin (m/s) and angular velocity (rad/s), (k, 6), world frame."""
    faces: NDArray[np.intp]
    """Mesh face (k,) at each contact point."""
    breaks: tuple[int, ...] = ()
    """First row of every segment but the first, in order."""
    postures: Array | None = None
    """Joint angles (len(breaks) + 1, n) at the first pose of each segment, rad; None: no arm."""
    forces: Array | None = None
    """Reference force (len(breaks) + 1,) of each segment, N; None: that of the scene's law."""
    unreachable: Mapping[int, str] = field(default_factory=dict)
    """Reason for each taxel (by id) that the path leaves out."""

    @classmethod
    def concatenate(cls, segments: Sequence[Path], force_reference: float | None = None) -> Path:
        """The path that follows the segments one after the other.

        force_reference, N: that of the law, for the segments without `forces` where others have
        some. Raises ConfigError where it is needed and not given.
        """
        postures = _joined([s.postures for s in segments])
        own = sum(s.forces is not None for s in segments)
        if 0 < own < len(segments):
            if force_reference is None:
                raise ConfigError(
                    "some segments have forces of their own, others that of the law",
                    value=f"{len(segments) - own} of {len(segments)} with forces = None",
                    remedy="give force_reference=scene.law.force_reference",
                )
            segments = [s.with_forces(force_reference) for s in segments]
        forces = _joined([s.forces for s in segments])
        breaks = tuple(np.cumsum([len(s.points) for s in segments])[:-1].tolist())
        rows: dict[str, Any] = {
            name: np.concatenate([getattr(s, name) for s in segments]) for name in ROWS
        }
        return cls(segments[0].dt, **rows, breaks=breaks, postures=postures, forces=forces)

    def with_forces(self, force_reference: float) -> Path:
        """The path with forces of its own: where it has none, this one, N, in every segment."""
        if self.forces is not None:
            return self
        return replace(self, forces=np.full(len(self.breaks) + 1, force_reference))

    @property
    def segments(self) -> list[Path]:
        """The segments, each as a path."""
        found = []
        for k, (first, last) in enumerate(pairwise([0, *self.breaks, len(self.points)])):
            rows = self._rows(slice(first, last)) | self._of_segments(slice(k, k + 1))
            found.append(Path(self.dt, **rows))
        return found

    def _rows(self, rows: slice) -> dict[str, Any]:
        """Some rows of the fields that have one per sample."""
        return {name: getattr(self, name)[rows] for name in ROWS}

    def _of_segments(self, rows: slice) -> dict[str, Any]:
        """The fields of SEGMENT_ROWS of some segments."""
        fields = {name: getattr(self, name) for name in SEGMENT_ROWS}
        return {name: None if value is None else value[rows] for name, value in fields.items()}

    def truncated(self, count: int) -> Path:
        """The path's first `count` rows."""
        breaks = tuple(row for row in self.breaks if row < count)
        rows = self._rows(slice(count)) | self._of_segments(slice(len(breaks) + 1))
        return replace(self, **rows, breaks=breaks)

    def resampled(self, dt: float, body: Body) -> Path:
        """The path at a period `dt`, s, a multiple of its own.

        Every segment keeps its first row and each row `dt` later; the faces are those of `body`,
        which may be another mesh of the same surface.
        """
        segments = []
        for segment in self.segments:
            rows = segment._rows(slice(None, None, round(dt / self.dt)))
            rows["twists"] = body_twists(rows["poses"], dt)
            rows["faces"] = body.closest(rows["points"]).face
            segments.append(replace(segment, dt=dt, **rows))
        return Path.concatenate(segments)

    @property
    def references(self) -> Array:
        """Inputs (k, 18) of the step function: position, rotation by columns, twist."""
        r = self.poses[:, :3, :3].transpose(0, 2, 1).reshape(-1, 9)
        return np.concatenate([self.poses[:, :3, 3], r, self.twists], axis=1)


@dataclass(frozen=True, eq=False)
class Plan(Value, Card, Tabular):
    """An exploration: its path, and what was assumed. `simulate(scene, path=plan.path)` runs it."""

    path: Path
    spacing: float
    """Distance between lanes, m."""
    notes: tuple[str, ...] = ()
    """Simplifications of the collision check: links without a readable mesh, and links that were
    taken for a part of the mount; and what would reach more taxels: another indenter, or more
    contacts."""
    contacts: pa.Table | None = None
    """The contacts to press with a carried indenter, see `contact_plan`; None: the body moves."""

    def __repr__(self) -> str:
        path, left_out = self.path, len(self.path.unreachable)
        apart = f"{1e3 * self.spacing:.4g} mm apart"
        what = f"{len(path.points)} contacts to press, {apart}"
        if self.contacts is None:
            sliding = f"{path.dt * len(path.points):.4g} s of sliding"
            parts = len(path.breaks) + 1
            what = f"{parts} segment{'s' * (parts > 1)}, {sliding}, lanes {apart}"
        return f"<Plan: {what}, {left_out} taxel{'s' * (left_out != 1)} left out>"

    def facts(self) -> dict[str, str]:
        """Segments or contacts, time, what is left out and why, for a notebook."""
        path, apart = self.path, f"{1e3 * self.spacing:.4g} mm apart"
        if self.contacts is not None:
            facts = {"contacts": f"{len(path.points)} to press, {apart}"}
        else:
            facts = {"segments": str(len(path.breaks) + 1), "lanes": apart}
            facts["sliding"] = f"{path.dt * len(path.points):.4g} s"
        lost = "; ".join(
            f"{count}: {why}" for why, count in Counter(path.unreachable.values()).most_common()
        )
        facts["taxels left out"] = lost or "none"
        return facts | ({"notes": "; ".join(self.notes)} if self.notes else {})

    def plot(self, ax: Axes | None = None) -> Figure:
        """Draw the contact points, coloured by their order in time, or as a list.

        ax: matplotlib axes; None: those of a new figure.
        """
        from ..core import drawing

        rows = np.arange(float(len(self.path.points)))
        return drawing.solid(
            ax,
            toward=drawing.front(self.path.normals),
            points=self.path.points,
            normals=self.path.normals,
            values=rows * self.path.dt if self.contacts is None else rows,
            label="time on the path (s)" if self.contacts is None else "contact",
            title=f"{len(self.unreachable)} taxels left out",
        )

    def to_arrow(self) -> pa.Table:
        """The contacts to press, or the path: segment, px, py, pz (m), nx, ny, nz a sample, and
        force (N) where some segments are pressed lighter than others."""
        if self.contacts is not None:
            return self.contacts
        rows = np.arange(len(self.path.points))
        numbers = np.column_stack([self.path.points, self.path.normals])
        names = ("px", "py", "pz", "nx", "ny", "nz")
        segment = np.searchsorted(self.path.breaks, rows, side="right")
        columns = {"segment": segment, **dict(zip(names, numbers.T, strict=True))}
        if self.path.forces is not None:
            columns["force"] = self.path.forces[segment]
        return pa.table(columns)

    def save_contacts(self, path: str | FilePath) -> None:
        """Write the contacts as CSV. Raises ConfigError where the plan moves the body."""
        from pyarrow import csv

        if self.contacts is None:
            raise ConfigError(
                "the plan has no list of contacts: it moves the body over a fixed indenter",
                remedy='plan with Indenter(carried_by="hand")',
            )
        with atomic(path) as temporary:
            csv.write_csv(self.contacts, temporary)

    @property
    def unreachable(self) -> Mapping[int, str]:
        """Reason for each taxel (by id) that the path leaves out."""
        return self.path.unreachable

    @property
    def segments(self) -> list[Path]:
        """The path's segments."""
        return self.path.segments

    @property
    def headings(self) -> Array:
        """R_w_b (k, 3, 3) along the path."""
        return self.path.poses[:, :3, :3]


def _joined(parts: list[Array | None]) -> Array | None:
    """The rows of all parts; None where one is None."""
    known = [part for part in parts if part is not None]
    return np.concatenate(known) if len(known) == len(parts) else None


def time_scaling(cruise: float, ramp: float, dt: float) -> Array:
    """Fractions (k,) of an arc length, every `dt`, s, with half-cosine ramps of speed at both ends.

    The length takes `cruise` s at full speed; each ramp takes `ramp` s.
    """
    total = max(cruise, 1e-9) + ramp
    count = max(int(np.ceil(total / dt)), 2)
    t = np.linspace(0.0, total, count + 1)[1:]
    r = min(ramp, total / 2)

    def ramp_up(x: Array) -> Array:
        x = np.clip(x, 0.0, r)
        return np.asarray(0.5 * (x - r / np.pi * np.sin(np.pi * x / r)))

    s = ramp_up(t) + np.clip(t - r, 0.0, total - 2 * r) + r / 2 - ramp_up(total - t)
    return np.asarray(s / s[-1])


def body_twists(poses: Array, dt: float) -> Array:
    """Twists (k, 6), linear part first, that move each pose to the next in `dt`; the last is 0."""
    r, p = poses[:, :3, :3], poses[:, :3, 3]
    turn = log_so3(r[1:] @ r[:-1].transpose(0, 2, 1))
    twists = np.concatenate([np.diff(p, axis=0), turn], axis=1) / dt
    return np.concatenate([twists, np.zeros((1, 6))])


def start_configuration(scene: Scene, path: Path) -> Array:
    """Where an exploration starts: at the standoff over the first pose of its path.

    Joint angles (n,), rad, or T_w_b (4, 4) of a body without an arm. Raises ReachError where the
    arm cannot lift off, ConfigError for a path that was planned for another arm.
    """
    lifted = scene.rig.lifted(path.poses[0], scene.exploration.standoff)
    if scene.rig.arm is None:
        return lifted
    joints = len(scene.arm.joint_names)
    if path.postures is None or path.postures.shape[1] != joints:
        raise ConfigError(
            "the path was planned for another arm than the scene's",
            value="no arm" if path.postures is None else f"{path.postures.shape[1]} joints",
            limit=f"{joints} joints",
            remedy="plan it with arm=scene.arm and mount=scene.mount_pose",
        )
    return scene.rig.follow(lifted[None], path.postures[0])[0][0]
