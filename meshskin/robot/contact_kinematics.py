"""Where an indenter is in the frame of a body on a robot's link, by the joint angles.

    c_b = T_link_body^-1 T_link_carrier(q(t - clock + delays) + offsets) p

The indenter's centre p is at rest in the frame of the link that carries it: the root, for an
indenter fixed in the world, or a link of another limb. What of this is not known exactly is
declared, each with a standard deviation, and c_b has derivatives by all of it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from types import MappingProxyType

import numpy as np

from ..core.arguments import (
    NamedFields,
    check_name,
    check_real,
    check_type,
    check_vector,
    repr_short,
)
from ..core.arrays import Array
from ..core.errors import ArmError, ConfigError, UnknownNameError
from ..core.se3 import TURN_PER_METRE, exp_so3, hat, is_rigid, left_jacobian, transform
from .chain import Chain

SIZES = {
    "indenter_position": 3,
    "mount": 6,
    "clock_offset": 1,
    "indenter_radius": 1,
    "mesh_scale": 1,
}
"""Number of entries of each unknown; joint_offset has one for each joint of the chain, joint_delay
for each of `ContactKinematics.delayed`."""
JOINT_OFFSET, JOINT_DELAY = "joint_offset", "joint_delay"
SIGMAS = MappingProxyType(
    {
        "joint_offset": math.radians(1.0),
        "joint_delay": 0.02,
        "indenter_position": 2e-3,
        "mount": 3e-3,
        "clock_offset": 0.05,
        "indenter_radius": 1e-4,
        "mesh_scale": 0.01,
    }
)
"""Default standard deviations: rad, s, m, m, s, m, and of the logarithm. Chosen: a joint's zero set
by a mark, cycles of a joint's driver, a place measured with a ruler, a few frames, a turned ball,
and a mesh in the right unit."""
USUAL = MappingProxyType(
    {
        name: SIGMAS[name]
        for name in ("joint_offset", "joint_delay", "indenter_position", "clock_offset")
    }
)
"""What is not known of most robots. Mount and size of the body are hard to tell from these."""
MAX_GAP = 5.0
"""Longest step of a path, in typical steps, over which its angles are interpolated: a robot may
stop, start or turn in a longer one."""
TURN = 5.0
"""Step of an angle, rad, from which it is a whole turn that an endless joint's angle leaves out:
2 pi less the 1.3 rad that a joint turns between two samples at most."""


def continuous_angles(angles: Array) -> Array:
    """Angles (n, ...), rad, over time, of endless joints without the jumps by whole turns. Joints
    that go beyond one turn, or are in degrees, have none."""
    one = np.ptp(angles, axis=0) <= 2 * np.pi + 1e-6  # rounding
    return np.where(one, np.unwrap(angles, TURN, axis=0), angles)


@dataclass(frozen=True, eq=False)
class JointPath:
    """Joint angles over time, interpolated by cubics with the differences of the samples."""

    time: Array
    """Times (n,), s, increasing, of at least two samples."""
    angles: Array
    """(n, k), rad; those of endless joints may jump by whole turns."""

    def at(self, time: Array, delays: Array | None = None) -> tuple[Array, Array]:
        """Angles (m, k), rad, and their rates, rad/s, at times (m,), s; of joints whose stamps are
        late by `delays` (k,), s, by default zero."""
        path = self._spline
        if delays is None or not delays.any():
            return np.asarray(path(time)), np.asarray(path(time, 1))
        angles, rates = (
            np.stack([path(time + d, order)[:, k] for k, d in enumerate(delays)], axis=1)
            for order in (0, 1)
        )
        return angles, rates

    def covers(self, time: Array) -> np.ndarray:
        """Whether the path has the times (m,), s: beyond its ends, and in gaps of more than MAX_GAP
        typical steps, nothing is known of it."""
        steps = np.diff(self.time)
        short = steps <= MAX_GAP * np.median(steps)
        step, next_ = (
            np.searchsorted(self.time, time, side).clip(1, len(steps)) - 1
            for side in ("left", "right")
        )  # two at a sample, which may be at the end of a gap
        inside = (time >= self.time[0]) & (time <= self.time[-1])
        return np.asarray(inside & (short[step] | short[next_]))

    @cached_property
    def _spline(self):  # type: ignore[no-untyped-def]
        from scipy.interpolate import CubicHermiteSpline

        angles = continuous_angles(self.angles)
        return CubicHermiteSpline(self.time, angles, np.gradient(angles, self.time, axis=0))


@dataclass(frozen=True, eq=False)
class AveragedPath(JointPath):
    """A path of which each of m contacts has the mean angles of its frames: where the path turns
    among them, these are not the angles at their mean time."""

    apart: Array
    """Times (f,), s, of the frames relative to the time of their contact."""
    first: np.ndarray
    """First frame (m,) of each contact."""

    def at(self, time: Array, delays: Array | None = None) -> tuple[Array, Array]:
        """Mean angles (m, k), rad, and rates, rad/s, of the contacts at times (m,), s; delays: as
        of JointPath."""
        count = np.diff(np.append(self.first, len(self.apart)))
        angles, rates = (
            np.add.reduceat(values, self.first, axis=0) / count[:, None]
            for values in super().at(np.repeat(time, count) + self.apart, delays)
        )
        return angles, rates


@dataclass(frozen=True, eq=False)
class ContactKinematics(NamedFields):
    """A body on a link and an indenter on another one. Raises ArmError, UnknownNameError."""

    chain: Chain
    """From the link of the body to the link that carries the indenter."""
    indenter: Array
    """The indenter's centre (3,) in the frame of the link that carries it, m."""
    mount: Array = field(default_factory=lambda: np.eye(4))
    """T_link_body (4, 4)."""
    unknown: Mapping[str, float] = field(default_factory=lambda: USUAL)
    """Standard deviations of what is not known exactly, by name: any of SIGMAS."""
    delayed: tuple[str, ...] | None = None
    """Joints whose stamps may be late against those of the others: the joint_delay. None: all but
    one, by default the first; `calibrate_log` takes the one that moves the heights fastest."""

    def __post_init__(self) -> None:
        check_type(Chain, self.chain, "chain of contact kinematics")
        centre = check_vector("centre of the indenter", self.indenter, error=ArmError)
        if not np.isfinite(centre).all():
            raise ArmError("centre of the indenter must be finite", value=centre)
        if not is_rigid(self.mount):
            raise ArmError("mount of the body must be a rigid transform (4, 4)", value=self.mount)
        if not isinstance(self.unknown, Mapping):
            raise ConfigError(
                "unknowns of contact kinematics must be a Mapping",
                value=repr_short(self.unknown),
                remedy=f'give standard deviations by name: unknown={{"{JOINT_OFFSET}": 0.017}}',
            )
        for name, sigma in self.unknown.items():
            if name not in SIGMAS:
                raise UnknownNameError("parameter of contact kinematics", name, SIGMAS)
            check_real(f"standard deviation of {name}", sigma, above=0.0)
        for name in self.delayed or ():
            check_name("joint", name, self.chain.joint_names)
        object.__setattr__(self, "indenter", centre)
        object.__setattr__(self, "mount", np.asarray(self.mount, dtype=float))

    @cached_property
    def columns(self) -> dict[str, slice]:
        """The entries of s of each unknown."""
        found, first = {}, 0
        for name in SIGMAS:
            if name in self.unknown:
                size = len(self._joints[name]) if name in self._joints else SIZES[name]
                found[name] = slice(first, first + size)
                first += size
        return found

    @property
    def _joints(self) -> dict[str, tuple[str, ...]]:
        """The joints that have an entry of an unknown that is one of each joint."""
        names = self.chain.joint_names
        return {
            JOINT_OFFSET: names,
            JOINT_DELAY: names[1:] if self.delayed is None else self.delayed,
        }

    @cached_property
    def labels(self) -> tuple[str, ...]:
        """A name (K,) for every entry of s."""
        axes = ("x", "y", "z", "rotation x", "rotation y", "rotation z")
        out: list[str] = []
        for name, at in self.columns.items():
            size = at.stop - at.start
            entries = self._joints.get(name, axes[:size])
            named = size > 1 or name in self._joints
            out += [f"{name} {entry}" for entry in entries] if named else [name]
        return tuple(out)

    @cached_property
    def sigma(self) -> Array:
        """Standard deviations (K,) of s before any measurement."""
        out = np.empty(len(self.labels))
        for name, at in self.columns.items():
            out[at] = self.unknown[name]
            if name == "mount":
                out[at][3:] *= TURN_PER_METRE
        return out

    def value(self, name: str, s: Array) -> float:
        """The entry of a scalar unknown in s (K,); 0 if it is not declared."""
        return float(self._entries(name, s, 1)[0])

    def _entries(self, name: str, s: Array, size: int) -> Array:
        """The entries of an unknown in s (K,); zeros (size,) if it is not declared."""
        return s[self.columns[name]] if name in self.columns else np.zeros(size)

    def mount_at(self, s: Array) -> Array:
        """T_link_body (4, 4) with the unknowns s (K,)."""
        shift, turn = np.split(self._entries("mount", s, 6), 2)
        return np.asarray(self.mount @ transform(exp_so3(turn), shift))

    @cached_property
    def _late(self) -> list[int]:
        """Index of each of the joints that may be late."""
        return [self.chain.joint_names.index(name) for name in self._joints[JOINT_DELAY]]

    def delays(self, s: Array) -> Array:
        """How late (k,), s, the stamps of all joints are with the unknowns s (K,)."""
        out = np.zeros(len(self.chain.joint_names))
        out[self._late] = self._entries(JOINT_DELAY, s, len(self._late))
        return out

    def centres(self, path: JointPath, time: Array, s: Array) -> tuple[Array, Array]:
        """The indenter's centres (m, 3), body frame, m, at times (m,), s, with the unknowns s (K,),
        and their derivatives (m, 3, K).
        """
        angles, rates = path.at(time - self.value("clock_offset", s), self.delays(s))
        angles = angles + self._entries(JOINT_OFFSET, s, angles.shape[1])
        point = self.indenter + self._entries("indenter_position", s, 3)
        held, mount = self.chain.with_tip(transform(np.eye(3), point)), self.mount_at(s)
        poses, back = held.poses(angles), mount[:3, :3].T
        centre = (poses[:, :3, 3] - mount[:3, 3]) @ back.T
        by_joint = back @ held.jacobian(angles)[:, :3]
        derivatives = {
            JOINT_OFFSET: by_joint,
            JOINT_DELAY: (by_joint * rates[:, None])[:, :, self._late],
            "indenter_position": back @ poses[:, :3, :3],
            "clock_offset": -by_joint @ rates[:, :, None],
            "mount": self._by_mount(centre, self._entries("mount", s, 6)[3:]),
        }
        slopes = np.zeros((len(centre), 3, len(s)))
        for name in derivatives.keys() & self.columns.keys():
            slopes[:, :, self.columns[name]] = derivatives[name]
        return centre, slopes

    def _by_mount(self, centre: Array, turn: Array) -> Array:
        """Derivatives (m, 3, 6) of centres (m, 3) by the mount's shift and rotation `turn` (3,).

        centre = exp(-turn) (rest - shift), and exp(turn + d) = exp(turn) exp(J(-turn) d).
        """
        by_shift = np.broadcast_to(-exp_so3(-turn), (len(centre), 3, 3))
        return np.concatenate([by_shift, hat(centre) @ left_jacobian(-turn)], axis=2)
