"""Columns of a table that hold contacts, found by their names.

A point is three columns x, y, z, alone or after a word such as `contact` or `pos` (`px`,
`contact_x_mm`, `point.x`), or after any word where there is none and the unit is one of length
(`stylus_x_mm`); a normal likewise after `n` or `normal`; a force is the one column such as `force`,
`fz` (without `fx`, `fy`) or `normal_force_n`, or that in N (`push_N`). Units may be in brackets.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

POINT_WORDS = {"p", "c", "cp", "contact", "touch", "point", "pos", "position", "body"}
"""Words before x, y, z that name a point; others, such as v or q, name something else."""
NORMAL_WORDS = {"n", "normal"}
"""Words of which one names a normal."""
FORCE = re.compile(r"(contact_|normal_|measured_)*(force|f)(_?(n|z|norm|normal))?(_n)?")
"""Names of a column of normal forces, N, in lower case."""
NEWTON = ("_N", "[N]", "(N)")
"""Ends of the names of columns in N."""
AXIS = re.compile(r"(?P<words>.*?)[_ .]?(?P<axis>[xyz])(_(?P<unit>m|mm|n))?")
"""Name of a coordinate, in lower case."""

_Columns = tuple[list[str], str]
"""Three columns and their unit."""


def plain(name: str) -> str:
    """The name of a column in lower case, its unit after an underscore: time_ms of `Time [ms]`."""
    return re.sub(r"\s*[\[(]([^\d\[\]()][^\[\]()]*)[\])]$", r"_\1", name.strip().lower())


def contact_columns(names: Sequence[str]) -> tuple[list[str], str]:
    """The columns of contact points, of normals and of forces, as far as there are, and the unit
    of the points, "" where they do not say it. No columns without those of points, or where two
    kinds of points could be meant.
    """
    triples: dict[tuple[str, str], dict[str, str]] = {}
    forces = [name for name in names if FORCE.fullmatch(plain(name))]
    forces = forces or [name for name in names if name.endswith(NEWTON)]
    for name in names:
        if found := AXIS.fullmatch(plain(name)):
            key = found["words"], found["unit"] or ""
            triples.setdefault(key, {})[found["axis"]] = name
    points, normals, others = list[_Columns](), list[_Columns](), list[_Columns]()
    for (words, unit), axes in triples.items():
        said = set(re.findall(r"[a-z]+", words))
        columns = [axes[axis] for axis in "xyz" if axis in axes]
        if len(columns) < 3 or unit == "n":
            continue
        if said <= POINT_WORDS | NORMAL_WORDS:
            (normals if said & NORMAL_WORDS else points).append((columns, unit))
        elif unit:
            others.append((columns, unit))
    points = points or others
    if len(points) != 1:
        return [], ""
    columns, unit = points[0]
    whole = any(len(axes) > 1 and axes.get("z") in forces for axes in triples.values())
    normal = normals[0][0] if len(normals) == 1 else []
    return columns + normal + (forces if len(forces) == 1 and not whole else []), unit
