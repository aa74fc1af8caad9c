"""URDF text: its joints, links and motors, checked; and the reduced text that adam reads.

yourdfpy (0.0.60) was weighed for the parsing: it accepts axes of two numbers, joints to missing
links and incomplete inertials, raises bare KeyErrors and AttributeErrors, and drops the motor
elements; all checks here would remain.
"""

from __future__ import annotations

import copy
import xml.etree.ElementTree as ET
from collections.abc import Iterable
from dataclasses import dataclass
from functools import partial

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import Array
from ..core.errors import ArmError, UnknownNameError
from ..core.se3 import from_rpy
from ..geometry.mesh import link_mesh

vector = partial(link_mesh.vector, error=ArmError)
"""The numbers of an attribute of a URDF file; raises ArmError."""


@dataclass(frozen=True)
class Mimic:
    """The joint that drives another one, whose position is multiplier * q + offset."""

    joint: str
    multiplier: float
    offset: float


@dataclass(frozen=True)
class Joint:
    """One joint of a URDF file."""

    name: str
    kind: str
    """"revolute", "continuous", "prismatic", "fixed", ..."""
    parent: str
    child: str
    xyz: Array
    """Origin (3,) in the parent link's frame, m."""
    rpy: Array
    """Fixed-axis roll, pitch and yaw (3,) of the origin, rad."""
    axis: Array
    """Unit vector (3,) in the joint's frame."""
    limits: dict[str, float]
    """"lower", "upper", "velocity" and "effort", as far as the file gives them."""
    dynamics: dict[str, float]
    """Damping and friction."""
    mimic: Mimic | None = None

    def motion(self, q: ca.SX | float) -> ca.SX:
        """Pose (4, 4) of the child link in the parent link at joint position `q`, rad or m."""
        origin, move = np.eye(4), ca.SX.eye(4)
        origin[:3, :3], origin[:3, 3] = rotation(self.rpy), self.xyz
        if self.kind == "prismatic":
            move[:3, 3] = self.axis * q
        elif self.kind != "fixed":
            x, y, z = self.axis
            along = np.outer(self.axis, self.axis)
            across = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
            move[:3, :3] = along + ca.cos(q) * (np.eye(3) - along) + ca.sin(q) * across
        return ca.sparsify(ca.SX(origin)) @ ca.sparsify(move)


def rotation(rpy: ArrayLike) -> Array:
    """Rotation matrix (3, 3) of URDF angles (3,), rad, as `se3.from_rpy`.

    Entries within rounding of -1, 0 and 1 become exact, so that expressions of quarter turns have
    no products.
    """
    r = from_rpy(rpy)
    return np.where(np.abs(r - np.round(r)) < 1e-15, np.round(r), r)


