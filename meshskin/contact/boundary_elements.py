"""The contact model "field": boundary elements on a grid, for any gap, half-space or bonded layer.

The pressure p >= 0 of total force F minimizes 1/2 p.Kp + p.gap. It is computed by the constrained
conjugate gradients of I. A. Polonsky and L. M. Keer, Wear 231 (1999), with the convolution K p by
FFT on a doubled grid, without periodic images.

Libraries weighed: tamaas has free surroundings for a half-space only, and its licence is the AGPL;
ContactMechanics has a layer of finite thickness only with periodic images, and needs muFFT and
NuMPI. Neither has a bonded layer with free surroundings. tamaas is the oracle of the tests.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from ..core.arrays import Array
from ..core.errors import ContactError
from . import elliptic
from .influence import Influence
from .patch import Patch
from .problem import ContactProblem, check_ratio

CELLS = 96
"""Default number of cells along each side of the grid: peak and depth are within 0.1 % of the
ellipse, the semi-axes within 0.6 % (tests/contact/test_boundary_elements.py)."""
COARSE_CELLS = 48
"""Cells along each side of the grids that locate the edge of the patch, a quarter of CELLS^2."""
MAX_ITERATIONS = 500
"""Most iterations of the conjugate gradients: 24 at a ratio of curvatures of 21."""
MAX_RADIUS_RATIO = 0.8
"""Largest semi-axis, in indenter radii. Beyond it the flank of the sphere is too steep for a gap
measured along the normal."""
GRID_MARGIN = 1.12
"""Half the side of the grid in semi-axes: five cells beyond the edge of the patch."""


@dataclass(frozen=True)
class GridSolution:
    """Pressure and approach of a contact on a grid."""

    pressure: Array
    """Pressure (n, m), Pa, of the cells."""
    approach: float
    """Approach of the two bodies, m: displacement + gap within the contact."""
    iterations: int
    """Iterations of the conjugate gradients."""


@dataclass(frozen=True, eq=False)
class GridPatch(Patch):
    """A patch with its pressure on a grid; the semi-axes are computed from second moments."""

    grid: Array | None = None
    """Pressure (n, m), Pa, at the cells."""
    spacing: tuple[float, float] = (1.0, 1.0)
    """Size of a cell along x and y, m; the centre of the grid is the centre of the patch."""

    def pressure(self, xy: ArrayLike) -> Array:
        """Pressure (...), Pa, at points `xy` (..., 2), m, interpolated linearly."""
        from scipy.ndimage import map_coordinates

        grid = np.zeros((1, 1)) if self.grid is None else self.grid
        xy = np.asarray(xy, dtype=float)
        centre = (np.array(grid.shape) - 1) / 2
        index = (xy / self.spacing + centre).reshape(-1, 2).T
        values = map_coordinates(grid, index, order=1, mode="constant")
        return np.asarray(values.reshape(xy.shape[:-1]))

    def reading(self, xy: ArrayLike, disc_radius: float) -> Array:
        """Mean pressure (...), Pa, over discs at `xy` (..., 2), m: 12 rings of 32 points."""
        x, weight = np.polynomial.legendre.leggauss(12)
        ring = disc_radius * np.sqrt((1 + x) / 2)  # Gauss-Legendre in the area
        angle = 2 * np.pi * np.arange(32) / 32
        disc = ring[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        values = self.pressure(np.asarray(xy, dtype=float)[..., None, None, :] + disc)
        return np.asarray(values.mean(axis=-1) @ (weight / 2))


def solve_grid(
    gap: ArrayLike,
    influence: Influence,
    force: float,
    cell: float,
    start: Array | None = None,
    tolerance: float = 1e-4,
) -> GridSolution:
    """The contact of a rigid indenter with `gap` (n, m), m, pressed on a body by `force`, N.

    cell: area of a grid cell, m^2; start: initial pressures (n, m), in any unit; tolerance: sum of
    the changes of the pressures in the last iteration, relative to the force. Raises ContactError
    where the iterations do not converge, and for a gap or a force that is not finite or positive.
    """
    h = np.asarray(gap, dtype=float)
    if not (np.isfinite(h).all() and math.isfinite(force) and force > 0):
        raise ContactError("gap and force must be finite, the force positive", value=f"{force} N")
    total = force / cell
    p = np.ones_like(h) if start is None else np.maximum(start, 0.0)
    p *= total / p.sum()
    direction, last_norm, conjugate = np.zeros_like(h), 1.0, 0.0
    for iteration in range(1, MAX_ITERATIONS + 1):
        g = influence(p) + h
        contact = p > 0
        approach = float(g[contact].mean())
        g -= approach
        inside = np.where(contact, g, 0.0)
        norm = float(np.vdot(inside, inside))
        direction = np.where(contact, inside + conjugate * (norm / last_norm) * direction, 0.0)
        last_norm = norm
        change = influence(direction)
        change -= change[contact].mean()
        curvature = float(np.vdot(direction, change))
        if curvature <= 0:  # zero gradient: the contact is one cell, or solved
            return GridSolution(p, approach, iteration)
        step = float(np.vdot(inside, direction)) / curvature
        new = np.maximum(p - step * direction, 0.0)
        overlap = (new == 0) & (g < 0)
        conjugate = 0.0 if overlap.any() else 1.0
        new[overlap] -= step * g[overlap]
        new *= total / new.sum()
        moved = float(np.abs(new - p).sum())
        p = new
        if moved < tolerance * total:
            return GridSolution(p, approach, iteration)
    raise ContactError(
        "the boundary elements do not converge",
        value=f"change {moved / total:.2g} of the force",
        limit=f"{tolerance:g} in {MAX_ITERATIONS} iterations",
        remedy="use a smoother gap or a finer grid",
    )


def solve(problem: ContactProblem, *, cells: int = CELLS, parabolic: bool = False) -> GridPatch:
    """The patch of a rigid sphere on a body by boundary elements.

    cells: number along a side of the grid; parabolic: the gap of Hertz instead of that of a sphere
    on a body whose normal sections are circles. Raises ContactError for a contact out of range: a
    patch nearly as wide as the indenter, a layer thinner than a cell.
    """
    check_ratio(problem.curvature_ratio, elliptic.MAX_CURVATURE_RATIO, "field")
    if problem.force == 0:
        return GridPatch(np.zeros(2), 0.0, 0.0, "field")
    low, high = np.sort(problem.curvature_pair)
    guess = elliptic.patches(
        problem.force, np.array([low, high]), problem.indenter_radius, problem.effective_modulus
    )
    axes, previous = np.array([guess.first, guess.second]), np.zeros(2)
    for _ in range(10):  # coarse grids, until one fits the patch
        if np.allclose(axes, previous, rtol=0.03):
            break
        previous, (axes, _, _) = axes, _solve_scaled(problem, axes, COARSE_CELLS, parabolic)
    axes, spacing, found = _solve_scaled(problem, axes, cells, parabolic)
    if axes[0] > MAX_RADIUS_RATIO * problem.indenter_radius:
        raise ContactError(
            "the patch is nearly as wide as the indenter",
            value=f"a/indenter radius = {axes[0] / problem.indenter_radius:.2f}",
            limit=MAX_RADIUS_RATIO,
            remedy="lower the force, or raise the modulus or the indenter's radius",
        )
    peak = float(found.pressure.max())
    axes = np.array([axes[0], min(axes)])  # equal but for rounding on a circle
    return GridPatch(
        axes, peak, found.approach, "field", grid=found.pressure, spacing=(spacing[0], spacing[1])
    )


def _solve_scaled(
    problem: ContactProblem, axes: Array, cells: int, parabolic: bool
) -> tuple[Array, list[float], GridSolution]:
    """The contact on a grid that fits a patch with semi-axes `axes` (2,), m.

    Semi-axes (2,), m, of the solved patch; size of the cells, m; pressure and approach.
    """
    dx, dy = (2 * GRID_MARGIN / cells * axes).tolist()
    count = np.arange(cells) - (cells - 1) / 2
    x, y = np.meshgrid(dx * count, dy * count, indexing="ij")
    low, high = np.sort(problem.curvature_pair)
    gap = sphere_gap(x, y, (low, high), problem.indenter_radius, parabolic)
    influence = Influence(
        (cells, cells), (dx, dy), problem.effective_modulus, problem.poisson, problem.thickness
    )
    start = np.maximum(1 - (x / axes[0]) ** 2 - (y / axes[1]) ** 2, 0.0) ** 0.6
    found = solve_grid(gap, influence, problem.force, dx * dy, start)
    contact = found.pressure > 0
    # a uniform ellipse has the second moments a^2/4 and b^2/4
    axes = np.array([2 * math.sqrt(float(np.mean(v[contact] ** 2))) for v in (x, y)])
    return axes, [dx, dy], found


def sphere_gap(
    x: Array, y: Array, pair: tuple[float, float], indenter_radius: float, parabolic: bool
) -> Array:
    """Gap, m, at (x, y), m, of a sphere on a body with the curvatures `pair` along x and y."""
    square = x * x + y * y
    body = pair[0] * x * x + pair[1] * y * y  # curvature along (x, y), times the square
    if parabolic:
        return (body + square / indenter_radius) / 2

    def arc(bend: Array) -> Array:  # height of a circle of curvature bend / square
        slope = bend * bend / np.maximum(square, 1e-300)  # square of the sine
        return bend / (1 + np.sqrt(np.maximum(1 - slope, 0.0)))

    return arc(body) + arc(square / indenter_radius)
