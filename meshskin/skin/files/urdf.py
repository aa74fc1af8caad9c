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
from .table import DISC_RADIUS, SkinTable, chosen_part, number_text, parse_numbers, pose_of

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
        ET.SubElement(
            joint, "origin", xyz=number_text(pose[:3, 3]), rpy=number_text(se3.to_rpy(pose[:3, :3]))
        )
        ET.SubElement(joint, "parent", link=part)
        ET.SubElement(joint, "child", link=frame)
    ET.indent(robot)
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"


def read(robot: ET.Element, name: str, part: str | None = None) -> SkinTable:
    """The frames of one part (None: the only one) in the frame of its link. Raises SkinError."""
    frames: dict[str, list[tuple[int, ET.Element]]] = {}
    for joint in robot.findall("joint"):
        match = _NAME.fullmatch(joint.get("name", ""))
        if match and joint.get("type") == "fixed":
            frames.setdefault(match[1], []).append((int(match[2]), joint))
    if not frames:
        raise SkinError(f"{name} has no skin", limit="fixed joints <part>_skin_<id>")
    part = chosen_part(part, frames, name)
    poses = np.array(
        [
            pose_of(joint.find("origin"), f"{name}: joint {joint.get('name')!r}")
            for _, joint in frames[part]
        ]
    )
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
