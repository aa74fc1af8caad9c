"""What messages of known types hold, and what those of unknown types could."""

from __future__ import annotations

import re
from typing import Any

from ..core.errors import MeshskinError
from . import field_path
from .log_map import StreamMap
from .stream import CONTACTS, JOINTS, POSE, TAXELS, WRENCH

POINT = ("x", "y", "z")
ORIENTATION = ("x", "y", "z", "w")


def words(name: str) -> set[str]:
    """Words of the name of a topic or a column, in lower case: of l_elbow, of LShoulderPitch; the d
    of arm_3d is none."""
    name = re.sub(r"(?<=\d)[dD](?![A-Za-z])", "", name)
    return {word.lower() for word in re.findall(r"[A-Z]?[a-z]+|[A-Z]+(?![a-z])", name)}


def _paths(prefix: str, names: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(f"{prefix}.{name}" for name in names)


def _wrench(prefix: str) -> tuple[str, ...]:
    return _paths(f"{prefix}force", POINT) + _paths(f"{prefix}torque", POINT)


def _pose(position: str, orientation: str) -> tuple[str, ...]:
    return _paths(position, POINT) + _paths(orientation, ORIENTATION)


NUMBERS = ("Float32", "Float64", "Int8", "Int16", "Int32", "Int64", "UInt8", "UInt16", "UInt32")
"""Number types of the arrays of std_msgs."""
KNOWN: dict[str, tuple[str, tuple[str, ...]]] = {
    "JointState": (JOINTS, ("position",)),
    "WrenchStamped": (WRENCH, _wrench("wrench.")),
    "Wrench": (WRENCH, _wrench("")),
    "PoseStamped": (POSE, _pose("pose.position", "pose.orientation")),
    "Pose": (POSE, _pose("position", "orientation")),
    "TransformStamped": (POSE, _pose("transform.translation", "transform.rotation")),
    "TactileState": (TAXELS, ("sensors[].values",)),
    "SensStream": (TAXELS, ("sensors[].taxels[].z",)),
    "TactileContact": (CONTACTS, _paths("position", POINT) + _paths("normal", POINT)),
    "SensorData": (TAXELS, ("sensor_values",)),
    **{f"{number}MultiArray": (TAXELS, ("data",)) for number in NUMBERS},
}
"""Kind and field paths by the name of the message type: sensor_msgs, geometry_msgs, std_msgs,
tactile_msgs (TactileState), XELA (SensStream) and GenTact (SensorData)."""
NAME_PATHS = {"JointState": "name"}
"""Field paths of the joint names."""
TIME_PATHS = {"SensStream": "sensors[0].time"}
"""Field paths of the times, s, of types without a header; they are proposed where not zero."""
COMMANDED = {"target", "desired", "d", "des", "cmd", "command", "commands", "commanded", "ref",
             "reference", "setpoint"}  # fmt: skip
"""Words of the names of topics and columns whose angles were asked for, not measured."""
TRANSFORMS = "TFMessage"
"""The type that holds poses of many frames, of which a path selects one."""
IGNORED = ("Image", "CompressedImage", "PointCloud", "PointCloud2", "OccupancyGrid", "LaserScan")
"""Types whose arrays are not taxels."""
MIN_TAXELS = 4
"""Length of an array from which it could be taxels: what is shorter is a point, a quaternion or a
status."""


def short(message_type: str) -> str:
    """The name of a type without its package."""
    return message_type.rpartition("/")[2]


def default_paths(message_type: str, kind: str) -> tuple[str, ...]:
    """Field paths of the numbers in messages of a known type, as a kind; empty for others."""
    known = KNOWN.get(short(message_type))
    return known[1] if known is not None and known[0] == kind else ()


def suggestions(topic: str, message_type: str, message: Any) -> list[StreamMap]:
    """What the stream of a message could be, the likeliest first."""
    name = short(message_type)
    if name in IGNORED or message is None:
        return []
    if name == TRANSFORMS:
        return [_transform(topic, part) for part in message.transforms]
    if name in KNOWN:
        kind, paths = KNOWN[name]
        try:
            found = sum(len(field_path.numbers(field_path.getter(p)(message), p)) for p in paths)
            time = TIME_PATHS.get(name, "")
            time = time if time and any(field_path.getter(time)(message)) else ""
        except MeshskinError:
            return _by_arrays(topic, message)  # another package has a type of the same name
        length = found if kind == TAXELS else None
        names = (NAME_PATHS[name],) if name in NAME_PATHS else ()
        if kind == JOINTS and COMMANDED & words(topic):
            return []
        return [StreamMap(topic, kind, paths, names, length, time=time)] if found else []
    return _by_arrays(topic, message)


def _by_arrays(topic: str, message: Any) -> list[StreamMap]:
    """Taxels of each array of numbers that is long enough, the longest first."""
    arrays = [one for one in field_path.numeric_paths(message) if one[1] >= MIN_TAXELS]
    arrays.sort(key=lambda one: -one[1])
    return [StreamMap(topic, TAXELS, (path,), length=length) for path, length in arrays]


def _transform(topic: str, part: Any) -> StreamMap:
    """The poses of one child frame of a topic of transforms."""
    chosen = f"transforms[child_frame_id={part.child_frame_id}]"
    paths = _pose(f"{chosen}.transform.translation", f"{chosen}.transform.rotation")
    return StreamMap(topic, POSE, paths, time=f"{chosen}.header.stamp")
