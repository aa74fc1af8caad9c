"""Folders of the YARP data dumper: info.log beside data.log, one folder a port.

A line of data.log is `count time content`, or `count sent received content` where info.log says
"Stamp: tx+rx". The content is a vector of numbers, numbers in nested lists (taken in their order;
`values` of the map says which, such as 0:6), or a list of skin contacts

    ((id body_part link skin_part) (centre of pressure) (force) (moment) (geometric centre) (normal)
     (active taxels) pressure)

in m and N in the link frame. Contacts become two streams a skin part: PORT/PART the contacts, and
PORT/PART/taxels the mean pressure of the contact in which a taxel is active, 0 elsewhere.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...core.arguments import repr_short
from ...core.errors import RecordingError, UnknownNameError
from ..log_map import FALLING, RISING, StreamMap
from ..message_types import MIN_TAXELS
from ..stream import CONTACTS, JOINTS, TAXELS, WRENCH, Log, Stream

if TYPE_CHECKING:
    from ..log_map import LogMap

VECTOR, SKIN_CONTACTS = "vector", "skinContactList"
"""Types of ports."""
CONTACT_FIELDS = ("px", "py", "pz", "nx", "ny", "nz", "force", "pressure")
"""Columns of contacts: centre of pressure, normal, magnitude of the force, mean reading."""
CONTACT_PARTS = (4, 3, 3, 3, 3, 3)
"""Lengths of the first six lists of a contact."""
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
STATE = re.compile(r"/(\w+)/state(Ext)?:o$")
"""Ports of joint angles, in degrees."""
RANGE = re.compile(r"(\d*):(\d*)")
"""A part of the numbers of a line, as a slice of Python's."""
_TOKEN = re.compile(r"[()]|[^\s()]+")


class OtherContentError(RecordingError):
    """A port of text, images or other content than numbers."""


@dataclass(frozen=True)
class Port:
    """One port: its name, the file of its data, and how many times a line begins with."""

    name: str
    file: Path
    stamps: int


def ports(folder: Path) -> list[Port]:
    """The ports in a folder and those below it, by the names of their sources."""
    found: dict[str, Port] = {}
    for file in sorted(folder.rglob("data.log")):
        info = file.with_name("info.log")
        text = info.read_text(encoding="utf-8", errors="replace") if info.is_file() else ""
        source = re.search(r"^\[[\d.]+\] (\S+) \[connected\]", text, re.MULTILINE)
        inside = file.parent.relative_to(folder).as_posix()
        name = source[1] if source else f"/{inside if inside != '.' else folder.name}"
        if name in found:
            name = f"{name}@{inside}"
        found[name] = Port(name, file, 2 if "tx+rx" in text else 1)
    return list(found.values())


def read(
    path: Path, log_map: LogMap | None, *, progress: bool = False
) -> tuple[Log, dict[str, list[StreamMap]]]:
    """The log in the folder of one port or of several, and what its streams could be.

    Raises RecordingError for lines that are not what a dumper writes, but for the last one: the
    log is read up to it.
    """
    folder = path if path.is_dir() else path.parent
    notes: list[str] = []
    streams: list[Stream] = []
    failed: list[OtherContentError] = []
    wanted = None if log_map is None else [stream.topic for stream in log_map.streams]
    for port in ports(folder):
        if wanted is not None and not any(f"{t}/".startswith(f"{port.name}/") for t in wanted):
            continue
        try:
            streams += _streams(port, notes, progress)
        except OtherContentError as error:
            if log_map is not None:
                raise
            failed.append(error)
            notes.append(f"{port.name} is not listed: {error}")
    if failed and not streams:
        raise failed[0]
    if log_map is None:
        return Log(path, tuple(sorted(streams, key=lambda one: one.name)), tuple(notes)), {
            one.name: suggest(one) for one in streams
        }
    by_name = {stream.name: stream for stream in streams}
    for topic in wanted or ():
        if topic not in by_name:
            known = {*by_name, *(port.name for port in ports(folder))}
            raise UnknownNameError("port", topic, known, f" in {path.name}")
    mapped = tuple(_mapped(by_name[one.topic], one) for one in log_map.streams)
    return Log(path, mapped, tuple(notes)), {}


