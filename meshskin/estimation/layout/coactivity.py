"""Distances of taxels from how often they answer together.

The share of the frames in which both of two taxels answer, among those in which either does (the
Jaccard index), falls with their distance: for touches that are discs of one radius, spread evenly,
it is that of two discs, whatever their radius, which is the unit of distance here. Graded readings
count once for each level that they reach, and each level has its own radius. Distances of taxels
that no touch joins are lengths of shortest paths over those that some do.

Sources: Jaccard, Bulletin de la Societe vaudoise des sciences naturelles 37 (1901); Tenenbaum,
de Silva, Langford, Science 290 (2000) (paths).
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from scipy.sparse import csr_array
from scipy.sparse.csgraph import shortest_path

from ...core.arguments import check_array
from ...core.arrays import Array
from ...core.errors import CalibrationError

LEVELS = 4
"""Levels of graded readings, with equally many readings each: eight change the errors on the
shipped scenes by at most 0.33 mm, either way (studies/coactivation.py --levels)."""
NEAR = 0.1
"""Index from which two taxels are near: below, the few shared frames are chance, and the distance
depends on the largest touches alone."""
SHARED = 2
"""Frames that near taxels share at least: one may be a false response."""
CURVE = 1001
"""Points of the curve of index against distance, which is smooth."""


def distinct_levels(frames: ArrayLike) -> np.ndarray:
    """Levels (m', n) int, from 0, silent, of readings `frames` (m, n) that are 0 where silent.

    A frame that repeats the one before it, or is silent, is left out: a touch that rests says
    nothing new. Raises CalibrationError.
    """
    values = check_array("frames of a layout", frames, error=CalibrationError)
    if values.ndim != 2:
        raise CalibrationError(
            "frames of a layout need a row per frame and a column per taxel",
            value=f"shape {values.shape}",
            limit="(frames, taxels)",
        )
    if not np.isfinite(values).all() or (values < 0).any():
        raise CalibrationError(
            "frames of a layout must be finite and not negative",
            remedy="subtract the level at rest, and set what is below the noise to 0",
        )
    active = values[values > 0]
    if not len(active):
        raise CalibrationError("no taxel answers in any frame of the layout")
    edges = np.unique(np.quantile(active, np.arange(1, LEVELS) / LEVELS, method="lower"))
    levels = (values > 0).astype(np.int8)
    for edge in edges[edges < active.max()]:
        levels += values > edge
    changed = np.concatenate([[True], np.any(np.diff(levels, axis=0) != 0, axis=1)])
    return np.asarray(levels[changed & (levels.max(axis=1) > 0)])


def index(levels: np.ndarray, weight: Array | None = None) -> tuple[Array, Array]:
    """Index (n, n), 0 to 1, and number of shared frames (n, n) of taxels, from levels (m, n).

    weight (m,): how much each frame counts, by default 1.
    """
    shared, either = [np.zeros((levels.shape[1],) * 2) for _ in range(2)]
    frames = np.zeros_like(shared)
    for level in range(1, int(levels.max()) + 1):
        reached = csr_array((levels >= level).astype(float))
        weighted = reached if weight is None else reached.multiply(weight[:, None]).tocsr()
        both = (reached.T @ weighted).toarray()
        count = np.diag(both)
        shared += both
        either += count[:, None] + count[None] - both
        frames = both if level == 1 else frames
    return shared / np.maximum(either, 1e-12), frames


def disc_distances(values: Array, radii: Array) -> Array:
    """Distances, from 2 to 0, at which discs of the `radii` (k,) have the index `values`.

    Taxels at a distance d share 2 r^2 acos(d / 2r) - (d / 2) sqrt(4 r^2 - d^2) of the touches'
    centres at each level.
    """
    distance = np.linspace(0.0, 2.0, CURVE)
    half = np.clip(distance[:, None] / (2.0 * radii), 0.0, 1.0)
    overlap = (2 * radii**2 * (np.arccos(half) - half * np.sqrt(1 - half**2))).sum(axis=1)
    curve = overlap / (2 * np.pi * np.sum(radii**2) - overlap)
    return np.interp(values, curve[::-1], distance[::-1])


def near_lengths(levels: np.ndarray, weight: Array | None = None) -> Any:
    """Distances, in radii of the touches, of near taxels: a sparse array (n, n).

    weight (m,): how much each frame counts, by default 1.
    """
    values, frames = index(levels, weight)
    near = (values >= NEAR) & (frames >= SHARED)
    np.fill_diagonal(near, False)
    i, j = np.nonzero(near)
    areas = [np.count_nonzero(levels >= k) for k in range(1, int(levels.max()) + 1)]
    radii = np.sqrt(np.array(areas) / areas[0])  # of each level's disc, in those of the first
    length = np.maximum(disc_distances(values[i, j], radii), 1e-6)  # 0: no edge
    return csr_array((length, (i, j)), shape=values.shape)


def path_lengths(levels: np.ndarray, weight: Array | None = None) -> Array:
    """Lengths (n, n), in radii of the touches, of shortest paths between taxels, or inf.

    weight (m,): how much each frame counts, by default 1.
    """
    # each pair is in the graph both ways, so that a directed search finds the same in half the time
    return np.asarray(shortest_path(near_lengths(levels, weight)))


def largest_part(lengths: Array) -> np.ndarray:
    """Taxels (n,) bool of the largest part that paths of `lengths` (n, n) join."""
    joined = np.isfinite(lengths)
    return np.asarray(joined[np.argmax(joined.sum(axis=1))])


def strokes(levels: np.ndarray) -> np.ndarray:
    """Stroke (m,), from 0, of each frame: it ends where no taxel of its first frame answers.

    Frames of one stroke are of nearly the same touch, and err together.
    """
    active = levels > 0
    number, first = np.zeros(len(levels), dtype=np.intp), active[0]
    for k in range(1, len(levels)):
        ended = not np.any(first & active[k])
        first = active[k] if ended else first
        number[k] = number[k - 1] + ended
    return number
