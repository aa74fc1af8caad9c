"""TOML <-> frozen dataclasses.

A dataclass field made by `quantity` carries a unit and bounds. In TOML its key ends in the unit it
is given in (`radius_mm = 100` for the field `radius` in m); an unknown key is refused with the
nearest known name, a value out of bounds with its limit.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import numbers
import re
import tomllib
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, TypeVar, cast

from .errors import ConfigError, UnknownNameError

T = TypeVar("T")
KINDS: dict[type, str] = {str: "text in quotes", bool: "true or false"}
"""Kinds of values without a unit that are checked, and what they are called."""
ANY = -1
"""Number of values of a tuple of any length."""

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
    """A dataclass field in SI `unit`, with bounds (`above` excludes its end, the others do not)."""
    bounds = {"unit": unit, "above": above, "least": least, "most": most}
    return dataclasses.field(default=default, metadata=bounds)


def check_fields(config: Any) -> None:
    """Check every bounded field of a dataclass; for use in `__post_init__`. Raises ConfigError.

    A field declared as a tuple of n numbers must be one, a field declared as `int` a whole number.
    """
    cls: Any = type(config)
    forms = _forms(cls)
    for field in dataclasses.fields(config):
        m, value = field.metadata, getattr(config, field.name)
        if "unit" not in m or value is None:
            continue
        name = f"{_written(cls)}.{field.name}"
        kind, count = forms[field.name]
        if count is not None and (not isinstance(value, tuple) or count not in (ANY, len(value))):
            many = "" if count == ANY else f"{count} "
            raise ConfigError(f"{name} must be a tuple of {many}numbers", value=repr(value))
        for number in (value,) if count is None else value:
            _check_number(name, number, m)
            if kind is int and not isinstance(number, int):
                raise ConfigError(f"{name} must be a whole number", value=repr(number))


def _written(cls: type) -> str:
    """What a configuration calls a class: _ArmTable arm, GaussianNoise gaussian_noise."""
    bare = cls.__name__.strip("_").removesuffix("Table")
    return re.sub(r"(?<=[a-z])(?=[A-Z])", "_", bare).lower()


@functools.cache
def _forms(cls: type) -> dict[str, tuple[Any, int | None]]:
    """Of each field: the type of its numbers, and how many it has (None: one, and no tuple)."""
    out: dict[str, tuple[Any, int | None]] = {}
    for name, hint in typing.get_type_hints(cls).items():
        if isinstance(hint, types.UnionType) or typing.get_origin(hint) is typing.Union:
            hint = next(part for part in typing.get_args(hint) if part is not type(None))
        parts = typing.get_args(hint)
        if typing.get_origin(hint) is tuple:
            out[name] = parts[0], ANY if parts[-1] is Ellipsis else len(parts)
        else:
            out[name] = hint, None
    return out


def _check_number(name: str, number: Any, m: Mapping[str, Any]) -> None:
    unit = f" {m['unit']}" if m["unit"] else ""
    real = isinstance(number, numbers.Real) and not isinstance(number, bool)
    if not real or not math.isfinite(number):
        raise ConfigError(f"{name} must be a finite number", value=repr(number))
    if m["above"] is not None and number <= m["above"]:
        raise ConfigError(
            f"{name} is out of range",
            value=f"{number:g}{unit}",
            limit=f"above {m['above']:g}{unit}",
            remedy="correct the value or its unit",
        )
    if m["least"] is not None and number < m["least"]:
        raise ConfigError(
            f"{name} is out of range",
            value=f"{number:g}{unit}",
            limit=f"at least {m['least']:g}{unit}",
            remedy="correct the value or its unit",
        )
    if m["most"] is not None and number > m["most"]:
        raise ConfigError(
            f"{name} is out of range",
            value=f"{number:g}{unit}",
            limit=f"at most {m['most']:g}{unit}",
            remedy="correct the value or its unit",
        )


def _keys(field: dataclasses.Field[Any]) -> dict[str, float]:
    """TOML keys of a field, each with its factor to SI."""
    unit = field.metadata.get("unit", "")
    return {f"{field.name}_{s}" if s else field.name: f for s, f in UNITS[unit].items()}


def _scaled(value: Any, factor: float, where: str) -> Any:
    if isinstance(value, list):
        return tuple(_scaled(v, factor, where) for v in value)
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ConfigError(f"{where} must be a number", value=repr(value))
    return value if factor == 1.0 else value * factor


def check_table(table: Any, where: str) -> None:
    """Raise ConfigError for what is no table."""
    if not isinstance(table, Mapping):
        raise ConfigError(f"{where} must be a table", value=repr(table), remedy=f"write [{where}]")


def from_table(cls: type[T], table: Mapping[str, Any], where: str) -> T:
    """Make the dataclass `cls` from a TOML table; `where` names the table in errors.

    Raises UnknownNameError for an unknown key, ConfigError for a missing or wrong value.
    """
    check_table(table, where)
    fields = {f.name: f for f in dataclasses.fields(cls) if f.init}  # type: ignore[arg-type]
    known = {key: (f, factor) for f in fields.values() for key, factor in _keys(f).items()}
    forms, values = _forms(cast(Any, cls)), dict[str, Any]()
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
            given = tuple(value) if isinstance(value, list) else value
            _check_kind(forms[field.name], given, f"{where}.{key}")
            values[field.name] = given
    for field in fields.values():
        required = (
            field.default is dataclasses.MISSING and field.default_factory is dataclasses.MISSING
        )
        if required and field.name not in values:
            raise ConfigError(
                f"[{where}] lacks {field.name}", remedy=f"add {' or '.join(_keys(field))}"
            )
    return cls(**values)


def _check_kind(form: tuple[Any, int | None], value: Any, where: str) -> None:
    """Check words and switches; of other kinds of values their classes know. Raises ConfigError."""
    kind, count = form
    if kind not in KINDS:
        return
    listed = count is not None
    each = (value if isinstance(value, tuple) else [None]) if listed else [value]
    if not all(isinstance(v, kind) for v in each):
        wanted = f"a list, each of them {KINDS[kind]}" if listed else KINDS[kind]
        raise ConfigError(f"{where} must be {wanted}", value=repr(value))


def read_toml(path: Path) -> dict[str, Any]:
    """Read a TOML file. Raises ConfigError, naming the line, if it is not valid."""
    try:
        return tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path.name} is no valid TOML: {error}") from error
    except OSError as error:
        raise ConfigError(f"cannot read {path}", value=error.strerror) from error


@functools.cache
def _stem(key: str) -> str:
    """A key without its unit."""
    units = sorted((u for table in UNITS.values() for u in table if u), key=len, reverse=True)
    return next((key.removesuffix(f"_{u}") for u in units if key.endswith(f"_{u}")), key)


def merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """`base` with the values of `over`, table by table; a quantity may come in another unit."""
    taken = {_stem(key) for key in over}
    out = {key: value for key, value in base.items() if key in over or _stem(key) not in taken}
    for key, value in over.items():
        if isinstance(value, Mapping) and isinstance(out.get(key), Mapping):
            out[key] = merge(out[key], value)
        else:
            out[key] = value
    return out
