"""One case of a study: what defines it, and the hash that it is known by."""

from __future__ import annotations

import inspect
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from ...core.arguments import needs
from ...core.errors import ConfigError, StudyError, UnknownNameError
from ...core.provenance import digest, versions
from .base import Base, canonical

if TYPE_CHECKING:
    from ...scene.belief import Belief
    from ...scene.scene import Scene

Run = Callable[["Case"], Mapping[str, Any]]
"""What computes a case: its numbers (or texts) by name."""
Grid = Mapping[str, Sequence[Any]]
"""Values by dotted key."""

OWN = "run."
"""Keys of the run function's own parameters start with this."""
BELIEF = "belief."
"""Keys that change only what the owner believes start with this."""
RESERVED = ("key", "seed", "method", "status", "error")
"""Columns of a study's table that are neither parameters nor results."""


@dataclass(frozen=True)
class Case:
    """One case, as its run function gets it."""

    key: str
    """Hash of what defines it."""
    parameters: Mapping[str, Any]
    """Values by dotted key."""
    seed: int
    """Of every random stream."""
    method: str
    """Of the calibration."""
    base: Base
    """What the parameters change."""

    @cached_property
    def scene(self) -> Scene:
        """The world of this case."""
        return self.base.scene(_scene_part(self.parameters))

    @cached_property
    def belief(self) -> Belief:
        """What the owner knows: the world's belief, with the parameters `belief.*` changed."""
        beliefs = _belief_part(self.parameters)
        if not beliefs:
            return self.scene.belief()
        return self.base.scene({**_scene_part(self.parameters), **beliefs}).belief()

    @property
    def own(self) -> dict[str, Any]:
        """The run function's own parameters (`run.*`), without the prefix."""
        return _within(self.parameters, OWN)


def _within(parameters: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    return {k.removeprefix(prefix): v for k, v in parameters.items() if k.startswith(prefix)}


def _belief_part(parameters: Mapping[str, Any]) -> dict[str, Any]:
    return _within(parameters, BELIEF)


def _scene_part(parameters: Mapping[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in parameters.items() if not k.startswith((OWN, BELIEF))}


def lists(grid: Grid | Sequence[Grid]) -> list[dict[str, list[Any]]]:
    """A grid, or several, with plain lists of plain values. Raises ConfigError."""
    out = []
    needs(Iterable, grid, "the grid of a study")
    for one in [grid] if isinstance(grid, Mapping) else grid:
        needs(Mapping, one, "a grid of a study")
        for key in one:
            needs(str, key, "a key of a grid")
        out.append(plain := {key: _list(key, values) for key, values in one.items()})
        for key in RESERVED:
            if key in plain and key != "method":
                raise ConfigError(f"{key} cannot be in the grid", remedy="seeds has its own place")
    return out


def _list(key: str, values: Any) -> list[Any]:
    values = values.tolist() if isinstance(values, np.ndarray) else values
    if isinstance(values, str | Mapping) or not isinstance(values, Sequence):
        raise ConfigError(f"grid {key} must be a list", value=repr(values))
    if not values:
        raise ConfigError(f"grid {key} has no values", remedy="remove it or fill it")
    return [v.item() if isinstance(v, np.generic) else v for v in values]


def check(base: Base, grid: Grid | Sequence[Grid], method: str) -> None:
    """Check every value of every key, on its own. Raises ConfigError."""
    for one in lists(grid):
        for key, values in one.items():
            for value in values:
                _check_value(base, key, value)
    _check_value(base, "method", method)


def _check_value(base: Base, key: str, value: Any) -> None:
    if key == "method":
        from ...estimation.calibrate import METHODS

        if value not in METHODS:
            raise UnknownNameError("method", str(value), METHODS)
    else:
        parameters = {key: value}
        base.check(_scene_part(parameters))
        base.check(_belief_part(parameters))


def points(grid: Grid | Sequence[Grid]) -> Iterator[dict[str, Any]]:
    """Every combination of a grid's values, the last key fastest; of several grids, one by one."""
    for one in lists(grid):
        for values in itertools.product(*one.values()):
            yield dict(zip(one, values, strict=True))


def expand(
    base: Base, grid: Grid | Sequence[Grid], seeds: Sequence[int], method: str, runner: str
) -> Iterator[Case]:
    """All cases, the seeds fastest; what is defined the same twice comes once.

    `runner`: the identity of what computes them (`runner_identity`).
    """
    found = versions()
    del found["python"]  # a patch release of Python is no reason to compute anything again
    shared = canonical([found, runner])
    seen: set[str] = set()
    for point in points(grid):
        how = str(point.pop("method", method))
        own = canonical({k: v for k, v in point.items() if k.startswith((OWN, BELIEF))})
        what = f"{shared}|{how}|{own}|{base.identity(_scene_part(point))}|"
        for seed in seeds:
            key = digest(what + str(seed))
            if key not in seen:
                seen.add(key)
                yield Case(key, point, seed, how, base)


def runner_identity(run: Run, version: str = "") -> str:
    """Name and source text of a run function, and the version its author gave it.

    What it calls is not seen: the author raises `version` when that changes.
    """
    try:
        source = inspect.getsource(run)
    except (OSError, TypeError):
        source = ""
    return canonical([getattr(run, "__qualname__", ""), source, version])


def checked(values: Any, parameters: Mapping[str, Any]) -> dict[str, Any]:
    """What a run function returned, as plain values by name. Raises StudyError."""
    if not isinstance(values, Mapping):
        raise StudyError("a run function returns values by name", value=type(values).__name__)
    out: dict[str, Any] = {}
    for name, value in values.items():
        plain = value.item() if hasattr(value, "item") and getattr(value, "ndim", 0) == 0 else value
        if plain is not None and not isinstance(plain, bool | int | float | str):
            raise StudyError(f"the result {name!r} is no number", value=type(value).__name__)
        if type(plain) is int and abs(plain) >= 2**63:
            plain = float(plain)  # tables hold 64 bits
        if name in parameters or name in RESERVED:
            raise StudyError(f"the result {name!r} has the name of a parameter")
        out[str(name)] = plain
    return out
