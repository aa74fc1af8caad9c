"""Creep with a further time constant, beyond the one that an estimate has.

Covers and electronics relax with several constants, and the loops of hysteresis are not those of a
play operator. What of it is left is small, and displaces the taxels against the motion of the
contacts: by how much follows, to first order, from the share of a further creep that makes the
residuals most likely. The square of that displacement counts in the covariances.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.arrays import Array
from ..joint.departures import FittedReadings
from ..joint.electronics import Electronics

LEAST_SCORE = 3.5
"""Score, in standard deviations, from which the displacements count: 2e-3 by chance, of five time
constants. Worlds with a single constant have 0.8 to 2.7, those with two or other loops 3.7 to 9.3
(creep_03, creep_30, creep_stops, creep_slides, hysteresis and together of
studies/foreign_worlds.py; constants of 0.1 and 2 s; Preisach's operator)."""
NAME = "creep with a further time constant"
WORDS = "creep with a further time constant, by what it displaces the taxels"


@dataclass(frozen=True)
class FurtherCreep:
    """The most significant further creep."""

    score: float
    """In standard deviations."""
    covariances: Array
    """Squares (n, 2, 2), m^2, of the displacements along the tangents; zeros below LEAST_SCORE."""

    @property
    def departure(self) -> dict[str, float]:
        """Its score, by its name."""
        return {NAME: self.score}


def further_creep(fitted: FittedReadings) -> FurtherCreep | None:
    """The further creep; None where the estimate has none yet."""
    if "creep" not in fitted.data.parameters.names:
        return None
    rises = fitted.creeps(Electronics(fitted.data, fitted.readings, fitted.points))
    slope, information = fitted.shared(rises)
    known = np.maximum(np.diag(information), 1e-300)
    scores = np.abs(slope) / np.sqrt(known)
    best = int(np.argmax(scores))
    covariances = np.zeros((len(fitted.points), 2, 2))
    if scores[best] > LEAST_SCORE:
        share = slope[best] / known[best]
        moved = share * fitted.displaced(rises[:, [best]])
        covariances = moved @ np.swapaxes(moved, 1, 2)
    return FurtherCreep(float(scores[best]), covariances)
