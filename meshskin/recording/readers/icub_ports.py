"""The ports of the iCub: their joints, their skin parts, and what a port could be by its name."""

from __future__ import annotations

import re

from ..log_map import FALLING, RISING, StreamMap
from ..message_types import MIN_TAXELS
from ..stream import JOINTS, TAXELS, WRENCH, Stream

SKIN_PARTS = {
    1: "left_hand",
    2: "left_forearm",
    3: "left_upper_arm",
    4: "right_hand",
    5: "right_forearm",
    6: "right_upper_arm",
    7: "torso",
}
"""Names of the skin parts by their number in a skin contact (iCub, skinDynLib)."""
ARM = (
    "shoulder_pitch", "shoulder_roll", "shoulder_yaw", "elbow",
    "wrist_prosup", "wrist_pitch", "wrist_yaw",
    "hand_finger", "thumb_oppose", "thumb_proximal", "thumb_distal",
    "index_proximal", "index_distal", "middle_proximal", "middle_distal", "pinky",
)  # fmt: skip
LEG = ("hip_pitch", "hip_roll", "hip_yaw", "knee", "ankle_pitch", "ankle_roll")
PARTS: dict[str, tuple[str, ...]] = {
    "left_arm": tuple(f"l_{name}" for name in ARM),
    "right_arm": tuple(f"r_{name}" for name in ARM),
    "left_leg": tuple(f"l_{name}" for name in LEG),
    "right_leg": tuple(f"r_{name}" for name in LEG),
    "torso": ("torso_yaw", "torso_roll", "torso_pitch"),
    "head": ("neck_pitch", "neck_roll", "neck_yaw", "eyes_tilt", "eyes_version", "eyes_vergence"),
}
"""Names of the joints by port, in its order: those of the robot's URDF files where they have the
joint."""
STATE = re.compile(r"/(\w+)/state:o$")
"""Ports of joint angles, in degrees."""


def suggest(stream: Stream) -> list[StreamMap]:
    """What a port could be, by its name and the length of its vectors."""
    width = stream.values.shape[1]
    if stream.kind:
        return [StreamMap(stream.name, stream.kind)]
    if match := STATE.search(stream.name):
        names = PARTS.get(match[1], ())
        names = names if len(names) == width else ()
        return [StreamMap(stream.name, JOINTS, names=names, length=width, unit="deg")]
    if "skin" in stream.name and width >= MIN_TAXELS:
        polarity = RISING if "_comp" in stream.name else FALLING
        return [StreamMap(stream.name, TAXELS, length=width, polarity=polarity)]
    if width == 6 and any(word in stream.name for word in ("FT", "analog", "wrench")):
        return [StreamMap(stream.name, WRENCH)]
    return [StreamMap(stream.name, TAXELS, length=width)] if width >= MIN_TAXELS else []
