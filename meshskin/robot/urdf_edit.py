"""Edits of URDF text: zero positions of joints, poses and sizes of shapes, and nothing else."""

from __future__ import annotations

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from xml.parsers import expat
from xml.sax.saxutils import quoteattr

from ..core.arrays import Array
from ..core.se3 import exp_so3, to_rpy
from ..geometry.mesh.link_mesh import KINDS
from .link_shapes import SIZES
from .urdf import Joint, numbers, rotation, vector

_START_TAG = re.compile(rb"""(?:[^>"']|"[^"]*"|'[^']*')*>""")
"""A start tag to its end; attributes may hold ">"."""


def with_moved_zeros(urdf: str, joints: Mapping[str, tuple[Joint, float]]) -> str:
    """URDF text with other zero positions of joints.

    joints: by name, each joint and its present position, rad or m, that becomes zero. Only the tags
    of their origins are changed.
    """
    tags = _tags(urdf.encode())
    edits = []
    for tag in tags:
        name = tag.attributes.get("name", "")
        if tag.path != ("robot", "joint") or name not in joints:
            continue
        joint, position = joints[name]
        turn, xyz = rotation(joint.rpy), joint.xyz
        if joint.kind == "prismatic":
            xyz = xyz + turn @ (position * joint.axis)
        else:
            turn = turn @ exp_so3(position * joint.axis)
        edits.append(_origin(tags, tag, xyz, turn))
    return _edited(urdf, edits)


def with_moved_shapes(urdf: str, link: str, pose: Array, scale: float, where: str = "") -> str:
    """URDF text in which the shapes of a link are scaled about its origin, then moved by a pose
    (4, 4), m. Only their origins and sizes are changed. Raises ArmError.

    where: appended to messages.
    """
    tags, edits = _tags(urdf.encode()), []
    here = f" of a shape of link {link!r}{where}"
    for shape in tags:
        geometry = _children(tags, shape, "geometry")
        of_link = shape.path in [("robot", "link", kind) for kind in KINDS]
        if not geometry or not of_link or tags[shape.parent].attributes.get("name") != link:
            continue
        for kind, sizes in SIZES.items():
            edits += [_scaled(t, sizes, scale, here) for t in _children(tags, geometry[0], kind)]
        origin = ET.Element("origin", *(t.attributes for t in _children(tags, shape, "origin")[:1]))
        xyz, rpy = (vector(origin, key, "0 0 0", 3, here) for key in ("xyz", "rpy"))
        turn = pose[:3, :3]
        edits.append(_origin(tags, shape, turn @ (scale * xyz) + pose[:3, 3], turn @ rotation(rpy)))
    return _edited(urdf, edits)


@dataclass(frozen=True)
class _Tag:
    """A start tag of an XML file."""

    index: int
    """In the order of the file."""
    at: int
    """Its first byte."""
    path: tuple[str, ...]
    """Names of the elements from the root to its own."""
    parent: int
    """Index of the tag of the element that it is in; -1: none."""
    attributes: dict[str, str]


def _tags(source: bytes) -> list[_Tag]:
    parser, open_, found = expat.ParserCreate("utf-8"), list[_Tag](), list[_Tag]()

    def start(name: str, attributes: dict[str, str]) -> None:
        path, parent = (open_[-1].path, open_[-1].index) if open_ else ((), -1)
        tag = _Tag(len(found), parser.CurrentByteIndex, (*path, name), parent, attributes)
        open_.append(tag)
        found.append(tag)

    parser.StartElementHandler = start
    parser.EndElementHandler = lambda _: open_.pop()
    parser.Parse(source, True)
    return found


def _children(tags: Iterable[_Tag], tag: _Tag, name: str) -> list[_Tag]:
    return [t for t in tags if t.parent == tag.index and t.path[-1] == name]


@dataclass(frozen=True)
class _Edit:
    """A tag, and the one that replaces it or, of an element without it, follows it."""

    tag: _Tag
    name: str
    attributes: Mapping[str, str]


def _origin(tags: list[_Tag], owner: _Tag, xyz: Array, turn: Array) -> _Edit:
    """The origin of an element at `xyz` (3,), m, with the rotation `turn` (3, 3)."""
    place = {"xyz": numbers(xyz), "rpy": numbers(to_rpy(turn))}
    return _Edit(next(iter(_children(tags, owner, "origin")), owner), "origin", place)


def _scaled(tag: _Tag, sizes: Mapping[str, str], scale: float, where: str) -> _Edit:
    """A shape with its sizes, by name with their defaults, times `scale`."""
    element, changed = ET.Element(tag.path[-1], tag.attributes), dict(tag.attributes)
    for key, default in sizes.items():
        count = len(default.split())
        changed[key] = numbers(scale * vector(element, key, default, count, where))
    return _Edit(tag, tag.path[-1], changed)


def _edited(urdf: str, edits: Iterable[_Edit]) -> str:
    """The text with its edits; all else is kept, to the byte."""
    source = urdf.encode()
    for edit in sorted(edits, key=lambda edit: -edit.tag.at):
        at = edit.tag.at
        start = _START_TAG.match(source, at)
        assert start is not None  # the parser found a tag there
        end = start.end()
        values = " ".join(f"{key}={quoteattr(text)}" for key, text in edit.attributes.items())
        new = f"<{edit.name} {values}".encode()
        if edit.name == edit.tag.path[-1]:
            closed = source[at:end].endswith(b"/>")
            source = source[:at] + new + (b"/>" if closed else b">") + source[end:]
        else:
            source = source[:end] + new + b"/>" + source[end:]
    return source.decode()
