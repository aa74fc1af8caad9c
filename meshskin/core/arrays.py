"""Types of arrays, and ragged arrays: rows of unequal length, one after the other in one array."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Index = NDArray[np.intp]


def ranges(first: Index, count: Index) -> Index:
    """The integers first[k], ..., first[k] + count[k] - 1 of every k, concatenated."""
    return np.repeat(first - np.cumsum(count) + count, count) + np.arange(count.sum())
