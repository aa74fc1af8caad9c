"""The registry of effects: those of this package, of other packages, and of the program itself."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from dataclasses import MISSING, fields, is_dataclass
from importlib import import_module
from importlib.metadata import EntryPoint
from typing import Any, cast

from ..core import config
from ..core.errors import ConfigError, UnknownNameError
from ..core.field_docs import document_fields
from .base import NAMES, BaseEffect, Effect, check_effect

ENTRY_POINT_GROUP = "meshskin.effects"
"""Group of the entry points through which other packages add effects."""


def find(name: str) -> type[Effect]:
    """The effect class called `name`; its module is imported here, its docstring lists its fields.

    After those of this package and of others, the class that the program defined last counts.
    Raises UnknownNameError for an unknown name, and ConfigError where the entry point of another
    package cannot be loaded.
    """
    if name in NAMES:
        module = import_module(f".{name}", __package__)
        return cast(type[Effect], document_fields(getattr(module, name.title().replace("_", ""))))
    entry_points = _entry_points()
    if name not in entry_points:
        own = _defined(BaseEffect)
        if name not in own:
            where = f" (its package would have an entry point {ENTRY_POINT_GROUP})"
            raise UnknownNameError("effect", name, {*NAMES, *entry_points, *own}, where)
        return own[name]
    try:
        found = entry_points[name].load()
    except ConfigError:  # of this package, about the class: it has its remedy
        raise
    except Exception as error:  # the import of another package may raise anything
        raise ConfigError(
            f"the effect {name} of another package cannot be loaded: {_one_line(error)}",
            value=entry_points[name].value,
            remedy="reinstall that package, or remove the effect",
        ) from error
    if not is_dataclass(found):
        raise ConfigError(
            f"the effect {name} of another package must be a dataclass",
            value=entry_points[name].value,
        )
    return cast(type[Effect], found)


def every_name() -> tuple[str, ...]:
    """The names of all effects, those of other packages last."""
    return (*NAMES, *sorted(set(_entry_points()) - set(NAMES)))


def registered() -> tuple[Effect, ...]:
    """All effects that have defaults, with those defaults, those of other packages last.

    An effect of another package that cannot be loaded is left out with a warning that names it.
    """
    found: list[Effect] = []
    for name in every_name():
        try:
            found += _with_defaults(name)
        except ConfigError as error:
            warnings.warn(f"{error}: it is left out", stacklevel=2)
    return tuple(found)


def from_table(table: Mapping[str, Any], where: str = "effects") -> Effect:
    """The effect of a TOML table: `kind` is its name, the other keys are its fields.

    Raises ConfigError for a table without `kind` or with values out of bounds, UnknownNameError for
    an unknown effect or field.
    """
    if "kind" not in table:
        known = ", ".join(sorted(NAMES))
        raise ConfigError(f"[{where}] lacks kind", remedy=f"add one of {known}")
    values = {key: value for key, value in table.items() if key != "kind"}
    return config.from_table(find(str(table["kind"])), values, where)


def _entry_points() -> dict[str, EntryPoint]:
    """Effects of other packages, by name."""
    from importlib.metadata import entry_points

    return {point.name: point for point in entry_points(group=ENTRY_POINT_GROUP)}


def _defined(base: type[Any]) -> dict[str, type[Effect]]:
    """The effects among the classes derived from `base`, by name."""
    found: dict[str, type[Effect]] = {}
    for kind in base.__subclasses__():
        if hasattr(kind, "stage") and is_dataclass(kind):
            effect = cast(type[Effect], kind)
            found[effect.name] = effect
        found |= _defined(kind)
    return found


def _with_defaults(name: str) -> tuple[Effect, ...]:
    """The effect with its defaults, if it has them. Raises ConfigError for one of another package
    that cannot be created."""
    kind = find(name)
    missing = [f for f in fields(cast(Any, kind)) if f.default is f.default_factory is MISSING]
    if missing:
        return ()
    try:
        effect = kind()
    except Exception as error:  # the code of another package may raise anything
        raise ConfigError(
            f"the effect {name} of another package cannot be created: {_one_line(error)}"
        ) from error
    check_effect(effect)
    return (effect,)


def _one_line(error: Exception) -> str:
    return " ".join(f"{type(error).__name__}: {error}".split())
