"""Paths to numbers in messages: "position", "wrench.force.x", "sensors[].taxels[].z".

A path is a chain of field names. `name[]` takes every element of a list, `name[2]` the third,
`name[2::3]` every third from there on (a slice of Python's), and `name[key=text]` those whose field
`key` is that text: `transforms[child_frame_id=tool0]`.
"""

from __future__ import annotations

import operator
import re
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

from ..core.arguments import repr_short
from ..core.errors import ConfigError, RecordingError, UnknownNameError

_STEP = re.compile(r"(\w+)(?:\[(?:(\d+)|(\d*:\d*(?::[1-9]\d*)?)|([\w/]+)=([^\]]+))?(\])?)?")
MAX_DEPTH = 6
"""Depth to which `numeric_paths` descends; standard messages nest up to five deep."""

Getter = Callable[[Any], list[Any]]


def parse(path: str) -> list[tuple[str, str]]:
    """The steps of a path: a field name and what its brackets hold, "", "[]", "2", "2::3" or
    "key=text". Raises ConfigError for a path that is not one."""
    steps = []
    for part in re.split(r"\.(?![^\[]*\])", path):  # at dots that are not in brackets
        match = _STEP.fullmatch(part)
        if match is None or ("[" in part) != part.endswith("]"):
            raise ConfigError(
                "a field path must be names separated by dots",
                value=repr_short(path),
                remedy="write it like position, wrench.force.x, sensors[0].values, "
                "transforms[child_frame_id=tool0].transform",
            )
        name, _, inside = part.partition("[")
        inside = inside.removesuffix("]")
        steps.append((name, inside if inside or "[" not in part else "[]"))
    return steps


def getter(path: str) -> Getter:
    """The function that takes the values at `path` from a message, as a list of what it finds.

    Its elements are numbers, texts or arrays. The function raises RecordingError for a field that
    the message does not have, naming those that it has.
    """
    steps = parse(path)

    def get(message: Any) -> list[Any]:
        found = [message]
        for name, inside in steps:
            found = [_field(item, name, path) for item in found]
            if inside:
                found = [part for item in found for part in _elements(item, inside, path)]
        return found

    return get


def numbers(found: list[Any], path: str) -> np.ndarray:
    """What a getter found as one array (k,) of numbers. Raises RecordingError for anything else."""
    try:
        if len(found) == 1:
            values = np.atleast_1d(np.asarray(found[0]))
        elif found and np.ndim(found[0]):
            values = np.concatenate(found)
        else:
            values = np.asarray(found)
        if values.ndim != 1 or (values.dtype.kind not in "biuf" and len(values)):
            raise TypeError
        if not found or not isinstance(found[0], np.ndarray):
            values = values.astype(float)  # of Python's numbers the next message may have others
    except (TypeError, ValueError) as error:
        raise RecordingError(
            f"the field {path} must contain numbers",
            value=repr_short(found[0] if len(found) == 1 else found),
            remedy="give the path down to the numbers",
        ) from error
    return values


def plain_getter(paths: Sequence[str], message: Any) -> Callable[[Any], Any] | None:
    """A faster getter for messages like this one: of an array, or of numbers as a tuple.

    None for messages of other make, and for paths with brackets. The function raises AttributeError
    for a message without the fields.
    """
    if isinstance(message, dict) or any(inside for path in paths for _, inside in parse(path)):
        return None
    get = operator.attrgetter(*paths)
    found = get(message)
    if len(paths) == 1:
        return get if isinstance(found, np.ndarray) and found.ndim == 1 else None
    return get if all(isinstance(one, int | float) for one in found) else None


def selects(path: str) -> bool:
    """Whether a path selects elements by a text, and so may find nothing in a message."""
    return any("=" in inside for _, inside in parse(path))


def _field(item: Any, name: str, path: str) -> Any:
    try:
        return item[name] if isinstance(item, dict) else getattr(item, name)
    except (AttributeError, KeyError):
        known = fields(item)
        where = f" in the field path {path} of a {type(item).__name__}"
        if not known:
            raise RecordingError(
                f"nothing is below {name}{where}", remedy="shorten the path"
            ) from None
        raise UnknownNameError("field", name, known, where) from None


def _elements(item: Any, inside: str, path: str) -> list[Any]:
    """The elements of a list that the brackets select."""
    if not isinstance(item, list | tuple | np.ndarray):
        raise RecordingError(
            f"brackets in the field path {path} belong to lists", value=repr_short(item)
        )
    if inside == "[]":
        return list(item)
    if "=" in inside:
        key, _, text = inside.partition("=")
        return [part for part in item if str(_field(part, key, path)) == text]
    if ":" in inside:
        return list(item[slice(*(int(part) if part else None for part in inside.split(":")))])
    if int(inside) >= len(item):
        raise RecordingError(
            f"the list in the field path {path} is shorter than its number",
            value=f"{len(item)} elements",
            limit=f"element {inside}",
        )
    return [item[int(inside)]]


def fields(message: Any) -> list[str]:
    """Names of the fields of a message."""
    if isinstance(message, dict):
        return list(message)
    names = getattr(message, "__dataclass_fields__", {})
    return [name for name in names if not name.startswith("__")]


def numeric_paths(message: Any, prefix: str = "", depth: int = 0) -> Iterator[tuple[str, int]]:
    """Paths of the numbers and arrays of numbers in a message, each with how many it finds.

    Of lists of messages the elements are taken together, by the fields of the first.
    """
    for name in fields(message) if depth < MAX_DEPTH else []:
        value = message[name] if isinstance(message, dict) else getattr(message, name)
        path = f"{prefix}{name}"
        if isinstance(value, bool | str | bytes):
            continue
        if isinstance(value, int | float | np.number):
            yield path, 1
        elif isinstance(value, list | tuple | np.ndarray):
            if len(value) and isinstance(value[0], int | float | np.number):
                yield path, len(value)
            elif len(value) and fields(value[0]):
                for below, _ in numeric_paths(value[0], f"{path}[].", depth + 1):
                    yield (
                        below,
                        sum(np.size(part) for part in getter(below[len(prefix) :])(message)),
                    )
        else:
            yield from numeric_paths(value, f"{path}.", depth + 1)
