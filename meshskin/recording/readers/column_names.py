"""Columns of a table by their names: their units, which of them are one stream, and what that
could be.

Columns whose names differ in a number alone are one stream: q_1, q_2 are q_*, q_1_deg, q_2_deg are
q_*_deg. Columns of contact points, normals and forces are the stream `contacts`, those of a wrench
`wrench`, and those that have names of joints, or units of angles, without such a number `joints`
(l_elbow, wrist_1_joint, LShoulderPitch_deg).
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

from ..log_map import TIME_UNITS, UNITS, StreamMap
from ..message_types import COMMANDED, MIN_TAXELS, words
from ..recording import QUATERNION
from ..stream import CONTACTS, JOINTS, TAXELS, WRENCH
from .contact_columns import contact_columns, plain

TIME_NAMES = {"time", "t", "timestamp", "stamp"}
"""Names of the column of times, before their unit; without a unit they are in s."""
DURATIONS = {"latency", "lag", "delay", "duration", "period", "interval", "jitter", "age", "dt",
             "timeout", "cycle", "step"}  # fmt: skip
"""Words of the names of columns in units of time that are not times of a clock."""
JOINT_NAMES = {"q", "j", "joint", "joints", "position", "positions", "angle", "angles"}
"""Words of the names of columns that could be joint angles."""
BODY_PARTS = {"shoulder", "elbow", "wrist", "hip", "knee", "ankle", "neck", "head", "torso",
              "waist", "thumb", "proximal", "distal"}  # fmt: skip
"""Words of the names of joints that do not say that they are one."""
OTHER_NAMES = {"qd", "dq", "qdd", "qdot", "dot", "velocity", "velocities", "vel", "speed",
               "acceleration", "acc", "tau", "torque", "torques", "effort", "efforts", "current",
               "currents", "temperature", "temp", "voltage", "pwm", "pose", "error", "status",
               "mode", "imu", *COMMANDED}  # fmt: skip
"""Words of the names of columns that are neither measured joint angles nor taxels."""
AXES = {"x", "y", "z", "w", *QUATERNION, "fx", "fy", "fz", "force", "pressure"}
"""Words of the names of single columns that are not angles."""
ANGLES = {"": "", "rad": "rad", "radian": "rad", "radians": "rad", "deg": "deg", "degree": "deg",
          "degrees": "deg", "\N{DEGREE SIGN}": "deg"}  # fmt: skip
"""Units of the names of columns of angles, with those of the map."""
FORCES, TORQUES = ("fx", "fy", "fz"), (("tx", "ty", "tz"), ("mx", "my", "mz"))
"""Names of the columns of a wrench, before their unit."""
ANGLE_FIELDS = {"position", "pos", "angle", "q"}
"""Ends of the paths of joint angles, after the name of the joint."""
_WRENCH = re.compile(r"(?P<start>.*[/.])?(?P<kind>force|torque)[/._](?P<axis>[xyz])")
_UNIT = re.compile(r"(?P<base>.+?)_(?P<unit>[^\W\d_]+|\N{DEGREE SIGN})")
_KNOWN = {*TIME_UNITS, *ANGLES, *(unit.lower() for units in UNITS.values() for unit in units), "nm"}
"""Units that the end of a name is taken for, in lower case."""


def split_unit(name: str) -> tuple[str, str]:
    """The name of a column without its unit, and the unit in lower case, "" without one: q_1_deg,
    time [ms]. A name that is a unit of time, such as ms or [s], has no other part."""
    end = plain(name)
    if end != "s" and end.lstrip("_") in TIME_UNITS:
        return "", end.lstrip("_")
    match = _UNIT.fullmatch(end)
    if match is None or (match["unit"] not in _KNOWN and end == name.strip().lower()):
        return name.strip(), ""
    return name.strip()[: len(match["base"])], match["unit"]


def is_time(name: str) -> bool:
    """Whether a column is named as one of times, alone or with a unit of time, is such a unit, or
    has it in brackets after any name but one of DURATIONS: Zeit [ms]."""
    base, unit = split_unit(name.lower().lstrip("%_ "))
    if base in TIME_NAMES:
        return not unit or unit in TIME_UNITS
    named = not base or (name.rstrip()[-1] in ")]" and not words(base) & DURATIONS)
    return unit in TIME_UNITS and named


def groups(names: Sequence[str]) -> dict[str, list[str]]:
    """Columns by the name of their stream, but for those of times; beside the streams of contacts,
    of a wrench and of joints a column that is named as its group is in none."""
    found: dict[str, list[str]] = {}
    if contacts := contact_columns(names)[0]:
        found[CONTACTS] = contacts
    if wrench := wrench_columns([name for name in names if name not in contacts]):
        found[WRENCH] = wrench
    known = {*found, *(name for columns in found.values() for name in columns)}
    numbered: dict[str, list[str]] = {}
    for name in names:
        if name and name not in known and not is_time(name):
            base, _ = split_unit(name)
            end = name.strip()[len(base) :]
            numbered.setdefault(re.sub(r"\d+(?=\]?$)", "*", base) + end, []).append(name)
    for group, columns in numbered.items():
        if kind := _joint_group(columns):
            found.setdefault(kind, []).extend(columns)
        else:
            found[group] = columns
    return found


def wrench_columns(names: Sequence[str]) -> list[str]:
    """The columns of forces in N and of their torques; none where a direction is missing. Of
    several wrenches, those of the first."""
    every: dict[str, dict[str, str]] = {}
    for name in names:
        base = split_unit(name)[0].lower()
        if match := _WRENCH.fullmatch(base):
            short = f"{match['kind'][0]}{match['axis']}"
            every.setdefault(match["start"] or "/", {}).setdefault(short, name)
        else:
            every.setdefault("", {}).setdefault(base, name)
    for at in every.values():
        units = {split_unit(at[name])[1] for name in FORCES if name in at}
        if not set(FORCES) <= set(at) or units - {"", "n"}:
            continue
        # beside a quaternion these are the translation of a pose
        beside = set(QUATERNION) <= set(names)
        torques = next((one for one in TORQUES if set(one) <= set(at) and not beside), ())
        return [at[name] for name in (*FORCES, *torques)]
    return []


def _joint_group(columns: Sequence[str]) -> str:
    """The group `joints`, with the unit, of columns that have names of joints without a number;
    empty for others."""
    base, unit = split_unit(columns[0])
    found = words(base)
    if unit not in ANGLES or found & (OTHER_NAMES | AXES):
        return ""
    if len(columns) == 1:
        named = bool(found & (BODY_PARTS | JOINT_NAMES) or ANGLES[unit])
    else:
        named = len(columns) < MIN_TAXELS and bool(found & BODY_PARTS)
    if named:
        return f"{JOINTS}_{ANGLES[unit]}" if unit else JOINTS
    return ""


def suggest(
    topic: str, columns: Sequence[str], texts: Mapping[str, str] | None = None
) -> list[StreamMap]:
    """What a group of columns could be, by its name and size. texts: the first ones of columns of
    text by their names, of which `name0` holds the name of the joint of `position0`."""
    name, width = topic.rpartition("/")[2], len(columns)
    contacts, unit = contact_columns(columns)
    if contacts == list(columns):
        return [StreamMap(topic, CONTACTS, length=width, unit=unit)]
    base, unit = split_unit(name)
    found = words(base)
    if found & {"wrench", "force", "ft", "f"} and width in (3, 6):
        return [StreamMap(topic, WRENCH)] if unit in ("", "n") else []
    if found & OTHER_NAMES:
        return []
    if found & JOINT_NAMES or ANGLES.get(unit):
        units = [split_unit(column)[1] for column in columns]
        if not set(units) <= set(ANGLES):
            return []
        alone = name.partition("_")[0] == JOINTS and "*" not in name
        names = _joint_names(columns, texts or {})
        return [
            StreamMap(
                topic, JOINTS, tuple(columns) if alone or width < 2 else (),
                names if names != tuple(columns) else (), unit=ANGLES[units[0]],
            )
        ]  # fmt: skip
    if width < MIN_TAXELS:
        return []
    given = {name.lower(): name for name in UNITS[TAXELS]}.get(unit, "")
    return [StreamMap(topic, TAXELS, length=width, unit=given)]


def _joint_names(columns: Sequence[str], texts: Mapping[str, str]) -> tuple[str, ...]:
    """The joints of columns of angles: by texts, or by their own names without unit and field."""
    given = [texts.get(column.replace("position", "name"), "") for column in columns]
    if all(given):
        return tuple(given)
    bases = [split_unit(column)[0] for column in columns]
    paths = [re.split("[/.]", base) for base in bases]
    if all(len(path) > 1 and path[-1].lower() in ANGLE_FIELDS for path in paths):
        return tuple(path[-2] for path in paths)
    return tuple(bases)
