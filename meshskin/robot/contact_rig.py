"""The contact rig: the arm with the body on its tip, and the fixed indenter under it.

It says where the indenter can be pressed in, and which poses of the body and which postures of the
arm bring a contact point onto the indenter.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..contact.indenter import Indenter
from ..core.arrays import Array
from ..core.errors import ReachError
from ..core.se3 import inverse, orthonormal_basis, transform
from ..geometry.body import Body
from ..geometry.geodesics import any_tangents, rotate_about
from . import accessibility, collision, posture, turntable
from .arm import Arm

SITES = 10
"""Sites of a skin at which all postures are sought. Chosen: ten, far apart, sample a body's sides;
their postures only serve to bound what effects of the joints can do."""


@dataclass(frozen=True)
class ContactRig:
    """An arm with a body over a fixed indenter."""

    body: Body
    indenter: Indenter
    depth: float
    """Indentation depth, m."""
    sensing_radius: float
    """Distance along the surface up to which a taxel feels a contact, m."""
    arm: Arm | None = None
    """None: the body moves without an arm."""
    mount: Array = field(default_factory=lambda: np.eye(4))
    """T_tip_body (4, 4)."""
    patch_radius: float = 0.0
    """Longer semi-axis of the contact patch, m: edges must be farther from a contact than that."""
    model_reasons: Callable[[Array], Array] | None = None
    """Principal curvatures (k, 2), 1/m -> reason (k,) why the contact model does not hold there, ""
    where it does. None: it always does."""

    @cached_property
    def edge_points(self) -> Array:
        """Points (k, 3) on the body's edges."""
        if not self.patch_radius:
            return np.zeros((0, 3))
        return collision.edge_points(self.body, 0.2 * self.patch_radius)

    @cached_property
    def _edge_tree(self) -> Any:
        from scipy.spatial import cKDTree

        # asked a few times: a tree that is built fast
        return cKDTree(self.edge_points, balanced_tree=False, compact_nodes=False)

    @cached_property
    def allowed_collisions(self) -> collision.AllowedCollisions | None:
        """The parts of the arm that are not checked against the body; None: no arm."""
        if self.arm is None:
            return None
        return collision.allowed_collisions(self.arm, self.body, self.mount)

    @cached_property
    def turned_arm(self) -> Arm:
        """The arm on a turntable about the indenter's axis. The rig must have an arm."""
        assert self.arm is not None
        return turntable.on_turntable(self.arm, self.indenter.position, self.indenter.axis)

    def follow(self, poses: Array, posture: Array) -> tuple[Array, Array]:
        """Joint angles (k, n) along T_w_b `poses` (k, 4, 4) from a posture (n,), and the poses.

        An arm that cannot hold any pose turns the body about the indenter's axis as it must; the
        poses are then those that it holds. Raises ReachError.
        """
        assert self.arm is not None
        tips = poses @ inverse(self.mount)
        q = turntable.follow(self.arm, tips, posture, self.indenter.position, self.indenter.axis)
        return q, poses if self.arm.holds_any_pose else self.arm.pose(q) @ self.mount

    def held_poses(self, poses: Array, posture: Array) -> Array:
        """T_w_b `poses` (k, 4, 4), turned about the indenter's axis where the arm cannot hold them.

        Raises ReachError.
        """
        assert self.arm is not None
        tips = poses @ inverse(self.mount)
        if self.arm.holds_any_pose:
            with suppress(ReachError):
                self.arm.inverse_kinematics(tips, posture)
                return poses
        q = self.turned_arm.inverse_kinematics(tips, np.concatenate([[0.0], posture]))
        return np.asarray(self.arm.pose(q[:, 1:]) @ self.mount)

    def headings(self, poses: Array) -> Array:
        """Tangents (k, 3), body frame, that T_w_b `poses` (k, 4, 4) bring onto x of the indenter's
        frame."""
        return np.asarray(self.indenter.rotation[:, 0] @ poses[:, :3, :3])

    def contact_reasons(self, points: Array, normals: Array) -> Array:
        """Reason (k,) why the indenter cannot be pressed in at points (k, 3), "" where it can.

        It does not fit, an edge is within the contact patch, the contact model does not hold, or no
        straight path leads there from outside.
        """
        reason = collision.contact_reasons(self.body, points, normals, self.indenter, self.depth)
        free = np.flatnonzero(reason == "")
        curvature = self.body.surface.nearest(points[free]).curvature
        reason[free] = self.patch_reasons(points[free], curvature)
        free = np.flatnonzero(reason == "")
        held = accessibility.enclosed(self.body, points[free], normals[free], self.indenter.radius)
        reason[free[held]] = collision.ENCLOSED
        return reason

    def patch_reasons(self, points: Array, curvature: Array) -> Array:
        """`contact_reasons` (k,) that need no search over the body: an edge is within the contact
        patch, or the contact model does not hold at principal curvatures (k, 2), 1/m.
        """
        reason = np.full(len(points), "", dtype=object)
        if self.model_reasons is not None and len(points):
            reason[:] = self.model_reasons(curvature)
        gap = self._edge_tree.query(points, distance_upper_bound=self.patch_radius)[0]
        reason[gap < self.patch_radius] = collision.EDGE
        return reason

    def indenter_centres(self, points: Array, normals: Array) -> Array:
        """The indenter's centre (..., 3), body frame, pressed in at contact points (..., 3)."""
        return np.asarray(points + (self.indenter.radius - self.depth) * normals)

    def lifted(self, pose: Array, height: float) -> Array:
        """A contact pose T_w_b (4, 4), lifted until the gap to the indenter is `height`, m."""
        lifted = pose.copy()
        lifted[:3, 3] += (height + self.depth) * self.indenter.axis
        return lifted

    def poses(self, centres: Array, normals: Array, headings: Array) -> Array:
        """T_w_b (..., 4, 4) with the normals (..., 3) opposite to the indenter's direction.

        centres (..., 3): the indenter's centre in the body frame; headings (..., 3): unit tangents
        that are brought onto x of the indenter's frame.
        """
        centres, normals, headings = np.broadcast_arrays(centres, normals, headings)
        return self.frame_poses(centres, orthonormal_basis(normals, headings))

    def frame_poses(self, centres: Array, frames: Array, angle: float = 0.0) -> Array:
        """`poses` with frames (..., 3, 3) of a heading, normal x heading, and normal in the body.

        angle: that of the headings from x of the indenter's frame, about its z axis, rad.
        """
        down, ahead = np.array([0.0, 0.0, -1.0]), np.array([np.cos(angle), np.sin(angle), 0.0])
        goal = self.indenter.rotation @ orthonormal_basis(down, ahead)
        rotation = goal @ np.swapaxes(frames, -1, -2)
        position = np.array(self.indenter.position) - np.einsum(
            "...ij,...j->...i", rotation, centres
        )
        return np.asarray(transform(rotation, position))

    def contact_poses(self, points: Array, normals: Array, headings: Array) -> Array:
        """T_w_b (..., 4, 4) with the indenter pressed in at contact points (..., 3)."""
        return self.poses(self.indenter_centres(points, normals), normals, headings)

    def spin_poses(self, points: Array, normals: Array, tangents: Array) -> Array:
        """T_w_b (m, s, 4, 4) at contact points (m, 3), for s spins about the normals on a grid.

        tangents (m, 3): the headings at spin 0.
        """
        points, normals, tangents = points[:, None], normals[:, None], tangents[:, None]
        spins = posture.SPIN_STEP * np.arange(posture.SPINS, dtype=float)
        return self.contact_poses(points, normals, rotate_about(normals, tangents, spins))

    def solved_spins(
        self,
        points: Array,
        normals: Array,
        tangents: Array,
        anchor_spacing: int,
        starts: NDArray[np.bool_] | None = None,
    ) -> posture.Nodes:
        """The postures at contact points (m, 3), the spins about the normals solved with them.

        tangents (m, 3): the headings at spin 0; anchor_spacing, starts: see `posture.solve_nodes`.
        """
        assert self.arm is not None
        tips = self.contact_poses(points, normals, tangents) @ inverse(self.mount)
        return posture.solve_spins(self.arm, self.turned_arm, tips, anchor_spacing, starts)

    def postures(self, sites: Array) -> Array:
        """Joint angles (k, n) with which the arm presses sites (m, 3), body frame, on the indenter.

        At ten of the sites, far apart, in all spins and postures within the joint limits, whatever
        path is planned. The rig must have an arm.
        """
        assert self.arm is not None
        hit = self.body.closest(sites[farthest_points(sites, SITES)])
        tangents = any_tangents(hit.normal)
        poses = self.spin_poses(hit.point, hit.normal, tangents)
        nodes = posture.solve_nodes(self.arm, poses @ inverse(self.mount), anchor_spacing=1)
        if not nodes.within_limits.any():
            nodes = self.solved_spins(hit.point, hit.normal, tangents, anchor_spacing=1)
        return nodes.q[nodes.within_limits]


def farthest_points(points: Array, count: int) -> np.ndarray:
    """Rows of at most `count` of the points (m, 3), each farthest from those before it.

    Source: Gonzalez, "Clustering to minimize the maximum intercluster distance" (1985).
    """
    rows = [0]
    gap = np.linalg.norm(points - points[0], axis=1)
    while len(rows) < count and gap.max() > 0:
        rows.append(int(gap.argmax()))
        gap = np.minimum(gap, np.linalg.norm(points - points[rows[-1]], axis=1))
    return np.array(rows)
