"""Geometry of the triangular modules that cover iCub: twelve slots, two of them thermal pads.

Frame of a module: origin at slot 3, the centre of the triangle; z outward, x along the rows. The id
of a taxel is 12 * module + slot.

Sources: the offsets of the module with ten taxels are those published in
icub-taxel-positions (taxeltrans.txt); those of the first kind, with twelve taxels and no thermal
pad, follow from the drawing in icub-main, iCubSkinGui (Triangle.h).
"""

from __future__ import annotations

from collections import Counter

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..core.arrays import Array

Ids = NDArray[np.int64]

PER_MODULE = 12
"""slots of a module"""
SIDE = 30e-3
"""side of the triangle, m"""
THERMAL = (6, 10)
"""slots that are thermal pads"""
TAXELS = (0, 1, 2, 3, 4, 5, 7, 8, 9, 11)
"""slots that are taxels"""
CENTRE = 3
"""slot at the centre of the triangle, which represents its module in a position file"""


def _metres(*millimetres: tuple[float, float]) -> Array:
    flat = np.array(millimetres)
    return 1e-3 * np.column_stack([flat, np.zeros(len(flat))])


OFFSETS = _metres(
    *((6.533, 0), (9.8, -5.66), (3.267, -5.66), (0, 0), (-3.267, -5.66), (-9.8, -5.66)),
    *((-6.51, -3.75), (-6.533, 0), (-3.267, 5.66), (0, 11.317), (0, 7.507), (3.267, 5.66)),
)
"""(12, 3) slots of the module with ten taxels, m"""
TWELVE_OFFSETS = _metres(
    *((7.5, -1.443), (10, -5.774), (5, -5.774), (0, -2.887), (-5, -5.774), (-10, -5.774)),
    *((-7.5, -1.443), (-2.5, 1.443), (-2.5, 7.217), (0, 11.547), (2.5, 7.217), (2.5, 1.443)),
)
"""(12, 3) slots of the first kind of module, twelve taxels; origin at the triangle's centre, m"""
CORNERS = (
    SIDE
    / np.sqrt(3.0)
    * np.array([[-np.sqrt(0.75), -0.5, 0.0], [np.sqrt(0.75), -0.5, 0.0], [0.0, 1.0, 0.0]])
)
"""(3, 3) corners of the triangle, counter-clockwise seen from outside, m"""


def module(ids: ArrayLike) -> NDArray[np.int64]:
    """Module numbers of the taxels with ids (n,)."""
    return np.asarray(ids, dtype=np.int64) // PER_MODULE


def slot(ids: ArrayLike) -> NDArray[np.int64]:
    """Slots of the taxels with ids (n,)."""
    return np.asarray(ids, dtype=np.int64) % PER_MODULE


def is_modular(ids: ArrayLike) -> bool:
    """Whether ids (n,) are those of modules with ten taxels: ten a module, none thermal."""
    numbers = np.asarray(ids, dtype=np.int64)
    if not len(numbers) or np.isin(slot(numbers), THERMAL).any():
        return False
    return set(Counter(module(numbers).tolist()).values()) == {len(TAXELS)}
