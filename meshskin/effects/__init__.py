"""Effects: each departure from the ideal scene is a frozen dataclass in a file of its own.

An effect that is off is absent: no branch in the loop, no random number drawn. Each draws from its
own random stream, derived from the scene's seed and the effect's name, so that toggling one never
shifts another's noise. A new effect is one new file here and one line in KINDS, or, from another
package, one entry point in the group "meshskin.effects": `name = "module:Class"`.
"""

from __future__ import annotations

import warnings
from collections import Counter
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass, replace
from dataclasses import Field as DataField
from importlib import import_module
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, cast, runtime_checkable

from ..core import config
from ..core.errors import ConfigError, UnknownNameError
from ..core.se3 import Array
from .context import Context as Context
from .frames import EffectClock, Frames, PressureField

if TYPE_CHECKING:
    from importlib.metadata import EntryPoint

STAGES = ("contact", "field", "pressure", "transducer", "geometry", "robot")
"""Where an effect acts, in the order of the flow, and what it builds:

contact     Frames -> Frames: what presses the skin
field       Field -> Field: how contacts become pressures at any place of the skin
pressure    Pressures: the pressures on the taxels
transducer  Pressures: what the taxels say
geometry    Frames -> Frames: what is recorded of a contact's place
robot       Frames -> Frames: what is recorded of the robot's pose and force
"""

KINDS = {
    "friction": "Friction",
    "layer": "Layer",
    "elliptic_patch": "EllipticPatch",
    "disc_averaging": "DiscAveraging",
    "cover_fabric": "CoverFabric",
    "scan_order": "ScanOrder",
    "relaxation": "Relaxation",
    "crosstalk": "Crosstalk",
    "hysteresis": "Hysteresis",
    "capacitive": "Capacitive",
    "gain_offset": "GainOffset",
    "temperature_drift": "TemperatureDrift",
    "gaussian_noise": "GaussianNoise",
    "sensing_range": "SensingRange",
    "quantisation": "Quantisation",
    "broken_taxels": "BrokenTaxels",
    "mesh_facets": "MeshFacets",
    "body_pose": "BodyPose",
    "indenter_offset": "IndenterOffset",
    "sampling": "Sampling",
    "encoder": "Encoder",
    "gravity_error": "GravityError",
    "joint_friction": "JointFriction",
    "force_sensor": "ForceSensor",
}
"""Name of each effect (and of its module in this folder) -> its class, in the signal's order:
effects of one stage act in this order, those of other packages after them."""

GROUP = "meshskin.effects"
"""Group of entry points through which other packages add effects."""

PressureTransform = Callable[[Array, Frames], Array]
"""(pressures (m, n), Pa, the next m frames in time) -> pressures (m, n)."""
FrameTransform = Callable[[Frames], Frames]
"""The next frames in time -> the frames as the effect changes them."""


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
        """Seconds it adds for each taxel and frame (measured on one core, 80 taxels)."""

    def bound(self, context: Context) -> float:
        """Bound on the taxel error, m, that leaving it out can cause."""

    def build(self, context: Context) -> Any:
        """What acts in the loop, see STAGES."""


class BaseEffect:
    """What most effects have in common: no company needed, none refused, fields checked."""

    requires: ClassVar[tuple[str, ...]] = ()
    excludes: ClassVar[tuple[str, ...]] = ()

    def __post_init__(self) -> None:
        config.check_fields(self)


@runtime_checkable
class NoiseEffect(Protocol):
    """An effect that is white Gaussian noise on every reading: a belief may know its sigma."""

    def sigma(self, context: Context) -> float:
        """Standard deviation, Pa."""


def find(name: str) -> type[Effect]:
    """The effect class called `name`; its module is imported here.

    Raises UnknownNameError, and ConfigError where another package's entry point leads nowhere.
    """
    if name in KINDS:
        return cast(type[Effect], getattr(import_module(f".{name}", __name__), KINDS[name]))
    outside = _outside()
    if name not in outside:
        raise UnknownNameError("effect", name, {*KINDS, *outside})
    try:
        found = outside[name].load()
    except Exception as error:  # another package's module runs here, and may raise anything
        raise ConfigError(
            f"the effect {name} of another package cannot be loaded: {_said(error)}",
            value=outside[name].value,
            remedy="install that package again, or take the effect out",
        ) from error
    if not is_dataclass(found):
        raise ConfigError(f"the effect {name} is no dataclass", value=outside[name].value)
    return cast(type[Effect], found)


