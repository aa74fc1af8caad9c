"""Robot arms from URDF files: limits, kinematics, dynamics, inverse kinematics.

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
from numpy.typing import ArrayLike, NDArray

from ..errors import ArmError, ReachError, UnknownNameError

Array = NDArray[np.float64]

GRAVITY = 9.80665  # m/s^2, standard gravity
TOLERANCE = 1e-10  # largest position (m) and rotation (rad) error of inverse kinematics
LARGEST_STEP = 0.5  # rad, of one joint in one Newton step
TRACKING_STEPS = 2  # Newton steps per sample while following a path
MOVING = ("revolute", "continuous")  # adam 0.5 fails on prismatic joints


@dataclass(frozen=True)
class Joint:
    """One joint of a URDF file: where it sits on its parent link, and how it moves."""

    name: str
    kind: str
    parent: str
    child: str
    xyz: Array  # (3,) m, origin in the parent link's frame
    rpy: Array  # (3,) rad, fixed-axis roll, pitch, yaw of the origin
    axis: Array  # (3,) unit vector in the joint's frame
    limits: dict[str, float]  # lower, upper, velocity, effort: those that the file gives

    def motion(self, q: cs.SX | float) -> cs.SX:
        """Pose (4, 4) of the child link in the parent link at joint angle `q` (rad)."""
        origin, move = np.eye(4), cs.SX.eye(4)
        origin[:3, :3], origin[:3, 3] = rotation(self.rpy), self.xyz
        if self.kind != "fixed":
            x, y, z = self.axis
            along = np.outer(self.axis, self.axis)
            across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
            move[:3, :3] = along + cs.cos(q) * (np.eye(3) - along) + cs.sin(q) * across
        return cs.sparsify(cs.SX(origin)) @ cs.sparsify(move)


def rotation(rpy: ArrayLike) -> Array:
    """Rotation matrix (3, 3) of URDF angles (rad), Rz(yaw) Ry(pitch) Rx(roll).

    Entries within rounding of -1, 0, 1 are made exact: quarter turns then cost no instructions.
    """
    (sr, sp, sy), (cr, cp, cy) = np.sin(rpy), np.cos(rpy)
    r = np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )
    return np.where(np.abs(r - np.round(r)) < 1e-15, np.round(r), r)


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
        robot = _parse(urdf, where)
        _check_links(robot, where)
        joints = _chain(_joints(robot, where), _links(robot), tip, where)
        moving = [j for j in joints if j.kind != "fixed"]
        if not moving:
            raise ArmError(f"no moving joint leads to the link {tip!r}{where}", remedy="set tip=")
        for j in moving:
            if j.kind not in MOVING:
                raise ArmError(f"joint {j.name!r}{where} is {j.kind}", limit=" or ".join(MOVING))
            if j.kind != "continuous" and not {"lower", "upper"} <= j.limits.keys():
                raise ArmError(f"joint {j.name!r}{where} has no <limit lower= upper=>")
        free = [j.kind == "continuous" for j in moving]
        motors = _motors(robot, where)

        def limits(key: str) -> Array:
            return np.array([j.limits.get(key, math.inf) for j in moving])

        return cls(
            name=robot.get("name", "arm"),
            joint_names=tuple(j.name for j in moving),
            lower=np.where(free, -math.inf, limits("lower")),
            upper=np.where(free, math.inf, limits("upper")),
            velocity_limit=limits("velocity"),
            effort_limit=limits("effort"),
            reflected_inertia=np.array([motors.get(j.name, 0.0) for j in moving]),
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
        ET.SubElement(inertial, "origin", xyz=_numbers(c), rpy="0 0 0")
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
        """CasADi expressions of T_w_tip (4, 4) and the Jacobian (6, n) at joint angles (n,)."""
        robot = _parse(self.urdf, "")
        chain = _chain(_joints(robot, ""), _links(robot), self.tip, "")
        pose, axes, points = cs.SX.eye(4), [], []
        index = {name: k for k, name in enumerate(self.joint_names)}
        for joint in chain:
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
        """T_w_tip (..., 4, 4) at joint angles (..., n)."""
        return self._evaluate(0, q)

    def jacobian(self, q: ArrayLike) -> Array:
        """Jacobians (..., 6, n) at joint angles (..., n)."""
        return self._evaluate(1, q)

    def _evaluate(self, output: int, q: ArrayLike) -> Array:
        """Output (..., a, b) of the kinematics at joint angles (..., n)."""
        q = np.asarray(q, dtype=float)
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
        first pose that cannot be reached or that breaks a joint limit.
        """
        targets = _flat_poses(poses)
        first, _ = self._converge(np.reshape(np.asarray(seed, dtype=float), (1, -1)), targets[:1])
        track = self._newton.mapaccum("track", len(targets))
        q = track(first.T, targets.T)[0].full().T
        q, residual = self._converge(q, targets)
        if not np.all(residual < TOLERANCE):
            k = int(np.argmin(residual < TOLERANCE))
            raise ReachError(
                f"{self.name} cannot reach pose {k} of {len(q)}",
                value=f"residual {residual[k]:.3g} (m, rad)",
                limit=f"{TOLERANCE:g}",
                remedy="move the path nearer, sample it finer, or start from another seed",
            )
        self._check_limits(q)
        return q

    def solve(self, pose: ArrayLike, seeds: ArrayLike | None = None) -> Array:
        """Joint angles (n,) for one pose T_w_tip (4, 4): the solution farthest from all limits.

        Newton's method starts from `seeds` (k, n), or from 200 fixed pseudo-random ones between the
        limits; whole turns are taken off. Raises ReachError where none reaches the pose, or none
        within the joint limits.
        """
        target = _flat_poses(pose)
        low = np.where(np.isfinite(self.lower), self.lower, -math.pi)
        high = np.where(np.isfinite(self.upper), self.upper, math.pi)
        if seeds is None:
            seeds = np.random.default_rng(0).uniform(low, high, (200, len(low)))
        start = np.atleast_2d(np.asarray(seeds, dtype=float))
        q, residual = self._converge(start, np.repeat(target, len(start), axis=0), rounds=100)
        reached = residual < TOLERANCE
        if not reached.any():
            raise ReachError(
                f"{self.name} cannot reach the pose at {target[0, 9:].round(4).tolist()} m",
                value=f"residual {residual.min():.3g} (m, rad)",
                limit=f"{TOLERANCE:g}",
                remedy="move the pose nearer to the arm's base",
            )
        q = self._unwind(q[reached])
        margin = np.minimum(q - self.lower, self.upper - q).min(axis=1)
        best = q[np.argmax(margin)]
        self._check_limits(best[None])
        return np.asarray(best)

    def _unwind(self, q: Array) -> Array:
        """`q` (k, n) with whole turns removed, nearest the middle of the range."""
        with np.errstate(invalid="ignore"):
            middle = np.where(np.isfinite(self.lower), 0.5 * (self.lower + self.upper), 0.0)
        turns = np.round((q - middle) / (2.0 * math.pi))
        return np.asarray(q - 2.0 * math.pi * turns)

    def _check_limits(self, q: Array) -> None:
        """Raise ReachError for the first sample of `q` (k, n) outside the joint limits."""
        outside = (q < self.lower - 1e-9) | (q > self.upper + 1e-9)
        if outside.any():
            k, j = np.argwhere(outside)[0]
            raise ReachError(
                f"pose {k} of {len(q)} takes {self.joint_names[j]} of {self.name} past its limit",
                value=f"{q[k, j]:.4f} rad",
                limit=f"[{self.lower[j]:.4f}, {self.upper[j]:.4f}] rad",
                remedy="move the poses, or start from another configuration",
            )

    def _converge(self, q: Array, targets: Array, rounds: int = 30) -> tuple[Array, Array]:
        """Newton from all `q` (k, n) at once to `targets` (k, 12): angles, residuals (k,)."""
        q, residual, open_ = q.copy(), np.full(len(q), np.inf), np.arange(len(q))
        for _ in range(rounds):
            stepped, error = (o.full().T for o in self._newton_step(q[open_].T, targets[open_].T))
            residual[open_] = error[:, 0]
            unfinished = error[:, 0] >= TOLERANCE
            open_ = open_[unfinished]
            if not len(open_):
                break
            q[open_] = stepped[unfinished]
        return q, residual

    @cached_property
    def _newton_step(self) -> cs.Function:
        """(q (n,), target (12,)) -> (q after one step, residual before it).

        Levenberg-Marquardt: dq = J^T (J J^T + mu I)^-1 e with mu of the order of |e|^2, so that it
        is cautious far away and converges quadratically.
        """
        q, target = cs.SX.sym("q", len(self.joint_names)), cs.SX.sym("target", 12)
        pose, jacobian = self.kinematics(q)
        error = _pose_error(pose, cs.reshape(target[:9], 3, 3), target[9:])
        size = cs.dot(error, error)
        normal = jacobian @ jacobian.T + (0.01 * size + 1e-12) * cs.SX.eye(6)
        step = jacobian.T @ cs.ldl_solve(error, *cs.ldl(normal))
        step *= cs.fmin(1.0, LARGEST_STEP / (cs.norm_inf(step) + 1e-12))
        return cs.Function("newton", [q, target], [q + step, cs.sqrt(size)], {"cse": True})

    @cached_property
    def _newton(self) -> cs.Function:
        """Newton steps from the sample before to the next target: (q, target) -> q."""
        q, target = cs.SX.sym("q", len(self.joint_names)), cs.SX.sym("target", 12)
        following = q
        for _ in range(TRACKING_STEPS):
            following = self._newton_step(following, target)[0]
        return cs.Function("follow", [q, target], [following, following])


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
        factory = URDFModelFactory(_bare(arm), exact)
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


