"""Open meshes over a square, for tests of several folders."""

from collections.abc import Callable

import numpy as np

from meshskin.core.arrays import Array, Index


def height_field(
    height: Callable[[Array, Array], Array], half: float, count: int = 41
) -> tuple[Array, Index]:
    """Vertices (count^2, 3), m, and faces of z = height(x, y) over a square of half the side."""
    x, y = np.meshgrid(*[np.linspace(-half, half, count)] * 2, indexing="ij")
    k = np.arange(count * count).reshape(count, count)
    a, b, c, d = (v.ravel() for v in (k[:-1, :-1], k[1:, :-1], k[1:, 1:], k[:-1, 1:]))
    faces = np.concatenate([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    return np.stack([x, y, height(x, y)], axis=-1).reshape(-1, 3), faces
