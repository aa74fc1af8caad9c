"""Transforms in iDynTree's Python notation: the centres of modules, or the slots of one (mm).

Each is a rotation (row by row) and a position, assigned to `transform_..._TRIANGLE<n>` or
`transform_..._TAXEL<n>`. Source of the files: icub-models-generator, icub-taxel-positions.
"""

from __future__ import annotations

import re

import numpy as np

from ..slots import OFFSETS, PER_MODULE, TAXELS, THERMAL
from .table import SkinTable, damaged, parse_id, parse_numbers

MARK = "iDynTree.Transform"
UNIT = 1e-3
"""Unit of the positions, m."""
_TRANSFORM = re.compile(
    r"_(TRIANGLE|TAXEL)(\d+)\s*=\s*iDynTree\.Transform\(\s*iDynTree\.Rotation\(([^)]*)\)"
    r"[\s,\\]*iDynTree\.Position\(([^)]*)\)"
)


def read(text: str, name: str) -> SkinTable:
    """The taxels of the modules, without thermal pads. Raises SkinError where there are none."""
    ids: list[int] = []
    positions, normals = [], []
    for kind, digits, rotation, position in _TRANSFORM.findall(text):
        where = f"{name}: {kind}{digits}"
        number = parse_id(digits, where, np.int32)
        r = parse_numbers(rotation.replace("\\", " ").split(","), 9, where).reshape(3, 3)
        p = UNIT * parse_numbers(position.replace("\\", " ").split(","), 3, where)
        if kind == "TRIANGLE":
            ids += [PER_MODULE * number + slot for slot in TAXELS]
            positions.append(OFFSETS[list(TAXELS)] @ r.T + p)
            normals.append(np.tile(r[:, 2], (len(TAXELS), 1)))
        elif number not in THERMAL:
            ids.append(number)
            positions.append(p[None])
            normals.append(r[None, :, 2])
    if not ids:
        raise damaged(f"{name} holds no taxels", limit="transforms of a TRIANGLE or a TAXEL")
    return SkinTable(
        "idyntree",
        np.array(ids, dtype=np.int64),
        np.concatenate(positions),
        np.concatenate(normals),
    )
