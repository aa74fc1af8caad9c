"""Crosstalk: a part of the reading of a taxel leaks into the readings of its neighbours.

    y = p - (c / d) L p,

where L is the Laplacian of the graph of neighbours and d its largest degree. The sum of the
readings over the skin is preserved.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..core.config import quantity
from .base import BaseEffect, Context, PressureTransform


@dataclass(frozen=True)
class Crosstalk(BaseEffect, stage="transducer", cost=2e-9):
    """Leaks between neighbouring taxels."""

    coupling: float = quantity("", 0.03, least=0.0, most=0.5)
    """Fraction c that a taxel with the largest number of neighbours gives away."""
    reach_relative: float = quantity("", 1.3, above=1.0, most=10.0)
    """Largest distance of neighbours, relative to the median distance of nearest neighbours."""
    module_size: int | None = quantity("", None, least=2)
    """Leaks occur only between taxels whose ids have the same quotient by this; None: anywhere."""

    def bound(self, context: Context) -> float:
        """From a taxel that reads p_0 while its neighbours read zero, m."""
        return context.reading_error_bound(self.coupling)

    def build(self, context: Context) -> PressureTransform:
        """A stateless linear transform."""
        mixing = self.mixing(context)
        return lambda pressures, frames: np.asarray(mixing @ pressures.T).T

    def mixing(self, context: Context) -> Any:
        """I - (c / d) L: a sparse, symmetric matrix (n, n) whose rows and columns sum to 1."""
        from scipy.sparse import csr_array, diags_array
        from scipy.spatial import cKDTree

        positions, n = context.skin.positions, len(context.skin)
        tree = cKDTree(positions)
        nearest = tree.query(positions, k=2)[0][:, 1] if n > 1 else np.zeros(1)
        pairs = tree.query_pairs(self.reach_relative * np.median(nearest), output_type="ndarray")
        if self.module_size is not None:
            module = np.asarray(context.skin.ids) // self.module_size
            pairs = pairs[module[pairs[:, 0]] == module[pairs[:, 1]]]
        degree = np.bincount(pairs.ravel(), minlength=n)
        leak = self.coupling / max(int(degree.max()), 1)
        row, col = np.concatenate([pairs, pairs[:, ::-1]]).T
        leaks = csr_array((np.full(len(row), leak), (row, col)), shape=(n, n))
        return (diags_array(1.0 - leak * degree) + leaks).tocsr()
