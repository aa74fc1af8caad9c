"""A jump of all contacts in the course of a recording, as of a body that was mounted anew.

Taxels that are touched before and after it show it: others are displaced with their contacts.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import ArrayLike

from ...core.arrays import Array
from .departures import MIN_SCORE, FittedReadings, fitted_readings, normal_score
from .joint_estimator import JointEstimator

PLACES = 15
"""Places in a recording, evenly spaced, where a jump is looked for."""
PERIODS, GROUP = 30, 2.0
"""Parts of a recording, and size of a part of the body in reaches of a contact, over which errors
that neighbouring contacts share are summed."""
TOGETHER = 3
"""Places whose displacements are solved for together: more need the memory of the contacts' again.
"""
MIN_SHOWN = 0.02
"""Information on a direction of a jump, relative to the best known one, from which it is estimated:
that along the normals is near zero."""


@dataclass(frozen=True)
class Jump:
    """A displacement of all contacts from one on."""

    score: float = 0.0
    """In standard deviations."""
    part: float = 0.0
    """Part of the contacts before it."""
    displacement: Array = field(default_factory=lambda: np.zeros(3))
    """(3,), m."""

    @property
    def shown(self) -> Array:
        """The displacement (3,), m, where its score is above MIN_SCORE, else zero."""
        return self.displacement if self.score > MIN_SCORE else np.zeros(3)

    @property
    def departure(self) -> dict[str, float]:
        """Its score, by a name that says where it is."""
        where = f"at {self.part:.0%} of the recording, as of a body mounted anew"
        return {f"a jump of the contacts {where}": self.score}


def largest_jump(fitted: FittedReadings, places: ArrayLike | None = None) -> Jump:
    """The most significant displacement of all contacts from one on; places: contacts at which it
    may begin, by default PLACES."""
    m, found = len(fitted.data.points), list[Jump]()
    moved = fitted.moved(np.broadcast_to(np.eye(3), (m, 3, 3)))
    if places is None:
        places = np.unique(np.linspace(0, m, PLACES + 2).astype(int)[1:-1])
        places = places[places > 0]  # from the first contact on all move: that is no jump
    for begin, slope, information in _displaced(fitted, moved, np.asarray(places)):
        value, vectors = np.linalg.eigh(information)
        seen = value > MIN_SHOWN * max(float(value[-1]), 1e-300)
        if not seen.any():
            continue
        along, value, vectors = (vectors.T @ slope)[seen], value[seen], vectors[:, seen]
        score = normal_score(float(np.sum(along**2 / value)), len(value))
        found.append(Jump(score, begin / m, vectors @ (along / value)))
    best = Jump()
    for jump in sorted(found, key=lambda jump: -jump.score):
        if jump.score <= best.score:
            break
        if jump.score > MIN_SCORE:  # else none is shown, whatever its factor
            jump = replace(jump, score=jump.score / _shared_deviation(fitted, moved, jump))
        best = max(best, jump, key=lambda jump: jump.score)
    return best


def _shared_deviation(fitted: FittedReadings, moved: Array, jump: Jump) -> float:
    """Factor, at least 1, of the standard deviation of a jump by errors that neighbouring contacts
    share, in time or in place: its variance from sums over groups of contacts of the terms of its
    derivative, without the jump, over that of independent errors. moved (k, 3): as in `_displaced`.

    Source: White, "Maximum likelihood estimation of misspecified models", Econometrica 50 (1982),
    with groups as in Liang and Zeger, Biometrika 73 (1986).
    """
    contact, m = fitted.readings.contact, len(fitted.data.points)
    later = contact >= round(jump.part * m)
    column = (later * (moved @ jump.displacement))[:, None]
    left, marginal = (part[:, 0] for part in fitted.unexplained(column))
    terms = -marginal * (fitted.rate + fitted.curvature * left)
    cell = np.floor(fitted.data.points / (GROUP * float(np.median(fitted.data.reach()))))
    in_place = np.unique(cell, axis=0, return_inverse=True)[1].ravel()
    in_time = np.arange(m) * PERIODS // m
    groups = (np.bincount(group[contact], terms) for group in (in_time, in_place))
    square = max(float(np.sum(sums**2)) for sums in groups)
    independent = float(fitted.curvature @ (marginal * left))
    return max(1.0, (square / max(independent, 1e-300)) ** 0.5)


def _displaced(
    fitted: FittedReadings, moved: Array, places: np.ndarray
) -> Iterator[tuple[int, Array, Array]]:
    """Each place, with derivative (3,) and information (3, 3) of displacements from there on; moved
    (k, 3): derivatives of the readings in displacements of their contacts."""
    for begin in range(0, len(places), TOGETHER):
        few = places[begin : begin + TOGETHER]
        later = fitted.readings.contact[:, None] >= few
        columns = (later[:, :, None] * moved[:, None]).reshape(-1, 3 * len(few))
        slope, information = fitted.shared(columns)
        for k, place in enumerate(few):
            at = slice(3 * k, 3 * k + 3)
            yield place, slope[at], information[at, at]


def jump_of(estimator: JointEstimator, fitted: FittedReadings) -> Jump:
    """The most significant displacement of all contacts from one on, by the readings `fitted` of
    the estimate with their weights.

    Beside a jump the readings before or after it are outlying: its size is that by all readings.
    """
    found = largest_jump(fitted)
    if found.score <= MIN_SCORE:
        return found
    place = round(found.part * len(estimator.data.points))
    everything = fitted_readings(estimator, np.ones_like(estimator.likelihood.readings.weight))
    return replace(found, displacement=largest_jump(everything, [place]).displacement)
