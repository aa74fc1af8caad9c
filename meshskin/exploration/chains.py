"""Chains of points, as the parts of lanes are: their lengths, directions, samples and runs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import Array, Index, runs


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
