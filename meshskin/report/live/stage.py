"""What the live page shows besides the estimate: body, indenter, robot, and their poses in time."""

from __future__ import annotations

from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ...contact import AUTO, LEARNED, ContactModel
from ...core.arrays import Array
from ...core.errors import ContactError
from ...core.se3 import inverse, orthonormal_basis, shortest_rotation, transform, transform_points
from ...estimation.data.resolve_belief import resolve_belief
from ...robot.link_meshes import MIN_ROD, link_meshes, link_poses, rod
from ...robot.robot import Robot

if TYPE_CHECKING:
    from ...geometry.mesh.triangles import Triangles
    from ...recording.recording import Recording
    from ...recording.skin_log import SkinLog
    from ...scene.belief import Belief
    from ...scene.scene import Scene

MAX_POSES = 20_000
"""Contacts of which the poses of the links are kept, 16 numbers a link: 60 MB for 24 links. Of a
longer recording every k-th contact has them."""


@dataclass(frozen=True)
class Carrier:
    """The robot that moves the body, or the body alone where only its pose is known."""

    body: Array
    """T_w_body (m, 4, 4) at each contact, m."""
    links: Mapping[str, Triangles] = field(default_factory=dict)
    """Triangles of each link that is drawn, link frame, m."""
    poses: Mapping[str, Array] = field(default_factory=dict)
    """T_w_link (k, 4, 4), m, of every `step`-th contact."""
    step: int = 1

    def link_pose(self, link: str, row: int) -> Array:
        """T_w_link (4, 4) at contact `row`."""
        return np.asarray(self.poses[link][row // self.step])


@dataclass(frozen=True)
class Contact:
    """One contact as it is drawn, body frame."""

    patch: Array
    """Pose (4, 4) of the patch, z outward, x along the first principal direction, m."""
    semi_axes: Array
    """(2,) of the patch, m; NaN where the contact model does not hold."""
    indenter: Array
    """Pose (4, 4) of the sphere, z from its support to it, m."""


@dataclass(frozen=True)
class Stage:
    """A recording with the things that it is about."""

    recording: Recording
    belief: Belief
    """With a contact model and a reference force."""
    carrier: Carrier | None = None
    """None: the recording does not say how the body moves; the indenter moves about it."""
    column: tuple[float, float] | None = None
    """Radius and height of the indenter's support, m; None: not known, not drawn."""
    axis: Array | None = None
    """Unit vector (3,) from the support to the indenter, world frame."""
    truth: Array | None = None
    """True positions (n, 3) of the taxels, body frame, m, in a simulation."""

    @classmethod
    def of_recording(cls, recording: Recording, belief: Belief) -> Stage:
        """A recording of a robot about which nothing else is known."""
        return cls(recording, _drawable(belief, recording))

    @classmethod
    def of_scene(cls, recording: Recording, scene: Scene, belief: Belief) -> Stage:
        """The recording of a scene: its arm, its indenter, and the true taxels."""
        stage = replace(cls.of_recording(recording, belief), truth=scene.skin.positions)
        if recording.motion is None:  # an indenter that is carried to a body at rest
            return stage
        motion = recording.motion
        rows = _nearest(np.asarray(motion.column("time")), recording.time)
        moving = [name for name in motion.column_names if name[:1] == "q" and name[1:].isdigit()]
        free = ("x", "y", "z", "qw", "qx", "qy", "qz")
        q = np.stack([np.asarray(motion.column(k))[rows] for k in moving or free], axis=1)
        carrier = Carrier(scene.body_pose(q))
        if moving:
            arm = scene.arm
            robot = Robot(arm.name, Path(), arm.urdf, arm.tree, tuple(map(Path, arm.folders)))
            carrier = _carrier(robot, dict(zip(arm.joint_names, q.T, strict=True)), arm.base)
            carrier = _mounted(replace(carrier, body=scene.body_pose(q)), scene)
        column = (scene.indenter.column_radius, scene.indenter.support_height)
        return replace(stage, carrier=carrier, column=column, axis=scene.indenter.axis)

    @classmethod
    def of_log(
        cls, recording: Recording, belief: Belief, robot: Robot, link: str, log: SkinLog
    ) -> Stage:
        """A robot's log with joint angles: the robot, its body on `link`."""
        rows = _nearest(log.time, recording.time)
        angles = dict(zip(log.joint_names, log.joint_angles[rows].T, strict=True))
        carrier = _carrier(robot, angles, np.eye(4), without=link)
        body = robot.chain(robot.root, link)
        moved = np.stack([angles[name] for name in body.joint_names], axis=1)
        stage = cls.of_recording(recording, belief)
        return replace(stage, carrier=replace(carrier, body=body.poses(moved)))

    def contact(self, row: int) -> Contact:
        """The contact in row `row` of the recording, under the believed material."""
        belief, force = self.belief, float(self.recording.force[row])
        hit = belief.body.closest(self.recording.points[row][None])
        material = belief.material
        model = ContactModel(belief.contact, material.poisson, material.thickness)
        semi_axes, depth = np.full(2, np.nan), 0.0
        with suppress(ContactError):  # out of range of the model: the patch is not drawn
            found = model.patches(
                force=np.array([force if force > 0 else belief.force_reference]),
                curvature=hit.curvature,
                indenter_radius=belief.indenter.radius,
                effective_modulus=material.effective_modulus,
            )
            semi_axes, depth = np.array([found.first[0], found.second[0]]), float(found.depth[0])
        normal = hit.normal[0]
        axis = -normal
        if self.carrier is not None and self.axis is not None:
            axis = self.carrier.body[row, :3, :3].T @ self.axis
        centre = hit.point[0] + (belief.indenter.radius - depth) * normal
        return Contact(
            patch=transform(orthonormal_basis(normal, hit.direction[0]), hit.point[0]),
            semi_axes=semi_axes,
            indenter=transform(shortest_rotation([0.0, 0.0, 1.0], axis), centre),
        )

    def world_in_body(self, row: int) -> Array:
        """T_body_w (4, 4) at contact `row`; the identity where the motion is not known."""
        return np.eye(4) if self.carrier is None else inverse(self.carrier.body[row])


def _drawable(belief: Belief, recording: Recording) -> Belief:
    """The belief with a reference force and the contact model whose patches are drawn."""
    if belief.contact == LEARNED:  # its mean is the widest model that holds
        belief = replace(belief, contact=AUTO)
    try:
        return resolve_belief(belief, recording)
    except ContactError:  # no model holds in all contacts; those where it does have a patch
        return resolve_belief(replace(belief, contact="elliptic"), recording)


def _carrier(robot: Robot, angles: Mapping[str, Array], base: Array, without: str = "") -> Carrier:
    """The links of a robot, apart from the link `without`, at joint angles (m,) by joint name."""
    count = len(next(iter(angles.values())))
    step = -(-count // MAX_POSES)
    meshes = link_meshes(robot.tree, [*robot.folders, *robot.path.resolve().parents[:-1]])
    meshes.pop(without, None)  # the body is drawn in its place
    moved = link_poses(robot, {name: a[::step] for name, a in angles.items()})
    poses = {name: np.asarray(base @ moved[name]) for name in meshes}
    return Carrier(np.broadcast_to(np.eye(4), (count, 4, 4)), meshes, poses, step)


def _mounted(carrier: Carrier, scene: Scene) -> Carrier:
    """The carrier with a rod from the arm's tip to the nearest point of the body."""
    tip = inverse(scene.mount_pose)[:3, 3]
    end = transform_points(scene.mount_pose, scene.body.closest(tip[None]).point[0])
    if np.linalg.norm(end) < MIN_ROD:
        return carrier
    poses = carrier.body[:: carrier.step] @ inverse(scene.mount_pose)
    return replace(
        carrier,
        links={**carrier.links, "mount": rod(end)},
        poses={**carrier.poses, "mount": poses},
    )


def _nearest(times: Array, wanted: Array) -> NDArray[np.intp]:
    """Row (m,) of increasing `times` (n,) nearest to each of `wanted` (m,)."""
    after = np.clip(np.searchsorted(times, wanted), 1, max(len(times) - 1, 1))
    before = wanted - times[after - 1] < times[np.minimum(after, len(times) - 1)] - wanted
    return np.where(before, after - 1, np.minimum(after, len(times) - 1))
