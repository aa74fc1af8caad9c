"""The g2o text format: `VERTEX_SE3:QUAT id x y z qx qy qz qw`, and `EDGE_SE3:QUAT i j x y z qx qy
qz qw` with the 21 upper-triangular entries of the information matrix, translation first. 2D files,
`VERTEX_SE2 id x y yaw` and `EDGE_SE2 i j x y yaw` with 6 entries, are read into the plane z = 0.

Source: Kuemmerle et al., "g2o: A General Framework for Graph Optimization", ICRA 2011.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from scipy.spatial.transform import Rotation

from ...core import se3
from ...core.arguments import read_text
from ...core.arrays import Array, Index
from ...core.atomic_io import write_text
from ...core.errors import GraphError
from .symmetric_blocks import UPPER
from .validation import SINGULAR

if TYPE_CHECKING:
    from .graph import PoseGraph

FIELDS = {"VERTEX_SE3:QUAT": 8, "EDGE_SE3:QUAT": 30, "VERTEX_SE2": 4, "EDGE_SE2": 11}
"""Tags that are read, and their numbers per line."""
IGNORED = {"FIX"}
"""Tags that are ignored: the anchors follow from the edges."""
PLANAR = np.array([0, 1, 5])
"""Degrees of freedom of a pose that moves in the plane z = 0: x, y, yaw."""
UPPER_PLANAR = np.triu_indices(3)
"""Entries of a planar information matrix in the order of the file."""
ROLL_PITCH_RATIO = 4.0
"""Information about roll and pitch over that about yaw: then 3 / (2 tr(inv(I_R))) is I_yaw, the
weight kappa of a 2D displacement in SE-Sync."""
MAX_ID = 2**53
"""Largest id: ids are read as double-precision numbers, which are exact up to it."""
QUATERNION_TOLERANCE = 1e-2
"""Largest error of a quaternion's norm: files with three digits stay below it; it is normalized."""


def read(path: str | Path) -> dict[str, Any]:
    """Arguments of PoseGraph from the file `path`; ids may have gaps and come in any order.

    2D vertices and edges lie in the plane z = 0, with the information of `lift_information`.
    Raises GraphError with the number of a line that cannot be read.
    """
    tables = _tables(path)
    vertices, poses, vertex_lines = _join(tables, "VERTEX", 1)
    edges, measurements, edge_lines = _join(tables, "EDGE", 2)
    if not len(vertices):
        raise GraphError(f"{path} has no VERTEX_SE3:QUAT or VERTEX_SE2 line")
    ids, first = np.unique(vertices[:, 0].astype(np.int64), return_index=True)
    if len(ids) < len(vertices):
        again = np.setdiff1d(np.arange(len(vertices)), first)[0]
        raise GraphError(
            f"{path}, line {vertex_lines[again]}: vertex defined twice", value=vertices[again, 0]
        )
    ends = edges.astype(np.int64)
    index = np.minimum(np.searchsorted(ids, ends), len(ids) - 1)
    unknown = (ids[index] != ends).any(axis=1) | (ends[:, 0] == ends[:, 1])
    if unknown.any():
        row = int(np.argmax(unknown))
        raise GraphError(
            f"{path}, line {edge_lines[row]}: an edge must join two vertices of the file",
            value=tuple(ends[row].tolist()),
        )
    information = _symmetric(tables["EDGE_SE3:QUAT"][0][:, 9:], UPPER)
    planar = _symmetric(tables["EDGE_SE2"][0][:, 5:], UPPER_PLANAR)
    return {
        "poses": poses[first],
        "edges": index,
        "measurements": measurements,
        "information": np.concatenate([information, lift_information(planar)]),
        "ids": ids,
    }


def lift_information(planar: Array) -> Array:
    """Information (m, 6, 6) of displacements in the plane z = 0; `planar` (m, 3, 3): x, y, yaw.

    z, roll and pitch are measured as zero, independent of the others. A planar graph with planar
    anchors then stays in the plane, and the geodesic cost is the cost of the 2D graph, whatever
    these weights are. They are chosen so that the chordal weights are those of SE-Sync in 2D,
    tau = 2 / tr(inv(I_xy)) and kappa = I_yaw: I_z = 2 / tr(inv(I_xy)), the harmonic mean of the
    information about x and y (their mean, where I_xy is singular), and I_roll = I_pitch = 4 I_yaw.
    Variances of z, roll and pitch follow from these choices and mean nothing.
    """
    out = np.zeros((len(planar), 6, 6))
    out[:, PLANAR[:, None], PLANAR] = planar
    values = np.linalg.eigvalsh(planar[:, :2, :2])
    regular = values[:, 0] > SINGULAR * values[:, 1]
    safe = np.where(regular[:, None], values, 1.0)
    mean = np.maximum(values, 0.0).mean(axis=1)
    out[:, 2, 2] = np.where(regular, 2.0 / np.sum(1.0 / safe, axis=1), mean)
    yaw = np.maximum(planar[:, 2, 2], 0.0)
    out[:, 3, 3] = out[:, 4, 4] = ROLL_PITCH_RATIO * yaw
    return out


