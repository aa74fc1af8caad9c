"""Level sets on a grid as triangle meshes, by surface nets.

Each cell that the level set passes gets one vertex, and each edge of the grid that it crosses one
quadrilateral. Unlike those of marching cubes, the triangles have no slivers, which a fit of smooth
patches does not stand. Source: Gibson, "Constrained elastic surface nets", MICCAI (1998).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ...core.arrays import Array, Index, means_by_group


def surface_nets(values: NDArray[np.floating]) -> tuple[Array, Index]:
    """Vertices (n, 3), in grid steps, and faces (m, 3) of the level set 0 of values (a, b, c).

    Normals point to where the values are positive. The level set must not meet the outer nodes.
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
