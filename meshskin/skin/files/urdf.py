"""Taxel frames in URDF: fixed joints `<part>_skin_<id>`, with or without a suffix, to a link.

In the URDF of iCub (icub-models) they are frames of modules: the number is the module's, the origin
its centre, z the outward normal; the rotation about z is not the module's. A file written by
meshskin holds one frame a taxel, with the taxel's disc for viewers, and the sigma of its position,
m, as a comment in its joint.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET

import numpy as np

from ...core import se3
from ...core.errors import SkinError
from .table import (
    DISC_RADIUS,
    SkinRows,
    SkinTable,
    chosen_part,
    number_text,
    parse_numbers,
    parse_sigmas,
    pose_of,
)

_NAME = re.compile(r"(.+)_skin_(\d+)(?:_fixed_joint|_joint)?")
_SIGMA = " sigma_m: "
THICKNESS = 1e-3
"""Thickness of a disc for viewers, m."""


def base(rows: SkinRows) -> ET.Element:
    """A robot with the link `rows.link`, fixed to its parent if it has one."""
    robot = ET.Element("robot", name=f"{rows.link}_skin")
    ET.SubElement(robot, "link", name=rows.link)
    if rows.parent is not None:
        ET.SubElement(robot, "link", name=rows.parent)
        joint = ET.SubElement(robot, "joint", name=f"{rows.link}_fixed_joint", type="fixed")
        ET.SubElement(joint, "origin", xyz="0 0 0", rpy="0 0 0")
        ET.SubElement(joint, "parent", link=rows.parent)
        ET.SubElement(joint, "child", link=rows.link)
    return robot


def add_sigma(element: ET.Element, sigma: str) -> None:
    """Add the sigma, m, of a taxel as a comment, which every reader of URDF skips."""
    if sigma:
        element.append(ET.Comment(f"{_SIGMA}{sigma} "))


def sigma_of(element: ET.Element) -> str:
    """The text of `add_sigma`; "" without one."""
    texts = [child.text or "" for child in element if child.tag is ET.Comment]
    return next((t.removeprefix(_SIGMA).strip() for t in texts if t.startswith(_SIGMA)), "")


def write(rows: SkinRows) -> str:
    """Text with one link and one fixed joint a taxel on `rows.link`; exact to rounding."""
    robot, part = base(rows), rows.link
    each = zip(rows.ids.tolist(), rows.poses, rows.sigma_texts(), strict=True)
    for taxel, pose, sigma in each:
        frame = f"{part}_skin_{taxel}"
        link = ET.SubElement(robot, "link", name=frame)
        shape = ET.SubElement(ET.SubElement(link, "visual"), "geometry")
        ET.SubElement(
            shape, "cylinder", radius=repr(float(rows.disc_radius)), length=repr(THICKNESS)
        )
        joint = ET.SubElement(robot, "joint", name=f"{frame}_fixed_joint", type="fixed")
        ET.SubElement(
            joint, "origin", xyz=number_text(pose[:3, 3]), rpy=number_text(se3.to_rpy(pose[:3, :3]))
        )
        ET.SubElement(joint, "parent", link=part)
        ET.SubElement(joint, "child", link=frame)
        add_sigma(joint, sigma)
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
        sigmas=parse_sigmas([sigma_of(joint) for _, joint in frames[part]], name),
        frame=_parent(frames[part][0][1]),
    )


def _parent(joint: ET.Element) -> str | None:
    """The link that a joint starts from."""
    link = joint.find("parent")
    return None if link is None else link.get("link")
