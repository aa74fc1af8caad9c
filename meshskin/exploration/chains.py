"""Chains of points, as the parts of lanes are: their lengths, directions, samples and runs, and the
gaps between the pieces of a surface that they cross.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import Array, Index, runs
from ..geometry.surface.closest_point import Closest
from ..geometry.surface.surface import Surface

GAP = 0.5e-3
"""Gap between pieces of a mesh, m, above which they are apart. A sphere of 5 mm radius sinks 6 um
into it; meshes of one surface in several pieces have smaller ones at their seams."""
HALVINGS = 12
"""Halvings of the way between two samples: 1 um remains of 4 mm."""


def crosses_gap(surface: Surface, start: Closest, end: Closest) -> NDArray[np.bool_]:
    """Whether there is a gap above GAP between pieces of the surface from points to others (k,)."""
    out = surface.pieces[start.face] != surface.pieces[end.face]
    rows = np.flatnonzero(out)
    one, two, piece = start.point[rows], end.point[rows], surface.pieces[start.face[rows]]
    for _ in range(HALVINGS if len(rows) else 0):
        middle = surface.nearest(0.5 * (one + two))
        here = (surface.pieces[middle.face] == piece)[:, None]
        one, two = np.where(here, middle.point, one), np.where(here, two, middle.point)
    out[rows] = np.linalg.norm(two - one, axis=1) > GAP
    return out


def gaps_along(surface: Surface, chain: Closest) -> NDArray[np.bool_]:
    """Whether a chain crosses a gap before each of its points (k,); False at the first."""
    crossed = crosses_gap(surface, chain.take(slice(-1)), chain.take(slice(1, None)))
    return np.append(False, crossed)


def gradient(points: Array, ends: Index) -> Array:
    """`np.gradient` (k, 3) of the points (k, 3) of chains of two or more, which stop at `ends`."""
    out = np.empty_like(points)
    out[1:-1] = 0.5 * (points[2:] - points[:-2])
    out[ends - 1] = points[ends - 1] - points[ends - 2]
    first = np.append(0, ends[:-1])
    out[first] = points[first + 1] - points[first]
    return out


def chain_runs(mask: NDArray[np.bool_], ends: Index) -> list[slice]:
    """The runs of True values of chains, which stop at `ends`."""
    apart = runs(np.insert(mask, ends[:-1], False))
    chain = np.searchsorted(ends + np.arange(len(ends)), [run.start for run in apart], side="right")
    return [slice(r.start - k, r.stop - k) for r, k in zip(apart, chain.tolist(), strict=True)]


def lengths_along(points: Array) -> Array:
    """Lengths (k,), m, from the start of a polyline (k, 3) to its points."""
    return np.append(0.0, np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1)))


def evenly(points: Array, step: float, least: int) -> Array:
    """Points evenly about `step`, m, apart on the polyline (k, 3), in `least` intervals or more."""
    s = lengths_along(points)
    even = np.linspace(0.0, s[-1], max(round(s[-1] / step), least) + 1)
    return np.stack([np.interp(even, s, x) for x in points.T], axis=1)


def joined_runs(mask: NDArray[np.bool_], gap: int) -> list[slice]:
    """The runs of True values, joined over gaps of up to `gap` samples."""
    filled = mask.copy()
    for run in runs(~mask):
        if run.start > 0 and run.stop < len(mask) and run.stop - run.start <= gap:
            filled[run] = True
    return runs(filled)
