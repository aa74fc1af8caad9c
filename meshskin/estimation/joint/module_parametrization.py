"""Rigid modules: taxels at known offsets in a frame whose pose (6) is unknown.

    x_i = t + v + exp(w) R o_i,

v, w being moves in the body frame. The rotation about the normal, which single round taxels do not
show, is observable for a module. The surface is a factor of its own: each taxel's height h over it
costs (h / SURFACE_SIGMA)^2 / 2. A taxel that was never touched, or that is dead, follows from the
others of its module.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core import se3
from ...core.arrays import Array
from ...core.errors import CalibrationError
from ...geometry.body import Body
from ..data.measurements import Measurements

MODULES = "rigid modules: the known places of their taxels"
MODULE_SURFACE = "body surface: modules lie on it to 0.1 mm a taxel"
SURFACE_SIGMA = 1e-4
"""Standard deviation of a taxel's height over the surface, m: how well a rigid triangle is glued on
a body; a sphere of 0.1 m radius bends away by 0.3 mm over 8 mm."""
MAX_OFFSET = 3e-3
"""Largest median distance of single taxels from their positions in their modules, m: half the
distance between neighbouring taxels, beyond which ids are wrong."""
LEVER = 8e-3
"""Length that converts rotations into moves, m: about the distance of its taxels from a module's
centre."""


@dataclass(frozen=True)
class ModuleParametrization:
    """n taxels on G modules: a `Parametrization` with six coordinates (v, w) a module."""

    poses: Array
    """T_b_module (G, 4, 4)."""
    group: np.ndarray
    """Module (n,) of each taxel, rising."""
    offsets: Array
    """o_i (n, 3), m."""
    step: float
    """Longest step, m."""
    height: Array
    """Height (n,), m, of each taxel over the surface at z = 0."""
    normals: Array
    """Normals (n, 3) of the surface below each taxel."""
    size: int = 6
    """Coordinates of a module."""

    @classmethod
    def about(
        cls, body: Body, poses: Array, group: np.ndarray, offsets: Array, step: float
    ) -> ModuleParametrization:
        """Modules linearized at `poses` (G, 4, 4)."""
        hit = body.closest(_points(poses, group, offsets))
        return cls(poses, group, offsets, step, hit.distance, hit.normal)

    @property
    def count(self) -> int:
        """Number of modules."""
        return len(self.poses)

    def at(self, z: Array, groups: np.ndarray, rows: np.ndarray) -> tuple[Array, Array]:
        """Points (r, 3), m, of the taxels `rows` at z (r, 6), and dx/dz (r, 3, 6)."""
        pose = self.poses[groups]
        arm = np.einsum("rij,rj->ri", pose[:, :3, :3], self.offsets[rows])
        arm = np.einsum("rij,rj->ri", se3.exp_so3(z[:, 3:]), arm)
        slope = np.concatenate([np.broadcast_to(np.eye(3), (len(rows), 3, 3)), -se3.hat(arm)], 2)
        return pose[:, :3, 3] + z[:, :3] + arm, slope

    def limit_step(self, step: Array) -> Array:
        """Steps (g, ...) of which none moves a taxel by more than about the limit."""
        size = np.linalg.norm(step[:, :6] * np.repeat([1.0, LEVER], 3), axis=1)
        return np.asarray(step * np.minimum(1.0, self.step / np.maximum(size, 1e-300))[:, None])

    def prior(self, z: Array, groups: np.ndarray) -> tuple[Array, Array, Array]:
        """The surface factor: cost (g,), gradient (g, D) and Hessian (g, D, D)."""
        place = np.full(self.count, -1)
        place[groups] = np.arange(len(groups))
        rows = np.flatnonzero(place[self.group] >= 0)
        owner, own = place[self.group[rows]], self.group[rows]
        x, slope = self.at(z[owner, :6], own, rows)
        normal = self.normals[rows]
        moved = x - _points(self.poses, own, self.offsets[rows])
        r = (self.height[rows] + np.einsum("ri,ri->r", normal, moved)) / SURFACE_SIGMA
        j = np.zeros((len(rows), z.shape[1]))
        j[:, :6] = np.einsum("ri,rij->rj", normal, slope) / SURFACE_SIGMA
        g, d = z.shape
        cost, gradient, hessian = np.zeros(g), np.zeros((g, d)), np.zeros((g, d, d))
        np.add.at(cost, owner, r**2 / 2)
        np.add.at(gradient, owner, j * r[:, None])
        np.add.at(hessian, owner, j[:, :, None] * j[:, None, :])
        return cost, gradient, hessian

    def relinearized(self, body: Body, z: Array) -> ModuleParametrization:
        """The modules linearized at the coordinates z (G, 6)."""
        poses = self.poses.copy()
        poses[:, :3, 3] += z[:, :3]
        poses[:, :3, :3] = se3.exp_so3(z[:, 3:]) @ poses[:, :3, :3]
        return ModuleParametrization.about(body, poses, self.group, self.offsets, self.step)

    def points(self) -> Array:
        """Points (n, 3), m, at z = 0."""
        return _points(self.poses, self.group, self.offsets)

    def rotations(self) -> Array:
        """Frames (n, 3, 3) of the taxels: those of their modules."""
        return np.asarray(self.poses[self.group, :3, :3])

    def covariances(self, of_moves: Array) -> Array:
        """Covariances (n, 6, 6) in the taxels' frames from those (G, 6, 6) of the moves (v, w)."""
        rotation = self.rotations()
        back = np.swapaxes(rotation, 1, 2)
        into = np.zeros((len(rotation), 6, 6))
        into[:, :3, :3] = into[:, 3:, 3:] = back
        into[:, :3, 3:] = -back @ se3.hat(np.einsum("nij,nj->ni", rotation, self.offsets))
        return np.asarray(into @ of_moves[self.group] @ np.swapaxes(into, 1, 2))


