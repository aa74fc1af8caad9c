"""Skins in GLB, to look at: one node a taxel, `taxel_<id>`, whose matrix is the taxel's pose.

All nodes show the same coloured spikes. Reading takes any GLB with nodes of such names, by id.
"""

from __future__ import annotations

import io
import re
import struct

import numpy as np
from numpy.typing import NDArray

from ...core import se3
from ...core.errors import SkinError
from . import triad
from .table import DISC_RADIUS, Table

Array = NDArray[np.float64]

_NODE = re.compile(r"taxel_(-?\d+)")
_RADIUS = "disc_radius_m"
_BROKEN = (ValueError, KeyError, IndexError, TypeError, NotImplementedError, struct.error)
"""what trimesh raises over a file that is no GLB, or half of one"""


def write(poses: Array, ids: NDArray[np.int64], disc_radius: float) -> bytes:
    """The file of poses (n, 4, 4) and ids (n,)."""
    import trimesh

    vertices, faces, colours = triad.shape(disc_radius)
    mesh = trimesh.Trimesh(vertices, faces, vertex_colors=colours, process=False)
    scene = trimesh.Scene({"frame": mesh}, metadata={_RADIUS: float(disc_radius)})
    scene.graph.clear()
    for taxel, pose in zip(ids.tolist(), poses, strict=True):
        scene.graph.update(frame_to=f"taxel_{taxel}", matrix=pose, geometry="frame")
    return bytes(scene.export(file_type="glb"))


def read(data: bytes, name: str) -> Table:
    """The nodes `taxel_<id>`; SkinError where there are none."""
    import trimesh

    try:
        scene = trimesh.load_scene(io.BytesIO(data), file_type="glb")
    except _BROKEN as error:
        raise SkinError(f"{name} cannot be read", value=str(error)) from error
    found = [(m, node) for node in scene.graph.nodes if (m := _NODE.fullmatch(str(node)))]
    nodes = sorted((int(match[1]), node) for match, node in found)
    if not nodes:
        raise SkinError(f"{name} has no skin", limit="nodes taxel_<id>")
    poses = np.array([scene.graph.get(node)[0] for _, node in nodes], dtype=float)
    return Table(
        "glb",
        np.array([taxel for taxel, _ in nodes], dtype=np.int64),
        poses[:, :3, 3],
        poses[:, :3, 2],
        se3.quaternion(poses[:, :3, :3]),
        float(scene.metadata.get(_RADIUS, DISC_RADIUS)),
    )
