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
    state, found = np.zeros((2, 3)), np.empty((len(steps), 2, 3))  # the shear, its derivative
    for k, normal in enumerate(data.normals):
        if released[k]:
            state, found[k] = np.zeros((2, 3)), 0.0
            continue
        found[k] = _moved(state, amid[k], normal, size)
        state = _moved(state, steps[k], normal, size)
    return np.copysign(1.0, limit) * found[:, 0], found[:, 1]


def _moved(state: Array, step: Array, normal: Array, limit: float) -> Array:
    """A shear and its derivative in the limit (2, 3) after a step (3,) of the contact."""
    shear, slope = state - np.outer(state @ normal, normal)
    shear = shear + step - (step @ normal) * normal
    size = float(np.sqrt(shear @ shear))
    if size > limit:
        along = shear / size
        slope = along + limit / size * (slope - along * (along @ slope))
        shear = limit * along
    return np.stack([shear, slope])


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
