"""Skins in GLB for viewers: one node `taxel_<id>` a taxel, whose matrix is the taxel's pose.

All nodes show the same coloured spikes. Any GLB file with nodes of such names can be read.
"""

from __future__ import annotations

import io
import re
import struct

import numpy as np

from .table import DISC_RADIUS, SkinRows, SkinTable, damaged, frame_mesh, parse_id

_NODE = re.compile(r"taxel_(-?\d+)")
_RADIUS, _FRAME, _SIGMA = "disc_radius_m", "frame", "sigma_m"
_READ_ERRORS = (
    ValueError, LookupError, TypeError, AttributeError, NotImplementedError, struct.error,
)  # fmt: skip
"""Exceptions of trimesh for a file that is not GLB, or truncated."""


def write(rows: SkinRows) -> bytes:
    """Content of a file of the rows; radius, frame and sigmas are extras of the scene."""
    import trimesh

    vertices, faces, colours = frame_mesh(rows.disc_radius)
    mesh = trimesh.Trimesh(vertices, faces, vertex_colors=colours, process=False)
    extras = {_RADIUS: float(rows.disc_radius), _FRAME: rows.link}
    if rows.sigmas is not None:
        texts = zip(rows.ids.tolist(), rows.sigma_texts(), strict=True)
        extras[_SIGMA] = {str(taxel): float(text) for taxel, text in texts if text}
    scene = trimesh.Scene({"frame": mesh}, metadata=extras)
    scene.graph.clear()
    for taxel, pose in zip(rows.ids.tolist(), rows.poses, strict=True):
        scene.graph.update(frame_to=f"taxel_{taxel}", matrix=pose, geometry="frame")
    return bytes(scene.export(file_type="glb"))


def read(data: bytes, name: str) -> SkinTable:
    """The nodes `taxel_<id>`. Raises SkinError where there are none."""
    import trimesh

    try:
        scene = trimesh.load_scene(io.BytesIO(data), file_type="glb")
        found = [(m, node) for node in scene.graph.nodes if (m := _NODE.fullmatch(str(node)))]
        nodes = sorted((parse_id(match[1], name), node) for match, node in found)
        poses = np.array([scene.graph.get(node)[0] for _, node in nodes], dtype=float)
        extras, ids = scene.metadata, [taxel for taxel, _ in nodes]
        sigma, radius = extras.get(_SIGMA), float(extras.get(_RADIUS, DISC_RADIUS))
        known = [float(sigma.get(str(taxel), "nan")) for taxel in ids] if sigma else None
    except _READ_ERRORS as error:
        raise damaged(f"{name} cannot be read", error, remedy="write it again") from error
    if not nodes:
        raise damaged(f"{name} has no skin", limit="nodes taxel_<id>")
    sigmas = None if known is None else np.array(known)
    return SkinTable.of_poses("glb", ids, poses, radius, sigmas, extras.get(_FRAME))