def _mapped(stream: Stream, given: StreamMap) -> Stream:
    """The stream as the map says. Raises RecordingError for a kind that it cannot be."""
    ranges = [RANGE.fullmatch(part) for part in given.values]
    if given.time or not all(ranges) or (ranges and stream.type != VECTOR):
        raise RecordingError(
            f"the lines of {stream.name} have one time and one vector",
            value="values or time in the map",
            remedy="leave them out, or write values as ranges of the vector, such as 0:6",
        )
    wrong = stream.type == SKIN_CONTACTS and given.kind != stream.kind
    if wrong or (stream.type == VECTOR and given.kind == CONTACTS):
        raise RecordingError(
            f"{stream.name} has the wrong type for {given.kind}",
            value=stream.type,
            remedy=f"it can be {stream.kind or 'joints, taxels, a wrench or a pose'}",
        )
    values = stream.values
    if ranges:
        every = np.arange(values.shape[1])
        parts = [every[slice(*(int(k) if k else None for k in r.groups()))] for r in ranges if r]
        values = values[:, np.concatenate(parts)]
    width = values.shape[1]
    names = stream.fields[:width]
    if stream.type == VECTOR:
        given.check_length(width, 0)
        if given.kind == TAXELS:
            names = given.taxel_ids(width)
        elif given.kind == JOINTS:
            names = given.names or tuple(f"joint_{k}" for k in range(width))
        if len(names) != width or len(set(names)) < width:
            raise RecordingError(
                f"{stream.name} needs one name for each joint",
                value=f"{len(names)} names",
                limit=f"{width} values",
                remedy="correct names in the map",
            )
    unit = given.unit or given.si_unit
    return Stream(stream.name, stream.type, stream.times, values, names, given.kind, unit)


def _streams(port: Port, notes: list[str], progress: bool) -> list[Stream]:
    """The streams of a port: one of vectors, or two of contacts for each skin part."""
    from tqdm import tqdm

    hidden = None if progress else True  # None: hidden where stderr is not a terminal
    lines = tqdm(_lines(port, notes), port.name, leave=False, unit=" lines", disable=hidden)
    times, vectors, contacts = list[float](), list[np.ndarray](), list[tuple[int, list[Any]]]()
    empty, nested = list[int](), False
    for number, (time, content) in enumerate(lines):
        if not vectors and not contacts:
            nested = content.startswith("(") and not _is_contacts(content)
        try:
            if content.startswith("(") and not nested:
                contacts += [(len(times), _contact(one)) for one in _parsed(content)]
            elif content:
                words = content.replace("(", " ").replace(")", " ") if nested else content
                vectors.append(np.array(words.split(), dtype=float))
                if len(vectors[-1]) != len(vectors[0]):
                    raise ValueError(f"{len(vectors[-1])} values, {len(vectors[0])} before")
            else:
                empty.append(len(times))
        except (ValueError, IndexError) as error:
            if number and number + 1 == _count_lines(port.file):
                notes.append(f"{port.name} is torn in its last line: what is before is read")
                vectors = vectors[: len(times)]
                break
            kind = RecordingError if vectors or contacts else OtherContentError
            raise kind(
                f"line {number + 1} of {port.file.parent.name}/{port.file.name} is neither a "
                f"vector as long as those before nor a list of contacts: {error}",
                remedy="read a port of vectors or of skin contacts",
            ) from error
        times.append(time)
    if vectors and contacts:
        raise RecordingError(
            f"{port.name} has lines of vectors and of contacts", value=f"{len(vectors)} vectors",
            limit=f"{len(times)} lines", remedy="remove the ones or the others",
        )  # fmt: skip
    if vectors and empty:
        notes.append(f"{len(empty)} lines of {port.name} are empty: they are left out")
        times = np.delete(times, empty).tolist()
    if contacts:
        return _contact_streams(port.name, np.array(times), contacts)
    values = np.array(vectors) if vectors else np.empty((len(times), 0))
    fields = tuple(str(k) for k in range(values.shape[1]))
    return [Stream(port.name, VECTOR, np.array(times), values, fields)]


def _count_lines(file: Path) -> int:
    with file.open("rb") as stream:
        return sum(1 for line in stream if line.strip())


