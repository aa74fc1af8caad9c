"""Skins in MJCF, the format of MuJoCo: one site with a touch sensor a taxel, on one body.

The file is a model of its own, and a part of a larger one by `<include>` or `MjSpec.attach`. A site
is a flat cylinder on the taxel's disc, its z axis the outward normal. MuJoCo adds up the normal
forces of the contacts of the body's geoms that lie within the site; the file has no geoms. The
sigma of a position, m, is the site's `user` value.

Source: mujoco.readthedocs.io, XML reference, body/site and sensor/touch.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET

import numpy as np

from ...core import se3
from . import table

HALF_HEIGHT = 1e-3
"""Half the height of a site, m: contact points lie up to the indentation, tenths of a millimetre
here, below the surface."""


def write(rows: table.SkinRows) -> str:
    """Text with the sites on the body `rows.link`; exact to rounding."""
    part, size = rows.link, np.array([rows.disc_radius, HALF_HEIGHT])
    model = ET.Element("mujoco", model=f"{part}_skin")
    body = ET.SubElement(ET.SubElement(model, "worldbody"), "body", name=part)
    sensor = ET.SubElement(model, "sensor")
    for taxel, pose, sigma in rows.each():
        site = f"{part}_skin_{taxel}"
        ET.SubElement(
            body, "site", name=site, type="cylinder",
            size=table.number_text(size), pos=table.number_text(pose[:3, 3]),
            quat=table.number_text(np.roll(se3.quaternion(pose[:3, :3]), 1)),
        )  # fmt: skip
        if sigma:
            body[-1].set("user", sigma)
        ET.SubElement(sensor, "touch", name=site, site=site)
    ET.indent(model)
    return ET.tostring(model, encoding="unicode") + "\n"


def read(model: ET.Element, name: str, part: str | None = None) -> table.SkinTable:
    """The sites `<part>_skin_<id>` of one body (None: the only one), in its frame.

    Raises SkinError, also for sites that are not placed by `pos` and `quat`.
    """
    found = table.named_parts(model.iter("site"), name)
    if not found:
        raise table.damaged(f"{name} has no skin", limit="sites <part>_skin_<id>")
    part = table.chosen_part(part, found, name)
    places, radius = [], table.DISC_RADIUS
    for number, site in found[part]:
        where = f"{name}: site of taxel {number}"
        other = {"euler", "axisangle", "xyaxes", "zaxis", "fromto"} & set(site.attrib)
        if other:
            raise table.damaged(where, ", ".join(sorted(other)), "pos and quat")
        pos = table.parse_numbers(site.get("pos", "0 0 0").split(), 3, where)
        quat = table.parse_numbers(site.get("quat", "1 0 0 0").split(), 4, where)
        places.append(np.concatenate([pos, np.roll(quat / np.linalg.norm(quat), -1)]))
        size = site.get("size", repr(table.DISC_RADIUS)).split()
        radius = float(table.parse_numbers(size[:1], 1, where)[0])
    ids = [number for number, _ in found[part]]
    sigmas = table.parse_sigmas([site.get("user") for _, site in found[part]], name)
    return table.SkinTable.of_quaternions("mjcf", ids, np.array(places), radius, sigmas, part)
