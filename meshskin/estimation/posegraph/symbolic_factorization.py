"""Fronts: what the elimination of a sparse symmetric matrix looks like, before any number.

A front is a dense matrix over some nodes: its pivots, which are eliminated together, and the later
nodes that they touch. Fronts form a tree; what is left of one is added to its parent.

Source: Liu, "The multifrontal method for sparse matrix solution", SIAM Review 34 (1992).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy import sparse

from .ordering import Integers, Long, elimination_order

WASTE = 0.3
"""Share of zeros that a front may hold for the sake of fewer, larger fronts."""


@dataclass(frozen=True, eq=False)
class SymbolicFactorization:
    """Fronts in the order of elimination, children before parents, a subtree without a gap."""

    order: Long
    """(nodes,) node at each place in the order of elimination."""
    place: Long
    """(nodes,) its inverse."""
    front: Long
    """(nodes,) the front that eliminates what is at a place."""
    start: Long
    """(fronts + 1,) the places of front f are rows[start[f] : start[f + 1]]."""
    rows: Long
    """Sorted places of each front; the first are its pivots, and follow each other."""
    up: Long
    """For each of `rows` but the pivots: which row of the parent it is."""
    pivots: Long
    """(fronts,) how many of the rows are eliminated here."""
    parent: Long
    """(fronts,) the front that takes up the rest; -1 for a root."""
    depth: Long
    """(fronts,) parents up to the root."""
    span: Long
    """(fronts,) fronts of the subtree, itself included: they end at the front itself."""
    panel: Long
    """(fronts + 1,) blocks in the pivots' columns of all fronts before."""
    stacks: tuple[int, int]
    """Most blocks of updates that wait at once, of fronts of even and of odd depth."""

    @property
    def work(self) -> tuple[int, int]:
        """Blocks of the largest panel, and rows of the largest front."""
        heights = np.diff(self.start)
        return int((self.pivots * heights).max(initial=0)), int(heights.max(initial=0))


def symbolic_factorization(nodes: int, rows: Integers, columns: Integers) -> SymbolicFactorization:
    """Fronts of the symmetric matrix with entries at `rows` and `columns`, either way round."""
    off = rows != columns
    i, j = np.concatenate([rows[off], columns[off]]), np.concatenate([columns[off], rows[off]])
    pattern = sparse.csr_array((np.ones(len(i)), (i, j)), shape=(nodes, nodes))
    order = np.asarray(elimination_order(pattern), dtype=np.int64)
    below = _below(pattern, order)
    moved = _postorder(np.array([b[0] if len(b) else -1 for b in below], dtype=np.int64))
    before = _inverse(moved)
    order = order[before]
    below = [moved[below[k]] for k in before.tolist()]  # on one path to the root: still sorted
    firsts = _merged(below)
    lasts = np.append(firsts[1:], nodes) - 1
    front = np.repeat(np.arange(len(firsts)), lasts - firsts + 1)
    touched = [below[last] for last in lasts.tolist()]
    parts = [
        np.concatenate([np.arange(f, k + 1), rest])
        for f, k, rest in zip(firsts, lasts, touched, strict=True)
    ]
    parent = np.array([front[t[0]] if len(t) else -1 for t in touched], dtype=np.int64)
    up = np.zeros(sum(map(len, parts)), dtype=np.int64)
    start = np.concatenate([[0], np.cumsum([len(p) for p in parts], dtype=np.int64)])
    pivots = lasts - firsts + 1
    for f, above in enumerate(parent.tolist()):
        if above >= 0:
            up[start[f] + pivots[f] : start[f + 1]] = np.searchsorted(parts[above], touched[f])
    depth, span = np.zeros_like(parent), np.ones_like(parent)
    for f, above in enumerate(parent.tolist()):
        if above >= 0:
            span[above] += span[f]
    for f in range(len(parent) - 1, -1, -1):
        if parent[f] >= 0:
            depth[f] = depth[parent[f]] + 1
    panel = np.concatenate([[0], np.cumsum(pivots * np.diff(start))])
    left = (np.diff(start) - pivots) ** 2
    return SymbolicFactorization(
        order=order,
        place=_inverse(order),
        front=front,
        start=start,
        rows=np.concatenate(parts),
        up=up,
        pivots=pivots,
        parent=parent,
        depth=depth,
        span=span,
        panel=panel,
        stacks=_stacks(left, parent, depth),
    )


def _below(pattern: sparse.csr_array, order: Long) -> list[Long]:
    """For each place in `order` the later places that its elimination touches, sorted."""
    permuted = pattern[order][:, order].tocsr()
    permuted.sort_indices()
    linked, ends = permuted.indices.astype(np.int64), permuted.indptr.tolist()
    below: list[Long] = []
    children: list[list[int]] = [[] for _ in order]
    for k in range(len(order)):
        row = linked[ends[k] : ends[k + 1]]
        rest = row[np.searchsorted(row, k) :]
        if children[k]:
            every = np.concatenate([rest, *(below[child][1:] for child in children[k])])
            every.sort()
            once = np.ones(len(every), dtype=bool)
            np.not_equal(every[:-1], every[1:], out=once[:-1])
            rest = every[once]
        below.append(rest)
        if len(rest):
            children[rest[0]].append(k)
    return below


def _postorder(parent: Long) -> Long:
    """Place of each node of a forest, subtrees without a gap; parents are numbered higher."""
    span = np.ones_like(parent)
    for k, above in enumerate(parent.tolist()):
        if above >= 0:
            span[above] += span[k]
    free, place, top = np.empty_like(parent), np.empty_like(parent), len(parent)
    for k in range(len(parent) - 1, -1, -1):
        above, end = parent[k], top
        if above < 0:
            top -= span[k]
        else:
            end = free[above]
            free[above] -= span[k]
        free[k] = place[k] = end - 1
    return place


def _inverse(permutation: Long) -> Long:
    places = np.empty_like(permutation)
    places[permutation] = np.arange(len(permutation))
    return places


def _merged(below: list[Long]) -> Long:
    """First places of the fronts: chains of the elimination tree, while few zeros come along."""
    first, firsts, useful = 0, [0], 0
    for k in range(1, len(below)):
        useful += len(below[k - 1]) + 1
        width, height = k - first + 1, k - first + 1 + len(below[k])
        whole = width * height - width * (width - 1) // 2
        chained = len(below[k - 1]) and below[k - 1][0] == k
        if not (chained and whole - useful - len(below[k]) - 1 <= WASTE * whole):
            first, useful = k, 0
            firsts.append(k)
    return np.array(firsts[: len(below)], dtype=np.int64)


def _stacks(left: Long, parent: Long, depth: Long) -> tuple[int, int]:
    """Most that waits on the stacks of even and odd depth if front f leaves left[f]."""
    waiting, most, held = [0, 0], [0, 0], np.zeros(len(left), dtype=np.int64)
    for f, (above, odd) in enumerate(zip(parent.tolist(), (depth % 2).tolist(), strict=True)):
        waiting[1 - odd] -= int(held[f])
        waiting[odd] += int(left[f])
        most[odd] = max(most[odd], waiting[odd])
        if above >= 0:
            held[above] += left[f]
    return most[0], most[1]
