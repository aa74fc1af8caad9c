"""Any gap, half-space or bonded layer: boundary elements on a grid by FFT.

The pressure p >= 0 of total force F minimises 1/2 p.Kp + p.gap; it is found by the constrained
conjugate gradients of I. A. Polonsky and L. M. Keer, Wear 231 (1999), with the convolution K p by
FFT on a doubled grid, so that the surroundings are free.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..core.errors import ContactError
from ..core.se3 import Array
from . import elliptic
from .influence import Influence
from .patch import Patch
from .problem import ContactProblem

CELLS = 96
"""Cells along each side of the grid."""
_COARSE = 48
"""Cells along each side of the grids that find the patch's size."""
ITERATIONS = 500
"""Most iterations of the conjugate gradients."""
MAX_SINK = 0.8
"""Largest semi-axis, in indenter radii: beyond, a sphere's flank is no gap over a plane."""
_ROOM = 1.12
"""Half side of the grid in semi-axes."""


@dataclass(frozen=True)
class Pressing:
    """The solved contact on a grid."""

    pressure: Array
    """Pressure (n, m), Pa, of the cells."""
    approach: float
    """Approach of the two bodies, m: displacement + gap in the contact."""
    iterations: int
    """Iterations of the conjugate gradients."""


@dataclass(frozen=True)
class GridPatch(Patch):
    """A patch with the pressure on a grid; its semi-axes are those of its second moments."""

    grid: Array | None = None
    """Pressure (n, m), Pa, at the cells."""
    spacing: tuple[float, float] = (1.0, 1.0)
    """Size of a cell along x and y, m; the grid's middle is the patch's centre."""

    def pressure(self, xy: ArrayLike) -> Array:
        """Pressure (...), Pa, at points `xy` (..., 2), m: linear between the cells."""
        from scipy.ndimage import map_coordinates

        grid = np.zeros((1, 1)) if self.grid is None else self.grid
        xy = np.asarray(xy, dtype=float)
        middle = (np.array(grid.shape) - 1) / 2
        index = (xy / self.spacing + middle).reshape(-1, 2).T
        values = map_coordinates(grid, index, order=1, mode="constant")
        return np.asarray(values.reshape(xy.shape[:-1]))

    def reading(self, xy: ArrayLike, disc_radius: float) -> Array:
        """Mean pressure (...), Pa, over discs at `xy` (..., 2), m: 12 rings of 32 points."""
        x, weight = np.polynomial.legendre.leggauss(12)
        ring = disc_radius * np.sqrt((1 + x) / 2)  # equal areas, Gauss in the area
        angle = 2 * np.pi * np.arange(32) / 32
        disc = ring[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        values = self.pressure(np.asarray(xy, dtype=float)[..., None, None, :] + disc)
        return np.asarray(values.mean(axis=-1) @ (weight / 2))


def press(
    gap: ArrayLike,
    influence: Influence,
    force: float,
    cell: float,
    start: Array | None = None,
    tolerance: float = 1e-4,
) -> Pressing:
    """Press a rigid indenter with `gap` (n, m), m, on a body by `force`, N.

    cell: area of a grid cell, m^2; start: pressures (n, m) to begin with, in any unit; tolerance:
    sum of the last changes of the pressures, in parts of the force. Raises ContactError where
    the iterations do not converge (gaps that are not finite, a force that is not positive).
    """
    h = np.asarray(gap, dtype=float)
    if not (np.isfinite(h).all() and math.isfinite(force) and force > 0):
        raise ContactError("gap and force must be finite, the force positive", value=f"{force} N")
    total = force / cell
    p = np.ones_like(h) if start is None else np.maximum(start, 0.0)
    p *= total / p.sum()
    way, before, keep = np.zeros_like(h), 1.0, 0.0
    for iteration in range(1, ITERATIONS + 1):
        g = influence(p) + h
        contact = p > 0
        approach = float(g[contact].mean())
        g -= approach
        inside = np.where(contact, g, 0.0)
        size = float(np.vdot(inside, inside))
        way = np.where(contact, inside + keep * (size / before) * way, 0.0)
        before = size
        change = influence(way)
        change -= change[contact].mean()
        curvature = float(np.vdot(way, change))
        if curvature <= 0:  # nothing is left to change: the contact is one cell, or solved
            return Pressing(p, approach, iteration)
        step = float(np.vdot(inside, way)) / curvature
        new = np.maximum(p - step * way, 0.0)
        overlap = (new == 0) & (g < 0)
        keep = 0.0 if overlap.any() else 1.0
        new[overlap] -= step * g[overlap]
        new *= total / new.sum()
        moved = float(np.abs(new - p).sum())
        p = new
        if moved < tolerance * total:
            return Pressing(p, approach, iteration)
    raise ContactError(
        "the boundary elements do not converge",
        value=f"change {moved / total:.2g} of the force",
        limit=f"{tolerance:g} in {ITERATIONS} iterations",
        remedy="take a smoother gap or a finer grid",
    )


def solve(setting: ContactProblem, *, cells: int = CELLS, parabolic: bool = False) -> GridPatch:
    """The patch of a rigid sphere on a body by boundary elements.

    `cells` along a side of the grid. The gap is that of a true sphere on a body whose normal
    sections are circles, or with `parabolic` that of Hertz. Raises ContactError for what leaves
    the model's range: a patch nearly as wide as the indenter, a layer thinner than two cells.
    """
    elliptic.refuse_ratio(setting.ratio)
    if setting.force == 0:
        return GridPatch(np.zeros(2), 0.0, 0.0, "field")
    low, high = np.sort(setting.pair)
    guess = elliptic.patches(
        setting.force, np.array([low, high]), setting.indenter_radius, setting.e_star
    )
    axes, seen = np.array([guess.first, guess.second]), np.zeros(2)
    for _ in range(10):  # coarse grids, until one fits the patch
        if np.allclose(axes, seen, rtol=0.03):
            break
        seen, (axes, _, _) = axes, _press(setting, axes, _COARSE, parabolic)
    axes, spacing, found = _press(setting, axes, cells, parabolic)
    if axes[0] > MAX_SINK * setting.indenter_radius:
        raise ContactError(
            "the patch is nearly as wide as the indenter",
            value=f"a/indenter radius = {axes[0] / setting.indenter_radius:.2f}",
            limit=MAX_SINK,
            remedy="lower the force, or raise the modulus or the indenter's radius",
        )
    peak = float(found.pressure.max())
    axes = np.array([axes[0], min(axes)])  # equal but for rounding on a circle
    return GridPatch(
        axes, peak, found.approach, "field", grid=found.pressure, spacing=(spacing[0], spacing[1])
    )


def _press(
    setting: ContactProblem, axes: Array, cells: int, parabolic: bool
) -> tuple[Array, list[float], Pressing]:
    """Semi-axes (2,), m, of the patch on a grid for one with `axes`; the cells' size; the rest."""
    dx, dy = (2 * _ROOM / cells * axes).tolist()
    count = np.arange(cells) - (cells - 1) / 2
    x, y = np.meshgrid(dx * count, dy * count, indexing="ij")
    low, high = np.sort(setting.pair)
    gap = sphere_gap(x, y, (low, high), setting.indenter_radius, parabolic)
    influence = Influence(
        (cells, cells), (dx, dy), setting.e_star, setting.poisson, setting.thickness
    )
    start = np.maximum(1 - (x / axes[0]) ** 2 - (y / axes[1]) ** 2, 0.0) ** 0.6
    found = press(gap, influence, setting.force, dx * dy, start)
    contact = found.pressure > 0
    # a uniform ellipse has the second moments a^2/4 and b^2/4
    axes = np.array([2 * math.sqrt(float(np.mean(v[contact] ** 2))) for v in (x, y)])
    return axes, [dx, dy], found


def sphere_gap(
    x: Array, y: Array, pair: tuple[float, float], indenter_radius: float, parabolic: bool
) -> Array:
    """Gap, m, at (x, y), m, of a sphere on a body with the curvatures `pair` along x and y."""
    square = x * x + y * y
    bend = pair[0] * x * x + pair[1] * y * y
    if parabolic:
        return (bend + square / indenter_radius) / 2

    def arc(bend: Array, square: Array) -> Array:  # of a circle with curvature bend / square
        slope = bend * bend / np.maximum(square, 1e-300)
        return bend / (1 + np.sqrt(np.maximum(1 - slope, 0.0)))

    return arc(bend, square) + arc(square / indenter_radius, square)
