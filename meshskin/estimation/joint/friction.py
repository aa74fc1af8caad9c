"""Friction: a contact that sticks drags the skin along until it slides.

The motion of the contact shears the skin, and the patch lags behind the contact by the shear. From
the size d on the contact slides, and the shear points backwards along the motion. Where the motion
turns, the contact sticks again until the shear has turned, too: the stop operator of the path.

Sources: Visintin, Differential Models of Hysteresis (1994), section III.1; K. L. Johnson, Contact
Mechanics (1985), section 7.2.
"""

from __future__ import annotations

import numpy as np

from ...core.arrays import Array
from ..data.measurements import Measurements

PAUSE = 1.5
"""Interval between two contacts, in median ones, from which the skin was released between."""


def shears(data: Measurements, limit: float) -> tuple[Array, Array]:
    """Shears (m, 3), m, of the skin under contacts that slide from |limit|, m, on, and their
    derivatives (m, 3) in it; with a negative limit both signs of the shears are turned."""
    steps = np.diff(data.points, axis=0, prepend=data.points[:1])
    interval = np.diff(data.time, prepend=-np.inf)
    released = interval > PAUSE * np.median(interval)
    state, found = np.zeros((2, 3)), np.empty((len(steps), 2, 3))  # the shear, its derivative
    for k, (step, normal) in enumerate(zip(steps, data.normals, strict=True)):
        state = np.zeros((2, 3)) if released[k] else state + np.outer([1.0, 0.0], step)
        state = state - np.outer(state @ normal, normal)
        size = float(np.linalg.norm(state[0]))
        if size > abs(limit):
            along = state[0] / size
            turned = state[1] - along * (along @ state[1])
            state = np.stack([abs(limit) * along, along + abs(limit) / size * turned])
        found[k] = state
    return np.copysign(1.0, limit) * found[:, 0], found[:, 1]


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
