"""One case of a study: its parameters, the key (hash) that identifies it, and its outcome."""

from __future__ import annotations

import functools
import itertools
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from ...core.arguments import check_type
from ...core.errors import ConfigError, StudyError, UnknownNameError
from ...core.provenance import digest, versions
from .base_scene import BaseScene, canonical_json, source_text

if TYPE_CHECKING:
    from ...scene.belief import Belief
    from ...scene.scene import Scene


RunFunction = Callable[["Case"], Mapping[str, Any]]
"""Computes a case: returns its numbers (or texts) by name."""
Grid = Mapping[str, Sequence[Any]]
"""Values by dotted key."""

PACKAGE = Path(__file__).parents[2]
"""Folder of the package meshskin."""
RUN_PREFIX = "run."
"""Prefix of the keys that are parameters of the run function."""
BELIEF_PREFIX = "belief."
"""Prefix of the keys that change the belief of the owner and not the world."""
RESERVED = ("key", "seed", "method", "status", "error")
"""Columns of the table of a study that are neither parameters nor results."""


@dataclass(frozen=True)
class Case:
    """One case: the argument of a run function."""

    key: str
    """Hash of everything that defines the case."""
    parameters: Mapping[str, Any]
    """Values by dotted key."""
    seed: int
    """Seed of every random stream."""
    method: str
    """Method of the calibration."""
    base: BaseScene
    """The scene that the parameters change."""

    @cached_property
    def scene(self) -> Scene:
        """The true scene of this case."""
        return self.base.scene(_scene_part(self.parameters))

    @cached_property
    def belief(self) -> Belief:
        """The belief of the owner: that of the scene, changed by the parameters `belief.*`."""
        changes = _belief_part(self.parameters)
        if not changes:
            return self.scene.belief()
        return self.base.scene({**_scene_part(self.parameters), **changes}).belief()

    @property
    def own(self) -> dict[str, Any]:
        """The parameters of the run function (`run.*`), without the prefix."""
        return _with_prefix(self.parameters, RUN_PREFIX)


def _with_prefix(parameters: Mapping[str, Any], prefix: str) -> dict[str, Any]:
    return {k.removeprefix(prefix): v for k, v in parameters.items() if k.startswith(prefix)}


def _belief_part(parameters: Mapping[str, Any]) -> dict[str, Any]:
    return _with_prefix(parameters, BELIEF_PREFIX)


def _scene_part(parameters: Mapping[str, Any]) -> dict[str, Any]:
    return {k: v for k, v in parameters.items() if not k.startswith((RUN_PREFIX, BELIEF_PREFIX))}


def plain_grids(grid: Grid | Sequence[Grid]) -> list[dict[str, list[Any]]]:
    """One grid or several, as lists of plain Python values. Raises ConfigError."""
    out = []
    check_type(Iterable, grid, "the grid of a study")
    for one in [grid] if isinstance(grid, Mapping) else grid:
        check_type(Mapping, one, "a grid of a study")
        for key in one:
            check_type(str, key, "a key of a grid")
        out.append(plain := {key: _list(key, values) for key, values in one.items()})
        for key in RESERVED:
            if key in plain and key != "method":
                raise ConfigError(
                    f"{key} cannot be in the grid", remedy="give seeds as an argument of the study"
                )
    return out


def _list(key: str, values: Any) -> list[Any]:
    values = values.tolist() if isinstance(values, np.ndarray) else values
    if isinstance(values, str | Mapping) or not isinstance(values, Sequence):
        raise ConfigError(f"grid {key} must be a list", value=repr(values))
    if not values:
        raise ConfigError(f"grid {key} has no values", remedy="remove it or fill it")
    return [v.item() if isinstance(v, np.generic) else v for v in values]


def check_grid(base: BaseScene, grids: Sequence[Grid], method: str) -> None:
    """Check every value of every key separately. Raises ConfigError."""
    for one in grids:
        for key, values in one.items():
            for value in values:
                _check_value(base, key, value)
    _check_value(base, "method", method)


def _check_value(base: BaseScene, key: str, value: Any) -> None:
    if key == "method":
        from ...estimation.calibrate import METHODS

        if value not in METHODS:
            raise UnknownNameError("method", str(value), METHODS)
    else:
        parameters = {key: value}
        base.check(_scene_part(parameters))
        base.check(_belief_part(parameters))