def write(path: str | Path, graph: PoseGraph) -> None:
    """Write a graph with all digits, the whole file or nothing.

    Raises OutputError if the file cannot be written.
    """
    poses, measurements = _rows(graph.poses), _rows(graph.measurements)
    lines = [
        f"VERTEX_SE3:QUAT {name} {_text(row)}" for name, row in zip(graph.ids, poses, strict=True)
    ]
    upper = graph.information[:, UPPER[0], UPPER[1]]
    lines += [
        f"EDGE_SE3:QUAT {i} {j} {_text(row)} {_text(entries)}"
        for (i, j), row, entries in zip(graph.ids[graph.edges], measurements, upper, strict=True)
    ]
    write_text(path, "\n".join(lines) + "\n")


def _join(
    tables: dict[str, tuple[Array, list[int]]], kind: str, ids: int
) -> tuple[Array, Array, list[int]]:
    """Ids (k, ids), transforms (k, 4, 4) and line numbers of the 3D and 2D lines of a `kind`."""
    (space, lines), (plane, planar_lines) = tables[f"{kind}_SE3:QUAT"], tables[f"{kind}_SE2"]
    xy, yaw = plane[:, ids : ids + 2], plane[:, ids + 2] / 2
    zero = np.zeros(len(plane))
    lifted = np.column_stack([xy, zero, zero, zero, np.sin(yaw), np.cos(yaw)])
    rows = np.concatenate([space[:, ids : ids + 7], lifted])
    names = np.concatenate([space[:, :ids], plane[:, :ids]])
    return names, _poses(rows), lines + planar_lines


def _symmetric(entries: Array, upper: tuple[Index, Index]) -> Array:
    """Symmetric matrices of their `upper` triangles (m, k)."""
    size = int(upper[0][-1]) + 1
    out = np.zeros((len(entries), size, size))
    out[:, upper[0], upper[1]] = out[:, upper[1], upper[0]] = entries
    return out


def _tables(path: str | Path) -> dict[str, tuple[Array, list[int]]]:
    """For each tag the numbers (k, FIELDS) of its lines, and their line numbers."""
    text = read_text("a pose graph", path, error=GraphError)
    rows: dict[str, list[list[float]]] = {tag: [] for tag in FIELDS}
    lines: dict[str, list[int]] = {tag: [] for tag in FIELDS}
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#") or words[0] in IGNORED:
            continue
        fields = _fields(words, f"{path}, line {number}")
        rows[words[0]].append(fields)
        lines[words[0]].append(number)
    return {
        tag: (np.array(rows[tag], dtype=float).reshape(-1, width), lines[tag])
        for tag, width in FIELDS.items()
    }


def _fields(words: list[str], line: str) -> list[float]:
    """The numbers of one line, checked."""
    tag, *fields = words
    if tag not in FIELDS:
        raise GraphError(f"{line}: unknown tag", value=tag, limit=", ".join(FIELDS))
    if len(fields) != FIELDS[tag]:
        raise GraphError(f"{line}: wrong number of fields", value=len(fields), limit=FIELDS[tag])
    try:
        values = [float(word) for word in fields]
    except ValueError as error:
        raise GraphError(f"{line}: not a number", value=error) from error
    ids = values[: 1 if tag.startswith("VERTEX") else 2]
    if not np.isfinite(values).all():
        raise GraphError(f"{line}: not finite")
    if any(value != int(value) for value in ids):
        raise GraphError(f"{line}: an id must be an integer", value=ids)
    if max(map(abs, ids)) > MAX_ID:
        raise GraphError(
            f"{line}: the id is too large", value=fields[: len(ids)], limit=MAX_ID,
            remedy="number the vertices anew",
        )  # fmt: skip
    if tag.endswith(":QUAT"):
        norm = float(np.linalg.norm(values[len(ids) + 3 : len(ids) + 7]))
        if abs(norm - 1.0) > QUATERNION_TOLERANCE:
            raise GraphError(f"{line}: a quaternion must have norm 1", value=f"{norm:.3g}")
    return values


def _poses(rows: Array) -> Array:
    """Transforms (n, 4, 4) of rows (n, 7): translation, quaternion xyzw."""
    if not len(rows):
        return np.empty((0, 4, 4))
    return se3.transform(Rotation.from_quat(rows[:, 3:]).as_matrix(), rows[:, :3])


def _rows(poses: Array) -> Array:
    """Rows (n, 7) of transforms (n, 4, 4): translation, quaternion xyzw."""
    if not len(poses):
        return np.empty((0, 7))
    return np.concatenate([poses[:, :3, 3], se3.quaternion(poses[:, :3, :3])], axis=1)


def _text(values: Array) -> str:
    return " ".join(format(float(value), ".17g") for value in values)
