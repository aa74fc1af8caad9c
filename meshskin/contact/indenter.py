"""The indenter: a rigid sphere on a straight support, whose pose in the world is known."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.config import check_fields, quantity
from ..core.errors import ConfigError
from ..core.se3 import Array, exp_so3


@dataclass(frozen=True)
class Indenter:
    """A rigid sphere, fixed in the world."""

    radius: float = quantity("m", 0.01, above=0.0, least=1e-6, most=1.0)
    """Radius r_e."""
    position: tuple[float, float, float] = quantity("m", (0.424, -0.424, 0.7), least=-10, most=10)
    """Centre, world; the default lies well inside the reach of a Puma 560."""
    support_radius: float | None = quantity("m", None, above=0.0, most=1.0)
    """Radius of the column that carries the sphere; None: 0.4 of the sphere's."""
    support_height: float = quantity("m", 0.1, above=0.0, most=10.0)
    """Length of that column behind the sphere."""
    direction: tuple[float, float, float] = quantity("", (0.0, 0.0, 1.0))
    """Where it points, from the support to the sphere, world; its length is of no matter."""

    def __post_init__(self) -> None:
        check_fields(self)
        if not any(self.direction):
            raise ConfigError(
                "indenter.direction must not be zero",
                value=self.direction,
                remedy="give the vector from the support to the tip, such as (0, 0, 1)",
            )

    @property
    def column_radius(self) -> float:
        """Radius of the support, m."""
        return 0.4 * self.radius if self.support_radius is None else self.support_radius

    @property
    def axis(self) -> Array:
        """Unit vector (3,), world, in which it points: the body is pressed on it the other way."""
        way = np.array(self.direction, dtype=float)
        way /= np.abs(way).max()  # the square of a very small or large number is none
        return np.asarray(way / np.linalg.norm(way))

    @property
    def rotation(self) -> Array:
        """Rotation (3, 3), world from the indenter's frame: its z axis points as it does.

        The least turn out of the world's axes; half a turn about x where it points straight down.
        """
        x, y, z = self.axis
        sine = float(np.hypot(x, y))
        axis = np.array([-y, x, 0.0]) / sine if sine > 0.0 else np.array([1.0, 0.0, 0.0])
        return exp_so3(np.arctan2(sine, z) * axis)

    @classmethod
    def sphere(
        cls,
        radius: float,
        position: tuple[float, float, float] = (0.424, -0.424, 0.7),
        direction: tuple[float, float, float] = (0.0, 0.0, 1.0),
    ) -> Indenter:
        """A sphere of `radius` (m) centred at `position` (m, world) that points in `direction`."""
        return cls(radius, position, direction=direction)
