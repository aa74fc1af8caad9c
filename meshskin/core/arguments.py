"""What callers give, checked at the door: one line for what is of the wrong kind, shape or size."""

from __future__ import annotations

import dataclasses
import math
import numbers
import os
from collections.abc import Mapping, Sequence
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike

from .errors import ConfigError, MeshskinError, UnknownNameError
from .se3 import Array

T = TypeVar("T")
SHOWN = 60
"""Most characters of a value that an error repeats."""


def repr_short(value: object) -> str:
    """A value as an error repeats it: on one line, cut where it is long."""
    text = " ".join(repr(value).split())
    return text if len(text) <= SHOWN else f"{text[: SHOWN - 3]}..."


def check_type(kind: type, value: object, what: str) -> None:
    """Raise ConfigError where the value given for `what` is no `kind`; for a name or a path the
    error says how it is loaded.
    """
    if isinstance(value, kind):
        return
    remedy = None
    if isinstance(value, str | os.PathLike) and hasattr(kind, "load"):
        remedy = f"give {kind.__name__}.load({os.fspath(value)!r})"
    article = "an" if kind.__name__[0] in "AEIOU" else "a"
    raise ConfigError(
        f"{what} must be {article} {kind.__name__}", value=repr_short(value), remedy=remedy
    )


def check_real(
    what: str,
    value: Any,
    unit: str = "",
    *,
    above: float | None = None,
    least: float | None = None,
    most: float | None = None,
    error: type[MeshskinError] = ConfigError,
) -> float:
    """A finite number within its bounds (`above` excludes its end). Raises `error`."""
    unit = f" {unit}" if unit else ""
    number = isinstance(value, numbers.Real | np.number) and not isinstance(value, bool)
    if not number or not math.isfinite(value):
        raise error(f"{what} must be a finite number", value=repr_short(value))
    limit = None
    if above is not None and not value > above:
        limit = f"above {above:g}{unit}"
    if least is not None and not value >= least:
        limit = f"at least {least:g}{unit}"
    if most is not None and not value <= most:
        limit = f"at most {most:g}{unit}"
    if limit is not None:
        raise error(f"{what} is out of range", value=f"{value:g}{unit}", limit=limit)
    return float(value)


def check_integer(
    what: str,
    value: Any,
    *,
    least: int,
    most: int | None = None,
    error: type[MeshskinError] = ConfigError,
) -> int:
    """A whole number within its bounds. Raises `error`."""
    if not isinstance(value, numbers.Integral) or isinstance(value, bool):
        raise error(f"{what} must be a whole number", value=repr_short(value))
    check_real(what, value, least=least, most=most, error=error)
    return int(value)


def check_vectors(
    what: str, values: ArrayLike, width: int = 3, *, error: type[MeshskinError] = ConfigError
) -> Array:
    """Vectors (n, width); a single one (width,) is a row. Raises `error`."""
    found = check_array(what, values, error=error)
    if found.ndim not in (1, 2) or (found.shape[-1] != width and found.size):
        raise error(f"{what} must be vectors", value=f"shape {found.shape}", limit=f"(n, {width})")
    return found.reshape(-1, width)


def check_vector(
    what: str, values: ArrayLike, size: int = 3, *, error: type[MeshskinError] = ConfigError
) -> Array:
    """A vector (size,). Raises `error`."""
    found = check_array(what, values, error=error)
    if found.shape != (size,):
        raise error(f"{what} must be {size} numbers", value=repr_short(values))
    return found


def check_array(what: str, values: ArrayLike, *, error: type[MeshskinError] = ConfigError) -> Array:
    """Numbers in any shape. Raises `error`."""
    try:
        return np.asarray(values, dtype=float)
    except (TypeError, ValueError) as reason:
        raise error(f"{what} must be numbers", value=repr_short(values)) from reason


def replace_fields(config: T, changes: Mapping[str, Any]) -> T:
    """The dataclass with other values in some fields. Raises UnknownNameError for what is none."""
    names = [f.name for f in dataclasses.fields(config) if f.init]  # type: ignore[arg-type]
    for name in changes:
        if name not in names:
            kind = type(config).__name__.lower()
            raise UnknownNameError("field", name, names, f" of a {kind}")
    return dataclasses.replace(config, **changes)  # type: ignore[type-var]


def check_name(kind: str, name: str, names: Sequence[str]) -> None:
    """Raise UnknownNameError unless `name` is one of `names`."""
    if name not in names:
        raise UnknownNameError(kind, name, names)
