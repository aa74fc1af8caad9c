"""Crosstalk: a part of what a taxel says leaks into its neighbours' readings.

    y = p - (c / d) L p,

L the Laplacian of the graph of neighbours, d its largest degree: what one loses the others gain, so
that the sum over the skin stays.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from ..core.config import quantity
from ..core.se3 import Array
from . import BaseEffect, Context, PressureTransform
from .frames import Frames


@dataclass(frozen=True)
class Crosstalk(BaseEffect):
    """Leaks between neighbouring taxels."""

    coupling: float = quantity("", 0.03, least=0.0, most=0.5)
    """Part c that a taxel with all its neighbours gives away."""
    reach_relative: float = quantity("", 1.3, above=1.0, most=10.0)
    """Largest distance of neighbours, relative to the median distance of nearest neighbours."""
    module_size: int | None = quantity("", None, least=2)
    """Leak only between taxels whose ids agree after division by this; None: no modules."""

    name: ClassVar[str] = "crosstalk"
    stage: ClassVar[str] = "transducer"
    cost: ClassVar[float] = 2e-9

    def bound(self, context: Context) -> float:
        """Where one taxel reads p_0 and its neighbours nothing, m."""
        return context.reading_error_bound(self.coupling)

    def build(self, context: Context) -> PressureTransform:
        """A function without memory."""
        mixing = self.mixing(context)

        def leak(pressures: Array, frames: Frames) -> Array:
            return np.asarray(mixing @ pressures.T).T

        return leak

    def mixing(self, context: Context) -> Any:
        """The sparse, symmetric matrix (n, n) of the leaks; its rows and columns sum to 1."""
        from scipy.sparse import csr_array, diags_array
        from scipy.spatial import cKDTree

        places, n = context.skin.positions, len(context.skin)
        tree = cKDTree(places)
        nearest = tree.query(places, k=2)[0][:, 1] if n > 1 else np.zeros(1)
        pairs = tree.query_pairs(self.reach_relative * np.median(nearest), output_type="ndarray")
        if self.module_size is not None:
            module = np.asarray(context.skin.ids) // self.module_size
            pairs = pairs[module[pairs[:, 0]] == module[pairs[:, 1]]]
        degree = np.bincount(pairs.ravel(), minlength=n)
        part = self.coupling / max(int(degree.max()), 1)
        row, col = np.concatenate([pairs, pairs[:, ::-1]]).T
        leaks = csr_array((np.full(len(row), part), (row, col)), shape=(n, n))
        return (diags_array(1.0 - part * degree) + leaks).tocsr()
