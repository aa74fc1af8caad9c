"""Postures that are equal but for whole turns of joints.

A joint with a range of more than one turn reaches a pose at several of its angles, of which a chain
of postures needs the one that leaves room for the turns to come. One with a range of two turns or
more counts as endless: its angle is taken modulo one turn.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import Array, Index
from .arm import Arm


def endless_joints(arm: Arm) -> NDArray[np.bool_]:
    """The joints (n,) with a range of two turns or more: whole turns are equivalent for them."""
    return np.asarray(arm.upper - arm.lower > 4 * math.pi - 0.1)


def with_whole_turns(arm: Arm, q: Array) -> Array:
    """`q` (m, s, b, n) and, after them, the postures within all limits that whole turns give."""
    found = q
    for j in np.flatnonzero((arm.upper - arm.lower > 2 * math.pi) & ~endless_joints(arm)):
        parts = [found]
        for turn in (-2 * math.pi, 2 * math.pi):
            angle = found[..., j] + turn
            within = (angle >= arm.lower[j]) & (angle <= arm.upper[j])
            other = np.where(within[..., None], found, np.nan)
            other[..., j] += turn
            parts.append(_packed(other))
        found = np.concatenate(parts, axis=2)
    turned = found[:, :, q.shape[2] :]
    outside = ((turned < arm.lower) | (turned > arm.upper)).any(axis=-1)
    turned[outside] = np.nan
    return np.concatenate([q, _packed(turned)], axis=2)


def used_first(used: NDArray[np.bool_]) -> Index:
    """Indices (m, s, w) of the `used` (m, s, b) postures, in order, before the others; w: the most
    that are used at one spin."""
    width = int(used.sum(axis=2).max(initial=0))
    return np.argsort(~used, axis=2, kind="stable")[:, :, :width]


def _packed(q: Array) -> Array:
    """`q` (m, s, b, n) with its postures, in order, before the NaN, and no wider than they need."""
    return np.take_along_axis(q, used_first(np.isfinite(q[..., 0]))[..., None], axis=2)
