"""Positions whose distances agree with given ones: plane taxels, rigid modules, taxels on a body.

What is minimized is the stress, the sum of w_ij (d_ij - s L_ij)^2 over all pairs, with
w_ij = 1 / L_ij^2: relative errors count, since path lengths err in proportion to their number of
steps at least.

Sources: Torgerson, Psychometrika 17 (1952) (start); De Leeuw, "Applications of convex analysis to
multidimensional scaling" (1977) (majorization); De Leeuw, Heiser, "Multidimensional scaling with
restrictions on the configuration" (1980) (longer steps); Kamada, Kawai, Inf. Process. Lett. 31
(1989) (weights). scikit-learn's SMACOF was weighed: it has no weights, and points alone.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree

from ...core.arrays import Array
from ...core.errors import CalibrationError

LEAST = 0.1
"""Least length, in radii of the touches, in the weights: shorter ones are not known better."""
TOLERANCE = 1e-5
"""Root mean square step, in radii of the touches, at which the majorization has converged."""
NEIGHBOURS = 3
"""Neighbours at one distance that a taxel has in lattices of triangles, squares and hexagons."""
RELAXATION = 1.8
"""Steps of the majorization are longer by this factor: at 2 they are twice as fast, but the size of
the layout then oscillates for ever (De Leeuw, Heiser 1980)."""
ITERATIONS = 500
"""Most steps of the majorization, which converges linearly; the torso of iCub takes about 100."""


def weights(lengths: Array) -> Array:
    """Weights (n, n) of the pairs, 0 on the diagonal."""
    weight = 1.0 / np.maximum(lengths, LEAST) ** 2
    np.fill_diagonal(weight, 0.0)
    return weight


def in_plane(lengths: Array, start: Array | None = None) -> Array:
    """Plane positions (n, 2) of least stress for finite `lengths` (n, n), in their unit.

    start (n, 2): by default classical scaling. Raises CalibrationError for fewer than 4 taxels.
    """
    n = len(lengths)
    if n < 4:
        raise CalibrationError(
            "too few taxels answer together for a layout",
            value=n,
            limit="at least 4",
            remedy="record touches that cover several taxels",
        )
    if start is None:
        centring = np.eye(n) - 1.0 / n
        values, vectors = np.linalg.eigh(-0.5 * centring @ lengths**2 @ centring)
        start = vectors[:, -2:] * np.sqrt(np.maximum(values[-2:], 0.0))
    points, weight = start, weights(lengths)
    laplacian = np.diag(weight.sum(axis=1)) - weight
    # the null space is the common translation: adding ones makes it regular
    inverse = np.linalg.inv(laplacian + 1.0 / n) - 1.0 / n
    target = weight * lengths
    for _ in range(ITERATIONS):
        ratio = target / np.maximum(distances(points), 1e-12)
        np.fill_diagonal(ratio, 0.0)
        moved = inverse @ (ratio.sum(axis=1)[:, None] * points - ratio @ points)
        step = float(np.sqrt(np.mean((moved - points) ** 2)))
        points = points + RELAXATION * (moved - points)
        if step < TOLERANCE:
            break
    return points


def misfit(along: Array, lengths: Array, unit: float) -> float:
    """Root mean square relative error of distances `along` (n, n), m, for `lengths` in a unit."""
    weight = weights(lengths)
    return float(np.sqrt(np.sum(weight * (along / unit - lengths) ** 2) / np.count_nonzero(weight)))


def distances(points: Array) -> Array:
    """Distances (n, n) of points (n, D)."""
    square = np.sum(points**2, axis=1)
    return np.sqrt(np.maximum(square[:, None] + square - 2.0 * points @ points.T, 0.0))


def neighbour_spacing(positions: Array) -> float:
    """Median of the mean distances of taxels at `positions` (n, D) from their NEIGHBOURS nearest.

    The nearest one alone is too near where positions err.
    """
    near = KDTree(positions).query(positions, NEIGHBOURS + 1)[0][:, 1:]
    return float(np.median(near.mean(axis=1)))
