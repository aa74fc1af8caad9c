"""The data that define the closed loop: its parts, its parameters, the layout of its arrays."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any

import numpy as np

from ..contact import ContactModel
from ..core.arguments import check_name
from ..core.arrays import Array
from ..core.se3 import inverse, poses_of_states, quaternion
from ..robot import turntable
from ..scene.settings import INTEGRATORS, MODES, Law

if TYPE_CHECKING:
    from ..robot.arm import Arm
    from ..scene.scene import Scene

REFERENCE = 18
"""Length of a reference: body position (3), body rotation (9, by columns), linear velocity (3) and
angular velocity (3), all in the world frame."""
ANCHOR = 69
"""Length of an anchor: a face's surface patch (21, 3) and an affine map (2, 3), column-major.

The map takes (u, v, 1) of the previous step's foot point, on the previous face, to this face."""


@dataclass(frozen=True)
class Parameters:
    """Parameters that are inputs of the step function: changing one needs no new function.

    The values are floats, or CasADi symbols when they are chosen by optimization.
    """

    dt: Any
    """Step, s."""
    gamma: Any
    """Gain of the force law, 1/s."""
    rate: Any
    """Velocity gain L: 1/s with shape "inertia", N m s/rad with shape "identity"."""
    force_reference: Any
    """Reference contact force, N."""
    approach_speed: Any
    """Largest speed that the force law asks for, m/s."""
    tracking: Any
    """Gain of the pose error along the path, 1/s."""
    effective_modulus: Any
    """E*, Pa."""
    indenter_radius: Any
    """m."""
    track_normal: Any = 0.0
    """0: the law controls the force along the contact normal; 1: the body follows the path along
    the normal, too, and the force is not controlled."""

    @classmethod
    def split(cls, vector: Any) -> Parameters:
        """The parameters in a CasADi or NumPy vector (9,)."""
        return cls(*(vector[k] for k in range(len(fields(cls)))))

    @property
    def values(self) -> list[Any]:
        """The parameters as a list (9,), in the order of the fields."""
        return [getattr(self, f.name) for f in fields(self)]


PARAMETERS = len(fields(Parameters))
"""Number of parameters of a step."""
_NAMES = [f.name for f in fields(Parameters)]
FORCE_REFERENCE, APPROACH_SPEED = map(_NAMES.index, ("force_reference", "approach_speed"))
"""Indices among the parameters of those that change during a run."""


