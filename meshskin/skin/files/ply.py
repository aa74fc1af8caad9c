"""Skins in PLY for viewers: the frame of each taxel as coloured spikes and as numbers.

The numbers are an element of their own, `taxel`: id, position (m), quaternion (xyzw). Viewers
ignore it; `read` uses it alone.
"""

from __future__ import annotations

import numpy as np

from ...core import se3
from ...core.arrays import Array
from ...core.errors import SkinError
from ..slots import Ids
from .table import DISC_RADIUS, SkinTable, frame_mesh

NUMBERS = ("x", "y", "z", "qx", "qy", "qz", "qw")
_COMMENT = "comment disc_radius_m "


def write(poses: Array, ids: Ids, disc_radius: float, name: str) -> str:
    """Text of poses (n, 4, 4) and ids (n,), exact to the last bit of positions."""
    import trimesh

    vertices, faces, colours = frame_mesh(disc_radius)
    n = len(ids)
    placed = vertices @ np.swapaxes(poses[:, :3, :3], 1, 2) + poses[:, None, :3, 3]
    mesh = trimesh.Trimesh(
        placed.reshape(-1, 3),
        (faces + len(vertices) * np.arange(n)[:, None, None]).reshape(-1, 3),
        vertex_colors=np.tile(colours, (n, 1)),
        process=False,
    )
    exported = mesh.export(file_type="ply", encoding="ascii", vertex_normal=False)
    text = exported.decode() if isinstance(exported, bytes) else exported
    head, _, body = text.partition("end_header\n")
    first, _, rest = head.partition("\n")
    properties = "".join(f"property double {column}\n" for column in NUMBERS)
    element = f"element taxel {n}\nproperty int id\n{properties}"
    values = np.column_stack([poses[:, :3, 3], se3.quaternion(poses[:, :3, :3])]).tolist()
    rows = [" ".join(map(repr, [taxel, *v])) for taxel, v in zip(ids.tolist(), values, strict=True)]
    comment = f"{_COMMENT}{float(disc_radius)!r}\n"
    form, _, elements = rest.partition("\n")
    lines = [first, form, comment + elements + element + "end_header"]
    return "\n".join(lines) + "\n" + body.rstrip("\n") + "\n" + "\n".join(rows) + "\n"


def read(text: str, name: str) -> SkinTable:
    """The taxels of a file made by `write`. Raises SkinError for any other PLY file."""
    from scipy.spatial.transform import Rotation

    head, _, body = text.partition("end_header")
    lines = head.splitlines()
    if "format ascii 1.0" not in lines or "\nelement taxel " not in head:
        raise SkinError(f"{name} is a mesh without taxels", remedy="a PLY file made by Skin.save")
    try:
        count = [int(line.split()[2]) for line in lines if line.startswith("element taxel ")]
        radius = [float(line[len(_COMMENT) :]) for line in lines if line.startswith(_COMMENT)]
        listed = [[float(v) for v in r.split()] for r in body.splitlines()[-count[0] :]]
        if len({len(row) for row in listed}) > 1:
            raise ValueError("rows of different lengths: the file is truncated")
        rows = np.array(listed)
    except (ValueError, IndexError) as error:
        raise SkinError(f"{name}: rows of taxels", value=str(error)) from error
    if rows.shape != (count[0], 1 + len(NUMBERS)):
        raise SkinError(f"{name}: rows of taxels", value=rows.shape, limit=(count[0], 8))
    quaternions = rows[:, 4:]
    normals = np.zeros((len(rows), 3))
    valid = np.linalg.norm(quaternions, axis=1) > 0.0  # False for NaN
    normals[valid] = Rotation.from_quat(quaternions[valid]).as_matrix()[:, :, 2]
    ids = rows[:, 0].astype(np.int64)
    return SkinTable("ply", ids, rows[:, 1:4], normals, quaternions, (radius or [DISC_RADIUS])[0])
