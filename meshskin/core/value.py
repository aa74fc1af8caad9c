"""The base of the objects that a user holds: equal by content, copied and sent without caches."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from numbers import Number
from typing import Any

import numpy as np

CLOCKED = ("created", "steps_per_second")
"""Entries of mappings that a clock says: two runs of the same content differ in them."""


class Value:
    """Base of frozen dataclasses (declared with eq=False) that hold arrays, meshes and tables.

    `==` compares content and always answers True or False, also where fields are arrays. Copies,
    pickles and what is sent to a worker hold the fields and no cached properties, which may be
    compiled functions or search trees that cannot be sent; they are computed again on first use.
    """

    def __getstate__(self) -> dict[str, Any]:
        return {f.name: vars(self)[f.name] for f in dataclasses.fields(self)}  # type: ignore[arg-type]

    def __eq__(self, other: object) -> bool:
        if type(other) is not type(self):
            return NotImplemented
        return same_content(self, other)

    def __hash__(self) -> int:
        """From the type and from texts, numbers and lengths: equal objects have equal hashes."""
        compared = (f.name for f in dataclasses.fields(self) if f.compare)  # type: ignore[arg-type]
        return hash((type(self), *(_sketch(getattr(self, name)) for name in compared)))


def _sketch(value: Any) -> Any:
    """What a hash takes of a field: a text, a number or a length, which values that `same_content`
    calls equal have in common: 1 and 1.0, an array and a list."""
    if isinstance(value, np.ndarray) and value.ndim == 0:
        value = value.item()
    if isinstance(value, str | Number | np.generic):
        return value if value == value else None  # NaN, which is equal to NaN here
    return len(value) if isinstance(value, np.ndarray | Mapping | Sequence) else None


def same_content(a: Any, b: Any) -> bool:
    """Whether two values are equal: arrays element by element (NaN equals NaN), meshes by vertices
    and faces, dataclasses by the fields that count in a comparison, containers by their entries
    but CLOCKED.
    """
    if a is b:
        return True
    if isinstance(a, np.ndarray) or isinstance(b, np.ndarray):
        return _same_arrays(np.asarray(a), np.asarray(b))
    if all(hasattr(mesh, part) for mesh in (a, b) for part in ("vertices", "faces")):
        return _same_arrays(a.vertices, b.vertices) and _same_arrays(a.faces, b.faces)
    if type(a) is not type(b):
        return bool(a == b)
    if dataclasses.is_dataclass(a):
        names = [f.name for f in dataclasses.fields(a) if f.compare]
        return all(same_content(getattr(a, name), getattr(b, name)) for name in names)
    if isinstance(a, Mapping):
        keys = [key for key in a if key not in CLOCKED]
        return a.keys() == b.keys() and all(same_content(a[key], b[key]) for key in keys)
    if isinstance(a, Sequence) and not isinstance(a, str | bytes):
        return len(a) == len(b) and all(map(same_content, a, b))
    if isinstance(a, float) and a != a:
        return bool(b != b)
    return bool(a == b)


def _same_arrays(a: Any, b: Any) -> bool:
    a, b = np.asarray(a), np.asarray(b)
    numbers = a.dtype.kind in "fc" and b.dtype.kind in "fc"
    return bool(np.array_equal(a, b, equal_nan=numbers))
