"""The indenter: a rigid sphere on a straight support, fixed in the world or carried to the body."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.arguments import check_name
from ..core.arrays import Array
from ..core.config import check_fields, quantity
from ..core.errors import ConfigError
from ..core.se3 import shortest_rotation

CARRIERS = ("hand", "arm")


@dataclass(frozen=True)
class Indenter:
    """A rigid sphere, fixed in the world or carried to a body at rest."""

    radius: float = quantity("m", 0.01, above=0.0, least=1e-4, most=1.0)
    """Radius r_e of the sphere."""
    position: tuple[float, float, float] = quantity("m", (0.424, -0.424, 0.7), least=-10, most=10)
    """Centre of the sphere, world frame; the default is well inside the workspace of a Puma 560."""
    support_radius: float | None = quantity("m", None, above=0.0, most=1.0)
    """Radius of the column that carries the sphere; None: 0.4 of the sphere's radius."""
    support_height: float = quantity("m", 0.1, above=0.0, most=10.0)
    """Length of the column behind the sphere."""
    direction: tuple[float, float, float] = quantity("", (0.0, 0.0, 1.0))
    """Vector of any length from the support to the sphere, world frame."""

    carried_by: str | None = None
    """What carries the indenter to a body at rest: "hand", or "arm", the scene's arm. `position`
    and `direction` are then not used. None: it is fixed, and the body moves."""

    def __post_init__(self) -> None:
        check_fields(self)
        if self.carried_by is not None:
            check_name("carrier of the indenter", self.carried_by, CARRIERS)
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
        """Unit vector (3,) from the support to the sphere, world frame.

        The body is pressed against the indenter in the opposite direction.
        """
        axis = np.array(self.direction, dtype=float)
        axis /= np.abs(axis).max()  # the square of a very small or large number is 0 or inf
        return np.asarray(axis / np.linalg.norm(axis))

    @property
    def rotation(self) -> Array:
        """Rotation (3, 3), world from the frame of the indenter, whose z axis is `axis`.

        The shortest rotation from the axes of the world.
        """
        return shortest_rotation([0.0, 0.0, 1.0], self.axis)

    @classmethod
    def sphere(
        cls,
        radius: float,
        position: tuple[float, float, float] = (0.424, -0.424, 0.7),
        direction: tuple[float, float, float] = (0.0, 0.0, 1.0),
        carried_by: str | None = None,
    ) -> Indenter:
        """A sphere of `radius` (m) centred at `position` (m, world frame), see the fields."""
        return cls(radius, position, direction=direction, carried_by=carried_by)
