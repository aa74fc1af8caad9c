"""Taxel frames in URDF: fixed joints `<part>_skin_<id>`, with or without a suffix, to a link.

In the URDF of iCub (icub-models) they are frames of modules: the number is the module's, the origin
its centre, z the outward normal; the rotation about z is not the module's. A file written by
meshskin holds one frame a taxel, with the taxel's disc for viewers.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET

import numpy as np

from ...core import se3
from ...core.arrays import Array
from ...core.errors import SkinError
from ..slots import Ids
from .table import DISC_RADIUS, SkinTable, parse_numbers

_NAME = re.compile(r"(.+)_skin_(\d+)(?:_fixed_joint|_joint)?")
THICKNESS = 1e-3
"""Thickness of a disc for viewers, m."""


def write(poses: Array, ids: Ids, disc_radius: float, part: str) -> str:
    """Text with one link and one fixed joint a taxel on the link `part`; exact to rounding."""
    robot = ET.Element("robot", name=f"{part}_skin")
    ET.SubElement(robot, "link", name=part)
    for taxel, pose in zip(ids.tolist(), poses, strict=True):
        frame = f"{part}_skin_{taxel}"
        link = ET.SubElement(robot, "link", name=frame)
        shape = ET.SubElement(ET.SubElement(link, "visual"), "geometry")
        ET.SubElement(shape, "cylinder", radius=repr(float(disc_radius)), length=repr(THICKNESS))
        joint = ET.SubElement(robot, "joint", name=f"{frame}_fixed_joint", type="fixed")
        ET.SubElement(joint, "origin", xyz=_text(pose[:3, 3]), rpy=_text(_angles(pose[:3, :3])))
        ET.SubElement(joint, "parent", link=part)
        ET.SubElement(joint, "child", link=frame)
    ET.indent(robot)
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"


def read(text: str, name: str, part: str | None = None) -> SkinTable:
    """The frames of one part (None: the only one) in the frame of its link. Raises SkinError."""
    try:
        robot = ET.fromstring(text)
    except ET.ParseError as error:
        raise SkinError(f"{name} is not XML", value=str(error)) from error
    frames: dict[str, list[tuple[int, ET.Element]]] = {}
    for joint in robot.findall("joint"):
        match = _NAME.fullmatch(joint.get("name", ""))
        if match and joint.get("type") == "fixed":
            frames.setdefault(match[1], []).append((int(match[2]), joint))
    if not frames:
        raise SkinError(f"{name} has no skin", limit="fixed joints <part>_skin_<id>")
    if part is None and len(frames) == 1:
        part = next(iter(frames))
    if part not in frames:
        raise SkinError(
            f"part of {name}",
            value=part,
            limit=", ".join(frames),
            remedy="choose one with part= (--part)",
        )
    poses = np.array([_pose(joint, name) for _, joint in frames[part]])
    radius = robot.find(f"link[@name='{part}_skin_{frames[part][0][0]}']/visual/geometry/cylinder")
    return SkinTable(
        "urdf",
        np.array([number for number, _ in frames[part]], dtype=np.int64),
        poses[:, :3, 3],
        poses[:, :3, 2],
        se3.quaternion(poses[:, :3, :3]),
        DISC_RADIUS
        if radius is None
        else float(parse_numbers([radius.get("radius", "")], 1, name)[0]),
    )


def _pose(joint: ET.Element, name: str) -> Array:
    """The pose (4, 4) of a joint in its parent link. Raises SkinError."""
    where = f"{name}: joint {joint.get('name')!r}"
    origin = joint.find("origin")
    given = {} if origin is None else origin.attrib
    xyz, rpy = (parse_numbers(given.get(k, "0 0 0").split(), 3, where) for k in ("xyz", "rpy"))
    return se3.transform(se3.from_rpy(rpy), xyz)


def _angles(r: Array) -> Array:
    """Roll, pitch, yaw (3,) in rad of a rotation (3, 3); yaw is 0 where they are not unique."""
    cosine = np.hypot(r[0, 0], r[1, 0])
    pitch = np.arctan2(-r[2, 0], cosine)
    if cosine < 1e-9:
        return np.array([np.arctan2(-r[1, 2], r[1, 1]), pitch, 0.0])
    return np.array([np.arctan2(r[2, 1], r[2, 2]), pitch, np.arctan2(r[1, 0], r[0, 0])])


def _text(values: Array) -> str:
    """Numbers as text that is read back exactly."""
    return " ".join(repr(value) for value in values.tolist())
