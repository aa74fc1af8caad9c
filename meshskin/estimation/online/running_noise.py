"""The noise of the readings, estimated while they come in.

As in the batch estimate (joint/noise.py): by the differences of residuals between neighbouring
contacts. Until it shows, readings have the weight of the nominal noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..joint.noise import estimate_noise, least_scale
from ..uncertainty.goodness_of_fit import MIN_PAIRS
from .running_estimate import CHUNK, RunningEstimate
from .settling import settle

FIRST_CONTACTS = 100
"""Contacts after which the noise is looked for first, and again after as many more until it shows;
then whenever there are twice as many."""
TAXELS = 12
"""Taxels that it is estimated from in a frame, those with the most readings: 20 ms."""
TOLERANCE = 0.02
"""Relative change of the noise that is taken over in a frame: that of a sample of 1,250 pairs."""


class RunningNoise:
    """Estimates the noise of a running estimate, unless it is known."""

    def __init__(self, known: bool) -> None:
        self.known, self._next = known, FIRST_CONTACTS

    def look(self, estimate: RunningEstimate) -> None:
        """Estimate the noise where it is time to, from a few taxels."""
        count = estimate.store.count
        if not self.known and count >= self._next:
            found = self._estimate(estimate, TAXELS, TOLERANCE)
            self._next = 2 * count if found else count + FIRST_CONTACTS

    def settle(self, estimate: RunningEstimate) -> None:
        """Estimate the noise from as many taxels as the memory bears, and all taxels anew by it."""
        if not self.known and self._estimate(estimate, CHUNK, 0.0):
            settle(estimate)

    def _estimate(self, estimate: RunningEstimate, most: int, tolerance: float) -> bool:
        """Whether the noise shows; it is taken over where it changed by more than `tolerance`."""
        info, counts = estimate.information, estimate.store.counts
        rows = np.flatnonzero(info.placed & estimate.fits)
        rows = rows[np.argsort(-counts[rows], kind="stable")[:most]]
        if not len(rows):
            return False
        estimator = estimate.estimator(rows)[0]
        estimator.converge()
        found = estimate_noise(estimator, estimator.problem.reduce(estimator.state))
        if found.pairs < MIN_PAIRS or found.scale <= least_scale(estimator.data):
            return False
        template = estimate.store.template
        if estimate.store.noise_is_nominal or abs(found.scale - 1) > tolerance:
            noise = found.scale * template.sigma
            estimate.refer(replace(template, noise=noise, noise_pairs=found.pairs))
        return True
