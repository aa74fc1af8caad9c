"""iCub layout files (.ini): how the skin of a part is drawn on a flat screen by iCubSkinGui.

They are no positions on a body. Under [SENSORS], each line is one element: kind, number, x, y,
orientation (degrees), gain, mirror. Triangles are drawn with a side of 30 units, so a unit is taken
as 1 mm, and the layout read as a flat skin: the modules side by side as when the skin is peeled off
and laid on a table. Fingertips, palms and other elements are not triangles: they are left out.
Source: icub-main, iCubSkinGui, Triangle.h and Triangle_10pad.h.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.errors import SkinError
from ..slots import OFFSETS, PER_MODULE, TAXELS, TWELVE_OFFSETS
from .table import Table

UNIT = 1e-3
"""m"""
KINDS = {
    "triangle_10pad": (OFFSETS, TAXELS),
    "triangle": (TWELVE_OFFSETS, tuple(range(PER_MODULE))),
}
"""offsets (12, 3) in m, and slots that are taxels, of the elements that are modules"""


@dataclass(frozen=True)
class Element:
    """One line of a layout."""

    kind: str
    number: int
    """of the module: its taxels are 12 * number + slot"""
    x: float
    y: float
    """middle, in units of the drawing"""
    orientation: float
    """degrees, counter-clockwise"""
    mirror: bool = False
    """drawn as seen from inside"""


def parse(text: str, name: str) -> tuple[Element, ...]:
    """The elements of a layout; SkinError, with the line, where one cannot be read."""
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
                module, (x, y, turn) = int(fields[1]), map(float, fields[2:5])
                mirror = len(fields) > 6 and int(fields[6]) != 0
            except (ValueError, IndexError) as error:
                raise SkinError(
                    f"{name}, line {number}",
                    value=repr(line.strip()[:60]),
                    limit="kind number x y orientation gain [mirror]",
                ) from error
            elements.append(Element(fields[0], module, x, y, turn, mirror))
    return tuple(elements)


def read(text: str, name: str) -> Table:
    """The triangular modules of a layout as a flat skin, z up; SkinError where it has none."""
    elements = parse(text, name)
    triangles = [element for element in elements if element.kind in KINDS]
    if not triangles:
        raise SkinError(
            f"{name} draws no triangular modules",
            value=", ".join(sorted({element.kind for element in elements})) or "no elements",
            limit=", ".join(KINDS),
            remedy="the positions of other elements are in the part's position file",
        )
    ids, positions = [], []
    for element in sorted(triangles, key=lambda e: e.number):
        offsets, taxels = KINDS[element.kind]
        local = offsets[list(taxels)] * [-1.0 if element.mirror else 1.0, 1.0, 1.0]
        c, s = np.cos(np.radians(element.orientation)), np.sin(np.radians(element.orientation))
        turned = local @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]).T
        positions.append(turned + UNIT * np.array([element.x, element.y, 0.0]))
        ids.append(PER_MODULE * element.number + np.array(taxels))
    points = np.concatenate(positions)
    up = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    return Table("icub layout", np.concatenate(ids).astype(np.int64), points, up)
