"""The elimination of fronts in NumPy, where there is no C compiler: what fronts.c does."""

from __future__ import annotations

import numpy as np
from scipy.linalg import lapack, solve_triangular

from ...core.se3 import Array
from .ordering import Long
from .symbolic_factorization import SymbolicFactorization


def add(
    fronts: SymbolicFactorization,
    size: int,
    rows: Long,
    columns: Long,
    blocks: Array,
    panels: Array,
) -> None:
    """Add blocks (k, size, size) between nodes `rows` and `columns` to the panels."""
    a, b, heights = fronts.place[rows], fronts.place[columns], np.diff(fronts.start)
    values = np.where((a < b)[:, None, None], np.swapaxes(blocks, 1, 2), blocks)
    a, b = np.maximum(a, b), np.minimum(a, b)
    f, nodes = fronts.front[b], len(fronts.place)
    names = np.repeat(np.arange(len(heights)), heights) * nodes + fronts.rows  # sorted
    row = np.searchsorted(names, f * nodes + a) - fronts.start[f]
    leading, column = size * heights[f], b - fronts.rows[fronts.start[f]]
    corner = size * (size * fronts.panel[f] + column * leading + row)
    r, c = np.arange(size)[:, None], np.arange(size)
    np.add.at(panels, corner[:, None, None] + leading[:, None, None] * c + r, values)


def eliminate(fronts: SymbolicFactorization, size: int, least: float, panels: Array) -> int:
    """Factorise what is in the panels; 0, or 1 + the node whose pivot is not positive."""
    waiting: list[list[tuple[Long, Array]]] = [[] for _ in fronts.parent]
    for f, parent in enumerate(fronts.parent.tolist()):
        panel, width = _panel(fronts, size, f, panels), size * int(fronts.pivots[f])
        scale = np.diagonal(panel).copy()
        rest = np.zeros((len(panel) - width,) * 2)
        for at, update in waiting[f]:
            near, far = at[at < width], at[at >= width] - width
            panel[np.ix_(at, near)] += update[:, : len(near)]
            rest[np.ix_(far, far)] += update[len(near) :, len(near) :]
        waiting[f] = []
        factor, fault = lapack.dpotrf(panel[:width], lower=1, clean=1)
        good = np.diagonal(factor) ** 2 > least * scale
        if fault or not good.all():
            column = fault - 1 if fault else int(np.argmin(good))
            return 1 + int(fronts.order[_places(fronts, f)[0] + column // size])
        panel[:width] = factor
        if len(rest):
            panel[width:] = solve_triangular(factor, panel[width:].T, lower=True).T
            waiting[parent].append((_ups(fronts, size, f), rest - panel[width:] @ panel[width:].T))
    return 0


def solve(fronts: SymbolicFactorization, size: int, right: Array, panels: Array) -> Array:
    """x with `right` (nodes, size, k)."""
    y = right[fronts.order].reshape(-1, right.shape[-1])
    pieces = []
    for f in range(len(fronts.parent)):
        panel, width = _panel(fronts, size, f, panels), size * int(fronts.pivots[f])
        at = _scalars(_places(fronts, f), size)
        y[at[:width]] = solve_triangular(panel[:width], y[at[:width]], lower=True)
        y[at[width:]] -= panel[width:] @ y[at[:width]]
        pieces.append((panel, width, at))
    for panel, width, at in reversed(pieces):
        own = y[at[:width]] - panel[width:].T @ y[at[width:]]
        y[at[:width]] = solve_triangular(panel[:width], own, lower=True, trans=1)
    return np.asarray(y.reshape(right.shape)[fronts.place])


def invert(fronts: SymbolicFactorization, size: int, blocks: Array, panels: Array) -> None:
    """Diagonal blocks (nodes, size, size) of the inverse, written to `blocks`."""
    handed: dict[int, Array] = {}
    for f in range(len(fronts.parent) - 1, -1, -1):
        panel, width = _panel(fronts, size, f, panels), size * int(fronts.pivots[f])
        root = lapack.dtrtri(panel[:width], lower=1)[0]
        side, whole = panel[width:] @ root, np.empty((len(panel),) * 2)
        whole[:width, :width] = root.T @ root
        if len(side):
            far = handed.pop(f)
            cross = -far @ side
            whole[width:, width:], whole[width:, :width] = far, cross
            whole[:width, :width] -= side.T @ cross
            whole[:width, width:] = cross.T
        child = f - 1
        while child > f - fronts.span[f]:
            at = _ups(fronts, size, child)
            handed[child] = whole[np.ix_(at, at)]
            child -= int(fronts.span[child])
        own = whole[:width, :width].reshape(-1, size, width // size, size)
        each = np.arange(width // size)
        blocks[fronts.order[_places(fronts, f)[: width // size]]] = own[each, :, each, :]


def _panel(fronts: SymbolicFactorization, size: int, f: int, panels: Array) -> Array:
    """(height, width) of front f."""
    width, height = size * int(fronts.pivots[f]), size * len(_places(fronts, f))
    first = size * size * int(fronts.panel[f])
    return panels[first : first + width * height].reshape(width, height).T


def _places(fronts: SymbolicFactorization, f: int) -> Long:
    return fronts.rows[fronts.start[f] : fronts.start[f + 1]]


def _ups(fronts: SymbolicFactorization, size: int, f: int) -> Long:
    """Rows of the parent, scalar by scalar."""
    return _scalars(fronts.up[fronts.start[f] + fronts.pivots[f] : fronts.start[f + 1]], size)


def _scalars(places: Long, size: int) -> Long:
    return np.asarray((size * places[:, None] + np.arange(size)).ravel())
