"""Robot arms from URDF files: limits, kinematics, dynamics.

World = base: the root link is fixed at the world's origin, z up, gravity along -z. `T_w_tip` is the
pose of the tip link. Jacobians stack the tip's linear velocity over its angular velocity, both in
world axes (m/rad, rad/rad).

Source: Featherstone, "Rigid Body Dynamics Algorithms" (2008); the recursions are those of adam.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ET
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import casadi as cs
import numpy as np
from numpy.typing import ArrayLike

from ..errors import ArmError
from ..se3 import Array
from . import reach
from .urdf import bare, chain, check_links, numbers, parse, reflected_inertias, rotation

GRAVITY = 9.80665  # m/s^2, standard gravity
MOVING = ("revolute", "continuous")  # adam 0.5 fails on prismatic joints


@dataclass(frozen=True, eq=False)
class Arm:
    """A serial arm: the rotary joints from the root link to the tip of a URDF file, in order."""

    name: str
    joint_names: tuple[str, ...]
    lower: Array
    """Lowest joint angles (n,), rad; -inf where continuous."""
    upper: Array
    """Highest joint angles (n,), rad; inf where continuous."""
    velocity_limit: Array
    """Largest joint speeds (n,), rad/s; inf where the file gives none."""
    effort_limit: Array
    """Largest joint torques (n,), N m; inf where the file gives none."""
    reflected_inertia: Array
    """Motor inertia felt at the joint (n,), kg m^2: rotor inertia times gear ratio squared."""
    tip: str
    """Name of the link whose pose is controlled and that carries the payload."""
    urdf: str
    """The text of the URDF file, with the payloads added."""

    @classmethod
    def from_urdf(cls, path: str | Path, tip: str = "tool0") -> Arm:
        """Read an arm from the URDF file at `path`; `tip` names the link whose pose is controlled.

        Motors are read from `<transmission>` elements as Drake documents them: `rotor_inertia`
        (kg m^2) and `gear_ratio` under `actuator`. Moving joints beside the chain are held at zero.
        Raises ArmError (no file, no URDF, no moving joint), UnknownNameError (no such tip).
        """
        path = Path(path)
        try:
            text = path.read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise ArmError(f"cannot read the arm {str(path)!r}: {error}") from error
        return cls.from_text(text, tip, where=f" in {path.name}")

    @classmethod
    def from_text(cls, urdf: str, tip: str = "tool0", where: str = "") -> Arm:
        """The arm described by URDF text; `where` is added to error messages. As `from_urdf`."""
        robot = parse(urdf, where)
        check_links(robot, where)
        moving = [j for j in chain(robot, tip, where) if j.kind != "fixed"]
        if not moving:
            raise ArmError(f"no moving joint leads to the link {tip!r}{where}", remedy="set tip=")
        for j in moving:
            if j.kind not in MOVING:
                raise ArmError(f"joint {j.name!r}{where} is {j.kind}", limit=" or ".join(MOVING))
            if j.kind != "continuous" and not {"lower", "upper"} <= j.limits.keys():
                raise ArmError(f"joint {j.name!r}{where} has no <limit lower= upper=>")
        free = [j.kind == "continuous" for j in moving]
        inertia = reflected_inertias(robot, where)

        def limits(key: str) -> Array:
            return np.array([j.limits.get(key, math.inf) for j in moving])

        return cls(
            name=robot.get("name", "arm"),
            joint_names=tuple(j.name for j in moving),
            lower=np.where(free, -math.inf, limits("lower")),
            upper=np.where(free, math.inf, limits("upper")),
            velocity_limit=limits("velocity"),
            effort_limit=limits("effort"),
            reflected_inertia=np.array([inertia.get(j.name, 0.0) for j in moving]),
            tip=tip,
            urdf=urdf,
        )

    def __getstate__(self) -> dict[str, Any]:
        return {f.name: getattr(self, f.name) for f in fields(self)}  # without cached expressions

    def with_payload(self, mass: float, com: ArrayLike, inertia: ArrayLike) -> Arm:
        """This arm with a rigid body mounted on its tip.

        `mass` in kg, `com` (3,) in m in the tip's frame, `inertia` (3, 3) in kg m^2 about the
        centre of mass in the tip's axes. Raises ArmError for a body that cannot exist.
        """
        c, i = np.asarray(com, dtype=float), np.asarray(inertia, dtype=float)
        if c.shape != (3,) or i.shape != (3, 3):
            raise ArmError(
                "payload of wrong shape", value=f"{c.shape}, {i.shape}", limit="(3,), (3, 3)"
            )
        if not (np.isfinite(mass) and mass >= 0.0 and np.isfinite(c).all()):
            raise ArmError(
                "payload mass or com", value=f"{mass} kg at {c}", limit="finite, mass >= 0"
            )
        if not np.allclose(i, i.T) or np.linalg.eigvalsh(i)[0] < -1e-12 * np.abs(i).max():
            raise ArmError("payload inertia is not symmetric and positive", value=i.tolist())
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

    def dynamics(self) -> Dynamics:
        """The arm's dynamics as CasADi expressions, built once."""
        return self._dynamics

    @cached_property
    def _dynamics(self) -> Dynamics:
        return Dynamics(self)

    def kinematics(self, q: cs.SX) -> tuple[cs.SX, cs.SX]:
        """CasADi expressions of T_w_tip (4, 4) and the Jacobian (6, n) at joint angles (n,).

        Raises ArmError for `q` of the wrong shape.
        """
        if q.shape != (len(self.joint_names), 1):
            raise ArmError("q of wrong shape", value=q.shape, limit=f"({len(self.joint_names)}, 1)")
        pose, axes, points = cs.SX.eye(4), [], []
        index = {name: k for k, name in enumerate(self.joint_names)}
        for joint in chain(parse(self.urdf, ""), self.tip, ""):
            pose = pose @ joint.motion(q[index[joint.name]] if joint.name in index else 0.0)
            if joint.name in index:  # the axis is the same before and after the joint's own motion
                axes.append(pose[:3, :3] @ joint.axis)
                points.append(pose[:3, 3])
        columns = [
            cs.vertcat(cs.cross(axis, pose[:3, 3] - point), axis)
            for axis, point in zip(axes, points, strict=True)
        ]
        return cs.densify(pose), cs.densify(cs.horzcat(*columns))

    def pose(self, q: ArrayLike) -> Array:
        """T_w_tip (..., 4, 4) at joint angles (..., n). Raises ArmError for a wrong shape."""
        return self._evaluate(0, q)

    def jacobian(self, q: ArrayLike) -> Array:
        """Jacobians (..., 6, n) at joint angles (..., n). Raises ArmError for a wrong shape."""
        return self._evaluate(1, q)

    def _evaluate(self, output: int, q: ArrayLike) -> Array:
        """Output (..., a, b) of the kinematics at joint angles (..., n)."""
        q = reach.shaped("q", q, (len(self.joint_names),), batch=None)
        f = self._kinematics_function
        a, b = f.size_out(output)
        flat = f(q.reshape(-1, f.size1_in(0)).T)[output].full()  # (a, k b)
        stacked = flat.reshape(a, -1, b).swapaxes(0, 1)
        return np.ascontiguousarray(stacked).reshape(*q.shape[:-1], a, b)

    @cached_property
    def _kinematics_function(self) -> cs.Function:
        q = cs.SX.sym("q", len(self.joint_names))
        return cs.Function("kinematics", [q], self.kinematics(q), {"cse": True})

    def inverse_kinematics(self, poses: ArrayLike, seed: ArrayLike) -> Array:
        """Joint angles (k, n) whose tip follows `poses` T_w_tip (k, 4, 4), in order.

        The path starts from the solution that Newton's method reaches from `seed` (n,) and stays on
        its branch: every sample starts from the one before it, so that joints may wind up but never
        jump. Position (m) and rotation (rad) errors end below 1e-10. Raises ReachError for the
        first pose that cannot be reached or that breaks a joint limit, ArmError for wrong shapes.
        """
        return reach.inverse_kinematics(self, poses, seed)

    def solve(self, pose: ArrayLike, seeds: ArrayLike | None = None) -> Array:
        """Joint angles (n,) for one pose T_w_tip (4, 4): the solution farthest from all limits.

        Newton's method starts from `seeds` (k, n), or from 200 fixed pseudo-random ones between the
        limits; whole turns are taken off. Raises ReachError where none reaches the pose, or none
        within the joint limits, ArmError for wrong shapes.
        """
        return reach.solve(self, pose, seeds)

    @cached_property
    def newton(self) -> reach.Newton:
        """The iterations of inverse kinematics as CasADi functions, built once."""
        return reach.newton(self)


