"""Rows of unequal length, one after the other in one array."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Index = NDArray[np.intp]


def ranges(first: Index, count: Index) -> Index:
    """The numbers first[k], first[k] + 1, ..., `count`[k] of them, for one k after the other."""
    return np.repeat(first - np.cumsum(count) + count, count) + np.arange(count.sum())