def align_modules(
    data: Measurements, points: Array, found: np.ndarray, step: float
) -> tuple[ModuleParametrization, np.ndarray]:
    """Modules with at least two taxels `found` (n,) at `points` (n, 3), m, and the rows of all
    their taxels.

    A pose is aligned with points and surface normals. Raises CalibrationError if there is no such
    module, or if the taxels are not arranged as in the modules.
    """
    slots = np.asarray(data.belief.module_slots)
    module, slot = np.divmod(data.ids, len(slots))
    normals = np.full_like(points, np.nan)
    normals[found] = data.body.closest(points[found]).normal
    poses, rows, off = [], [], []
    for number in np.unique(module[found]):
        own = np.flatnonzero(module == number)
        seen = own[found[own]]
        if len(seen) < 2:
            continue
        o, up = slots[slot[seen]], np.array([0.0, 0.0, LEVER])
        pose = se3.align(
            np.concatenate([o, o + up]),
            np.concatenate([points[seen], points[seen] + LEVER * normals[seen]]),
        )
        off.append(np.linalg.norm(points[seen] - o @ pose[:3, :3].T - pose[:3, 3], axis=1))
        poses.append(pose)
        rows.append(own)
    if not rows:
        raise CalibrationError(
            "no module has two taxels that are determined by the recording",
            value=f"{found.sum()} taxels determined, {len(np.unique(module))} modules",
            remedy="touch more taxels, or leave module_slots out of the belief",
        )
    typical = float(np.median(np.concatenate(off)))
    if typical > MAX_OFFSET:
        raise CalibrationError(
            "the taxels are not arranged as in the rigid modules that are believed",
            value=f"typically {1e3 * typical:.2g} mm off their positions",
            limit=f"{1e3 * MAX_OFFSET:g} mm",
            remedy=f"check that ids are {len(slots)} module + slot, or leave the modules out",
        )
    group = np.repeat(np.arange(len(rows)), [len(own) for own in rows])
    every = np.concatenate(rows)
    return ModuleParametrization.about(
        data.body, np.stack(poses), group, slots[slot[every]], step
    ), every


def _points(poses: Array, group: np.ndarray, offsets: Array) -> Array:
    pose = poses[group]
    return np.asarray(pose[:, :3, 3] + np.einsum("nij,nj->ni", pose[:, :3, :3], offsets))