def _lines(port: Port, notes: list[str]) -> Iterator[tuple[float, str]]:
    """Time, s, and content of each line; that of the sender where there are two times."""
    with port.file.open(encoding="utf-8", errors="replace") as stream:
        for number, line in enumerate(stream):
            words = line.strip().split(" ", 1 + port.stamps)
            if words == [""]:
                continue
            try:
                time = float(words[1])
                if port.stamps == 2:
                    float(words[2])
            except (ValueError, IndexError) as error:
                if not line.endswith("\n"):
                    notes.append(f"{port.name} is torn in its last line: what is before is read")
                    return
                raise RecordingError(
                    f"line {number + 1} of {port.file.parent.name}/{port.file.name} must begin "
                    f"with a number and {port.stamps} time{'s' * (port.stamps > 1)}",
                    value=repr_short(line),
                    remedy="read a folder that the YARP data dumper wrote",
                ) from error
            if not line.endswith("\n"):
                notes.append(f"{port.name} does not end with a line: its last line is left out")
                return
            yield time, words[1 + port.stamps].strip() if len(words) > 1 + port.stamps else ""


def _parsed(text: str) -> list[Any]:
    """Nested lists of numbers from parentheses. Raises ValueError if they do not match."""
    stack: list[list[Any]] = [[]]
    for token in _TOKEN.findall(text):
        if token == "(":
            stack.append([])
        elif token != ")":
            stack[-1].append(float(token))
        elif len(stack) > 1:
            done = stack.pop()
            stack[-1].append(done)
        else:
            raise ValueError("parentheses do not match")
    if len(stack) != 1:
        raise ValueError("parentheses do not match")
    return stack[0]


def _is_contacts(text: str) -> bool:
    """Whether a line lists skin contacts."""
    try:
        return bool([_contact(one) for one in _parsed(text)])
    except ValueError:
        return False


def _contact(entry: Any) -> list[Any]:
    """A contact, checked. Raises ValueError."""
    parts = entry if isinstance(entry, list) else []
    lengths = tuple(len(part) if isinstance(part, list) else 1 for part in parts[:6])
    if len(parts) != 8 or lengths != CONTACT_PARTS or not isinstance(parts[6], list):
        raise ValueError("it is not a skin contact")
    return parts


def _contact_streams(
    port: str, frames: np.ndarray, contacts: list[tuple[int, list[Any]]]
) -> list[Stream]:
    """Contacts and active taxels of each skin part; contacts are given with the rows of their
    frames."""
    streams = []
    for part in sorted({int(contact[0][3]) for _, contact in contacts}):
        own = [(row, contact) for row, contact in contacts if int(contact[0][3]) == part]
        name = f"{port}/{SKIN_PARTS.get(part, f'part_{part}')}"
        times = frames[[row for row, _ in own]]
        rows = [[*c[1], *c[5], float(np.linalg.norm(c[2])), c[7]] for _, c in own]
        streams.append(
            Stream(name, SKIN_CONTACTS, times, np.array(rows), CONTACT_FIELDS, CONTACTS, "m")
        )
        ids = sorted({int(taxel) for _, contact in own for taxel in contact[6]})
        column = {taxel: k for k, taxel in enumerate(ids)}
        pressure = np.zeros((len(frames), len(ids)), dtype=np.float32)
        for row, contact in own:
            columns = [column[int(taxel)] for taxel in contact[6]]
            pressure[row, columns] = np.maximum(pressure[row, columns], contact[7])
        fields = tuple(map(str, ids))
        active = f"{name}/taxels"
        streams.append(Stream(active, SKIN_CONTACTS, frames, pressure, fields, TAXELS, "count"))
    return streams


def suggest(stream: Stream) -> list[StreamMap]:
    """What a port could be, by its name and the length of its vectors."""
    name, width = stream.name, stream.values.shape[1]
    if not width:
        return []
    if stream.kind:
        return [StreamMap(name, stream.kind)]
    if match := STATE.search(name):
        names = PARTS.get(match[1], ())
        if match[2] and len(names) < width:  # angles come before velocities, currents and modes
            return (
                [StreamMap(name, JOINTS, (f"0:{len(names)}",), names, unit="deg")] if names else []
            )
        names = names if len(names) == width else ()
        return [StreamMap(name, JOINTS, names=names, length=width, unit="deg")]
    if "skin" in name and width >= MIN_TAXELS:
        polarity = RISING if "_comp" in name else FALLING
        return [StreamMap(name, TAXELS, length=width, polarity=polarity)]
    if width >= 6 and re.search("FT|analog|[wW]rench", name):
        return [StreamMap(name, WRENCH, ("0:6",) if width > 6 else ())]
    return [StreamMap(name, TAXELS, length=width)] if width >= MIN_TAXELS else []
