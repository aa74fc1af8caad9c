"""What is chosen, what it must keep to, and over which worlds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from itertools import product
from typing import Any

import numpy as np

from ..core.arguments import check_vector
from ..core.config import check_fields, quantity
from ..core.errors import ConfigError, UnknownNameError
from ..core.se3 import Array
from ..scene.scene import Scene
from ..scene.settings import Exploration, Law


@dataclass(frozen=True)
class Gains:
    """What is chosen: floats, or CasADi symbols while it is being chosen."""

    gamma: Any
    """1/s."""
    rate: Any
    """Velocity gain L of the law: 1/s with shape "inertia", N m s/rad with shape "identity"."""
    force_reference: Any
    """N."""
    approach_speed: Any
    """m/s."""
    approach_ramp: Any
    """Time in which the approach gains its speed, s."""
    settle: Any
    """Rest after the touch, s."""
    speed: Any
    """Largest speed of the slide, m/s."""
    ramp: Any
    """Time to speed up and to slow down, s."""

    @classmethod
    def of(cls, scene: Scene) -> Gains:
        """Those of a scene."""
        law, way = scene.law, scene.exploration
        return cls(
            law.gamma,
            law.rate if law.shape == "inertia" else law.gain,
            law.force_reference,
            law.approach_speed,
            way.approach_ramp,
            way.settle,
            way.speed,
            way.ramp,
        )

    def law(self, law: Law) -> Law:
        """`law` with these gains."""
        gain = "rate" if law.shape == "inertia" else "gain"
        return replace(
            law,
            gamma=self.gamma,
            force_reference=self.force_reference,
            approach_speed=self.approach_speed,
            **{gain: self.rate},
        )

    def exploration(self, exploration: Exploration) -> Exploration:
        """`exploration` with this speed profile."""
        return replace(
            exploration,
            approach_ramp=self.approach_ramp,
            settle=self.settle,
            speed=self.speed,
            ramp=self.ramp,
        )

    def applied(self, scene: Scene) -> Scene:
        """`scene` with these gains and speeds."""
        return scene.with_(law=self.law(scene.law), exploration=self.exploration(scene.exploration))

    @property
    def values(self) -> list[Any]:
        """In the order of the fields."""
        return [getattr(self, name) for name in NAMES]


NAMES = tuple(f.name for f in fields(Gains))
SPAN: dict[str, tuple[float, float]] = {
    "gamma": (2.0, 1000.0),
    "rate": (10.0, 1000.0),
    "approach_speed": (1e-3, 1.0),
    "approach_ramp": (1e-3, 0.5),
    "settle": (5e-3, 2.0),
    "speed": (1e-3, 0.5),
    "ramp": (5e-3, 1.0),
}
"""Between which values the gains are looked for, SI."""
REFERENCE = 0.01
"""How far the reference force may be from the one that the scene asks for, part of it."""


@dataclass(frozen=True)
class Demands:
    """Limits that hold in every scenario and, but for the settling, at every step."""

    overshoot: float = quantity("", 0.01, least=0.0)
    """Largest force over its reference, less one, to 1e-5; with objective "settling" that of a rest
    without end."""
    settled: float = quantity("", 0.02, above=0.0)
    """Largest error of the force when the slide begins, part of the reference."""
    force: float = quantity("", 0.05, above=0.0, most=1.0)
    """Largest error of the force from then on, part of the force that the scene asks for."""
    torque: float = quantity("", 1.0, above=0.0)
    """Largest torque of each joint, part of its limit."""
    velocity: float = quantity("", 1.0, above=0.0)
    """Largest speed of each joint, part of its limit."""
    position: float = quantity("rad", 0.0, least=0.0)
    """Least distance of each joint from the ends of its range."""
    time: float | None = quantity("s", None, above=0.0)
    """Longest time from the start to the end of the slide; None: the scene's own with
    objective "force_error", and none with "time"."""

    def __post_init__(self) -> None:
        check_fields(self)


@dataclass(frozen=True)
class Scenario:
    """A world that the gains must serve: what differs from the scene, which the law believes in."""

    modulus: float = quantity("", 1.0, above=0.0)
    """E* of the contact, times that of the scene."""
    curvature: float = quantity("", 1.0, above=0.0)
    """Curvature of the body at the contact, times that of the scene."""
    friction: float = quantity("", 0.0, least=0.0)
    """Coulomb friction of each joint, part of its torque limit, beside the arm's own."""

    def __post_init__(self) -> None:
        check_fields(self)

    @property
    def name(self) -> str:
        """What differs, in words."""
        parts = [f"E* x {self.modulus:g}"] if self.modulus != 1.0 else []
        parts += [f"curvature x {self.curvature:g}"] if self.curvature != 1.0 else []
        parts += [f"friction {100 * self.friction:g} %"] if self.friction else []
        return ", ".join(parts) or "nominal"


def scenarios(
    modulus: tuple[float, float] = (1.0, 1.0),
    curvature: tuple[float, float] = (1.0, 1.0),
    friction: tuple[float, float] = (0.0, 0.0),
) -> tuple[Scenario, ...]:
    """The nominal world and the corners of the ranges (lowest, highest); see Scenario."""
    ends = [sorted(set(r)) for r in (modulus, curvature, friction)]
    corners = [Scenario(*corner) for corner in product(*ends)]
    return tuple(dict.fromkeys([Scenario(), *corners]))


def span(bounds: Mapping[str, tuple[float, float]], target: float) -> Array:
    """Lowest and highest gains (2, 8), SI: SPAN with `bounds` in it. Raises ConfigError."""
    ranges = SPAN | {"force_reference": (target * (1.0 - REFERENCE), target * (1.0 + REFERENCE))}
    for name, pair in bounds.items():
        if name not in NAMES:
            raise UnknownNameError("gain", str(name), NAMES, " in bounds")
        low, high = check_vector(f"bounds of {name}", pair, 2).tolist()
        if not 0.0 < low <= high:
            raise ConfigError(f"bounds of {name}", value=(low, high), limit="0 < low <= high")
        ranges[name] = (low, high)
    return np.array([ranges[name] for name in NAMES]).T
