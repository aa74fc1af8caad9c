"""Tactile sensors in URDF, as the ROS package urdf_tactile reads them: a list of taxels on a link.

`idx` of a taxel is its id, the index of its reading in the channel of a tactile_msgs/TactileState;
z is the outward normal; the disc is its shape for viewers. Arrays of taxels are not read.

Source: github.com/ubi-agni/tactile_toolbox, urdf_tactile.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np

from ...core import se3
from ...core.arrays import Array
from ...core.errors import SkinError
from ..slots import Ids
from .table import DISC_RADIUS, SkinTable, chosen_part, number_text, parse_numbers, pose_of
from .urdf import THICKNESS

UPDATE_RATE = 100
"""Readings per second, which the format asks for and meshskin does not know: the one of the
examples of urdf_tactile."""


def write(poses: Array, ids: Ids, disc_radius: float, part: str) -> str:
    """Text with one sensor on the link `part`, its channel named alike; exact to rounding."""
    robot = ET.Element("robot", name=f"{part}_skin")
    ET.SubElement(robot, "link", name=part)
    sensor = ET.SubElement(robot, "sensor", name=f"{part}_skin", update_rate=str(UPDATE_RATE))
    ET.SubElement(sensor, "parent", link=part)
    ET.SubElement(sensor, "origin", xyz="0 0 0", rpy="0 0 0")
    tactile = ET.SubElement(sensor, "tactile", channel=part)
    for taxel, pose in zip(ids.tolist(), poses, strict=True):
        place = {"xyz": number_text(pose[:3, 3]), "rpy": number_text(se3.to_rpy(pose[:3, :3]))}
        element = ET.SubElement(tactile, "taxel", {"idx": str(taxel), **place})
        shape = ET.SubElement(element, "geometry")
        ET.SubElement(shape, "cylinder", radius=repr(float(disc_radius)), length=repr(THICKNESS))
    ET.indent(robot)
    return '<?xml version="1.0"?>\n' + ET.tostring(robot, encoding="unicode") + "\n"


def sensors(robot: ET.Element) -> dict[str, ET.Element]:
    """The sensors of a URDF that list taxels, by the names of their links."""
    found = {}
    for sensor in robot.findall("sensor"):
        parent = sensor.find("parent")
        if parent is not None and sensor.find("tactile/taxel") is not None:
            found[parent.get("link", "")] = sensor
    return found


def read(robot: ET.Element, name: str, part: str | None = None) -> SkinTable:
    """The taxels of one link (None: the only one) in its frame. Raises SkinError."""
    found = sensors(robot)
    sensor = found[chosen_part(part, found, name)]
    mount = pose_of(sensor.find("origin"), f"{name}: sensor {sensor.get('name')!r}")
    ids, poses, radius = [], [], DISC_RADIUS
    for taxel in sensor.findall("tactile/taxel"):
        where = f"{name}: taxel {taxel.get('idx')!r}"
        index = parse_numbers([taxel.get("idx", "")], 1, where)[0]
        if index != int(index) or index < 0:
            raise SkinError(where, value=index, limit="a whole number from 0 on")
        ids.append(int(index))
        poses.append(mount @ pose_of(taxel, where))
        disc = taxel.find("geometry/cylinder")
        if disc is not None:
            radius = float(parse_numbers([disc.get("radius", "")], 1, where)[0])
    placed = np.array(poses)
    return SkinTable(
        "urdf_tactile",
        np.array(ids, dtype=np.int64),
        placed[:, :3, 3],
        placed[:, :3, 2],
        se3.quaternion(placed[:, :3, :3]),
        radius,
    )
