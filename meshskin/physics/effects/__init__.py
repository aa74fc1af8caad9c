"""Effects: each departure from the ideal scene is a frozen dataclass in a file of its own.

An effect that is off is absent: no branch in the loop, no random number drawn. Each draws from its
own random stream, derived from the scene's seed and the effect's name, so that toggling one never
shifts another's noise.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from importlib import import_module
from typing import Any, Protocol, runtime_checkable

import numpy as np

from ... import config
from ...errors import ConfigError, UnknownNameError
from ...provenance import random_stream
from ...se3 import Array

STAGES = ("geometry", "contact", "pressure", "transducer", "robot")
"""Where an effect acts, in the order of the flow."""

KINDS = {"gaussian_noise": "GaussianNoise"}
"""Name of each effect (and of its module in this folder) -> its class."""

Pressures = Callable[[Array], Array]
"""What effects of the stages pressure and transducer build: dense pressures (frames, taxels), Pa,
of the next frames in time -> pressures of the same shape."""


@dataclass(frozen=True)
class Context:
    """What an effect may know when it is built."""

    seed: int
    """Seed of the run."""
    peak_pressure: float
    """Peak contact pressure p_0 at the reference force, Pa."""
    contact_radius: float
    """Contact radius a at the reference force, m."""

    def stream(self, name: str) -> np.random.Generator:
        """The random stream of the effect `name`."""
        return random_stream(self.seed, f"effect/{name}")


class Effect(Protocol):
    """One effect; its fields are the keys of its `[[effects]]` table in TOML."""

    @property
    def name(self) -> str:
        """Its name in KINDS."""

    @property
    def stage(self) -> str:
        """Where it acts, one of STAGES."""

    @property
    def requires(self) -> tuple[str, ...]:
        """Names of effects that must be on with it."""

    @property
    def excludes(self) -> tuple[str, ...]:
        """Names of effects that must be off with it."""

    @property
    def cost(self) -> float:
        """Seconds it adds for each taxel and frame (measured on one core)."""

    def bound(self, context: Context) -> float:
        """Bound on the taxel error, m, that leaving it out can cause."""

    def build(self, context: Context) -> Any:
        """What acts in the loop; for the stages pressure and transducer, a `Pressures`."""


@runtime_checkable
class Noise(Protocol):
    """An effect that is white Gaussian noise on every reading: a belief may know its sigma."""

    def sigma(self, context: Context) -> float:
        """Standard deviation, Pa."""


def find(name: str) -> type[Effect]:
    """The effect class called `name`; its module is imported here. Raises UnknownNameError."""
    if name not in KINDS:
        raise UnknownNameError("effect", name, KINDS)
    found: type[Effect] = getattr(import_module(f".{name}", __name__), KINDS[name])
    return found


def from_table(table: Mapping[str, Any], where: str = "effects") -> Effect:
    """The effect of a TOML table: `kind` names it, the other keys are its fields."""
    if "kind" not in table:
        raise ConfigError(f"[{where}] lacks kind", remedy=f"add one of {', '.join(sorted(KINDS))}")
    fields = {key: value for key, value in table.items() if key != "kind"}
    return config.build(find(str(table["kind"])), fields, where)


def ordered(effects: Iterable[Effect]) -> tuple[Effect, ...]:
    """The effects in the order of their stages, checked against one another.

    Raises ConfigError for an effect given twice, one that lacks what it requires, and two that
    exclude each other.
    """
    effects = tuple(effects)
    counts = Counter(effect.name for effect in effects)
    for name, count in counts.items():
        if count > 1:
            raise ConfigError(
                "an effect is given more than once",
                value=f"{name} {count} times",
                remedy="keep one",
            )
    for effect in effects:
        for other in effect.requires:
            if other not in counts:
                raise ConfigError(f"effect {effect.name} requires {other}", remedy=f"add {other}")
        for other in effect.excludes:
            if other in counts:
                raise ConfigError(f"effect {effect.name} excludes {other}", remedy="remove one")
    return tuple(sorted(effects, key=lambda effect: STAGES.index(effect.stage)))


def build(effects: Iterable[Effect], context: Context, stage: str) -> tuple[Any, ...]:
    """What the effects of one stage build, in order: empty where none is on."""
    return tuple(e.build(context) for e in ordered(effects) if e.stage == stage)