@dataclass(frozen=True)
class ClosedLoopModel:
    """The parts of a scene that determine the step function of its closed loop."""

    arm: Arm
    """The arm with its payload."""
    mount: Array
    """T_tip_body (4, 4)."""
    indenter_position: Array
    """Centre of the indenter (3,), world, m."""
    indenter_radius: float
    effective_modulus: float
    """E*, Pa."""
    law: Law
    dt: float
    """Step, s."""
    integrator: str = "semi_implicit"
    """One of INTEGRATORS; not used with mode "quasi_static"."""
    mode: str = "arm"
    """"arm": the arm's dynamics; "quasi_static": no arm, the body moves at the law's velocity."""
    contact: ContactModel = field(default_factory=ContactModel)
    """Contact model that gives the force."""
    delay: int = 0
    """Age of the contact measurement that the law receives, in steps."""
    indenter_direction: Array = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))
    """Unit vector (3,), world frame, in which the indenter points; the body lifts off along it."""

    def __post_init__(self) -> None:
        check_name("integrator", self.integrator, INTEGRATORS)
        check_name("mode of the closed loop", self.mode, MODES)

    @classmethod
    def of(cls, scene: Scene) -> ClosedLoopModel:
        """The closed loop of a scene, with the body's mass at the arm's tip."""
        return cls(
            arm=_arm_with_payload(scene),
            mount=scene.mount_pose,
            indenter_position=np.array(scene.indenter.position),
            indenter_radius=scene.indenter.radius,
            indenter_direction=scene.indenter.axis,
            effective_modulus=scene.material.effective_modulus,
            law=scene.law,
            dt=scene.loop.dt,
            integrator=scene.loop.integrator,
            mode=scene.loop.mode,
            contact=scene.model,
            delay=scene.loop.delay_steps,
        )

    @property
    def joints(self) -> int:
        """Number of joints n; 0 in mode "quasi_static"."""
        return len(self.arm.joint_names) if self.mode == "arm" else 0

    @property
    def memory(self) -> int:
        """Length of the part of the state that holds delayed measurements: 2 per step of delay."""
        return 2 * self.delay

    @property
    def parameters(self) -> Parameters:
        """The parameters of the step function."""
        law = self.law
        return Parameters(
            dt=self.dt,
            gamma=law.gamma,
            rate=law.rate if law.shape == "inertia" else law.gain,
            force_reference=law.force_reference,
            approach_speed=law.approach_speed,
            tracking=law.tracking,
            effective_modulus=self.effective_modulus,
            indenter_radius=self.indenter_radius,
        )

    @property
    def outputs(self) -> dict[str, slice]:
        """Slices of a step's output (9 + n,) by name.

        point (3,) and normal (3,) of the contact in the body frame, m; force, N; depth, m; radius:
        relative radius of the two surfaces, m; torque (n,) of the joints, N m.
        """
        n = self.joints
        return {
            "point": slice(0, 3),
            "normal": slice(3, 6),
            "force": slice(6, 7),
            "depth": slice(7, 8),
            "radius": slice(8, 9),
            "torque": slice(9, 9 + n),
        }

    def body_poses(self, q: Array) -> Array:
        """T_w_b (k, 4, 4) in configurations (k, n): joint angles, or position and quaternion."""
        return np.asarray(self.arm.pose(q) @ self.mount) if self.joints else poses_of_states(q)

    def follow(self, poses: Array, q: Array) -> Array:
        """Joint angles (k, n) from `q` (n,) along T_w_b `poses` (k, 4, 4): `turntable.follow`."""
        tips = poses @ inverse(self.mount)
        line = self.indenter_position, self.indenter_direction
        return turntable.follow(self.arm, tips, q, *line)

    def indenter_centres(self, poses: Array) -> Array:
        """The indenter's centre (k, 3) in the body frame, m, at body poses T_w_b (k, 4, 4)."""
        offset = self.indenter_position - poses[:, :3, 3]
        return np.asarray(np.einsum("kji,kj->ki", poses[:, :3, :3], offset))


def flat_anchor(patch: Array) -> Array:
    """The anchor (69,) of a patch (21, 3) with the identity map."""
    return np.concatenate([patch.T.ravel(), np.eye(2, 3).T.ravel()])


def state_of_pose(poses: Array) -> Array:
    """Position and unit quaternion (..., 7), as in the state, of the body at T_w_b (..., 4, 4)."""
    turn = quaternion(poses[..., :3, :3])[..., [3, 0, 1, 2]]
    return np.concatenate([poses[..., :3, 3], turn], axis=-1)


def _arm_with_payload(scene: Scene) -> Arm:
    """The arm with the body's mass at its tip, as a homogeneous solid; with its convex hull for an
    open mesh, which encloses no volume. A quasi-static loop has no use for the mass.
    """
    if scene.payload == 0 or scene.loop.mode == "quasi_static":
        return scene.arm
    surface, pose = scene.body.surface, scene.mount_pose
    volume, centre, square = _moments(surface.vertices[surface.faces])
    if not (surface.closed and volume > 0):
        volume, centre, square = _moments(np.asarray(scene.body.mesh.convex_hull.triangles))
    inertia = scene.payload / volume * (np.trace(square) * np.eye(3) - square)
    com = pose[:3, :3] @ centre + pose[:3, 3]
    return scene.arm.with_payload(scene.payload, com, pose[:3, :3] @ inertia @ pose[:3, :3].T)


def _moments(triangles: Array) -> tuple[float, Array, Array]:
    """Volume, m^3, centre (3,), m, and second moments (3, 3), m^5, about the centre of the solid
    within triangles (m, 3, 3), by tetrahedra with the middle of the corners. trimesh's are the
    same, and take 0.6 s to import.
    """
    middle = triangles.mean(axis=(0, 1))
    corners = triangles - middle
    size, total = np.linalg.det(corners), corners.sum(axis=1)  # six times the volumes
    volume = float(size.sum()) / 6
    centre = size @ total / (24 * volume)
    square = np.einsum("m,mki,mkj->ij", size, corners, corners)
    square += np.einsum("m,mi,mj->ij", size, total, total)
    return volume, middle + centre, square / 120 - volume * np.outer(centre, centre)
