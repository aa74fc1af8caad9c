"""The interface of an effect, and the context from which effects are built."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any, ClassVar, Protocol, runtime_checkable

import numpy as np

from ..core import config
from ..core.arguments import repr_short
from ..core.arrays import Array
from ..core.errors import ConfigError, UnknownNameError
from ..core.provenance import random_stream
from .frames import Frames

if TYPE_CHECKING:
    from ..contact.reading import ReadingModel
    from ..geometry.body import Body
    from ..skin.skin import Skin

STAGES = ("contact", "field", "pressure", "transducer", "geometry", "robot")
"""Stages at which effects act, in the order of the signal, and what an effect of each builds:

contact     FrameTransform: changes where and how hard the indenter presses
field       PressureField -> PressureField: changes the pressure that a contact causes at any point
pressure    PressureTransform: changes the pressures on the taxels
transducer  PressureTransform: changes the readings of the taxels
geometry    FrameTransform: changes the recorded contact points
robot       FrameTransform: changes the recorded pose and force of the robot
"""

NAMES = (
    "friction", "layer", "elliptic_patch", "disc_averaging", "cover_fabric", "scan_order",
    "relaxation", "crosstalk", "hysteresis", "capacitive", "gain_offset", "temperature_drift",
    "gaussian_noise", "sensing_range", "quantisation", "broken_taxels", "mesh_facets", "body_pose",
    "indenter_offset", "gravity_error", "joint_friction", "force_sensor", "encoder", "sampling",
)  # fmt: skip
"""Names of the effects of this package and of their modules, in the order of the signal: effects
of one stage act in this order, one derived from them in the place of its base, followed by those of
other packages."""

PressureTransform = Callable[[Array, Frames], Array]
"""(pressures (m, n), Pa, the next m frames in time) -> pressures (m, n), Pa."""
FrameTransform = Callable[[Frames], Frames]
"""The next frames in time -> the frames as the effect changes them."""

JOINT_STEP = 1e-5
"""Step of central differences by joint angles, rad: near the optimum (3 eps)^(1/3) = 9e-6 of double
precision, where truncation and rounding errors balance at about 1e-11 of the derivative."""


class Effect(Protocol):
    """An effect; its dataclass fields are the keys of its `[[effects]]` table in TOML."""

    name: ClassVar[str]
    """Name under which the effect is registered."""
    stage: ClassVar[str]
    """Stage at which the effect acts, one of STAGES."""
    requires: ClassVar[tuple[str, ...]]
    """Names of the effects that must be on with this one."""
    excludes: ClassVar[tuple[str, ...]]
    """Names of the effects that must be off with this one."""
    cost: ClassVar[float]
    """Computing time per taxel and frame, s, measured on one core with 80 taxels."""

    def bound(self, context: Context) -> float:
        """Upper bound on the taxel position error, m, when an estimate ignores the effect."""

    def build(self, context: Context) -> Any:
        """The function that acts in the loop; its type depends on the stage, see STAGES."""


@runtime_checkable
class NoiseEffect(Protocol):
    """An effect that adds white Gaussian noise to every reading; a belief may know its sigma."""

    def sigma(self, context: Context) -> float:
        """Standard deviation, Pa."""


def _check_name(kind: type, name: str) -> None:
    """Raise ConfigError for a class of the program, or of another package, with the name of an
    effect of this one: a table or a study that names it would build the latter."""
    if name in NAMES and kind.__module__ != f"{__package__}.{name}":
        raise ConfigError(
            f"an effect {name} exists in meshskin",
            value=f"the class {kind.__qualname__} of {kind.__module__}",
            remedy="rename the class",
        )


class BaseEffect:
    """Base class of effects: fields are checked on creation, and `Effect`'s facts are keywords.

        class GaussianNoise(BaseEffect, stage="transducer", cost=8e-9):

    The name is that of the class as in TOML, gaussian_noise, unless the class has one of its own.
    Raises ConfigError for a name of this package.
    """

    name: ClassVar[str]
    stage: ClassVar[str]
    requires: ClassVar[tuple[str, ...]] = ()
    excludes: ClassVar[tuple[str, ...]] = ()
    cost: ClassVar[float]

    def __init_subclass__(cls, **facts: Any) -> None:
        if "name" not in vars(cls):  # a derived effect does not take the name of its base
            facts.setdefault("name", config.table_name(cls))
        for key, value in facts.items():
            setattr(cls, key, value)
        _check_name(cls, cls.name)

    def __post_init__(self) -> None:
        config.check_fields(self)


class ReadingModelEffect(BaseEffect):
    """Base class of the effects that the reading model describes, with other parameters."""

    def change(self, model: ReadingModel, context: Context) -> ReadingModel:
        """The reading model with the effect."""
        raise NotImplementedError

    def bound(self, context: Context) -> float:
        """From the largest change of a reading, m."""
        return context.model_error_bound(self.change(context.reading_model, context))

    def build(self, context: Context) -> Callable[[ReadingModel], ReadingModel]:
        """A function that changes a reading model."""
        return partial(self.change, context=context)


def check_effect(effect: Any) -> None:
    """Raise ConfigError unless `effect` has the interface of `Effect`.

    `sigma` is reserved for the method of `NoiseEffect`. Raises UnknownNameError for an unknown
    stage.
    """
    missing = [n for n in ("name", "stage", "bound", "build") if not hasattr(effect, n)]
    if missing and isinstance(effect, BaseEffect):
        raise ConfigError(
            f"the effect {effect.name} has no {' and no '.join(missing)}",
            value=repr_short(effect),
            remedy='give it one: class Leak(BaseEffect, stage="transducer", cost=1e-8), with the '
            "methods bound and build",
        )
    if isinstance(effect, type) or missing:
        raise ConfigError(
            "scene.effects and scene.candidates must contain Effect objects",
            value=repr_short(effect),
            remedy="create one, such as meshskin.effects.find(NAME)()",
        )
    _check_name(type(effect), effect.name)
    if effect.stage not in STAGES:
        raise UnknownNameError("stage", effect.stage, STAGES, f" of the effect {effect.name}")
    for method in ("bound", "build", "sigma"):
        found = getattr(effect, method, None)
        if hasattr(effect, method) and not callable(found):
            raise ConfigError(
                f"{method} of the effect {effect.name} must be a method",
                value=repr_short(found),
                remedy="rename the field",
            )


@dataclass(frozen=True)
class Context:
    """The properties of a scene from which its effects are built."""

    seed: int
    """Seed of the run."""
    peak_pressure: float
    """Peak contact pressure p_0 at the reference force, Pa."""
    contact_radius: float
    """Contact radius a at the reference force, m."""
    force: float
    """Reference force, N."""
    indenter_radius: float
    """Radius of the indenter, m."""
    indenter_position: Array
    """Centre of the indenter (3,), world frame, m."""
    shear_modulus: float
    """Shear modulus of the skin, G = E / (2 (1 + nu)), Pa."""
    poisson: float
    """Poisson's ratio of the skin."""
    period: float
    """Time between frames, s."""
    speed: float
    """Speed of the contact over the skin, m/s."""
    skin: Skin = field(repr=False)
    body: Body = field(repr=False)
    reading_model: ReadingModel
    """Pressures of the taxels without any effect."""
    pose: Callable[[Array], Array] = field(repr=False)
    """Configurations (k, n) -> T_w_body (k, 4, 4)."""
    postures: Callable[[], Array] = field(repr=False)
    """() -> configurations (k, n) in which the arm holds the skin on the indenter, on any path."""
    joints: int = 0
    """Number of joints; 0 where the body moves without an arm."""
    carried: bool = False
    """Whether the indenter is carried to a body at rest: poses are in the indenter's frame then."""

    def stream(self, name: str) -> np.random.Generator:
        """The random stream of the effect `name`."""
        return random_stream(self.seed, f"effect/{name}")

    def indenter_centres(self, q: Array) -> Array:
        """Centres of the indenter (k, 3), body frame, m, in the configurations (k, n)."""
        pose = self.pose(q)
        return np.einsum("kji,kj->ki", pose[:, :3, :3], self.indenter_position - pose[:, :3, 3])

    def joint_jacobian(self, function: Callable[[Array], Array], q: Array) -> Array:
        """Derivatives (k, ..., joints) of `function` (k, joints) -> (k, ...) by the joint angles.

        Central differences with a step of JOINT_STEP.
        """
        steps = JOINT_STEP * np.eye(self.joints)
        columns = [function(q + step) - function(q - step) for step in steps]
        return np.stack(columns, axis=-1) / (2.0 * JOINT_STEP)

    def reading_error_bound(self, relative: float) -> float:
        """Bound on the taxel position error, m, from reading errors of at most `relative` p_0.

        Least squares shift a taxel by sum(s e) / sum(s^2) <= max|e| sum|s| / sum(s^2), where s are
        the slopes of the readings. The last ratio is about a / p_0 where contacts cover the whole
        patch. It is larger at a border of the explored region; the bound takes twice that value.
        """
        return 2.0 * relative * self.contact_radius

    def model_error_bound(self, other: ReadingModel) -> float:
        """Bound on the taxel position error, m, when the taxels read what `other` predicts."""
        curvature = self.body.closest(self.skin.positions).curvature
        return self.reading_error_bound(
            self.reading_model.max_difference(other, self.force, curvature)
        )

    def force_error_bound(self, force: float) -> float:
        """Bound on the taxel position error, m, from a force error `force`, N.

        By Hertz's law p_0 and a are proportional to the cube root of the force.
        """
        return 2.0 / 3.0 * force / self.force * self.contact_radius