def _flat_poses(poses: ArrayLike) -> Array:
    """Poses (k, 4, 4) or (4, 4) as rows (k, 12): the rotation column by column, then the origin."""
    t = np.asarray(poses, dtype=float).reshape(-1, 4, 4)
    return np.concatenate([t[:, :3, :3].swapaxes(1, 2).reshape(-1, 9), t[:, :3, 3]], axis=1)


def _pose_error(pose: cs.SX, rotation: cs.SX, origin: cs.SX) -> cs.SX:
    """Displacement (6,) in world axes from `pose` to the target: m, then rotation vector."""
    now = pose[:3, :3]
    turn = 0.5 * sum((cs.cross(now[:, k], rotation[:, k]) for k in range(3)), cs.SX(3, 1))
    sine = cs.sqrt(cs.dot(turn, turn) + 1e-40)
    cosine = 0.5 * (cs.dot(now, rotation) - 1.0)
    return cs.vertcat(origin - pose[:3, 3], turn * (cs.atan2(sine, cosine) / sine))


def _parse(urdf: str, where: str) -> ET.Element:
    """Root element of URDF text."""
    try:
        robot = ET.fromstring(urdf)
    except ET.ParseError as error:
        raise ArmError(f"bad XML{where}: {error}") from error
    if robot.tag != "robot":
        raise ArmError(f"no URDF{where}: the root element is <{robot.tag}>", limit="<robot>")
    return robot


