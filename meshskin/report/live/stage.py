"""What the live page shows besides the estimate: body, indenter, robot, and their poses in time."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from ...contact import AUTO, LEARNED
from ...core.arrays import Array, nearest_rows
from ...core.errors import ContactError
from ...core.se3 import (
    inverse,
    orthonormal_basis,
    poses_of_states,
    shortest_rotation,
    transform,
    transform_points,
)
from ...estimation.data.resolve_belief import contact_model, resolve_belief
from ...geometry.mesh.triangles import Triangles
from ...recording.recording import Recording
from ...recording.skin_log import SkinLog
from ...robot.link_meshes import MIN_ROD, LinkPoses, link_meshes, rod
from ...robot.robot import Robot
from ...scene.belief import Belief
from ...scene.scene import Scene


@dataclass(frozen=True)
class Carrier:
    """The robot that moves the body, or the body alone where only its pose is known."""

    body: Array
    """T_w_body (m, 4, 4) at each contact, m."""
    links: Mapping[str, Triangles] = field(default_factory=dict)
    """Triangles of each link that is drawn, link frame, m."""
    link_poses: Callable[[int], Mapping[str, Array]] = field(default=lambda row: {})
    """T_w_link (4, 4), m, of these links at contact `row`."""


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
        rows = nearest_rows(np.asarray(motion.column("time")), recording.time)
        moving = [name for name in motion.column_names if name[:1] == "q" and name[1:].isdigit()]
        free = ("x", "y", "z", "qw", "qx", "qy", "qz")
        q = np.stack([np.asarray(motion.column(k))[rows] for k in moving or free], axis=1)
        carrier = Carrier(scene.arm.pose(q) @ scene.mount_pose if moving else poses_of_states(q))
        if moving:
            arm = scene.arm
            robot = Robot(arm.name, Path(), arm.urdf, arm.tree, tuple(map(Path, arm.folders)))
            posed = _carrier(robot, carrier.body, arm.joint_names, q, arm.base)
            carrier = _mounted(posed, scene)
        column = (scene.indenter.column_radius, scene.indenter.support_height)
        return replace(stage, carrier=carrier, column=column, axis=scene.indenter.axis)

    @classmethod
    def of_log(
        cls, recording: Recording, belief: Belief, robot: Robot, link: str, log: SkinLog
    ) -> Stage:
        """A robot's log with joint angles: the robot, its body on `link`."""
        angles = log.joint_angles[nearest_rows(log.time, recording.time)]
        column = {name: k for k, name in enumerate(log.joint_names)}
        chain = robot.chain(robot.root, link)
        body = chain.poses(angles[:, [column[name] for name in chain.joint_names]])
        carrier = _carrier(robot, body, log.joint_names, angles, np.eye(4), without=link)
        return replace(cls.of_recording(recording, belief), carrier=carrier)

    def contact(self, row: int) -> Contact:
        """The contact in row `row` of the recording, under the believed material."""
        belief, force = self.belief, float(self.recording.force[row])
        hit = belief.body.closest(self.recording.points[row][None])
        model = contact_model(belief)
        semi_axes, depth = np.full(2, np.nan), 0.0
        with suppress(ContactError):  # out of range of the model: the patch is not drawn
            found = model.patches(
                force=np.array([force if force > 0 else belief.force_reference]),
                curvature=hit.curvature,
                indenter_radius=belief.indenter.radius,
                effective_modulus=belief.material.effective_modulus,
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


def _drawable(belief: Belief, recording: Recording) -> Belief:
    """The belief with a reference force and the contact model whose patches are drawn."""
    if belief.contact == LEARNED:  # its mean is the widest model that holds
        belief = replace(belief, contact=AUTO)
    try:
        return resolve_belief(belief, recording)
    except ContactError:  # no model holds in all contacts; those where it does have a patch
        return resolve_belief(replace(belief, contact="elliptic"), recording)


def _carrier(
    robot: Robot, body: Array, names: Sequence[str], angles: Array, base: Array, without: str = ""
) -> Carrier:
    """The links of a robot, apart from the link `without`, which is drawn as the body.

    angles (m, k): of the joints `names` at each contact; base: T_w_root (4, 4).
    """
    meshes = link_meshes(robot.tree, [*robot.folders, *robot.path.resolve().parents[:-1]])
    meshes.pop(without, None)
    posed = LinkPoses(robot, meshes)

    def poses(row: int) -> dict[str, Array]:
        found = posed.at(dict(zip(names, angles[row].tolist(), strict=True)))
        return {name: base @ pose for name, pose in found.items()}

    return Carrier(body, meshes, poses)


def _mounted(carrier: Carrier, scene: Scene) -> Carrier:
    """The carrier with a rod from the arm's tip to the nearest point of the body."""
    tip = inverse(scene.mount_pose)
    end = transform_points(scene.mount_pose, scene.body.closest(tip[None, :3, 3]).point[0])
    if np.linalg.norm(end) < MIN_ROD:
        return carrier
    return Carrier(
        carrier.body,
        {**carrier.links, "mount": rod(end)},
        lambda row: {**carrier.link_poses(row), "mount": carrier.body[row] @ tip},
    )