def expand(
    base: BaseScene, grids: Sequence[Grid], seeds: Sequence[int], method: str, runner: str
) -> Iterator[Case]:
    """All cases, grid after grid, the seeds fastest, then the last key; those with the same key are
    listed once.

    `runner`: identity of the run function (`runner_identity`).
    """
    packages = environment()
    del packages["python"]  # results do not depend on the patch release of Python
    shared = canonical_json([packages, runner])
    seen: set[str] = set()
    points = (dict(zip(g, v, strict=True)) for g in grids for v in itertools.product(*g.values()))
    for point in points:
        case_method = str(point.pop("method", method))
        other = {k: v for k, v in point.items() if k.startswith((RUN_PREFIX, BELIEF_PREFIX))}
        scene = base.identity(_scene_part(point))
        definition = f"{shared}|{case_method}|{canonical_json(other)}|{scene}|"
        for seed in seeds:
            key = digest(definition + str(seed))
            if key not in seen:
                seen.add(key)
                yield Case(key, point, seed, case_method, base)


def environment() -> dict[str, str]:
    """Versions of Python and of the packages that results depend on, and meshskin's source."""
    return {**versions(), "source": source_digest()}


SOURCES = {".py", ".c", ".h", ".csv"}
"""Suffixes of the files that results depend on."""


@functools.cache
def source_digest(folder: Path = PACKAGE) -> str:
    """Digest of the names and contents of a package's code and tables (SOURCES).

    A package that is installed in place (editable) is edited without a change of its version. The
    shipped scenes do not count: a wheel holds them, a checkout has them elsewhere, and the key of a
    case includes the content of its scene.
    """
    files = (f for f in folder.rglob("*") if f.suffix in SOURCES)
    named = ((f.relative_to(folder).as_posix(), f.read_bytes()) for f in sorted(files))
    return digest(*(part for pair in named for part in pair))


def runner_identity(run: RunFunction, version: str) -> str:
    """Name and source text of a run function, and the version that its author gave it.

    What it calls outside meshskin is not part of it: the author changes `version` when that
    changes.
    """
    return canonical_json([getattr(run, "__qualname__", ""), source_text(run), version])


def checked_results(values: Any, parameters: Mapping[str, Any]) -> dict[str, Any]:
    """The results of a run function as plain values by name. Raises StudyError."""
    if not isinstance(values, Mapping):
        raise StudyError("a run function must return a mapping", value=type(values).__name__)
    out: dict[str, Any] = {}
    for name, value in values.items():
        plain = value.item() if hasattr(value, "item") and getattr(value, "ndim", 0) == 0 else value
        if plain is not None and not isinstance(plain, bool | int | float | str):
            raise StudyError(
                f"the result {name!r} must be a number or text", value=type(value).__name__
            )
        if type(plain) is int and abs(plain) >= 2**63:
            plain = float(plain)  # columns hold 64-bit integers
        if name in parameters or name in RESERVED:
            raise StudyError(f"the result {name!r} has the name of a parameter")
        out[str(name)] = plain
    return out


DONE, FAILED = "done", "failed"
RAISED, TIMEOUT, MEMORY, DIED = "raised", "timeout", "memory", "died"


@dataclass(frozen=True)
class Limits:
    """Resources that one case may use."""

    seconds: float | None = None
    """Wall time, s; None: no limit."""
    memory: float | None = None
    """Data segment of the worker process, bytes; None: no limit."""


@dataclass(frozen=True)
class Outcome:
    """The result of a case, or the reason why there is none."""

    key: str
    """Key of the case."""
    values: Mapping[str, Any] = field(default_factory=dict)
    """Results of the run function; empty if it failed."""
    reason: str | None = None
    """None if done; otherwise RAISED, TIMEOUT, MEMORY or DIED."""
    error: str | None = None
    """Error message in one line; None if done."""
    trace: str | None = None
    """Traceback of a case that raised an exception."""
    seconds: float = 0.0
    """Wall time in the worker, s."""
    limits: Limits = field(default_factory=Limits)
    """Limits under which the case ran."""

    @property
    def status(self) -> str:
        """DONE or FAILED."""
        return DONE if self.reason is None else FAILED

    def is_final(self, limits: Limits) -> bool:
        """Whether running the case again under `limits` would give the same outcome.

        A case that ran out of time or memory may succeed with more of it; a worker that died may
        have been killed from outside.
        """
        if self.reason == TIMEOUT:
            return _not_larger(limits.seconds, self.limits.seconds)
        if self.reason == MEMORY:
            return _not_larger(limits.memory, self.limits.memory)
        return self.reason != DIED


def _not_larger(now: float | None, before: float | None) -> bool:
    return before is None or (now is not None and now <= before)
