"""Wavefront OBJ files: triangles in the order of the file, and names of objects, groups, materials.

trimesh's reader sorts faces by material and keeps one name of each.
"""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise, takewhile

import numpy as np

from ...core.arrays import Array, Index
from ...core.errors import MeshError


def read(text: str, file: str) -> tuple[Array, Index, dict[str, Index]]:
    """Vertices (n, 3), triangles (m, 3), and triangles by name, from the text of an OBJ file.

    Names are those of objects (`o`), groups (`g`, of which a face may have several) and materials
    (`usemtl`). Polygons become triangle fans about their first corner. Raises MeshError with the
    line.
    """
    places: list[float] = []  # three numbers a vertex; `faces`: three a triangle
    faces: list[int] = []
    spans: list[tuple[int, tuple[str, ...]]] = []  # first triangle, and the names from there on
    part: dict[str, tuple[str, ...]] = {}
    for number, words in _lines(text):
        key, values = words[0], words[1:]
        try:
            if key == "v":
                if len(values) < 3:
                    raise ValueError("a vertex needs three coordinates")
                places += map(float, values[:3])
            elif key == "f":
                corner = _corners(values, len(places) // 3)
                faces += corner[:3]
                for b, c in pairwise(corner[2:]):
                    faces += corner[0], b, c
            elif key in ("o", "g", "usemtl"):
                if words == ["usemtl", "None"]:  # Blender's word for no material
                    values = []
                part[key] = tuple(values) if key == "g" else (" ".join(values),)
                names = [name for kind in part.values() for name in kind if name]
                spans.append((len(faces) // 3, tuple(dict.fromkeys(names))))
        except ValueError as error:
            raise MeshError(f"{file} cannot be read", value=f"line {number}: {error}") from error
    named: dict[str, list[Index]] = {}
    for k, (first, names_here) in enumerate(spans):
        last = spans[k + 1][0] if k + 1 < len(spans) else len(faces) // 3
        for name in names_here if last > first else ():
            named.setdefault(name, []).append(np.arange(first, last))
    return (
        np.array(places, dtype=float).reshape(-1, 3),
        np.array(faces, dtype=np.intp).reshape(-1, 3) - 1,
        {name: np.concatenate(rows) for name, rows in named.items()},
    )


def _lines(text: str) -> Iterator[tuple[int, list[str]]]:
    """Number and words of each non-empty line; a backslash at its end continues a line."""
    continued: list[str] = []
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.split()
        if words and words[-1].endswith("\\"):
            continued += [*words[:-1], *filter(None, [words[-1][:-1]])]
            continue
        words, continued = continued + words, []
        if words:
            yield number, words


def _corners(words: list[str], count: int) -> list[int]:
    """Vertices, from 1, of the corners "v/vt/vn" of a face; negative ones count from the last."""
    try:
        corner = [int(word.partition("/")[0]) for word in words]
    except ValueError:
        words_before_comment = takewhile(lambda word: not word.startswith("#"), words)
        corner = [int(word.partition("/")[0]) for word in words_before_comment]
    if len(corner) < 3:
        raise ValueError("a face needs three corners")
    return corner if min(corner) > 0 else [k if k >= 0 else k + count + 1 for k in corner]
