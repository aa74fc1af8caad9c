"""Comparison of two skins: their alignment, and a permutation of ids that explains differences."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core import se3
from ..core.arguments import check_type
from ..core.arrays import Array
from ..core.errors import SkinError
from . import id_permutation, slots
from .pairing import pair
from .skin import Skin
from .slots import Ids

TAXEL_RATIO = 0.9
"""Taxels are paired one by one, instead of by modules, if their mean distance is below this part of
that of the modules: single taxels always fit a little better."""
EXPLAINED = 0.5
"""A permutation explains a difference if it leaves at most this part of the rms distance."""


@dataclass(frozen=True, eq=False)
class Difference:
    """Differences between skins A and B; distances in m."""

    ids: Ids
    """(n,) ids of taxels in both"""
    only_a: Ids
    """(k,) ids of taxels only in A"""
    only_b: Ids
    """(l,) ids of taxels only in B"""
    unaligned: Array
    """(n,) distance of each taxel to that of the same id"""
    alignment: Array
    """(4, 4) T_a_b that aligns B with A"""
    aligned: Array
    """(n,) distance of each taxel to that of the same id after the alignment"""
    unit: str
    """what was paired: "module" or "taxel" """
    permutation: dict[int, int]
    """units paired with one of another number: number in A -> number in B"""
    paired_ids: Ids
    """(p,) ids in A of the taxels whose unit has a partner in B"""
    paired: Array
    """(p,) their distances after alignment and permutation"""

    @property
    def explains(self) -> bool:
        """Whether the permutation explains the difference: it removes half of it or more."""
        if not self.permutation:
            return False
        size = slots.PER_MODULE if self.unit == "module" else 1
        only_a = np.unique(self.only_a // size)
        if np.isin(list(self.permutation), only_a).all():
            return True  # renumbered units alone: none of those in both has moved
        return rms(self.paired) <= EXPLAINED * rms(self.aligned)

    def sentences(self) -> tuple[str, ...]:
        """The permutation in words: exchanges, cycles, renumbered units."""
        return id_permutation.words(self.permutation, self.unit)

    def worst(self, count: int = 10) -> list[tuple[int, float]]:
        """Ids and distances (m) of the worst taxels after alignment and permutation."""
        order = np.argsort(-self.paired, kind="stable")[:count]
        return [(int(self.paired_ids[k]), float(self.paired[k])) for k in order]


def rms(values: Array) -> float:
    """Root mean square; 0 for an empty array."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0


def compare(a: Skin, b: Skin) -> Difference:
    """The differences between skins A and B, with the alignment and a permutation of ids.

    Taxels without a position are ignored. Raises SkinError where a skin has fewer than 3 taxels.
    """
    (ids_a, at_a), (ids_b, at_b) = _positions(a, "A"), _positions(b, "B")
    ids, rows_a, rows_b = np.intersect1d(ids_a, ids_b, return_indices=True)
    before = np.linalg.norm(at_a[rows_a] - at_b[rows_b], axis=1)
    modules, taxels = (pair(ids_a, at_a, ids_b, at_b, size) for size in (slots.PER_MODULE, 1))
    assert taxels is not None
    best = taxels
    if modules is not None and modules.score <= taxels.score / TAXEL_RATIO + 1e-9:
        best = modules
    after = np.linalg.norm(at_a[rows_a] - se3.transform_points(best.pose, at_b[rows_b]), axis=1)
    off = np.linalg.norm(
        at_a[best.rows_a] - se3.transform_points(best.pose, at_b[best.rows_b]), axis=1
    )
    return Difference(
        ids,
        np.setdiff1d(ids_a, ids_b),
        np.setdiff1d(ids_b, ids_a),
        before,
        best.pose,
        after,
        "taxel" if best.size == 1 else "module",
        best.moved,
        ids_a[best.rows_a],
        off,
    )


def _positions(skin: Skin, name: str) -> tuple[Ids, Array]:
    """Sorted ids and positions (n, 3) of the taxels that have a position. Raises SkinError."""
    check_type(Skin, skin, f"skin {name}")
    order = np.argsort(skin.ids, kind="stable")
    order = order[np.isfinite(skin.positions[order]).all(axis=1)]
    ids = np.asarray(skin.ids[order], dtype=np.int64)
    if len(ids) < 3:
        raise SkinError(f"taxels of skin {name}", value=len(ids), limit=">= 3")
    return ids, np.asarray(skin.positions[order])
