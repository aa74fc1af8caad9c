"""Robot arms from URDF files: limits, kinematics, dynamics.

The root link is fixed in the world at the pose `base`, by default the identity; the world's z axis
points up. `T_w_tip` is the pose of the tip link. Jacobians stack the tip's
linear velocity over its angular velocity, both in world axes (m/rad, rad/rad).

Source: Featherstone, "Rigid Body Dynamics Algorithms" (2008).
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ..core.arguments import read_text
from ..core.arrays import Array
from ..core.content_cache import cached_by_content
from ..core.errors import ArmError
from ..core.many_points import RowFunction
from ..core.se3 import inverse
from ..core.value import Value
from . import inverse_kinematics as ik
from .dynamics import Dynamics
from .urdf import Joint, UrdfTree, numbers

MOVING = ("revolute", "continuous", "prismatic")
RANK_POSTURES, RANK_TOLERANCE = 8, 1e-6
"""Random postures at which the rank of the Jacobian is taken, and the smallest singular value, m
and rad, that counts: those of rank-deficient arms are rounding, 1e-16."""


def _range(joint: Joint) -> tuple[float, float]:
    """Lowest and highest position of a joint."""
    if joint.kind == "continuous":
        return -math.inf, math.inf
    return joint.limits["lower"], joint.limits["upper"]


@dataclass(frozen=True)
class DrivenJoint:
    """A moving joint of the chain, and the joint of the arm that drives it."""

    joint: Joint
    column: int | None
    """Index of the arm's joint that drives it; None: a joint beside the chain, held at zero."""
    multiplier: float
    offset: float

    def position(self, q: ca.SX) -> ca.SX | float:
        """Position, rad or m, at the arm's joint angles `q` (n,)."""
        return self.offset + (0.0 if self.column is None else self.multiplier * q[self.column])


