"""Directions of the global parameters that the readings do not determine, in words.

Directions are in standard deviations of the priors; those count of which the readings have less
information than the priors. A taxel's gain takes part where it is declared: with gains, E* and
the force's scale unknown, (E*, force, gain) has the exact null direction (1, 1, -1).
"""

from __future__ import annotations

import numpy as np

from ...core.arrays import Array
from ..data.global_parameters import MOTION, GlobalParameters

MIN_COMPONENT = 0.05
"""Least component of a direction, relative to its largest, that is named: smaller ones are below
the two digits that are printed of the largest."""

MIN_SHARE = 0.2
"""Least component that is named of a direction of a contact motion: these have many unknowns, and
components below 4 % of a direction's variance do not help a reader."""

TIE = 1e-3
"""Difference of the variances of directions, relative to their priors, that are undetermined alike:
far above rounding, far below what is named."""


def undetermined(
    parameters: GlobalParameters, information: Array, gains: Array | None
) -> tuple[str, ...]:
    """The directions (weakest first) that rest on the priors, but for those of a contact motion.

    information (ks, ks): of the readings alone; gains (ks,): derivative of the mean ln gain by the
    global parameters, where gains are declared.
    """
    moving = parameters.columns.get(MOTION, slice(0, 0))
    still = np.setdiff1d(np.arange(len(information)), np.arange(moving.start, moving.stop))
    if not len(still):
        return ()
    sigma, labels = parameters.sigma[still], [parameters.labels[k] for k in still]
    gains = None if gains is None else gains[still]
    among = information[moving, moving] + np.eye(moving.stop - moving.start)
    with_motion = information[np.ix_(still, np.arange(moving.start, moving.stop))]
    information = information[np.ix_(still, still)]
    information = information - with_motion @ np.linalg.solve(among, with_motion.T)
    value, vector = np.linalg.eigh(sigma[:, None] * information * sigma)
    words = []
    for k in np.flatnonzero(value < 1.0):
        v = vector[:, k]
        step = sigma * v
        named = np.flatnonzero(np.abs(v) > MIN_COMPONENT * np.abs(v).max())
        direction = {labels[i]: float(step[i]) for i in named}
        if gains is not None:
            response = float(gains @ step)
            if abs(response) > MIN_COMPONENT * max(map(abs, direction.values())):
                direction["gain"] = response
        words.append(_in_words(direction))
    return tuple(words)


def undetermined_motion(parameters: GlobalParameters, covariance: Array) -> tuple[str, ...]:
    """The directions of a contact motion's unknowns (weakest first) in which their covariance is
    more than half of that before any measurement; covariance (ks, ks): of all global parameters.
    """
    if (motion := parameters.motion) is None:
        return ()
    at = parameters.columns[MOTION]
    left = motion.covariance(covariance[at, at]) / np.outer(motion.sigma, motion.sigma)
    # of directions that are undetermined alike, those of single unknowns
    value, vector = np.linalg.eigh(left - TIE * np.diag(np.arange(len(left))))
    words = []
    for k in np.flatnonzero(value > 0.5)[::-1]:
        v = vector[:, k]
        named = np.flatnonzero(np.abs(v) > MIN_SHARE * np.abs(v).max())
        words.append(_in_words({motion.labels[i]: float(motion.sigma[i] * v[i]) for i in named}))
    return tuple(words)


def _in_words(direction: dict[str, float]) -> str:
    if len(direction) == 1:
        return f"{next(iter(direction))} is not determined"
    most = max(map(abs, direction.values()))
    largest = next(x for x in direction.values() if abs(x) > 0.995 * most)  # alike in two digits
    parts = (f"{name} {x / largest:+.2g}" for name, x in direction.items())
    return f"cannot be told apart: {', '.join(parts)}"