def _outside() -> dict[str, EntryPoint]:
    """Effects of other packages, by name."""
    from importlib.metadata import entry_points

    return {point.name: point for point in entry_points(group=GROUP)}


def registered() -> tuple[Effect, ...]:
    """All effects that can be had, those of other packages too, at their defaults, in order.

    One that has no defaults is left out, and, with a warning that names it, one of another package
    that cannot be loaded.
    """
    kinds = [find(name) for name in KINDS]
    found = [kind() for kind in kinds if _has_defaults(kind)]
    for name in sorted(set(_outside()) - set(KINDS)):
        try:
            found += _made(name)
        except ConfigError as error:
            warnings.warn(f"{error}: it is left out", stacklevel=2)
    return tuple(found)


def _made(name: str) -> tuple[Effect, ...]:
    """The effect of another package at its defaults, where it has them. Raises ConfigError."""
    kind = find(name)
    if not _has_defaults(kind):
        return ()
    try:
        return (kind(),)
    except Exception as error:
        raise ConfigError(
            f"the effect {name} of another package cannot be made: {_said(error)}"
        ) from error


def _said(error: Exception) -> str:
    """What an error of another package says, on one line."""
    return " ".join(f"{type(error).__name__}: {error}".split())


def _has_defaults(kind: type[Effect]) -> bool:
    return all(map(_has_default, fields(cast(Any, kind))))


def _has_default(field: DataField[Any]) -> bool:
    return field.default is not MISSING or field.default_factory is not MISSING


def from_table(table: Mapping[str, Any], where: str = "effects") -> Effect:
    """The effect of a TOML table: `kind` names it, the other keys are its fields."""
    if "kind" not in table:
        raise ConfigError(f"[{where}] lacks kind", remedy=f"add one of {', '.join(sorted(KINDS))}")
    fields = {key: value for key, value in table.items() if key != "kind"}
    return config.from_table(find(str(table["kind"])), fields, where)


def ordered(effects: Iterable[Effect]) -> tuple[Effect, ...]:
    """The effects in the order in which they act, checked against one another.

    Raises ConfigError for an effect given twice, one that lacks what it requires, two that exclude
    each other, and an unknown stage.
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
        if effect.stage not in STAGES:
            raise UnknownNameError("stage", effect.stage, STAGES, f" of the effect {effect.name}")
        for other in effect.requires:
            if other not in counts:
                raise ConfigError(f"effect {effect.name} requires {other}", remedy=f"add {other}")
        for other in effect.excludes:
            if other in counts:
                raise ConfigError(f"effect {effect.name} excludes {other}", remedy="remove one")
    names = list(KINDS)

    def place(effect: Effect) -> tuple[int, int]:
        last = names.index(effect.name) if effect.name in KINDS else len(names)
        return STAGES.index(effect.stage), last

    return tuple(sorted(effects, key=place))


def build(effects: Iterable[Effect], context: Context, stage: str) -> tuple[Any, ...]:
    """What the effects of one stage build, in order: empty where none is on."""
    return tuple(e.build(context) for e in ordered(effects) if e.stage == stage)


@dataclass(frozen=True)
class EffectPipeline:
    """A scene's effects, compiled: what acts on its frames, batch after batch, in order."""

    contact: tuple[FrameTransform, ...]
    field: PressureField
    readings: tuple[PressureTransform, ...]
    recorded: tuple[FrameTransform, ...]
    clock: EffectClock

    @classmethod
    def from_effects(
        cls, effects: Iterable[Effect], context: Context, field: PressureField
    ) -> EffectPipeline:
        """The effects that are on; `field` is the ideal relation of contacts and pressures."""
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
        """What taxels at `poses` (n, 4, 4) say, (m, n), Pa, in the next frames in time."""
        frames = self.clock.to_effect_time(frames)
        for act in self.contact:
            frames = act(frames)
        pressures = self.field(frames, poses)
        for say in self.readings:
            pressures = say(pressures, frames)
        return pressures

    def record(self, frames: Frames) -> Frames:
        """The next frames in time as they are written into the recording."""
        if not len(frames):
            return frames
        recorded = self.clock.to_effect_time(frames)
        for act in self.recorded:
            recorded = act(recorded)
        return replace(recorded, time=frames.time)

    def start_next_run(self, seconds: float) -> None:
        """End a run: the next one, whose times begin anew, starts `seconds` after its last frame.

        What drifts drifts on, and what looks back finds no contact of that run.
        """
        self.clock.start = self.clock.now + seconds