@dataclass(frozen=True, eq=False)
class Arm(Value):
    """A serial arm: the moving joints from the root link to the tip of a URDF file, in order.

    Joints that mimic others are not counted. For prismatic joints, angles and torques (rad, N m)
    stand for displacements and forces (m, N).
    """

    name: str
    """Name of the robot in the URDF file."""
    joint_names: tuple[str, ...]
    """Names of the n joints, from the root to the tip."""
    lower: Array
    """Lowest joint angles (n,), rad; -inf where continuous."""
    upper: Array
    """Highest joint angles (n,), rad; inf where continuous."""
    velocity_limit: Array
    """Largest joint speeds (n,), rad/s; inf where the file gives none or 0."""
    effort_limit: Array
    """Largest joint torques (n,), N m; inf where the file gives none or 0."""
    reflected_inertia: Array
    """Motor inertia at the joint (n,), kg m^2: rotor inertia times gear ratio squared."""
    tip: str
    """Name of the link whose pose is controlled and that carries the payload."""
    urdf: str
    """The text of the URDF file, with the payloads added."""
    damping: Array
    """Viscous friction of the joints (n,), N m s/rad; zero where the file gives none."""
    friction: Array
    """Coulomb friction of the joints (n,), N m; zero where the file gives none."""
    folders: tuple[str, ...] = ()
    """Folders that are searched for the links' meshes, which only the collision check needs."""
    base: Array = field(default_factory=lambda: np.eye(4))
    """T_w_base (4, 4): pose of the root link."""

    def __repr__(self) -> str:
        return f"<Arm {self.name!r}: {len(self.joint_names)} joints, tip {self.tip!r}>"

    @classmethod
    def from_urdf(
        cls, path: str | Path, tip: str = "tool0", folders: Iterable[str | Path] = ()
    ) -> Arm:
        """Read an arm from the URDF file at `path`; `tip` names the link whose pose is controlled.

        folders: searched for the links' meshes (`package://...`), besides the file's folder and its
        parents. Motors are read from `<transmission>` elements as Drake documents them:
        `rotor_inertia` (kg m^2) and `gear_ratio` under `actuator`. Moving joints beside the chain
        are held at zero, also those that drive a mimic joint of the chain. Raises ArmError (no
        file, not a URDF, no moving joint), UnknownNameError (no such tip).
        """
        text, path = read_text("the arm", path, error=ArmError), Path(path)
        own = path.resolve().parents
        every = (*folders, *own[:-1])
        arm = cls.from_text(text, tip, where=f" in {path.name}")
        return replace(arm, folders=tuple(str(folder) for folder in every))

    @classmethod
    def from_text(cls, urdf: str, tip: str = "tool0", where: str = "") -> Arm:
        """The arm described by URDF text, as `from_urdf`; `where` is appended to error messages."""
        robot = UrdfTree(urdf, where)
        every = [j for j in robot.chain(tip) if j.kind != "fixed"]
        for j in every:
            if j.kind not in MOVING:
                raise ArmError(f"joint {j.name!r}{where} is {j.kind}", limit=" or ".join(MOVING))
            if j.kind != "continuous" and not {"lower", "upper"} <= j.limits.keys():
                raise ArmError(f"joint {j.name!r}{where} has no <limit lower= upper=>")
        moving = [j for j in every if j.mimic is None]
        if not moving:
            raise ArmError(f"no moving joint leads to the link {tip!r}{where}", remedy="set tip=")
        inertia = robot.reflected_inertias()
        ranges = {j.name: _range(j) for j in moving}
        for j in every:  # the range of a mimic joint limits the joint that drives it
            driver = robot.resolve_mimic(j)
            if driver.joint in ranges and driver.multiplier:
                ends = sorted((end - driver.offset) / driver.multiplier for end in _range(j))
                low, high = ranges[driver.joint]
                ranges[driver.joint] = max(low, ends[0]), min(high, ends[1])

        def limits(key: str) -> Array:  # 0 stands for unknown in the files of real arms
            return np.array([j.limits.get(key) or math.inf for j in moving])

        return cls(
            name=robot.root.get("name", "arm"),
            joint_names=tuple(ranges),
            lower=np.array([low for low, _ in ranges.values()]),
            upper=np.array([high for _, high in ranges.values()]),
            velocity_limit=limits("velocity"),
            effort_limit=limits("effort"),
            reflected_inertia=np.array([inertia.get(j.name, 0.0) for j in moving]),
            tip=tip,
            urdf=urdf,
            damping=np.array([j.dynamics.get("damping", 0.0) for j in moving]),
            friction=np.array([j.dynamics.get("friction", 0.0) for j in moving]),
        )

    def with_payload(self, mass: float, com: ArrayLike, inertia: ArrayLike) -> Arm:
        """This arm with a rigid body mounted on its tip.

        `mass` in kg, `com` (3,) in m in the tip's frame, `inertia` (3, 3) in kg m^2 about the
        centre of mass in the tip's axes. Raises ArmError for a mass or inertia that no body has.
        """
        c, i = np.asarray(com, dtype=float), np.asarray(inertia, dtype=float)
        if c.shape != (3,) or i.shape != (3, 3):
            raise ArmError(
                "payload com and inertia have the wrong shape",
                value=f"{c.shape}, {i.shape}",
                limit="(3,), (3, 3)",
            )
        if not (np.isfinite(mass) and mass >= 0.0 and np.isfinite(c).all()):
            raise ArmError(
                "payload mass or com is out of range",
                value=f"{mass} kg at {c}",
                limit="finite, mass >= 0",
            )
        if not np.allclose(i, i.T) or np.linalg.eigvalsh(i)[0] < -1e-12 * np.abs(i).max():
            raise ArmError(
                "payload inertia must be symmetric and positive semidefinite", value=i.tolist()
            )
        robot = ET.fromstring(self.urdf)
        name = f"{self.tip}_payload{sum(1 for _ in robot.iter('link'))}"
        joint = ET.SubElement(robot, "joint", name=f"{name}_fixed", type="fixed")
        ET.SubElement(joint, "parent", link=self.tip)
        ET.SubElement(joint, "child", link=name)
        inertial = ET.SubElement(ET.SubElement(robot, "link", name=name), "inertial")
        ET.SubElement(inertial, "origin", xyz=numbers(c), rpy="0 0 0")
        ET.SubElement(inertial, "mass", value=repr(float(mass)))
        entries = {
            f"i{'xyz'[a]}{'xyz'[b]}": repr(float(i[a, b])) for a in range(3) for b in range(a, 3)
        }
        ET.SubElement(inertial, "inertia", entries)
        return replace(self, urdf=ET.tostring(robot, encoding="unicode"))

    def with_base(self, base: ArrayLike) -> Arm:
        """This arm with its root link at `base`, T_w_base (4, 4).

        Raises ArmError if `base` is not a rigid transform.
        """
        pose = np.array(base, dtype=float)
        rigid = pose.shape == (4, 4) and np.allclose(pose @ inverse(pose), np.eye(4), atol=1e-9)
        if not rigid or np.linalg.det(pose) < 0.0:
            raise ArmError(
                "base of an arm must be a rigid transform T_w_base (4, 4)", value=pose.tolist()
            )
        return replace(self, base=pose)

    @cached_property
    def holds_any_pose(self) -> bool:
        """Whether the tip can move in all six directions, in any of RANK_POSTURES random postures.

        Not so with fewer than six joints, or with more than three parallel axes among six.
        """
        q = np.random.default_rng(0).uniform(-1.0, 1.0, (RANK_POSTURES, len(self.joint_names)))
        return bool(np.linalg.matrix_rank(self.jacobian(q), tol=RANK_TOLERANCE).max() == 6)

    def dynamics(self) -> Dynamics:
        """The arm's dynamics as CasADi expressions, built once."""
        return self._dynamics

    @cached_property
    def _dynamics(self) -> Dynamics:
        return Dynamics(self)

    def kinematics(self, q: ca.SX) -> tuple[ca.SX, ca.SX]:
        """CasADi expressions of T_w_tip (4, 4) and the Jacobian (6, n) at joint angles (n,).

        Raises ArmError if `q` has another shape.
        """
        if q.shape != (len(self.joint_names), 1):
            raise ArmError(
                "q has the wrong shape", value=q.shape, limit=f"({len(self.joint_names)}, 1)"
            )
        poses, driven = self.link_poses(q), {d.joint.name: d for d in self.driven}
        pose, jacobian = poses[-1], ca.SX.zeros(6, len(self.joint_names))
        for joint, moved in zip(self.chain, poses[1:], strict=True):
            by = driven.get(joint.name)
            if by and by.column is not None:
                # the joint's own motion leaves its axis unchanged
                axis, point = moved[:3, :3] @ joint.axis, moved[:3, 3]
                slides = joint.kind == "prismatic"
                linear = axis if slides else ca.cross(axis, pose[:3, 3] - point)
                angular = ca.SX.zeros(3) if slides else axis
                jacobian[:, by.column] += by.multiplier * ca.vertcat(linear, angular)
        return ca.densify(pose), ca.densify(jacobian)

    def link_poses(self, q: ca.SX) -> list[ca.SX]:
        """CasADi expressions of the poses (4, 4), world frame, of the chain's links, root first."""
        driven = {d.joint.name: d for d in self.driven}
        poses = [ca.SX(ca.sparsify(ca.DM(self.base)))]
        for joint in self.chain:
            by = driven.get(joint.name)
            poses.append(poses[-1] @ joint.motion(by.position(q) if by else 0.0))
        return poses

    @cached_property
    def driven(self) -> tuple[DrivenJoint, ...]:
        """Every moving joint of the chain, mimic joints included, in order."""
        index, found = {name: k for k, name in enumerate(self.joint_names)}, []
        for joint in self.chain:
            if joint.kind != "fixed":
                by = self.tree.resolve_mimic(joint)
                found.append(DrivenJoint(joint, index.get(by.joint), by.multiplier, by.offset))
        return tuple(found)

    @cached_property
    def tree(self) -> UrdfTree:
        """The links and joints of the URDF text."""
        return UrdfTree(self.urdf)

    @cached_property
    def chain(self) -> tuple[Joint, ...]:
        """The joints from the root link to the tip, fixed joints included, in order."""
        return tuple(self.tree.chain(self.tip))

    def pose(self, q: ArrayLike) -> Array:
        """T_w_tip (..., 4, 4) at joint angles (..., n). Raises ArmError for a wrong shape."""
        return _evaluate(self, self._pose, 4, q)

    def jacobian(self, q: ArrayLike) -> Array:
        """Jacobians (..., 6, n) at joint angles (..., n). Raises ArmError for a wrong shape."""
        return _evaluate(self, self._jacobian, 6, q)

    @cached_property
    def _pose(self) -> RowFunction:
        return _pose(self)

    @cached_property
    def _jacobian(self) -> RowFunction:
        return _jacobian(self)

    def inverse_kinematics(self, poses: ArrayLike, seed: ArrayLike) -> Array:
        """Joint angles (k, n) whose tip follows `poses` T_w_tip (k, 4, 4), in order.

        The path starts at the solution that Newton's method finds from `seed` (n,) and stays on its
        branch: every sample starts from the one before it, so that joints may wind up but do not
        jump. Position (m) and rotation (rad) errors are below 1e-10. Raises ReachError for the
        first pose that cannot be reached or that violates a joint limit, ArmError for wrong shapes.
        """
        return ik.inverse_kinematics(self, poses, seed)

    def solve(self, pose: ArrayLike, seeds: ArrayLike | None = None) -> Array:
        """Joint angles (n,) for one pose T_w_tip (4, 4): the solution farthest from all limits.

        Newton's method starts from `seeds` (k, n), or from 200 fixed pseudo-random ones between the
        limits; whole turns are removed. Raises ReachError where none reaches the pose, or none
        within the joint limits, ArmError for wrong shapes.
        """
        return ik.solve(self, pose, seeds)

    @cached_property
    def newton(self) -> ik.Newton:
        """The iterations of inverse kinematics, built once."""
        return ik.newton(self)


def _evaluate(arm: Arm, function: RowFunction, height: int, q: ArrayLike) -> Array:
    """Matrices (..., height, m) of a function at joint angles (..., n) of an arm."""
    q = ik.check_shape("q", q, (len(arm.joint_names),), batch=None)
    flat = function(q.reshape(-1, q.shape[-1]))
    columns = flat.reshape(*q.shape[:-1], -1, height)
    return np.ascontiguousarray(columns.swapaxes(-1, -2))


@cached_by_content
def _pose(arm: Arm) -> RowFunction:
    q = ca.SX.sym("q", len(arm.joint_names))
    return RowFunction.compiled("pose", q, arm.kinematics(q)[0])


@cached_by_content
def _jacobian(arm: Arm) -> RowFunction:
    q = ca.SX.sym("q", len(arm.joint_names))
    return RowFunction.compiled("jacobian", q, arm.kinematics(q)[1])
