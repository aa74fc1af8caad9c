"""Tactile sensors in URDF, as the ROS package urdf_tactile reads them: a list of taxels on a link.

`idx` of a taxel is its id, the index of its reading in the channel of a tactile_msgs/TactileState;
z is the outward normal; the disc is its shape for viewers; the sigma of its position, m, is a
comment. Arrays of taxels are not read.

Source: github.com/ubi-agni/tactile_toolbox, urdf_tactile.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np

from . import table
from .urdf import add_disc, add_sigma, base, document, radius_of, sigma_of

UPDATE_RATE = 100
"""Readings per second, which the format asks for and meshskin does not know: the one of the
examples of urdf_tactile."""


def write(rows: table.SkinRows) -> str:
    """Text with one sensor on `rows.link`, its channel named alike; exact to rounding.

    Raises SkinError for a negative id: `idx` is an index.
    """
    table.check_ids(rows.ids, "urdf_tactile", 0, np.iinfo(np.int64).max)
    robot, part = base(rows), rows.link
    sensor = ET.SubElement(robot, "sensor", name=f"{part}_skin", update_rate=str(UPDATE_RATE))
    ET.SubElement(sensor, "parent", link=part)
    ET.SubElement(sensor, "origin", xyz="0 0 0", rpy="0 0 0")
    tactile = ET.SubElement(sensor, "tactile", channel=part)
    for taxel, pose, sigma in rows.each():
        attributes = {"idx": str(taxel), **table.place_texts(pose)}
        element = ET.SubElement(tactile, "taxel", attributes)
        add_disc(element, rows.disc_radius)
        add_sigma(element, sigma)
    return document(robot)


def sensors(robot: ET.Element) -> dict[str, ET.Element]:
    """The sensors of a URDF that list taxels, by the names of their links."""
    found = {}
    for sensor in robot.findall("sensor"):
        parent = sensor.find("parent")
        if parent is not None and sensor.find("tactile/taxel") is not None:
            found[parent.get("link", "")] = sensor
    return found


def read(robot: ET.Element, name: str, part: str | None = None) -> table.SkinTable:
    """The taxels of one link (None: the only one) in its frame. Raises SkinError."""
    found = sensors(robot)
    part = table.chosen_part(part, found, name)
    sensor = found[part]
    mount = table.pose_of(sensor.find("origin"), f"{name}: sensor {sensor.get('name')!r}")
    ids, poses, sigmas, radius = [], [], [], table.DISC_RADIUS
    for taxel in sensor.findall("tactile/taxel"):
        where = f"{name}: taxel {taxel.get('idx')!r}"
        ids.append(table.parse_id(taxel.get("idx", ""), where))
        if ids[-1] < 0:
            raise table.damaged(where, limit="an index, from 0 on")
        sigmas.append(sigma_of(taxel))
        poses.append(mount @ table.pose_of(taxel, where))
        if (disc := taxel.find("geometry/cylinder")) is not None:
            radius = radius_of(disc, where)
    known = table.parse_sigmas(sigmas, name)
    return table.SkinTable.of_poses("urdf_tactile", ids, np.array(poses), radius, known, part)
