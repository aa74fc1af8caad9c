"""The pipeline that applies the effects of a scene to its frames."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np

from ..core.arguments import repr_short
from ..core.arrays import Array
from ..core.errors import ConfigError
from .base import NAMES, STAGES, Context, Effect, FrameTransform, PressureTransform, check_effect
from .frames import EffectClock, Frames, PressureField


def ordered(effects: Iterable[Effect]) -> tuple[Effect, ...]:
    """The effects in the order in which they act; one that is derived from an effect of this
    package, in the place of that.

    Raises ConfigError for an object that is not an effect, an effect given twice, an effect without
    one that it requires, and two effects that exclude each other; UnknownNameError for an unknown
    stage.
    """
    effects = tuple(effects)
    for effect in effects:
        check_effect(effect)
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
    return tuple(sorted(effects, key=lambda e: (STAGES.index(e.stage), _place(type(e)))))


def _place(kind: type) -> int:
    """Place among NAMES of an effect class or of the first of its bases there; else behind all."""
    names = (getattr(base, "name", None) for base in kind.__mro__)
    return next((NAMES.index(name) for name in names if name in NAMES), len(NAMES))


def build(effects: Iterable[Effect], context: Context, stage: str) -> tuple[Any, ...]:
    """What the effects of one stage build, in order; empty where none is on.

    What effects of programs and other packages return is checked, except of the stage "field".
    """
    built = []
    for effect in ordered(effects):
        if effect.stage == stage:
            own = effect.name in NAMES or stage == "field"
            acts = effect.build(context)
            built.append(acts if own else partial(_checked, effect, acts))
    return tuple(built)


def _checked(effect: Effect, acts: Callable[..., Any], given: Any, *more: Any) -> Any:
    """What `acts` makes of the given frames or pressures.

    Raises ConfigError unless it is as many frames, or pressures of their shape that are finite
    where those are.
    """
    found, value = acts(given, *more), ""
    if isinstance(given, Frames):
        limit = f"{len(given)} frames, as it is given"
        if not isinstance(found, Frames) or len(found) != len(given):
            value = repr_short(found)
    else:
        limit = f"finite pressures of the shape {given.shape}"
        if np.shape(found) != given.shape or np.asarray(found).dtype.kind not in "fiu":
            value = f"the shape {np.shape(found)}" if np.shape(found) else repr_short(found)
        elif lost := int(np.sum(~np.isfinite(found) & np.isfinite(given))):
            value = f"{lost} that are not finite"
    if value:
        raise ConfigError(
            f"what the effect {effect.name} returns is unusable",
            value=value,
            limit=limit,
            remedy=f"correct the function that {type(effect).__name__}.build returns",
        )
    return found


@dataclass(frozen=True)
class EffectPipeline:
    """The effects of a scene, built: functions that act on consecutive batches of frames."""

    contact: tuple[FrameTransform, ...]
    """Effects of the stage "contact"."""
    field: PressureField
    """The pressure field with the effects of the stage "field"."""
    readings: tuple[PressureTransform, ...]
    """Effects of the stages "pressure" and "transducer"."""
    recorded: tuple[FrameTransform, ...]
    """Effects of the stages "geometry" and "robot"."""
    clock: EffectClock
    """Time since the first run."""

    @classmethod
    def from_effects(
        cls, effects: Iterable[Effect], context: Context, field: PressureField
    ) -> EffectPipeline:
        """The pipeline of the effects that are on; `field`: the pressure field without effects.

        Raises ConfigError as `ordered`, and where an effect cannot be built.
        """
        effects = ordered(effects)
        for wrap in build(effects, context, "field"):
            field = wrap(field)
        return cls(
            build(effects, context, "contact"),
            field,
            build(effects, context, "pressure") + build(effects, context, "transducer"),
            build(effects, context, "geometry") + build(effects, context, "robot"),
            EffectClock(),
        )

    def read(self, frames: Frames, poses: Array) -> Array:
        """Readings (m, n), Pa, of taxels at `poses` (n, 4, 4) in the next m frames in time."""
        frames = self.clock.to_effect_time(frames)
        for transform in self.contact:
            frames = transform(frames)
        pressures = self.field(frames, poses)
        for transduce in self.readings:
            pressures = transduce(pressures, frames)
        return pressures

    def record(self, frames: Frames) -> Frames:
        """The next frames in time as they are written into the recording."""
        if not len(frames):
            return frames
        recorded = self.clock.to_effect_time(frames)
        for transform in self.recorded:
            recorded = transform(recorded)
        return replace(recorded, time=frames.time)

    def start_next_run(self, pause: float) -> None:
        """Let the next run start `pause`, s, after the last frame; its own times start at zero.

        Drifts continue over the pause. Effects with a memory find no contact of the previous run.
        """
        self.clock.run_start = self.clock.last_time + pause
