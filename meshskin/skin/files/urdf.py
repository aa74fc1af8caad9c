"""Taxel frames in URDF: fixed joints `<part>_skin_<id>`, with or without a suffix, to a link.

In the URDF of iCub (icub-models) they are frames of modules: the number is the module's, the origin
its centre, z the outward normal; the rotation about z is not the module's. A file written by
meshskin holds one frame a taxel, with the taxel's disc for viewers, and the sigma of its position,
m, as a comment in its joint.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np

from ...core import se3
from .table import (
    DISC_RADIUS,
    SkinRows,
    SkinTable,
    chosen_part,
    damaged,
    named_parts,
    number_text,
    parse_numbers,
    parse_sigmas,
    pose_of,
)

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
        add_disc(shape, rows.disc_radius)
        joint = ET.SubElement(robot, "joint", name=f"{frame}_fixed_joint", type="fixed")
        ET.SubElement(
            joint, "origin", xyz=number_text(pose[:3, 3]), rpy=number_text(se3.to_rpy(pose[:3, :3]))
        )
        ET.SubElement(joint, "parent", link=part)
        ET.SubElement(joint, "child", link=frame)
        add_sigma(joint, sigma)
    return document(robot)


def read(robot: ET.Element, name: str, part: str | None = None) -> SkinTable:
    """The frames of one part (None: the only one) in the frame of its link. Raises SkinError."""
    frames = named_parts(robot.findall("joint[@type='fixed']"), name, "(?:_fixed_joint|_joint)?")
    if not frames:
        raise damaged(f"{name} has no skin", limit="fixed joints <part>_skin_<id>")
    part = chosen_part(part, frames, name)
    ids, joints = zip(*frames[part], strict=True)
    poses = [pose_of(j.find("origin"), f"{name}: joint {j.get('name')!r}") for j in joints]
    links = {link.get("name"): link for link in robot.findall("link")}
    link = links.get(f"{part}_skin_{ids[0]}")
    disc = None if link is None else link.find("visual/geometry/cylinder")
    sigmas, parent = parse_sigmas([sigma_of(j) for j in joints], name), joints[0].find("parent")
    frame = None if parent is None else parent.get("link")
    return SkinTable.of_poses("urdf", ids, np.array(poses), radius_of(disc, name), sigmas, frame)


def radius_of(disc: ET.Element | None, where: str) -> float:
    """The radius, m, of a taxel's disc, or the default without one. Raises SkinError."""
    if disc is None:
        return DISC_RADIUS
    return float(parse_numbers([disc.get("radius", "")], 1, where)[0])


def add_disc(shape: ET.Element, radius: float) -> None:
    """Give a geometry the disc of a taxel, for viewers."""
    ET.SubElement(shape, "cylinder", radius=repr(float(radius)), length=repr(THICKNESS))


def document(robot: ET.Element) -> str:
    """The text of a URDF file."""
    ET.indent(robot)
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"
