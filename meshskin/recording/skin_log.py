"""A log of a robot with skin on one clock: joint angles, taxel readings and forces, frame by frame.

It is what remains of a bag or a dumper folder after its streams are resampled and the taxels are
tared, and what the contacts are computed from where the log has joint angles but no contact points.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import Array, runs
from ..core.errors import RecordingError
from ..core.value import Value

MOSTLY_SILENT = 0.5
"""Share of the frames without a reading from which a taxel is recorded only where it answers."""
NOISY = 3.0
"""Noise of a taxel, in that of the median one, from which it is noisy."""


@dataclass(frozen=True, eq=False)
class SkinLog(Value):
    """Joint angles, taxel readings and forces of n frames, all at the same times.

    Frames lie on the skin's frames, shifted to the robot's clock; the other streams are
    interpolated to them. Frames in which a stream has a gap are left out, so the times increase but
    need not be evenly spaced. Raises RecordingError for arrays of different lengths, times that do
    not increase, a name or an id that occurs twice, and joint angles that are infinite.
    """

    time: Array
    """Times (n,), s, increasing, on the clock of the joint angles."""
    joint_names: tuple[str, ...]
    """Names of the k joints, those of the log."""
    joint_angles: Array
    """Joint angles (n, k), rad; m for prismatic joints; NaN in the gaps of a joint. Those of
    endless joints go on beyond a turn."""
    taxel_ids: NDArray[np.integer]
    """Ids (t,) of the taxels."""
    readings: NDArray[np.floating]
    """Readings (n, t) less the level at rest, positive under pressure; NaN where a taxel is silent,
    or `missing`. In the unit of the log, usually counts."""
    noise: Array
    """Standard deviation (t,) of a reading at rest, same unit."""
    in_contact: NDArray[np.bool_]
    """Frames (n,) in which a taxel is pressed."""
    force: Array | None = None
    """Contact force (n,), N: the force of the wrench less its level at rest; None without one."""
    clock_offset: float = 0.0
    """Time, s, by which the skin's stamps were late against the robot's clock; it is already
    subtracted in `time`."""
    clock_sigma: float | None = None
    """Standard deviation of `clock_offset`, s; None where it was given or could not be found."""

    def __post_init__(self) -> None:
        n, k, t = len(self.time), len(self.joint_names), len(self.taxel_ids)
        for name, array, shape in (
            ("time", self.time, (n,)),
            ("joint_angles", self.joint_angles, (n, k)),
            ("taxel_ids", self.taxel_ids, (t,)),
            ("readings", self.readings, (n, t)),
            ("noise", self.noise, (t,)),
            ("in_contact", self.in_contact, (n,)),
            ("force", self.force, (n,)),
        ):
            if array is not None and np.shape(array) != shape:
                raise RecordingError(
                    f"{name} of a log has the wrong shape", value=np.shape(array), limit=shape
                )
        if not np.all(np.diff(self.time) > 0):
            row = int(np.argmin(np.diff(self.time) > 0)) + 1
            raise RecordingError(
                "times of a log must increase",
                value=f"{self.time[row]} s after {self.time[row - 1]} s in frame {row}",
            )
        if np.isinf(self.joint_angles).any():
            row, column = np.argwhere(np.isinf(self.joint_angles))[0]
            value = f"{self.joint_angles[row, column]} of {self.joint_names[column]} in frame {row}"
            raise RecordingError("joint angles of a log must not be infinite", value=value)
        for what, entries in (("joint", self.joint_names), ("taxel", self.taxel_ids.tolist())):
            if len(set(entries)) < len(entries):
                twice = next(entry for entry in entries if entries.count(entry) > 1)
                raise RecordingError(f"a {what} of a log occurs twice", value=twice)

    def __repr__(self) -> str:
        span = f"{self.time[-1] - self.time[0]:.4g} s" if len(self.time) else "nothing"
        return (
            f"<SkinLog: {len(self.time)} frames over {span}, {len(self.joint_names)} joints, "
            f"{len(self.taxel_ids)} taxels, {len(self.contacts)} contacts, "
            f"{'without' if self.force is None else 'with'} forces>"
        )

    @cached_property
    def missing(self) -> NDArray[np.bool_]:
        """Readings (n, t) that the log lacks, of taxels that it has in most frames: they are not
        silences."""
        lost = np.isnan(self.readings)
        return np.asarray(lost & (lost.mean(axis=0) < MOSTLY_SILENT))

    @property
    def noisy(self) -> NDArray[np.bool_]:
        """Taxels (t,) that are noisier than NOISY others."""
        usual = np.median(self.noise[self.noise > 0]) if self.noise.any() else np.inf
        return np.asarray(self.noise > NOISY * usual)

    @cached_property
    def contacts(self) -> list[slice]:
        """The frames of each contact, from its onset to its end."""
        return runs(self.in_contact)
