"""The g2o text format: `VERTEX_SE3:QUAT id x y z qx qy qz qw`, and `EDGE_SE3:QUAT i j x y z qx qy
qz qw` with the 21 upper-triangular entries of the information matrix, translation first.

Source: Kuemmerle et al., "g2o: A General Framework for Graph Optimization", ICRA 2011.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from ...core import se3
from ...core.errors import GraphError
from ...core.se3 import Array
from .graph import PoseGraph

FIELDS = {"VERTEX_SE3:QUAT": 8, "EDGE_SE3:QUAT": 30}
"""Tags that are read, and their numbers a line."""
IGNORED = {"FIX"}
"""Tags that are passed over: the anchors follow from the edges."""
UPPER = np.triu_indices(6)
"""Entries of an information matrix in the order of the file."""


def load(path: str | Path) -> PoseGraph:
    """The graph in the file `path`; ids may have gaps, and come in any order.

    Raises GraphError with the line's number for what it cannot read.
    """
    tables = _tables(path)
    (vertices, vertex_lines), (edges, edge_lines) = (tables[tag] for tag in FIELDS)
    if not len(vertices):
        raise GraphError(f"{path} has no VERTEX_SE3:QUAT line")
    ids, first = np.unique(vertices[:, 0].astype(np.int64), return_index=True)
    if len(ids) < len(vertices):
        again = np.setdiff1d(np.arange(len(vertices)), first)[0]
        raise GraphError(
            f"{path}, line {vertex_lines[again]}: a vertex defined twice", value=vertices[again, 0]
        )
    ends = edges[:, :2].astype(np.int64)
    index = np.minimum(np.searchsorted(ids, ends), len(ids) - 1)
    stray = (ids[index] != ends).any(axis=1) | (ends[:, 0] == ends[:, 1])
    if stray.any():
        row = int(np.argmax(stray))
        raise GraphError(
            f"{path}, line {edge_lines[row]}: an edge must join two vertices of the file",
            value=tuple(ends[row].tolist()),
        )
    information = np.zeros((len(edges), 6, 6))
    information[:, UPPER[0], UPPER[1]] = information[:, UPPER[1], UPPER[0]] = edges[:, 9:]
    return PoseGraph(
        poses=_poses(vertices[first, 1:]),
        edges=index,
        measurements=_poses(edges[:, 2:9]),
        information=information,
        ids=ids,
    )


def save(graph: PoseGraph, path: str | Path) -> None:
    """Write `graph` so that it is read back to the last digit but the rotations' rounding."""
    out = []
    for name, row in zip(graph.ids, _rows(graph.poses), strict=True):
        out.append(f"VERTEX_SE3:QUAT {name} {_text(row)}")
    ends, rows = graph.ids[graph.edges], _rows(graph.measurements)
    upper = graph.information[:, UPPER[0], UPPER[1]]
    for (i, j), row, info in zip(ends, rows, upper, strict=True):
        out.append(f"EDGE_SE3:QUAT {i} {j} {_text(row)} {_text(info)}")
    Path(path).write_text("\n".join(out) + "\n", encoding="utf-8")


def _tables(path: str | Path) -> dict[str, tuple[Array, list[int]]]:
    """By tag: the numbers (k, FIELDS) of the file's lines, and where they stand in it."""
    try:
        text = Path(path).read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise GraphError(f"cannot read {path}", value=error) from error
    rows: dict[str, list[list[float]]] = {tag: [] for tag in FIELDS}
    lines: dict[str, list[int]] = {tag: [] for tag in FIELDS}
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if not words or words[0].startswith("#") or words[0] in IGNORED:
            continue
        fields = _fields(words, path, number)
        rows[words[0]].append(fields)
        lines[words[0]].append(number)
    return {
        tag: (np.array(rows[tag], dtype=float).reshape(-1, width), lines[tag])
        for tag, width in FIELDS.items()
    }


def _fields(words: list[str], path: str | Path, number: int) -> list[float]:
    """The numbers of one line, checked."""
    tag = words[0]
    if tag not in FIELDS:
        raise GraphError(f"{path}, line {number}: unknown tag", value=tag, limit=", ".join(FIELDS))
    if len(words) - 1 != FIELDS[tag]:
        raise GraphError(
            f"{path}, line {number}: wrong number of fields",
            value=len(words) - 1,
            limit=FIELDS[tag],
        )
    try:
        values = [float(word) for word in words[1:]]
    except ValueError as error:
        raise GraphError(f"{path}, line {number}: not a number", value=error) from error
    named = values[: 1 if tag.startswith("VERTEX") else 2]
    if not np.isfinite(values).all():
        raise GraphError(f"{path}, line {number}: not finite")
    if any(value != int(value) for value in named):
        raise GraphError(f"{path}, line {number}: an id must be a whole number", value=named)
    norm = float(np.linalg.norm(values[len(named) + 3 : len(named) + 7]))
    if abs(norm - 1.0) > 1e-2:
        raise GraphError(f"{path}, line {number}: a quaternion of length {norm:.3g}", limit=1)
    return values


def _poses(rows: Array) -> Array:
    """Transforms (n, 4, 4) of rows (n, 7): translation, quaternion xyzw."""
    if not len(rows):
        return np.empty((0, 4, 4))
    return se3.transform(Rotation.from_quat(rows[:, 3:]).as_matrix(), rows[:, :3])


def _rows(poses: Array) -> Array:
    if not len(poses):
        return np.empty((0, 7))
    return np.concatenate([poses[:, :3, 3], se3.quaternion(poses[:, :3, :3])], axis=1)


def _text(values: Array) -> str:
    return " ".join(format(float(value), ".17g") for value in values)