class UrdfTree:
    """The links, joints and motors of URDF text, checked.

    `where` is appended to error messages. Raises ArmError unless the links form one tree and every
    inertial is complete.
    """

    def __init__(self, urdf: str, where: str = "") -> None:
        self.where = where
        try:
            self.root = ET.fromstring(urdf)
        except ET.ParseError as error:
            raise ArmError(f"bad XML{where}: {error}") from error
        if self.root.tag != "robot":
            raise ArmError(
                f"not a URDF{where}: the root element is <{self.root.tag}>", limit="<robot>"
            )
        self.links = {e.get("name", ""): e for e in self.root.findall("link")}
        self.joints = [_joint(element, where) for element in self.root.findall("joint")]
        for j in self.joints:
            for link in {j.parent, j.child} - set(self.links):
                raise ArmError(
                    f"joint {j.name!r}{where} names a link that is missing", value=repr(link)
                )
        names = [j.name for j in self.joints]
        if twice := next((name for name in names if names.count(name) > 1), None):
            raise ArmError(f"two joints{where} have one name", value=twice)
        children = [j.child for j in self.joints]
        roots = [link for link in self.links if link not in children]
        elements = self.root.findall("link")
        if len(roots) != 1 or len(self.links) < len(elements) or len(set(children)) < len(children):
            raise ArmError(
                f"the links{where} do not form a tree", value=f"roots {roots}", limit="one root"
            )
        for name, element in self.links.items():
            if (inertial := element.find("inertial")) is not None:
                here = f" of link {name!r}{where}"
                vector(inertial.find("mass"), "value", "", 1, here)
                for key in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz"):
                    vector(inertial.find("inertia"), key, "", 1, here)

    def chain(self, tip: str) -> list[Joint]:
        """The joints from the root link to `tip`, in order. Raises ArmError, UnknownNameError."""
        if tip not in self.links:
            raise UnknownNameError("link", tip, self.links, self.where)
        above = {j.child: j for j in self.joints}
        found: list[Joint] = []
        while tip in above:
            found.insert(0, above[tip])
            tip = above[tip].parent
            if len(found) > len(self.joints):
                raise ArmError(f"the links form a loop{self.where}")
        return found

    def resolve_mimic(self, joint: Joint) -> Mimic:
        """The joint that `joint` follows through all mimics; itself if it mimics none.

        Raises ArmError.
        """
        joints = {j.name: j for j in self.joints}
        name, multiplier, offset = joint.name, 1.0, 0.0
        for _ in joints:
            mimic = joints[name].mimic
            if mimic is None:
                return Mimic(name, multiplier, offset)
            if mimic.joint not in joints:
                raise ArmError(
                    f"joint {name!r}{self.where} mimics a joint that is missing", value=mimic.joint
                )
            name, offset = mimic.joint, offset + multiplier * mimic.offset
            multiplier *= mimic.multiplier
        raise ArmError(f"joint {joint.name!r}{self.where} mimics itself")

    def reflected_inertias(self) -> dict[str, float]:
        """Reflected inertia, kg m^2, of each joint that has a motor."""
        motors: dict[str, float] = {}
        for transmission in self.root.findall("transmission"):
            joint = transmission.find("joint")
            if joint is None:
                continue
            name = joint.get("name", "")
            found = {e.tag.rpartition("}")[2]: e for e in transmission.iter()}
            here = f" of the motor of {name!r}{self.where}"
            rotor = vector(found.get("rotor_inertia"), "value", "0", 1, here)[0]
            gear = vector(found.get("gear_ratio"), "value", "1", 1, here)[0]
            motors[name] = float(rotor * gear**2)
        return motors

    def massless_links(self, joint: Joint, moving: Iterable[str]) -> list[str]:
        """The links that `joint` moves, up to the next `moving` joints, if none has a mass."""
        free, moved = set(moving), [joint.child]
        for name in moved:  # grows while it is iterated
            moved += [j.child for j in self.joints if j.parent == name and j.name not in free]
        masses = (vector(self.links[k].find("inertial/mass"), "value", "0", 1, "") for k in moved)
        return [] if any(mass[0] > 0.0 for mass in masses) else moved

    def reduced(self, name: str, moving: Iterable[str]) -> str:
        """URDF text of links, inertials and joints only; joints not in `moving` become fixed."""
        robot, free = ET.Element("robot", name=name), set(moving)
        for link_name, link in self.links.items():
            kept = ET.SubElement(robot, "link", name=link_name)
            if (inertial := copy.deepcopy(link.find("inertial"))) is not None:
                if inertial.find("origin") is None:
                    ET.SubElement(inertial, "origin", xyz="0 0 0", rpy="0 0 0")
                kept.append(inertial)
        for j in self.joints:
            kind = j.kind if j.name in free else "fixed"
            joint = ET.SubElement(robot, "joint", name=j.name, type=kind)
            ET.SubElement(joint, "parent", link=j.parent)
            ET.SubElement(joint, "child", link=j.child)
            ET.SubElement(joint, "origin", xyz=numbers(j.xyz), rpy=numbers(j.rpy))
            ET.SubElement(joint, "axis", xyz=numbers(j.axis))
            ET.SubElement(joint, "limit", lower="0", upper="0", effort="0", velocity="0")
        return ET.tostring(robot, encoding="unicode")


def numbers(values: ArrayLike) -> str:
    """Numbers as the text of an attribute, exact to the last bit."""
    return " ".join(repr(float(v)) for v in np.asarray(values))


def _joint(element: ET.Element, where: str) -> Joint:
    """One joint of the file."""
    here = f" of joint {element.get('name')!r}{where}"
    parent, child = (
        "" if (end := element.find(key)) is None else end.get("link", "")
        for key in ("parent", "child")
    )
    if not (parent and child):
        raise ArmError(f"no parent or child{here}")
    origin, limit = element.find("origin"), element.find("limit")
    dynamics = element.find("dynamics")
    axis = vector(element.find("axis"), "xyz", "1 0 0", 3, here)
    length, kind = np.linalg.norm(axis), element.get("type", "")
    if not length > 0.0:
        if kind != "fixed":
            raise ArmError(f"zero axis{here}")
        axis, length = np.array([1.0, 0.0, 0.0]), np.float64(1.0)
    given = {} if limit is None else limit.attrib
    limits = {key: float(vector(limit, key, "", 1, here)[0]) for key in given}
    lower, upper = limits.get("lower", 0.0), limits.get("upper", 0.0)
    if kind in ("revolute", "prismatic") and lower > upper:
        raise ArmError(f"the lower limit{here} is above the upper one", value=f"{lower} > {upper}")
    return Joint(
        name=element.get("name", ""),
        kind=kind,
        parent=parent,
        child=child,
        xyz=vector(origin, "xyz", "0 0 0", 3, here),
        rpy=vector(origin, "rpy", "0 0 0", 3, here),
        axis=axis / length,
        limits=limits,
        dynamics={
            key: float(vector(dynamics, key, "0", 1, here)[0]) for key in ("damping", "friction")
        },
        mimic=_mimic(element.find("mimic"), here),
    )


def _mimic(element: ET.Element | None, where: str) -> Mimic | None:
    """The joint that drives another one, if any."""
    if element is None:
        return None
    multiplier = vector(element, "multiplier", "1", 1, where)[0]
    offset = vector(element, "offset", "0", 1, where)[0]
    return Mimic(element.get("joint", ""), float(multiplier), float(offset))
