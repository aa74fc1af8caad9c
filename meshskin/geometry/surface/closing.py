"""The outer surface of a skin on a body: an offset surface, closed at a scale.

A ball of radius `feature` that rolls over the skin from outside does not get into what is smaller
than itself: screw holes, steps, seams between parts, notches. The places of its centre are the
points farther than thickness + feature from the body, as far as they are connected with the far
field; the closed surface is at the distance `feature` from them. Where the ball touches one point
of the body, that is the offset surface; elsewhere it bridges. No sign of a distance is needed, so
that open meshes, and parts within others, serve as well.

Source: Serra, "Image Analysis and Mathematical Morphology" (1982), closing by a ball.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import Array, Index, means_by_group
from ...core.errors import MeshError
from ..mesh.triangles import Triangles
from .surface import Facets, Surface

LEVELS = 4
"""Halvings from the coarsest blocks of the grid to its nodes."""
TOUCHES = 2e-3
"""Overlap of the ball with the body, in grid steps, up to which it touches it at one point."""
RELAXATIONS = 3
"""Rounds in which the vertices move to the mean of their neighbours and back onto the surface."""
SHIFT = (-0.382, -0.276, -0.171)
"""Shift of the grid, in steps: planes of a mesh at round coordinates then miss its nodes."""
TINY = 1e-9
"""Least distance from the level set of a node that is not outside, m."""
EXACT = 1e-7
"""Error of the distance up to which a vertex counts as one where the skin lies on the body, m."""
BRIDGED = 0.1e-3
"""Distance above the skin's thickness from which a place counts as bridged, m."""
MAX_NODES = 60_000_000
"""Largest number of nodes of the grid (0.5 GB)."""

Distance = Callable[[Array], Array]
"""Distances (n,), m, of points (n, 3)."""


def closed_offset(
    surface: Surface, thickness: float, feature: float, step: float
) -> tuple[Array, Index]:
    """The surface at `thickness` above a surface, closed by a ball of radius `feature`, in m.

    Vertices (n, 3), m, and faces (m, 3), counter-clockwise seen from outside. step: of the grid, m,
    which is about the length of the edges. Raises MeshError for a step too coarse or too fine.
    """
    reach = thickness + feature
    coarsest = min(4.0 * thickness, 0.5 * feature)
    if step > coarsest:
        raise MeshError(
            "the resolution of a skinned surface is too coarse", value=f"{1e3 * step:.3g} mm",
            limit=f"{1e3 * coarsest:.3g} mm: 4 thicknesses or half a feature",
            remedy="give a smaller resolution",
        )  # fmt: skip
    low = surface.vertices.min(axis=0) - reach - 3.0 * step + step * np.array(SHIFT)
    size = np.ptp(surface.vertices, axis=0) + 2.0 * (reach + 3.0 * step)
    blocks = np.ceil(size / (step * 2**LEVELS)).astype(int)

    nodes = int(np.prod(blocks)) * 8**LEVELS
    if nodes > MAX_NODES:
        raise MeshError(
            "the grid of a skinned surface is too large", value=f"{nodes} nodes",
            limit=MAX_NODES, remedy="give a larger feature or resolution",
        )  # fmt: skip

    from_body = _band(lambda p: np.abs(surface.nearest(p).distance), low, blocks, step, reach)
    away = _outside(from_body - reach)
    last = np.array(away.shape) - 1
    centres = _on_grid(away, low, step)
    hit = surface.nearest(centres[0])
    centres = (hit.point + reach * _unit(centres[0] - hit.point, hit.normal), centres[1])
    rolling = _Rolling(surface, thickness, feature, centres, TOUCHES * step)

    def from_centres(points: Array) -> Array:
        near = rolling.nearest(points)
        node = np.round((points - low) / step).astype(int).clip(0, last)
        outside = away[tuple(node.T)] > 0
        return np.where(outside, -1.0, 1.0) * np.linalg.norm(points - near, axis=1)

    depth = _band(from_centres, low, blocks, step, feature)
    vertices, faces = _on_grid(feature - depth, low, step)
    vertices = rolling.project(vertices)
    for _ in range(RELAXATIONS):
        vertices = rolling.project(_relaxed(vertices, faces))
    return vertices, faces


