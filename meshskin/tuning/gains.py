"""The gains that are chosen, their ranges, and the demands that they must meet."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np

from ..core.arguments import check_vector
from ..core.arrays import Array
from ..core.config import check_fields, quantity
from ..core.errors import ConfigError, UnknownNameError
from ..scene.scene import Scene


@dataclass(frozen=True)
class Gains:
    """The variables of the tuning: floats, or CasADi symbols during the optimization."""

    gamma: Any
    """Gain of the force law, 1/s."""
    rate: Any
    """Velocity gain L of the law: 1/s with shape "inertia", N m s/rad with shape "identity"."""
    force_reference: Any
    """Reference force, N."""
    approach_speed: Any
    """m/s."""
    approach_ramp: Any
    """Time in which the approach reaches its speed, s."""
    settle: Any
    """Rest after the touch, s."""
    speed: Any
    """Largest speed of the slide, m/s."""
    ramp: Any
    """Time to speed up and to slow down, s."""

    @classmethod
    def of(cls, scene: Scene) -> Gains:
        """The gains of a scene."""
        law = {name: getattr(scene.law, name) for name in LAW}
        paths = {name: getattr(scene.exploration, name) for name in EXPLORATION}
        return cls(**law, **paths, rate=getattr(scene.law, RATE[scene.law.shape]))

    def applied(self, scene: Scene) -> Scene:
        """The scene with these gains and speeds."""
        law = {name: getattr(self, name) for name in LAW} | {RATE[scene.law.shape]: self.rate}
        paths = {name: getattr(self, name) for name in EXPLORATION}
        return scene.with_(
            law=replace(scene.law, **law), exploration=replace(scene.exploration, **paths)
        )

    @property
    def values(self) -> list[Any]:
        """The gains as a list (8,), in the order of the fields."""
        return [getattr(self, name) for name in NAMES]


NAMES = tuple(f.name for f in fields(Gains))
"""Names of the gains."""
LAW = ("gamma", "force_reference", "approach_speed")
EXPLORATION = ("approach_ramp", "settle", "speed", "ramp")
"""Those that are fields of the same name of a scene's law, and of its exploration."""
RATE = {"inertia": "rate", "identity": "gain"}
"""Field of the law that is the velocity gain, by its shape."""
BOUNDS: dict[str, tuple[float, float]] = {
    "gamma": (2.0, 1000.0),
    "rate": (10.0, 1000.0),
    "approach_speed": (1e-3, 1.0),
    "approach_ramp": (1e-3, 0.5),
    "settle": (5e-3, 2.0),
    "speed": (1e-3, 0.5),
    "ramp": (5e-3, 1.0),
}
"""Default range of each gain, SI: two to three decades about the defaults of Law and Exploration;
`tune(bounds=...)` replaces them."""
REFERENCE_RANGE = 0.01
"""Default range of the reference force, relative to the force that the scene asks for."""


@dataclass(frozen=True)
class Demands:
    """Limits that hold in every scenario and, except for `settled`, at every step."""

    overshoot: float = quantity("", 0.01, least=0.0)
    """Largest force over its reference, minus one, to 1e-5; with objective "settling" that of a
    rest without end."""
    settled: float = quantity("", 0.02, above=0.0)
    """Largest error of the force when the slide begins, relative to the reference."""
    force: float = quantity("", 0.05, above=0.0, most=1.0)
    """Largest error of the force during the slide, relative to the force that the scene asks for.
    """
    torque: float = quantity("", 1.0, above=0.0)
    """Largest torque of each joint, relative to its limit."""
    velocity: float = quantity("", 1.0, above=0.0)
    """Largest speed of each joint, relative to its limit."""
    position: float = quantity("rad", 0.0, least=0.0)
    """Least distance of each joint from the ends of its range."""
    time: float | None = quantity("s", None, above=0.0)
    """Longest time from the start to the end of the slide; None: the scene's own time with
    objective "force_error", no limit with "time"."""

    def __post_init__(self) -> None:
        check_fields(self)


def gain_bounds(bounds: Mapping[str, tuple[float, float]], force: float) -> Array:
    """Lowest and highest gains (2, 8), SI: the defaults, replaced by `bounds`.

    force: that the scene asks for, N. Raises UnknownNameError, ConfigError.
    """
    reference = (force * (1.0 - REFERENCE_RANGE), force * (1.0 + REFERENCE_RANGE))
    ranges = BOUNDS | {"force_reference": reference}
    for name, pair in bounds.items():
        if name not in NAMES:
            raise UnknownNameError("gain", str(name), NAMES, " in bounds")
        low, high = check_vector(f"bounds of {name}", pair, 2).tolist()
        if not 0.0 < low <= high:
            raise ConfigError(f"bounds of {name}", value=(low, high), limit="0 < low <= high")
        ranges[name] = (low, high)
    return np.array([ranges[name] for name in NAMES]).T
