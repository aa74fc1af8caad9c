"""Skins in PLY for viewers: the frame of each taxel as coloured spikes and as numbers.

The numbers are an element of their own, `taxel`: id, position (m), quaternion (xyzw), and sigma (m,
NaN where unknown) of a calibrated skin. Viewers ignore it; `read` uses it alone.
"""

from __future__ import annotations

import numpy as np

from ...core import se3
from . import table

NUMBERS = ("x", "y", "z", "qx", "qy", "qz", "qw")
SIGMA = "sigma"
_COMMENT, _FRAME = "comment disc_radius_m ", "comment frame "


def write(skin: table.SkinRows) -> str:
    """Text of the rows, exact to the last bit of positions."""
    import trimesh

    vertices, faces, colours = table.frame_mesh(skin.disc_radius)
    n, poses = len(skin.ids), skin.poses
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
    columns = NUMBERS if skin.sigmas is None else (*NUMBERS, SIGMA)
    properties = "".join(f"property double {column}\n" for column in columns)
    whole = "int" if np.abs(skin.ids).max() < 2**31 else "double"  # PLY has no longer integers
    element = f"element taxel {n}\nproperty {whole} id\n{properties}"
    numbers = [poses[:, :3, 3], se3.quaternion(poses[:, :3, :3])]
    numbers += [] if skin.sigmas is None else [np.asarray(skin.sigmas, dtype=float)[:, None]]
    each = zip(skin.ids.tolist(), np.concatenate(numbers, axis=1).tolist(), strict=True)
    rows = [" ".join(map(repr, [taxel, *values])) for taxel, values in each]
    comment = f"{_COMMENT}{float(skin.disc_radius)!r}\n{_FRAME}{skin.link}\n"
    form, _, elements = rest.partition("\n")
    lines = [first, form, comment + elements + element + "end_header"]
    return "\n".join(lines) + "\n" + body.rstrip("\n") + "\n" + "\n".join(rows) + "\n"


def read(text: str, name: str) -> table.SkinTable:
    """The taxels of a file made by `write`. Raises SkinError for any other PLY file."""
    head, _, body = text.partition("end_header")
    lines = head.splitlines()
    if "format ascii 1.0" not in lines or "\nelement taxel " not in head:
        what = f"{name} is a mesh without taxels"
        raise table.damaged(what, remedy="give a PLY file made by Skin.save")
    try:
        count = [int(line.split()[2]) for line in lines if line.startswith("element taxel ")]
        radius = [float(line[len(_COMMENT) :]) for line in lines if line.startswith(_COMMENT)]
        frame = [line[len(_FRAME) :] for line in lines if line.startswith(_FRAME)]
        listed = [fields for line in body.splitlines() if (fields := line.split())][-count[0] :]
        if len(listed) != count[0]:
            raise ValueError(f"{len(listed)} rows in place of {count[0]}")
    except (ValueError, IndexError) as error:
        raise table.damaged(f"{name}: cannot read the rows of taxels", error) from error
    known = f"property double {SIGMA}" in lines
    ids, rows = [], []
    for number, (taxel, *fields) in enumerate(listed, start=1):
        where = f"{name}, taxel row {number}"
        ids.append(table.parse_id(taxel, where))
        rows.append(table.parse_numbers(fields, len(NUMBERS) + known, where))
    places = np.array(rows)
    return table.SkinTable.of_quaternions(
        "ply", ids, places[:, :7], (radius or [table.DISC_RADIUS])[0],
        places[:, 7] if known else None, next(iter(frame), None),
    )  # fmt: skip