def statement(skinned: Surface, surface: Surface, thickness: float) -> str:
    """What a skinned surface bridges of another one, and the error of its distance elsewhere.

    The error is that of the smooth surface at the middles of faces whose corners are exact.
    """
    gap = np.abs(surface.nearest(skinned.vertices).distance) - thickness
    a, b, c = (skinned.vertices[skinned.faces[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    share = float(area @ (gap[skinned.faces] > BRIDGED).mean(axis=1) / area.sum())
    exact = np.flatnonzero((np.abs(gap[skinned.faces]) < EXACT).all(axis=1))
    middle = skinned.at(exact, np.full((len(exact), 2), 1.0 / 3.0)).point
    off = np.abs(np.abs(surface.nearest(middle).distance) - thickness)
    error = float(np.quantile(off, 0.95)) if len(off) else 0.0
    return (
        f"skin of {1e3 * thickness:.3g} mm: bridges {100 * share:.2g} % of its surface by more "
        f"than {1e3 * BRIDGED:g} mm, at most {1e3 * gap.max():.3g} mm; elsewhere 95 % of it are "
        f"within {1e3 * error:.2g} mm of that distance"
    )


class _Rolling:
    """A ball that rolls over a skin: the surface of its centres, and the surface that it leaves."""

    def __init__(
        self, surface: Surface, thickness: float, feature: float, centres: tuple[Array, Index],
        tolerance: float,
    ) -> None:  # fmt: skip
        self._surface, self._thickness, self._feature = surface, thickness, feature
        self._tolerance = tolerance
        self._centres = Facets(Triangles(*centres))

    def nearest(self, points: Array) -> Array:
        """The places (n, 3) of the ball's centre that are nearest to points (n, 3)."""
        return self._centres.closest(points)[0]

    def project(self, points: Array) -> Array:
        """Points (n, 3) near the closed surface, moved onto it."""
        hit = self._surface.nearest(points)
        normal = _unit(points - hit.point, hit.normal)
        reach = self._thickness + self._feature
        gap = np.abs(self._surface.nearest(hit.point + reach * normal).distance)
        touches = gap > reach - self._tolerance
        centre = self.nearest(points)
        inward = _unit(points - centre, -normal)
        exact = hit.point + self._thickness * normal
        return np.where(touches[:, None], exact, centre + self._feature * inward)


def _band(
    distance: Distance, low: Array, blocks: Index, step: float, level: float
) -> NDArray[np.float32]:
    """Distances at the nodes of a grid, exact near `level` and elsewhere on the right side of it.

    Blocks are halved where the level may be within them: a distance changes by at most the distance
    moved.
    """
    values = np.full(blocks, level, dtype=np.float32)
    for depth in range(LEVELS, -1, -1):
        size = step * 2**depth
        # the node at the middle of a block: half the grid's step off the middle at most
        reach = 0.5 * np.sqrt(3.0) * (size + step) if depth else 2.0 * step
        rows = np.nonzero(np.abs(values - level) <= (np.sqrt(3.0) * size + reach))
        offset = 0.5 * (2**depth - 1)
        points = low + step * (2**depth * np.stack(rows, axis=1) + offset)
        values[rows] = distance(points)
        if depth:
            for axis in range(3):
                values = np.repeat(values, 2, axis=axis)
    return values


def _outside(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """The values (a, b, c), negative where no positive ones connect them to the corner."""
    from scipy.ndimage import label

    parts = label(values > 0.0)[0]
    return np.where(parts == parts[0, 0, 0], values, -np.maximum(np.abs(values), TINY))


def _on_grid(values: NDArray[np.float32], low: Array, step: float) -> tuple[Array, Index]:
    """The level set 0 of values at the nodes of a grid: vertices, m, and faces."""
    vertices, faces = surface_nets(values)
    return low + step * vertices, faces


def _relaxed(vertices: Array, faces: Index) -> Array:
    """The vertices (n, 3) at the means of their neighbours."""
    from scipy.sparse import coo_array

    ends = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    count = len(vertices)
    beside = coo_array((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), (count, count)).tocsr()
    return np.asarray((beside @ vertices) / beside.sum(axis=1)[:, None])


def _unit(vectors: Array, otherwise: Array) -> Array:
    """The directions (n, 3) of vectors; `otherwise` (n, 3) for those without length."""
    length = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.where(length > 1e-9, vectors / np.maximum(length, 1e-9), otherwise)


def surface_nets(values: NDArray[np.floating]) -> tuple[Array, Index]:
    """Vertices (n, 3), in grid steps, and faces (m, 3) of the level set 0 of values (a, b, c).

    Each cell that the level set passes gets one vertex, each edge of the grid that it crosses one
    quadrilateral. Unlike those of marching cubes, the triangles have no slivers, which a fit of
    smooth patches does not stand. Normals point to where the values are positive. The level set
    must not meet the outer nodes.

    Source: Gibson, "Constrained elastic surface nets", MICCAI (1998).
    """
    shape = np.array(values.shape)
    crossings, cells, quads = [], [], []
    for axis in range(3):
        turned = np.moveaxis(values, axis, 0)
        before, after = turned[:-1, 1:-1, 1:-1], turned[1:, 1:-1, 1:-1]
        at = np.nonzero((before < 0.0) != (after < 0.0))
        first, second = before[at].astype(float), after[at].astype(float)
        node = np.stack(at, axis=1) + np.array([0, 1, 1])
        point = node.astype(float)
        point[:, 0] += first / (first - second)
        around = node[:, None] - np.array([(0, 1, 1), (0, 0, 1), (0, 0, 0), (0, 1, 0)])
        order = np.argsort([axis, *(k for k in range(3) if k != axis)])
        cell = np.ravel_multi_index(np.moveaxis(around[..., order], -1, 0), tuple(shape))
        outward = (first < 0.0) != (axis == 1)  # the axes (1, 0, 2) are a left-handed system
        crossings.append(np.repeat(point[:, order], 4, axis=0))
        cells.append(cell.ravel())
        quads.append(np.where(outward[:, None], cell, cell[:, ::-1]))
    used, row = np.unique(np.concatenate(cells), return_inverse=True)
    vertices = means_by_group(np.concatenate(crossings), row)
    return vertices, _triangles(vertices, np.searchsorted(used, np.concatenate(quads)))


def _triangles(vertices: Array, quads: Index) -> Index:
    """The triangles (2 m, 3) of quadrilaterals (m, 4), cut along the shorter diagonal."""
    a, b, c, d = (vertices[quads[:, k]] for k in range(4))
    other = np.linalg.norm(c - a, axis=1) > np.linalg.norm(d - b, axis=1)
    quads = np.where(other[:, None], np.roll(quads, -1, axis=1), quads)
    return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])
