"""One of two skins that touch: its chain of joints, its taxels, and what is unknown about it.

A taxel of patch p is at

    x_i = T(q + dq) M ( c_p + t_p + R_p (n_i + d_i - c_p) )

in the base: T the chain's pose at joint angles q, n_i its nominal position in the tip's frame, M
the mount, (t_p, R_p) the displacement of its patch about the patch's middle c_p, d_i its own. The
contact is where the weighted mean of the active taxels is.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike

from ...core.arguments import NamedFields, check_array, check_type
from ...core.arrays import Array, means_by_group
from ...core.config import check_fields, quantity
from ...core.errors import CalibrationError
from ...core.se3 import exp_so3, hat
from ...core.value import Value
from ...robot.chain import Chain

TURNS, FARTHEST = 4 * np.pi, 3.0
"""Largest angle, rad, and distance of a taxel from the origin of its link, m: larger ones are in
degrees or in mm."""


@dataclass(frozen=True, eq=False)
class TouchSide(Value, NamedFields):
    """A skin in m touches. A sigma of 0 means known. Raises CalibrationError and ConfigError."""

    chain: Chain | None
    """From the base that both skins share to the skin's link; None: the skin is on the base."""
    angles: Array
    """Joint angles (m, k), rad; (m, 0) without a chain."""
    positions: Array
    """Nominal positions (n, 3) of the taxels in the link's frame, m."""
    readings: Array
    """(m, n), binary or graded, 0 where a taxel is silent; in each touch one answers at least."""
    patch: np.ndarray | None = None
    """Number (n,) of each taxel's patch, from 0; None: one patch."""
    mount_sigma: float = quantity("m", 0.05, least=0.0)
    """Standard deviation of the mount's displacement before any data, m."""
    mount_turn_sigma: float = quantity("rad", 0.5, least=0.0)
    """Standard deviation of the mount's rotation about each axis, rad."""
    patch_sigma: float = quantity("m", 0.0, least=0.0)
    """Standard deviation of the displacement of each patch, m."""
    patch_turn_sigma: float = quantity("rad", 0.0, least=0.0)
    """Standard deviation of each patch's rotation about each axis, rad."""
    taxel_sigma: float = quantity("m", 0.0, least=0.0)
    """Standard deviation of each taxel's own displacement along each axis, m."""
    joint_sigma: float = quantity("rad", 0.0, least=0.0)
    """Standard deviation of a constant error of each joint angle, rad."""

    def __post_init__(self) -> None:
        check_fields(self)
        if self.chain is not None:
            check_type(Chain, self.chain, "the chain of a skin that touches")
        for name in ("angles", "positions", "readings"):
            value = check_array(f"{name} of a skin", getattr(self, name), error=CalibrationError)
            if value.ndim != 2 or not np.isfinite(value).all():
                raise CalibrationError(
                    f"{name} of a skin must be a finite table", value=f"shape {value.shape}"
                )
            object.__setattr__(self, name, value)
        n, joints = len(self.positions), len(self.chain.joint_names) if self.chain else 0
        patch = np.zeros(n, dtype=int) if self.patch is None else np.asarray(self.patch)
        object.__setattr__(self, "patch", patch)
        touches = len(self.readings)
        wanted = {"angles": (touches, joints), "positions": (n, 3), "readings": (touches, n)}
        for name, shape in (*wanted.items(), ("patch", (n,))):
            if getattr(self, name).shape != shape:
                raise CalibrationError(
                    f"the shape of {name} of a skin is wrong",
                    value=getattr(self, name).shape,
                    limit=shape,
                )
        for name, unit, other, limit in (
            ("angles", "rad", "degrees", TURNS), ("positions", "m", "mm", FARTHEST)
        ):  # fmt: skip
            if (largest := np.abs(getattr(self, name)).max(initial=0.0)) > limit:
                raise CalibrationError(
                    f"{name} of a skin are too large",
                    value=f"{largest:.3g} {unit}",
                    limit=f"{limit:.3g} {unit}",
                    remedy=f"convert them to {unit} if they are in {other}",
                )
        whole = np.issubdtype(patch.dtype, np.integer) and n and patch.min() >= 0
        if not whole or len(np.unique(patch)) != patch.max() + 1:
            raise CalibrationError("patches of a skin must be numbered from 0 without gaps")
        if (self.readings < 0).any() or not (self.readings.sum(axis=1) > 0).all():
            raise CalibrationError(
                "in each touch a taxel must read above 0, and none below",
                remedy="leave out frames in which one of the two skins is silent",
            )

    def __repr__(self) -> str:
        n, touches, joints = len(self.positions), *self.angles.shape
        return f"<TouchSide: {n} taxels in {touches} touches, moved by {joints} joints>"

    def of(self, rows: ArrayLike) -> TouchSide:
        """This side in some of the touches: indices or a mask."""
        i = np.asarray(rows)
        return replace(self, angles=self.angles[i], readings=self.readings[i])

    @property
    def patches(self) -> int:
        """Number of patches."""
        assert self.patch is not None
        return int(self.patch.max()) + 1

    @property
    def shares(self) -> Array:
        """Weights (m, n) of the taxels in the contact; rows sum to 1."""
        return np.asarray(self.readings / self.readings.sum(axis=1, keepdims=True))

    @property
    def prior_sigmas(self) -> Array:
        """Standard deviations (u,) before any data: mount, patches, joints, taxels if unknown."""
        patch = [self.patch_sigma] * 3 + [self.patch_turn_sigma] * 3
        mount = [self.mount_sigma] * 3 + [self.mount_turn_sigma] * 3
        joints = [self.joint_sigma] * self.angles.shape[1]
        taxels = [self.taxel_sigma] * (3 * len(self.positions) if self.taxel_sigma else 0)
        return np.array([*mount, *patch * self.patches, *joints, *taxels])

    @property
    def labels(self) -> list[str]:
        """What each unknown (u,) is."""
        six = [f"{kind} {axis}" for kind in ("displacement along", "turn about") for axis in "xyz"]
        names = [f"mount: {name}" for name in six]
        names += [f"patch {p}: {name}" for p in range(self.patches) for name in six]
        names += [f"joint {name}" for name in (self.chain.joint_names if self.chain else ())]
        taxels = range(len(self.positions) if self.taxel_sigma else 0)
        return names + [f"taxel {i} along {axis}" for i in taxels for axis in "xyz"]


