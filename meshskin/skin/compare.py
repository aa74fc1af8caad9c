"""Two skins compared: where one lies on the other, and whether exchanged ids explain the rest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..core.arguments import check_type
from ..core.errors import SkinError
from . import id_permutation, slots
from .pairing import Ids, moved, pair

if TYPE_CHECKING:
    from .skin import Skin

Array = NDArray[np.float64]

ALIKE = 0.9
"""of the modules' distance: what single taxels have to reach to be taken in their place"""
EXPLAINED = 0.5
"""of the rms distance: what is left where a permutation explains a difference"""


@dataclass(frozen=True, eq=False)
class Difference:
    """What tells skin B from skin A; distances in m."""

    ids: Ids
    """(n,) taxels of both"""
    only_a: Ids
    """(k,) taxels of A alone"""
    only_b: Ids
    """(l,) taxels of B alone"""
    as_they_are: Array
    """(n,) distance of each taxel to its namesake"""
    alignment: Array
    """(4, 4) T_a_b that brings B onto A"""
    aligned: Array
    """(n,) distance of each taxel to its namesake after the alignment"""
    unit: str
    """what was paired: "module" or "taxel" """
    permutation: dict[int, int]
    """of the units that moved: A's number -> the number in B of the unit that lies there"""
    paired_ids: Ids
    """(p,) taxels of A whose unit has a partner in B"""
    paired: Array
    """(p,) their distances after alignment and permutation"""

    @property
    def explains(self) -> bool:
        """Whether the permutation explains the difference: half of it, or more, is gone with it."""
        if not self.permutation:
            return False
        size = slots.PER_MODULE if self.unit == "module" else 1
        renamed = np.unique(self.only_a // size)
        if np.isin(list(self.permutation), renamed).all():
            return True  # new names alone: nothing that both have has moved
        return rms(self.paired) <= EXPLAINED * rms(self.aligned)

    def sentences(self) -> tuple[str, ...]:
        """The permutation in words: exchanges, cycles, renamed units."""
        return id_permutation.words(self.permutation, self.unit)

    def worst(self, count: int = 10) -> list[tuple[int, float]]:
        """The taxels farthest off, and their distances (m), after alignment and permutation."""
        order = np.argsort(-self.paired, kind="stable")[:count]
        return [(int(self.paired_ids[k]), float(self.paired[k])) for k in order]


def rms(values: Array) -> float:
    """Root of the mean square; 0 of nothing."""
    return float(np.sqrt(np.mean(values**2))) if len(values) else 0.0


def compare(a: Skin, b: Skin) -> Difference:
    """How skin B differs from skin A, taxels paired by id.

    Taxels without a position are left out. Raises SkinError where a skin has fewer than 3 taxels.
    """
    (ids_a, at_a), (ids_b, at_b) = _places(a, "A"), _places(b, "B")
    ids, rows_a, rows_b = np.intersect1d(ids_a, ids_b, return_indices=True)
    before = np.linalg.norm(at_a[rows_a] - at_b[rows_b], axis=1)
    tries = [pair(ids_a, at_a, ids_b, at_b, size) for size in (slots.PER_MODULE, 1)]
    modules, taxels = tries
    assert taxels is not None
    best = taxels
    if modules is not None and modules.score <= taxels.score / ALIKE + 1e-9:
        best = modules
    after = np.linalg.norm(at_a[rows_a] - moved(best.pose, at_b[rows_b]), axis=1)
    off = np.linalg.norm(at_a[best.rows_a] - moved(best.pose, at_b[best.rows_b]), axis=1)
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


def _places(skin: Skin, name: str) -> tuple[Ids, Array]:
    """Ids and positions of the taxels that have one, by id."""
    from .skin import Skin

    check_type(Skin, skin, f"skin {name}")
    order = np.argsort(skin.ids, kind="stable")
    order = order[np.isfinite(skin.positions[order]).all(axis=1)]
    ids = np.asarray(skin.ids[order], dtype=np.int64)
    if len(ids) < 3 or len(np.unique(ids)) < len(ids):
        raise SkinError(
            f"taxels of skin {name}", value=len(np.unique(ids)), limit=">= 3, each with its own id"
        )
    return ids, np.asarray(skin.positions[order])
