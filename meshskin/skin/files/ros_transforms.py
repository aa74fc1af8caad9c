"""Taxel frames as static transforms of ROS, in YAML: a tf2_msgs/TFMessage, one transform a line.

    ros2 topic pub --once --qos-durability transient_local /tf_static tf2_msgs/msg/TFMessage \\
      "$(cat skin.yaml)"

publishes them. The child frames are `<part>_skin_<id>`; z is the outward normal. Each line is JSON,
which is YAML, too, so that no YAML library is needed to read it back; the sigma of a position, m,
is a comment at its end.
"""

from __future__ import annotations

import json
import re

import numpy as np

from ...core import se3
from . import table

HEAD = "transforms:"
_RADIUS, _SIGMA = "# disc_radius_m: ", " # sigma_m: "


def write(rows: table.SkinRows) -> str:
    """Text with one transform a taxel, from the frame `rows.link`; exact to rounding."""
    lines = [_RADIUS + repr(float(rows.disc_radius)), HEAD]
    for taxel, pose, sigma in rows.each():
        x, y, z = pose[:3, 3].tolist()
        i, j, k, w = se3.quaternion(pose[:3, :3]).tolist()
        message = {
            "header": {"frame_id": rows.link},
            "child_frame_id": f"{rows.link}_skin_{taxel}",
            "transform": {
                "translation": {"x": x, "y": y, "z": z},
                "rotation": {"x": i, "y": j, "z": k, "w": w},
            },
        }
        lines.append("- " + json.dumps(message) + (_SIGMA + sigma if sigma else ""))
    return "\n".join(lines) + "\n"


def read(text: str, name: str) -> table.SkinTable:
    """The frames of a file as `write` gives it. Raises SkinError."""
    ids, places, sigmas, radius, frame = [], [], [], table.DISC_RADIUS, None
    for number, line in enumerate(text.splitlines(), start=1):
        where = f"{name}, line {number}"
        if line.startswith(_RADIUS):
            radius = float(table.parse_numbers([line.removeprefix(_RADIUS)], 1, where)[0])
        if not line.startswith("- "):
            continue
        try:
            text, _, sigma = line[2:].partition(_SIGMA)
            message = json.loads(text)
            match = re.fullmatch(table.TAXEL_NAME, message["child_frame_id"])
            at, turn = (message["transform"][key] for key in ("translation", "rotation"))
            places.append([*(float(at[k]) for k in "xyz"), *(float(turn[k]) for k in "xyzw")])
            frame = str(message["header"]["frame_id"])
        except (ValueError, KeyError, TypeError, OverflowError) as error:
            limit = "a transform in JSON: header, child_frame_id, transform"
            raise table.damaged(where, f"{type(error).__name__}: {error}", limit) from error
        if match is None:
            raise table.damaged(where, message["child_frame_id"], "<part>_skin_<id>")
        ids.append(table.parse_id(match[2], where))
        sigmas.append(sigma)
    if not ids:
        raise table.damaged(f"{name} holds no transforms", limit="lines `- {...}`")
    known = table.parse_sigmas(sigmas, name)
    return table.SkinTable.of_quaternions("ros", ids, np.array(places), radius, known, frame)
