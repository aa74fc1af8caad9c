"""What shared unknowns the readings cannot tell apart, in words.

Directions of the shared unknowns, in standard deviations of their priors, of which the readings say
less than the priors do. A taxel's gain takes part where it is declared: with gains, E* and the
force's scale unknown, (E*, force, gain) has one exact null direction (1, 1, -1).
"""

from __future__ import annotations

import numpy as np

from ...core.se3 import Array
from ..data.global_parameters import GlobalParameters

TAKES_PART = 0.05
"""Smallest entry of a direction, relative to its largest, that is named."""


def undetermined(
    shared: GlobalParameters, information: Array, gains: Array | None
) -> tuple[str, ...]:
    """The directions (weakest first) that the readings leave to the priors.

    `information` (ks, ks) is that of the readings alone; `gains` (ks,): how the mean ln gain
    follows the shared unknowns, where gains are declared.
    """
    if not len(information):
        return ()
    value, vector = np.linalg.eigh(shared.sigma[:, None] * information * shared.sigma)
    words = []
    for k in np.flatnonzero(value < 1.0):
        v = vector[:, k]
        step = shared.sigma * v
        part = np.abs(v) > TAKES_PART * np.abs(v).max()
        direction = {shared.labels[i]: float(step[i]) for i in np.flatnonzero(part)}
        if gains is not None:
            response = float(gains @ step)
            if abs(response) > TAKES_PART * max(map(abs, direction.values())):
                direction["gain"] = response
        words.append(_in_words(direction))
    return tuple(words)


def _in_words(direction: dict[str, float]) -> str:
    if len(direction) == 1:
        return f"{next(iter(direction))} is not determined"
    largest = max(direction.values(), key=abs)
    parts = (f"{name} {x / largest:+.2g}" for name, x in direction.items())
    return f"cannot be told apart: {', '.join(parts)}"