class Dynamics:
    """Expressions of an arm's equations of motion, M(q) qdd + bias(q, qd) = torque + J^T wrench."""

    def __init__(self, arm: Arm) -> None:
        from adam.casadi.casadi_like import SpatialMath
        from adam.core import RBDAlgorithms
        from adam.model import Model
        from adam.model.std_factories.std_model import URDFModelFactory

        class ExactMath(SpatialMath):
            """adam's mathematics with exact quarter turns: 40 % fewer instructions."""

            def R_from_RPY(self, rpy: Any) -> Any:
                angles = cs.DM(rpy.array).full().ravel()
                return self.factory.asarray(cs.sparsify(cs.SX(rotation(angles))))

        exact = ExactMath()
        factory = URDFModelFactory(bare(arm.urdf, arm.name, arm.joint_names), exact)
        model = Model.build(factory, joints_name_list=list(arm.joint_names))
        self._arm, self._adam = arm, RBDAlgorithms(model, exact)

    def mass_matrix(self, q: cs.SX) -> cs.SX:
        """Mass matrix (n, n), kg m^2, with the motors' reflected inertia, at angles `q` (n,)."""
        m = self._adam.crba(cs.SX.eye(4), q)[0].array[6:, 6:]
        return cs.densify(m + cs.diag(cs.DM(self._arm.reflected_inertia)))

    def bias(self, q: cs.SX, qd: cs.SX) -> cs.SX:
        """Coriolis, centrifugal and gravity torques (n,), N m, at `q` and velocities `qd` (n,)."""
        gravity = cs.SX([0.0, 0.0, -GRAVITY, 0.0, 0.0, 0.0])
        torque = self._adam.rnea(cs.SX.eye(4), q, cs.SX(6, 1), qd, gravity).array
        return cs.densify(torque[6:])

    def pose(self, q: cs.SX) -> cs.SX:
        """T_w_tip (4, 4)."""
        return self._arm.kinematics(q)[0]

    def jacobian(self, q: cs.SX) -> cs.SX:
        """Jacobian (6, n) of the tip, linear over angular velocity, world axes."""
        return self._arm.kinematics(q)[1]
