"""The indenter: a rigid sphere whose pose in the world is known."""

from __future__ import annotations

from dataclasses import dataclass

from ..config import check, quantity


@dataclass(frozen=True)
class Indenter:
    """A rigid sphere, fixed in the world."""

    radius: float = quantity("m", 0.01, above=0.0, most=1.0)
    """Radius r_e."""
    position: tuple[float, float, float] = quantity("m", (0.424, -0.424, 0.7), least=-10, most=10)
    """Centre, world; the default lies well inside the reach of a Puma 560."""
    support_radius: float | None = quantity("m", None, above=0.0, most=1.0)
    """Radius of the vertical column that carries the sphere; None: 0.4 of the sphere's."""
    support_height: float = quantity("m", 0.1, above=0.0, most=10.0)
    """Height of that column under the sphere."""

    def __post_init__(self) -> None:
        check(self)

    @property
    def column_radius(self) -> float:
        """Radius of the support, m."""
        return 0.4 * self.radius if self.support_radius is None else self.support_radius

    @classmethod
    def sphere(
        cls, radius: float, position: tuple[float, float, float] = (0.424, -0.424, 0.7)
    ) -> Indenter:
        """A sphere of `radius` (m) centred at `position` (m, world)."""
        return cls(radius, position)
