"""Directions of the global parameters that the readings do not determine, in words.

Directions are in standard deviations of the priors; those count of which the readings have less
information than the priors. A taxel's gain takes part where it is declared: with gains, E* and
the force's scale unknown, (E*, force, gain) has the exact null direction (1, 1, -1).
"""

from __future__ import annotations

import numpy as np

from ...core.arrays import Array
from ..data.global_parameters import GlobalParameters

MIN_COMPONENT = 0.05
"""Least component of a direction, relative to its largest, that is named: smaller ones are below
the two digits that are printed of the largest."""


def undetermined(
    parameters: GlobalParameters, information: Array, gains: Array | None
) -> tuple[str, ...]:
    """The directions (weakest first) that rest on the priors.

    information (ks, ks): of the readings alone; gains (ks,): derivative of the mean ln gain by the
    global parameters, where gains are declared.
    """
    if not len(information):
        return ()
    value, vector = np.linalg.eigh(parameters.sigma[:, None] * information * parameters.sigma)
    words = []
    for k in np.flatnonzero(value < 1.0):
        v = vector[:, k]
        step = parameters.sigma * v
        named = np.flatnonzero(np.abs(v) > MIN_COMPONENT * np.abs(v).max())
        direction = {parameters.labels[i]: float(step[i]) for i in named}
        if gains is not None:
            response = float(gains @ step)
            if abs(response) > MIN_COMPONENT * max(map(abs, direction.values())):
                direction["gain"] = response
        words.append(_in_words(direction))
    return tuple(words)


def _in_words(direction: dict[str, float]) -> str:
    if len(direction) == 1:
        return f"{next(iter(direction))} is not determined"
    largest = max(direction.values(), key=abs)
    parts = (f"{name} {x / largest:+.2g}" for name, x in direction.items())
    return f"cannot be told apart: {', '.join(parts)}"
