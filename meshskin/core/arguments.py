"""Checks of values that callers and files give: their type, shape and range."""

from __future__ import annotations

import dataclasses
import math
import numbers
import os
from collections.abc import Collection, Iterable, Mapping
from pathlib import Path
from typing import Any, Self, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from .arrays import Array
from .errors import ConfigError, MeshskinError, UnknownNameError, reason

T = TypeVar("T")
REPR_LENGTH = 60
"""Largest number of characters of a value in an error message, so that the message stays within
two lines of a terminal; longer values are cut."""


def repr_short(value: object) -> str:
    """The representation of a value for an error message: on one line, cut at REPR_LENGTH, between
    words where there are several."""
    text = " ".join(repr(value).split())
    if len(text) <= REPR_LENGTH:
        return text
    head = text[: REPR_LENGTH - 3].rpartition(" ")[0]
    return f"{head} ..." if len(head) > REPR_LENGTH // 2 else f"{text[: REPR_LENGTH - 3]}..."


def check_type(kind: type, value: object, what: str) -> None:
    """Raise ConfigError unless the value of argument `what` is an instance of `kind`.

    For a name or a path in place of an object that can be loaded, the error says how to load it.
    """
    if isinstance(value, kind):
        return
    remedy = "give a list" if kind is Iterable else None
    if isinstance(value, str | os.PathLike) and hasattr(kind, "load"):
        remedy = f"give {kind.__name__}.load({os.fspath(value)!r})"
    article = "an" if kind.__name__[0] in "AEIOU" else "a"
    raise ConfigError(
        f"{what} must be {article} {kind.__name__}", value=repr_short(value), remedy=remedy
    )


def check_path(what: str, value: object, *, error: type[MeshskinError] = ConfigError) -> Path:
    """The value as a path. Raises `error` for other values."""
    if not isinstance(value, str | os.PathLike):
        raise error(f"{what} must be a path", value=repr_short(value), remedy="give a file name")
    return Path(value)


def read_text(what: str, path: object, *, error: type[MeshskinError]) -> str:
    """The text of a file in UTF-8. Raises `error` where it cannot be read, or is not a path."""
    file = check_path(what, path, error=error)
    try:
        return file.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as wrong:
        raise error(f"cannot read {what} {str(file)!r}", value=reason(wrong)) from wrong


def check_real(
    what: str,
    value: Any,
    unit: str = "",
    *,
    above: float | None = None,
    least: float | None = None,
    most: float | None = None,
    error: type[MeshskinError] = ConfigError,
    remedy: str | None = None,
) -> float:
    """The value as a finite float with `above` < value, `least` <= value and value <= `most`.

    Raises `error` for any other value.
    """
    unit = f" {unit}" if unit else ""
    number = isinstance(value, numbers.Real) and not isinstance(value, bool)
    try:
        real = float(value) if number else math.nan
    except OverflowError:  # of an integer
        real = math.nan
    if not math.isfinite(real):
        raise error(f"{what} must be a finite number", value=repr_short(value))
    for bound, inside, words in (
        (above, above is None or value > above, "above"),
        (least, least is None or value >= least, "at least"),
        (most, most is None or value <= most, "at most"),
    ):
        if not inside:
            limit = f"{words} {bound:g}{unit}"
            raise error(
                f"{what} is out of range", value=f"{value:g}{unit}", limit=limit, remedy=remedy
            )
    return float(value)


def check_integer(
    what: str,
    value: Any,
    *,
    least: int | None = None,
    most: int | None = None,
    error: type[MeshskinError] = ConfigError,
) -> int:
    """The value as an int with `least` <= value <= `most`. Raises `error` for any other value."""
    if not isinstance(value, numbers.Integral) or isinstance(value, bool):
        raise error(f"{what} must be an integer", value=repr_short(value))
    check_real(what, value, least=least, most=most, error=error)
    return int(value)


def check_array(what: str, values: ArrayLike, *, error: type[MeshskinError] = ConfigError) -> Array:
    """The values as an array of floats of any shape. Raises `error` for other values."""
    try:
        return np.asarray(values, dtype=float)
    except (TypeError, ValueError) as wrong:
        raise error(f"{what} must be numbers", value=repr_short(values)) from wrong


def check_vector(
    what: str, values: ArrayLike, size: int = 3, *, error: type[MeshskinError] = ConfigError
) -> Array:
    """The values as an array (size,). Raises `error` for another shape."""
    vector = check_array(what, values, error=error)
    if vector.shape != (size,):
        raise error(f"{what} must be {size} numbers", value=repr_short(values))
    return vector


def check_vectors(
    what: str, values: ArrayLike, width: int = 3, *, error: type[MeshskinError] = ConfigError
) -> Array:
    """The values as an array (n, width); a single vector (width,) becomes one row.

    Raises `error` for another shape.
    """
    rows = check_array(what, values, error=error)
    if rows.ndim not in (1, 2) or (rows.shape[-1] != width and rows.size):
        raise error(f"{what} must be vectors", value=f"shape {rows.shape}", limit=f"(n, {width})")
    return rows.reshape(-1, width)


def check_name(kind: str, name: object, names: Collection[str]) -> None:
    """Raise UnknownNameError unless `name` is one of `names`; `kind` says what is named."""
    if name not in names:
        raise UnknownNameError(kind, name, names)


def replace_fields(config: T, changes: Mapping[str, Any]) -> T:
    """A copy of a dataclass with other values of some fields.

    Raises UnknownNameError for the name of a field that the class does not have.
    """
    names = [f.name for f in dataclasses.fields(config) if f.init]  # type: ignore[arg-type]
    for name in changes:
        if name not in names:
            kind = type(config).__name__.lower()
            raise UnknownNameError("field", name, names, f" of a {kind}")
    return dataclasses.replace(config, **changes)  # type: ignore[type-var]


class NamedFields:
    """Base of dataclasses that refuse an unknown keyword with an error that lists the known
    ones."""

    def __new__(cls, *args: Any, **values: Any) -> Self:
        known = cls.__dataclass_fields__  # type: ignore[attr-defined]
        for name in values:
            if name not in known:
                raise UnknownNameError("field", name, known, f" of a {cls.__name__}")
        return super().__new__(cls)
