"""Transforms in iDynTree's Python notation: the middles of modules, or the slots of one (mm).

Source of the files: icub-models-generator, icub-taxel-positions. Each is a rotation (row by row)
and a position, assigned to `transform_..._TRIANGLE<n>` or `transform_..._TAXEL<n>`.
"""

from __future__ import annotations

import re

import numpy as np

from ...core.errors import SkinError
from ..slots import OFFSETS, PER_MODULE, TAXELS, THERMAL
from .table import Table

MARK = "iDynTree.Transform"
UNIT = 1e-3
"""m"""
_ONE = re.compile(
    r"_(TRIANGLE|TAXEL)(\d+)\s*=\s*iDynTree\.Transform\(\s*iDynTree\.Rotation\(([^)]*)\)"
    r"[\s,\\]*iDynTree\.Position\(([^)]*)\)"
)


def read(text: str, name: str) -> Table:
    """The taxels of the modules, thermal pads left out; SkinError where there are none."""
    ids: list[int] = []
    positions, normals = [], []
    for kind, number, rotation, position in _ONE.findall(text):
        r = _numbers(rotation, 9, f"{name}: {kind}{number}").reshape(3, 3)
        p = UNIT * _numbers(position, 3, f"{name}: {kind}{number}")
        if kind == "TRIANGLE":
            ids += [PER_MODULE * int(number) + slot for slot in TAXELS]
            positions.append(OFFSETS[list(TAXELS)] @ r.T + p)
            normals.append(np.tile(r[:, 2], (len(TAXELS), 1)))
        elif int(number) not in THERMAL:
            ids.append(int(number))
            positions.append(p[None])
            normals.append(r[None, :, 2])
    if not ids:
        raise SkinError(f"{name} holds no taxels", limit="transforms of a TRIANGLE or a TAXEL")
    return Table(
        "idyntree",
        np.array(ids, dtype=np.int64),
        np.concatenate(positions),
        np.concatenate(normals),
    )


def _numbers(text: str, count: int, where: str) -> np.ndarray:
    try:
        values = [float(field) for field in text.replace("\\", " ").split(",")]
    except ValueError as error:
        raise SkinError(where, value=str(error)) from error
    if len(values) != count:
        raise SkinError(where, value=f"{len(values)} numbers", limit=count)
    return np.array(values)