@dataclass(frozen=True, eq=False)
class SideState:
    """Values of the unknowns of a skin."""

    mount: tuple[Array, Array]
    """Translation (3,), m, and rotation (3, 3)."""
    patches: tuple[Array, Array]
    """Translations (p, 3), m, and rotations (p, 3, 3), about the patches' middles."""
    joints: Array
    """Errors (k,) of the joint angles, rad."""
    taxels: Array
    """Own displacements (n, 3), m."""

    @classmethod
    def nominal(cls, side: TouchSide) -> SideState:
        """Everything as given."""
        turns = np.tile(np.eye(3), (side.patches, 1, 1))
        return cls(
            (np.zeros(3), np.eye(3)),
            (np.zeros((side.patches, 3)), turns),
            np.zeros(side.angles.shape[1]),
            np.zeros_like(side.positions),
        )

    def moved(self, step: Array) -> SideState:
        """After a step (u,) of the unknowns, in the order of `TouchSide.prior_sigmas`."""
        count, k = len(self.patches[0]), len(self.joints)
        mount, step = step[:6], step[6:]
        patch, step = step[: 6 * count].reshape(-1, 6), step[6 * count :]
        return SideState(
            (self.mount[0] + mount[:3], exp_so3(mount[3:]) @ self.mount[1]),
            (self.patches[0] + patch[:, :3], exp_so3(patch[:, 3:]) @ self.patches[1]),
            self.joints + step[:k],
            self.taxels + step[k:].reshape(-1, 3) if len(step) > k else self.taxels,
        )


def positions(side: TouchSide, state: SideState) -> Array:
    """Positions (n, 3) of the taxels in the link's frame, m."""
    return np.asarray(_on_mount(side, state)[0] @ state.mount[1].T + state.mount[0])


def _on_mount(side: TouchSide, state: SideState) -> tuple[Array, Array]:
    """Taxels (n, 3) before the mount, and their turned arms (n, 3) from the patches' middles."""
    assert side.patch is not None
    middle = means_by_group(side.positions, side.patch)
    arm = side.positions + state.taxels - middle[side.patch]
    turned = np.einsum("nij,nj->ni", state.patches[1][side.patch], arm)
    return (middle + state.patches[0])[side.patch] + turned, turned


def contacts(side: TouchSide, state: SideState) -> tuple[Array, Array]:
    """Contact (m, 3) in the base, m, and its derivative (m, 3, u) by the unknowns."""
    assert side.patch is not None
    share, m, n = side.shares, len(side.readings), len(side.positions)
    on_mount, turned = _on_mount(side, state)
    local = share @ on_mount @ state.mount[1].T
    if side.chain is None:
        pose = np.broadcast_to(np.eye(4), (m, 4, 4))
        motion = np.zeros((m, 6, 0))
    else:
        angles = side.angles + state.joints
        pose, motion = side.chain.poses(angles), side.chain.jacobian(angles)
    rotation = pose[:, :3, :3]
    lever = np.einsum("mij,mj->mi", rotation, local + state.mount[0])
    contact = lever + pose[:, :3, 3]
    mount = np.concatenate([rotation, -rotation @ hat(local)], axis=2)
    inner = rotation @ state.mount[1]
    columns = [mount]
    for p in range(side.patches):
        own = side.patch == p
        weight = share[:, own].sum(axis=1)[:, None, None]
        arm = share[:, own] @ turned[own]
        columns += [inner * weight, -inner @ hat(arm)]
    columns.append(motion[:, :3] - hat(lever) @ motion[:, 3:])
    if not side.taxel_sigma:
        return contact, np.concatenate(columns, axis=2)
    turns = state.patches[1][side.patch]
    by_taxel = np.einsum("mij,njk,mn->mink", inner, turns, share, optimize=True)
    return contact, np.concatenate([*columns, by_taxel.reshape(m, 3, 3 * n)], axis=2)
