"""Taxel frames in URDF: fixed joints `<part>_skin_<id>`, with or without a suffix, to a link.

In the URDF of iCub (icub-models) they are frames of modules: the number is the module's, the origin
its centre, z the outward normal; the rotation about z is not the module's. A file written by
meshskin holds one frame a taxel, with the taxel's disc for viewers, and the sigma of its position,
m, as a comment in its joint.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np

from . import table

_SIGMA = " sigma_m: "
THICKNESS = 1e-3
"""Thickness of a disc for viewers, m."""


def base(rows: table.SkinRows) -> ET.Element:
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


def write(rows: table.SkinRows) -> str:
    """Text with one link and one fixed joint a taxel on `rows.link`; exact to rounding."""
    robot, part = base(rows), rows.link
    for taxel, pose, sigma in rows.each():
        frame = f"{part}_skin_{taxel}"
        link = ET.SubElement(robot, "link", name=frame)
        add_disc(ET.SubElement(link, "visual"), rows.disc_radius)
        joint = ET.SubElement(robot, "joint", name=f"{frame}_fixed_joint", type="fixed")
        ET.SubElement(joint, "origin", table.place_texts(pose))
        ET.SubElement(joint, "parent", link=part)
        ET.SubElement(joint, "child", link=frame)
        add_sigma(joint, sigma)
    return document(robot)


def read(robot: ET.Element, name: str, part: str | None = None) -> table.SkinTable:
    """The frames of one part (None: the only one) in the frame of its link. Raises SkinError."""
    frames = table.named_parts(
        robot.findall("joint[@type='fixed']"), name, "(?:_fixed_joint|_joint)?"
    )
    if not frames:
        raise table.damaged(f"{name} has no skin", limit="fixed joints <part>_skin_<id>")
    part = table.chosen_part(part, frames, name)
    ids, joints = zip(*frames[part], strict=True)
    poses = [table.pose_of(j.find("origin"), f"{name}: joint {j.get('name')!r}") for j in joints]
    links = {link.get("name"): link for link in robot.findall("link")}
    link = links.get(f"{part}_skin_{ids[0]}")
    disc = None if link is None else link.find("visual/geometry/cylinder")
    sigmas = table.parse_sigmas([sigma_of(j) for j in joints], name)
    parent, radius = joints[0].find("parent"), radius_of(disc, name)
    frame = None if parent is None else parent.get("link")
    return table.SkinTable.of_poses("urdf", ids, np.array(poses), radius, sigmas, frame)


def radius_of(disc: ET.Element | None, where: str) -> float:
    """The radius, m, of a taxel's disc, or the default without one. Raises SkinError."""
    if disc is None:
        return table.DISC_RADIUS
    return float(table.parse_numbers([disc.get("radius", "")], 1, where)[0])


def add_disc(owner: ET.Element, radius: float) -> None:
    """Give an element the geometry of a taxel's disc, for viewers."""
    shape = ET.SubElement(owner, "geometry")
    ET.SubElement(shape, "cylinder", radius=repr(float(radius)), length=repr(THICKNESS))


def document(robot: ET.Element) -> str:
    """The text of a URDF file."""
    ET.indent(robot)
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"
