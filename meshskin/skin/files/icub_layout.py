"""iCub layout files (.ini): the drawing of the skin of a part on the screen, by iCubSkinGui.

They do not give positions on a body. Under [SENSORS], each line is one element: kind, number, x, y,
orientation (degrees), gain, mirror. Triangles are drawn with sides of 30 units: a unit is read as
1 mm, and the layout as a flat skin with the modules side by side. Fingertips, palms and other
elements that are not triangles are skipped.

Source: icub-main, iCubSkinGui, Triangle.h and Triangle_10pad.h.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.errors import SkinError
from ...core.se3 import exp_so3
from ..slots import OFFSETS, PER_MODULE, TAXELS, TWELVE_OFFSETS
from .table import SkinTable, damaged

UNIT = 1e-3
"""Unit of the drawing, m."""
MODULE_KINDS = {
    "triangle_10pad": (OFFSETS, TAXELS),
    "triangle": (TWELVE_OFFSETS, tuple(range(PER_MODULE))),
}
"""Offsets (12, 3), m, and slots that are taxels, of the elements that are modules."""


@dataclass(frozen=True)
class Element:
    """One line of a layout."""

    kind: str
    number: int
    """number of the module: the id of a taxel is 12 * number + slot"""
    x: float
    y: float
    """centre, in units of the drawing"""
    orientation: float
    """degrees, counter-clockwise"""
    mirror: bool = False
    """whether it is drawn as seen from inside"""


def parse(text: str, name: str) -> tuple[Element, ...]:
    """The elements of a layout. Raises SkinError, with the line, where one cannot be read."""
    elements = []
    inside = False
    for number, line in enumerate(text.splitlines(), start=1):
        fields = line.split("#")[0].split()
        if not fields:
            continue
        if fields[0].startswith("["):
            inside = fields[0] == "[SENSORS]"
        elif inside:
            try:
                module, (x, y, angle) = int(np.int32(int(fields[1]))), map(float, fields[2:5])
                mirror = len(fields) > 6 and int(fields[6]) != 0
            except (ValueError, IndexError, OverflowError) as error:
                raise damaged(
                    f"{name}, line {number} is not an element of a layout",
                    repr(line.strip()[:60]),
                    "kind number x y orientation gain [mirror]",
                ) from error
            elements.append(Element(fields[0], module, x, y, angle, mirror))
    return tuple(elements)


def read(text: str, name: str) -> SkinTable:
    """The triangular modules of a layout as a flat skin, z up. Raises SkinError if it has none."""
    elements = parse(text, name)
    triangles = [element for element in elements if element.kind in MODULE_KINDS]
    if not triangles:
        raise SkinError(
            f"{name} contains no triangular modules",
            value=", ".join(sorted({element.kind for element in elements})) or "no elements",
            limit=", ".join(MODULE_KINDS),
            remedy="the positions of other elements are in the part's position file",
        )
    ids, positions = [], []
    for element in sorted(triangles, key=lambda e: e.number):
        offsets, taxels = MODULE_KINDS[element.kind]
        local = offsets[list(taxels)] * [-1.0 if element.mirror else 1.0, 1.0, 1.0]
        rotation = exp_so3([0.0, 0.0, np.radians(element.orientation)])
        positions.append(local @ rotation.T + UNIT * np.array([element.x, element.y, 0.0]))
        ids.append(PER_MODULE * element.number + np.array(taxels))
    points = np.concatenate(positions)
    up = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    return SkinTable("icub layout", np.concatenate(ids).astype(np.int64), points, up)