def _links(robot: ET.Element) -> list[str]:
    """Names of all links."""
    return [link.get("name", "") for link in robot.findall("link")]


def _check_links(robot: ET.Element, where: str) -> None:
    """Raise ArmError unless the links form one tree and every inertial is complete."""
    links, joints = _links(robot), _joints(robot, where)
    for j in joints:
        for link in {j.parent, j.child} - set(links):
            raise ArmError(
                f"joint {j.name!r}{where} names a link that is missing", value=repr(link)
            )
    children = [j.child for j in joints]
    roots = [link for link in links if link not in children]
    if len(roots) != 1 or len(set(children)) != len(children):
        raise ArmError(f"the links{where} form no tree", value=f"roots {roots}", limit="one root")
    for element in robot.findall("link"):
        if (inertial := element.find("inertial")) is not None:
            here = f" of link {element.get('name')!r}{where}"
            _vector(inertial.find("mass"), "value", "", 1, here)
            for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"):
                _vector(inertial.find("inertia"), key, "", 1, here)


def _vector(element: ET.Element | None, key: str, default: str, size: int, where: str) -> Array:
    """Numbers (size,) of an attribute."""
    text = default if element is None else element.get(key, default)
    try:
        values = np.array([float(part) for part in text.split()])
    except ValueError:
        values = np.array([math.nan])
    if values.shape != (size,) or not np.isfinite(values).all():
        raise ArmError(f"bad {key}{where}", value=repr(text), limit=f"{size} numbers")
    return values


