"""Tactile sensors in URDF, as the ROS package urdf_tactile reads them: a list of taxels on a link.

`idx` of a taxel is its id, the index of its reading in the channel of a tactile_msgs/TactileState;
z is the outward normal; the disc is its shape for viewers; the sigma of its position, m, is a
comment. Arrays of taxels are not read.

Source: github.com/ubi-agni/tactile_toolbox, urdf_tactile.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np

from ...core import se3
from .table import (
    DISC_RADIUS,
    SkinRows,
    SkinTable,
    check_ids,
    chosen_part,
    damaged,
    number_text,
    parse_id,
    parse_sigmas,
    pose_of,
)
from .urdf import add_disc, add_sigma, base, document, radius_of, sigma_of

UPDATE_RATE = 100
"""Readings per second, which the format asks for and meshskin does not know: the one of the
examples of urdf_tactile."""


def write(rows: SkinRows) -> str:
    """Text with one sensor on `rows.link`, its channel named alike; exact to rounding.

    Raises SkinError for a negative id: `idx` is an index.
    """
    check_ids(rows.ids, "urdf_tactile", 0, np.iinfo(np.int64).max)
    robot, part = base(rows), rows.link
    sensor = ET.SubElement(robot, "sensor", name=f"{part}_skin", update_rate=str(UPDATE_RATE))
    ET.SubElement(sensor, "parent", link=part)
    ET.SubElement(sensor, "origin", xyz="0 0 0", rpy="0 0 0")
    tactile = ET.SubElement(sensor, "tactile", channel=part)
    each = zip(rows.ids.tolist(), rows.poses, rows.sigma_texts(), strict=True)
    for taxel, pose, sigma in each:
        place = {"xyz": number_text(pose[:3, 3]), "rpy": number_text(se3.to_rpy(pose[:3, :3]))}
        element = ET.SubElement(tactile, "taxel", {"idx": str(taxel), **place})
        shape = ET.SubElement(element, "geometry")
        add_disc(shape, rows.disc_radius)
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


def read(robot: ET.Element, name: str, part: str | None = None) -> SkinTable:
    """The taxels of one link (None: the only one) in its frame. Raises SkinError."""
    found = sensors(robot)
    part = chosen_part(part, found, name)
    sensor = found[part]
    mount = pose_of(sensor.find("origin"), f"{name}: sensor {sensor.get('name')!r}")
    ids, poses, sigmas, radius = [], [], [], DISC_RADIUS
    for taxel in sensor.findall("tactile/taxel"):
        where = f"{name}: taxel {taxel.get('idx')!r}"
        ids.append(parse_id(taxel.get("idx", ""), where))
        if ids[-1] < 0:
            raise damaged(where, limit="an index, from 0 on")
        sigmas.append(sigma_of(taxel))
        poses.append(mount @ pose_of(taxel, where))
        if (disc := taxel.find("geometry/cylinder")) is not None:
            radius = radius_of(disc, where)
    known = parse_sigmas(sigmas, name)
    return SkinTable.of_poses("urdf_tactile", ids, np.array(poses), radius, known, part)
