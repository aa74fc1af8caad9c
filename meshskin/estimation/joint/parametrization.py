"""Where taxels may be: each by itself on the body's surface, or rigidly on modules.

A place has groups of taxels with D coordinates z each: two in a chart of the surface for a free
taxel, six of the pose for a module. Coordinates are small moves from the current anchors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Protocol

import numpy as np

from ...core.se3 import Array
from .. import chart
from ..chart import Charts
from ..trilateration import trilaterate

if TYPE_CHECKING:
    from ...geometry.body import Body


class Parametrization(Protocol):
    """Groups of taxels that move together."""

    @property
    def size(self) -> int:
        """D."""
        ...

    @property
    def group(self) -> np.ndarray:
        """Group (n,) of each taxel, rising."""
        ...

    @property
    def count(self) -> int:
        """Number of groups."""
        ...

    def at(self, z: Array, groups: np.ndarray, rows: np.ndarray) -> tuple[Array, Array]:
        """Points (r, 3), m, of the taxels `rows`, and dx/dz (r, 3, D).

        groups (r,) and z (r, D) are those of each taxel."""
        ...

    def limit_step(self, step: Array) -> Array:
        """Steps (g, ...) whose first D entries are shortened to what the coordinates allow."""
        ...

    def prior(self, z: Array, groups: np.ndarray) -> tuple[Array, Array, Array]:
        """Cost (g,), gradient and Hessian, as wide as z (g, .), of what is known unread."""
        ...

    def relinearized(self, body: Body, z: Array) -> Parametrization:
        """The same places about the coordinates z (count, D)."""
        ...

    def points(self) -> Array:
        """Points (n, 3), m, at the anchors."""
        ...

    def rotations(self) -> Array:
        """Frames (n, 3, 3) of the taxels at the anchors."""
        ...


@dataclass(frozen=True)
class SurfaceParametrization:
    """Every taxel by itself, in a chart of the surface."""

    charts: Charts
    step: float
    """Longest step, m."""
    size: int = 2
    """D."""

    @property
    def group(self) -> np.ndarray:
        """Each taxel is its own group."""
        return np.arange(self.count)

    @property
    def count(self) -> int:
        """Number of taxels."""
        return len(self.charts.points)

    def at(self, z: Array, groups: np.ndarray, rows: np.ndarray) -> tuple[Array, Array]:
        """As `Parametrization.at`."""
        charts = self.charts[groups]
        return charts.at(z), charts.slope(z)

    def limit_step(self, step: Array) -> Array:
        """As `Parametrization.limited`."""
        size = np.linalg.norm(step[:, :2], axis=1)
        return step * np.minimum(1.0, self.step / np.maximum(size, 1e-300))[:, None]

    def prior(self, z: Array, groups: np.ndarray) -> tuple[Array, Array, Array]:
        """Nothing is known: the surface is in the charts."""
        g, d = z.shape
        return np.zeros(g), np.zeros((g, d)), np.zeros((g, d, d))

    def relinearized(self, body: Body, z: Array) -> SurfaceParametrization:
        """As `Parametrization.anchored`; the curvature is kept, for it only speeds the way."""
        rotations = trilaterate.frames_of(self.charts)
        return replace(self, charts=chart.carried(body, self.charts.at(z), rotations, self.charts))

    def points(self) -> Array:
        """As `Parametrization.points`."""
        return self.charts.points

    def rotations(self) -> Array:
        """Frames (n, 3, 3) of the taxels; the spin is a convention."""
        return trilaterate.frames_of(self.charts)

    def about(self, body: Body, points: Array) -> SurfaceParametrization:
        """Places anchored about other points (n, 3), m."""
        return replace(self, charts=chart.charts_at(body, points, self.rotations()))
