"""Parametrizations of taxel positions: each on the body's surface, or rigidly on modules.

A parametrization has groups of taxels with D coordinates z each: two in a chart of the surface for
a single taxel, six of the pose for a module. Coordinates are small moves from the poses at which it
was linearized.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from ...core.arrays import Array, means_by_group
from ...geometry.body import Body
from .. import chart
from ..chart import Charts
from ..data.global_parameters import GlobalParameters
from ..data.measurements import Measurements

OTHER_SIDE = -0.5
"""Scalar product of the normal of a taxel with the mean of those of its contacts below which it is
on the other side of a wall: 120 degrees where these are alike; the face of a rim is at 90."""
HALVINGS = 12
"""Halvings of a step, at most: to a few micrometres."""


class Parametrization(Protocol):
    """Groups of taxels that move together."""

    @property
    def size(self) -> int:
        """D, the coordinates of a group."""

    @property
    def group(self) -> np.ndarray:
        """Group (n,) of each taxel, rising."""

    @property
    def count(self) -> int:
        """Number of groups."""

    def at(self, z: Array, groups: np.ndarray, rows: np.ndarray) -> tuple[Array, Array]:
        """Points (r, 3), m, of the taxels `rows`, and dx/dz (r, 3, D).

        groups (r,) and z (r, D) are those of each taxel."""

    def limit_step(self, step: Array) -> Array:
        """Steps (g, ...) shortened so that the linearization holds for their first D entries."""

    def prior(self, z: Array, groups: np.ndarray) -> tuple[Array, Array, Array]:
        """Cost (g,), gradient and Hessian, as wide as z (g, .), of the prior."""

    def relinearized(self, body: Body, z: Array) -> Parametrization:
        """The parametrization linearized at the coordinates z (count, D)."""

    def points(self) -> Array:
        """Points (n, 3), m, at z = 0."""

    def rotations(self) -> Array:
        """Frames (n, 3, 3) of the taxels at z = 0."""


@dataclass(frozen=True)
class SurfaceParametrization:
    """Every taxel is a group of its own, in a chart of the surface."""

    charts: Charts
    step: float
    """Longest step, m."""
    size: int = 2
    """Coordinates of a taxel."""
    side: Array | None = None
    """Mean normals (n, 3) of the contacts that press the taxels, shorter where these surround an
    edge; the taxels stay on that side of the body. None: on any."""

    @classmethod
    def of(
        cls, data: Measurements, live: np.ndarray, charts: Charts, step: float
    ) -> SurfaceParametrization:
        """The taxels `live`, rows of `data.ids`, from their `charts`, each on the side of the
        contacts that it reads."""
        level = np.maximum(data.pressure - data.rest[data.taxel], 0.0)
        normals = data.normals[data.contact]
        side = means_by_group(normals, data.taxel, len(data.ids), level)
        return cls(charts, step, side=side[live])

    @property
    def group(self) -> np.ndarray:
        """Group (n,) of each taxel: its own number."""
        return np.arange(self.count)

    @property
    def count(self) -> int:
        """Number of taxels."""
        return len(self.charts.points)

    def at(self, z: Array, groups: np.ndarray, rows: np.ndarray) -> tuple[Array, Array]:
        """Points (r, 3), m, of the taxels `groups` at z (r, 2), and dx/dz (r, 3, 2)."""
        charts = self.charts[groups]
        return charts.at(z), charts.slope(z)

    def limit_step(self, step: Array) -> Array:
        """Steps (g, ...) whose first two entries are no longer than the limit."""
        size = np.linalg.norm(step[:, :2], axis=1)
        return step * np.minimum(1.0, self.step / np.maximum(size, 1e-300))[:, None]

    def prior(self, z: Array, groups: np.ndarray) -> tuple[Array, Array, Array]:
        """Zeros: that taxels are on the surface is in the charts."""
        g, d = z.shape
        return np.zeros(g), np.zeros((g, d)), np.zeros((g, d, d))

    def relinearized(self, body: Body, z: Array) -> SurfaceParametrization:
        """Charts about the surface points closest to z (n, 2); the shape operators are kept.

        Steps that lead past the rim of a wall to its other side are halved: a contact presses what
        lies in its tangent plane, so that the readings fit there as well. Taxels that are on the
        other side already move freely.
        """
        charts = chart.relinearized(body, self.charts, z)
        for _ in range(HALVINGS):
            turned = self._turned(charts.normals) & ~self.on_other_side
            if not turned.any():
                break
            z = np.where(turned[:, None], z / 2, z)
            charts = chart.relinearized(body, self.charts, z)
        return replace(self, charts=charts)

    @property
    def on_other_side(self) -> np.ndarray:
        """Taxels (n,) bool that are not on the side of the body whose contacts press them."""
        return self._turned(self.charts.normals)

    def _turned(self, normals: Array) -> np.ndarray:
        """Taxels (n,) bool for which `normals` (n, 3) are those of the other side of a wall."""
        if self.side is None:
            return np.zeros(len(normals), dtype=bool)
        return np.asarray(np.einsum("ni,ni->n", normals, self.side) < OTHER_SIDE)

    def points(self) -> Array:
        """Points (n, 3), m, at z = 0."""
        return self.charts.points

    def rotations(self) -> Array:
        """Frames (n, 3, 3) of the taxels; the rotation about the normal is a convention."""
        return self.charts.rotations

    def about(self, body: Body, points: Array) -> SurfaceParametrization:
        """The parametrization linearized at other points (n, 3), m."""
        charts = chart.charts_at(body, points, self.rotations(), self.charts.height)
        return replace(self, charts=charts)


@dataclass(frozen=True)
class Unknowns:
    """A value of all unknowns of an estimate whose contacts have errors of their own."""

    parametrization: SurfaceParametrization
    nuisance: Array
    """(n, q), ln gain, offset, and drift where it is estimated."""
    errors: Array
    """(m, 3) of the contacts."""
    s: Array
    """(ks,)."""

    def without(self, names: Collection[str], parameters: GlobalParameters) -> Unknowns:
        """These with the `parameters` of these names, also those of a taxel, at zero."""
        s, nuisance = self.s.copy(), self.nuisance.copy()
        for name in names:
            s[parameters.columns.get(name, slice(0, 0))] = 0.0
        nuisance[:, [name in names for name in parameters.nuisance_names]] = 0.0
        return replace(self, s=s, nuisance=nuisance)
