"""Friction: a contact that sticks drags the skin along until it slides.

The motion of the contact shears the skin, and the patch lags behind the contact by the shear. From
the size d on the contact slides, and the shear points backwards along the motion. Where the motion
turns, the contact sticks again until the shear has turned, too: the stop operator of the path.

Sources: Visintin, Differential Models of Hysteresis (1994), section III.1; K. L. Johnson, Contact
Mechanics (1985), section 7.2.
"""

from __future__ import annotations

import functools

import casadi as ca
import numpy as np

from ...core.arrays import Array
from ...core.codegen import compile_function
from ...core.ipopt import BufferedFunction
from ..data.measurements import Measurements
from .electronics import PAUSE

BLOCK = 500
"""Contacts of one call of a compiled path: some are filled up, and longer ones take memory."""
TINY = 1e-300
"""Square of a shear, m^2, that keeps its direction finite where there is none."""


def shears(data: Measurements, limit: float) -> tuple[Array, Array]:
    """Shears (m, 3), m, of the skin under contacts that slide from |limit|, m, on, and their
    derivatives (m, 3) in it; with a negative limit both signs of the shears are turned.

    The last step to each contact ends amid its neighbours: an error of its own point would else
    pass for a shear.
    """
    points, size = data.points, abs(limit)
    steps = np.diff(points, axis=0, prepend=points[:1])
    interval = np.diff(data.time, prepend=-np.inf)
    released = interval > PAUSE * np.median(interval)
    last = np.append(released[1:], True)
    amid = np.where((released | last)[:, None], steps, (steps + np.roll(steps, -1, axis=0)) / 2)
    columns = np.column_stack([steps, amid, data.normals, ~released])
    state, found = np.zeros((2, 3)), np.empty((len(steps), 2, 3))
    for begin in range(0, len(steps), BLOCK):
        part = columns[begin : begin + BLOCK]
        block = np.zeros((BLOCK, columns.shape[1]))
        block[: len(part)] = part
        states, shear = _path()(state, block, np.full(BLOCK, size))
        state = states.reshape(-1, 2, 3)[-1]
        found[begin : begin + BLOCK] = shear.reshape(-1, 2, 3)[: len(part)]
    return np.copysign(1.0, limit) * found[:, 0], found[:, 1]


@functools.cache
def _path() -> BufferedFunction:
    """Shears and their derivatives in the limit (3, 2) along a path of BLOCK contacts.

    (start (3, 2); by columns, the step (3), the step that ends amid the neighbours (3), the normal
    (3), whether the contact is held from the one before; limits) -> after each step, and amid.
    """
    state, limit, column = ca.SX.sym("state", 3, 2), ca.SX.sym("limit"), ca.SX.sym("column", 10)
    step, amid, normal, held = column[:3], column[3:6], column[6:9], column[9]
    before = state - normal @ (normal.T @ state)

    def moved(step: ca.SX) -> ca.SX:
        shear, slope = before[:, 0] + step - normal * ca.dot(step, normal), before[:, 1]
        size = ca.sqrt(ca.dot(shear, shear) + TINY)
        along = shear / size
        sliding = along + limit / size * (slope - along * ca.dot(along, slope))
        slides = size > limit
        return held * ca.horzcat(
            ca.if_else(slides, limit * along, shear), ca.if_else(slides, sliding, slope)
        )

    one = ca.Function("stop", [state, column, limit], [moved(step), moved(amid)])
    return BufferedFunction(compile_function(one).mapaccum("shears", BLOCK))


class Shears:
    """`shears` of a recording; keeps the last ones."""

    def __init__(self, data: Measurements) -> None:
        self.data = data
        self._last: tuple[float, tuple[Array, Array]] | None = None

    def __call__(self, limit: float) -> tuple[Array, Array]:
        """As `shears`."""
        if self._last is None or self._last[0] != limit:
            self._last = limit, shears(self.data, limit)
        return self._last[1]