def _numbers(values: ArrayLike) -> str:
    return " ".join(repr(float(v)) for v in np.asarray(values))


def _joints(robot: ET.Element, where: str) -> list[Joint]:
    """All joints of the file."""
    joints = []
    for e in robot.findall("joint"):
        name, here = e.get("name", ""), f" of joint {e.get('name')!r}{where}"
        ends = [
            end.get("link", "") if (end := e.find(k)) is not None else ""
            for k in ("parent", "child")
        ]
        if not all(ends):
            raise ArmError(f"no parent or child{here}")
        if e.find("mimic") is not None:
            raise ArmError(f"<mimic>{here} is not supported", remedy="make the joint fixed")
        origin, limit = e.find("origin"), e.find("limit")
        axis = _vector(e.find("axis"), "xyz", "1 0 0", 3, here)
        if not np.linalg.norm(axis) > 0.0:
            raise ArmError(f"zero axis{here}")
        given = {} if limit is None else limit.attrib
        joints.append(
            Joint(
                name=name,
                kind=e.get("type", ""),
                parent=ends[0],
                child=ends[1],
                xyz=_vector(origin, "xyz", "0 0 0", 3, here),
                rpy=_vector(origin, "rpy", "0 0 0", 3, here),
                axis=axis / np.linalg.norm(axis),
                limits={k: float(_vector(limit, k, "", 1, here)[0]) for k in given},
            )
        )
    return joints


def _chain(joints: list[Joint], links: list[str], tip: str, where: str) -> list[Joint]:
    """The joints from the root link to `tip`."""
    if tip not in links:
        raise UnknownNameError("link", tip, links, where)
    above = {j.child: j for j in joints}
    chain: list[Joint] = []
    while tip in above:
        chain.insert(0, above[tip])
        tip = above[tip].parent
        if len(chain) > len(joints):
            raise ArmError(f"the links form a loop{where}")
    return chain


def _motors(robot: ET.Element, where: str) -> dict[str, float]:
    """Reflected inertia (kg m^2) of each joint that has a motor."""
    motors: dict[str, float] = {}
    for transmission in robot.findall("transmission"):
        joint = transmission.find("joint")
        if joint is None:
            continue
        name = joint.get("name", "")
        found = {e.tag.rpartition("}")[2]: e for e in transmission.iter()}
        here = f" of the motor of {name!r}{where}"
        rotor = _vector(found.get("rotor_inertia"), "value", "0", 1, here)[0]
        gear = _vector(found.get("gear_ratio"), "value", "1", 1, here)[0]
        motors[name] = float(rotor * gear**2)
    return motors


def _bare(arm: Arm) -> str:
    """URDF text with links, inertials and joints only, joints beside the chain fixed."""
    source = _parse(arm.urdf, "")
    robot = ET.Element("robot", name=arm.name)
    for link in source.findall("link"):
        bare = ET.SubElement(robot, "link", name=link.get("name", ""))
        if (inertial := link.find("inertial")) is not None:
            if inertial.find("origin") is None:
                ET.SubElement(inertial, "origin", xyz="0 0 0", rpy="0 0 0")
            bare.append(inertial)
    for j in _joints(source, ""):
        kind = j.kind if j.name in arm.joint_names else "fixed"
        joint = ET.SubElement(robot, "joint", name=j.name, type=kind)
        ET.SubElement(joint, "parent", link=j.parent)
        ET.SubElement(joint, "child", link=j.child)
        ET.SubElement(joint, "origin", xyz=_numbers(j.xyz), rpy=_numbers(j.rpy))
        ET.SubElement(joint, "axis", xyz=_numbers(j.axis))
        ET.SubElement(joint, "limit", lower="0", upper="0", effort="0", velocity="0")
    return ET.tostring(robot, encoding="unicode")
