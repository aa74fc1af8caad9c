"""TOML tables to frozen dataclasses, with units and bounds.

A dataclass field made by `quantity` has a unit and bounds. Its key in TOML ends in the unit of the
value: `radius_mm = 100` is the field `radius` of 0.1 m. An unknown key, a wrong type and a value
out of its bounds raise a ConfigError that names the key, the limit and the nearest known key.
pydantic was weighed: it has no units, and its errors are reports of several lines.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import re
import tomllib
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar, cast

from .arguments import check_integer, check_real, repr_short
from .errors import ConfigError, UnknownNameError

T = TypeVar("T")
TYPE_NAMES: dict[type, str] = {str: "text in quotes", bool: "true or false"}
"""Types of fields without a unit that `from_table` checks, as error messages name them."""
ANY_LENGTH = -1
"""Length of a tuple of any length."""

UNITS: dict[str, dict[str, float]] = {
    "m": {"m": 1.0, "mm": 1e-3, "um": 1e-6},
    "rad": {"rad": 1.0, "deg": math.pi / 180.0},
    "s": {"s": 1.0, "ms": 1e-3, "us": 1e-6},
    "1/s": {"per_s": 1.0},
    "Hz": {"hz": 1.0},
    "N": {"n": 1.0},
    "N m": {"n_m": 1.0},
    "Pa": {"pa": 1.0, "kpa": 1e3, "mpa": 1e6, "gpa": 1e9},
    "kg": {"kg": 1.0, "g": 1e-3},
    "m/s": {"m_per_s": 1.0, "mm_per_s": 1e-3},
    "rad/s": {"rad_per_s": 1.0, "deg_per_s": math.pi / 180.0},
    "": {"": 1.0},
}
"""Suffixes of TOML keys by SI unit, each with its factor to that unit."""
STANDARD_GRAVITY = 9.80665
"""Standard acceleration of gravity, m/s^2 (3rd CGPM, 1901)."""


def quantity(
    unit: str,
    default: Any = dataclasses.MISSING,
    *,
    above: float | None = None,
    least: float | None = None,
    most: float | None = None,
) -> Any:
    """A dataclass field in the SI `unit` with `above` < value, `least` <= value <= `most`."""
    bounds = {"unit": unit, "above": above, "least": least, "most": most}
    return dataclasses.field(default=default, metadata=bounds)


def check_fields(config: Any) -> None:
    """Check every field of a dataclass made by `quantity`; for `__post_init__`. Raises ConfigError.

    A field declared as a tuple of n numbers must be such a tuple, one declared as int an integer.
    """
    cls: Any = type(config)
    hints = _field_types(cls)
    for field in dataclasses.fields(config):
        bounds, value = dict(field.metadata), getattr(config, field.name)
        if "unit" not in bounds or value is None:
            continue
        name, unit = f"{table_name(cls)}.{field.name}", bounds.pop("unit")
        kind, length = hints[field.name]
        values = (value,) if length is None else value
        if not isinstance(values, tuple) or length not in (None, ANY_LENGTH, len(values)):
            count = "" if length == ANY_LENGTH else f"{length} "
            raise ConfigError(f"{name} must be a tuple of {count}numbers", value=repr_short(value))
        for number in values:
            check_real(name, number, unit, **bounds, remedy="correct the value or its unit")
            if kind is int:
                check_integer(name, number)


def table_name(cls: type) -> str:
    """The name of a class in TOML: _ArmTable is arm, GaussianNoise is gaussian_noise."""
    bare = cls.__name__.strip("_").removesuffix("Table")
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", bare).lower()


@functools.cache
def _field_types(cls: type) -> dict[str, tuple[Any, int | None]]:
    """By field: the type of its values, and the length of a tuple; None for a single value."""
    out: dict[str, tuple[Any, int | None]] = {}
    for name, hint in typing.get_type_hints(cls).items():
        if isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union:
            hint = next(part for part in typing.get_args(hint) if part is not type(None))
        parts = typing.get_args(hint)
        if typing.get_origin(hint) is tuple:
            out[name] = parts[0], ANY_LENGTH if parts[-1] is Ellipsis else len(parts)
        else:
            out[name] = hint, None
    return out


def _keys(field: dataclasses.Field[Any]) -> dict[str, float]:
    """TOML keys of a field, each with its factor to SI."""
    unit = field.metadata.get("unit", "")
    return {f"{field.name}_{s}" if s else field.name: f for s, f in UNITS[unit].items()}


def _scaled(value: Any, factor: float, where: str) -> Any:
    """A TOML number, or a list of them as a tuple, times `factor`. Raises ConfigError."""
    if isinstance(value, list):
        return tuple(_scaled(v, factor, where) for v in value)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ConfigError(f"{where} must be a number", value=repr_short(value))
    return value if factor == 1.0 else value * factor


def check_table(table: Any, where: str) -> None:
    """Raise ConfigError unless `table`, the value of the key `where`, is a TOML table."""
    if not isinstance(table, Mapping):
        remedy = f"write [{where}]"
        raise ConfigError(f"{where} must be a table", value=repr_short(table), remedy=remedy)


def from_table(cls: type[T], table: Mapping[str, Any], where: str) -> T:
    """The dataclass `cls` from a TOML table; `where` names the table in errors.

    Raises UnknownNameError for an unknown key, ConfigError for a missing or wrong value, or one out
    of its bounds.
    """
    check_table(table, where)
    fields = {f.name: f for f in dataclasses.fields(cls) if f.init}  # type: ignore[arg-type]
    known = {key: (f, factor) for f in fields.values() for key, factor in _keys(f).items()}
    hints, values = _field_types(cast(Any, cls)), dict[str, Any]()
    for key, value in table.items():
        if key in fields and key not in known:
            units = ", ".join(_keys(fields[key]))
            raise ConfigError(f"{where}.{key} needs a unit in its name", remedy=f"write {units}")
        if key not in known:
            raise UnknownNameError("key", key, known, f" in [{where}]")
        field, factor = known[key]
        if field.name in values:
            raise ConfigError(f"{where}.{field.name} is given twice", remedy=f"keep one of {key}")
        if "unit" in field.metadata:
            values[field.name] = _scaled(value, factor, f"{where}.{key}")
        else:
            values[field.name] = _typed(value, *hints[field.name], f"{where}.{key}")
    for field in fields.values():
        required = (
            field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        )
        if required and field.name not in values:
            raise ConfigError(
                f"[{where}] lacks {field.name}", remedy=f"add {' or '.join(_keys(field))}"
            )
    config = cls(**values)
    check_fields(config)
    return config


def to_table(config: Any) -> dict[str, Any]:
    """The TOML table, in SI units, from which `from_table` makes a dataclass; None is left out."""
    out: dict[str, Any] = {}
    for field in dataclasses.fields(config):
        value = getattr(config, field.name)
        if value is not None and field.init:
            key = next(key for key, factor in _keys(field).items() if factor == 1.0)
            out[key] = list(value) if isinstance(value, tuple) else value
    return out


def _typed(value: Any, kind: Any, length: int | None, where: str) -> Any:
    """A value without a unit, a list as a tuple. Raises ConfigError for a wrong str or bool.

    Values of other types are checked by their classes.
    """
    value = tuple(value) if isinstance(value, list) else value
    if kind in TYPE_NAMES:
        single = length is None
        items = (value,) if single else value
        if not isinstance(items, tuple) or not all(isinstance(item, kind) for item in items):
            wanted = TYPE_NAMES[kind] if single else f"a list, each of them {TYPE_NAMES[kind]}"
            raise ConfigError(f"{where} must be {wanted}", value=repr_short(value))
    return value


def read_toml(path: Path) -> dict[str, Any]:
    """The contents of a TOML file. Raises ConfigError, with the line, if it is not valid."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path.name} is not valid TOML: {error}") from error
    except OSError as error:
        raise ConfigError(f"cannot read {path}", value=error.strerror) from error


@functools.cache
def stem(key: str) -> str:
    """A key without the suffix of its unit."""
    units = sorted((u for table in UNITS.values() for u in table if u), key=len, reverse=True)
    return next((key.removesuffix(f"_{u}") for u in units if key.endswith(f"_{u}")), key)


def merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """`base` with the values of `over`, table by table.

    A quantity of `over` replaces that of `base` in any unit.
    """
    taken = {stem(key) for key in over}
    out = {key: value for key, value in base.items() if key in over or stem(key) not in taken}
    for key, value in over.items():
        if isinstance(value, Mapping) and isinstance(out.get(key), Mapping):
            out[key] = merge(out[key], value)
        else:
            out[key] = value
    return out
