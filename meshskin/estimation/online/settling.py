"""A running estimate brought to rest, in a time not bounded; and the noise of its readings.

The noise is estimated while they come in, as in the batch estimate (joint/noise.py): by the
differences of residuals between neighbouring contacts. Until it shows, readings have the weight of
the nominal noise.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..joint.noise import estimate_noise, least_scale
from ..joint.rival_optima import DIRECTIONS
from ..uncertainty.goodness_of_fit import MIN_PAIRS
from .linearization import contradictions, search
from .running_estimate import CHUNK, MIN_READINGS, TOLERANCE, RunningEstimate

SETTLED = 0.0003
"""`running_estimate.TOLERANCE` here, where time does not press: 0.001 of a standard deviation."""
MAX_ROUNDS = 8
"""Rounds; three are usual."""
FIRST_CONTACTS = 100
"""Contacts after which the noise is looked for first, and again after as many more until it shows;
then whenever there are twice as many."""
TAXELS = 12
"""Taxels that it is estimated from in a frame, those with the most readings: 20 ms."""
NOISE_TOLERANCE = 0.02
"""Relative change of the noise that is taken over in a frame: that of a sample of 1,250 pairs."""


def settle(estimate: RunningEstimate) -> None:
    """Estimate anew all that waits, as the batch estimate does, outlying readings and all, and
    examine what was not, until nothing moves; contacts that were rejected are tested again."""
    store = estimate.store
    for _ in range(MAX_ROUNDS):
        counts = store.counts
        lost = (counts >= MIN_READINGS) & ~estimate.fits & (estimate.searched < counts)
        rows = np.union1d(estimate.waiting(SETTLED), np.flatnonzero(lost))
        estimate.searched[rows] = counts[rows]
        for begin in range(0, len(rows), CHUNK):
            mine = rows[begin : begin + CHUNK]
            estimator, part = estimate.estimator(mine)
            estimate.take(mine, *search(estimator, estimate.scale), part)
        examined = estimate.examine_all(CHUNK // DIRECTIONS)
        if not len(rows) and not examined and not _readmit(estimate):
            return


def _readmit(estimate: RunningEstimate) -> bool:
    """Count the readings of rejected contacts that contradict the others no longer: what they were
    compared with has moved. Whether there were any."""
    store = estimate.store
    contacts = np.flatnonzero(store.misfitting.values)
    if not len(contacts):
        return False
    mine = np.isin(store.contact.values, contacts)
    rows = estimate.near(store.columns["points"].values[contacts], store.taxel.values[mine])
    store.misfitting.values[contacts] = False
    new = estimate.linearized(store.part_of(rows, contacts), rows)
    sure = estimate.fits[rows[new.taxel]]
    rejected = contradictions(new, sure, len(contacts), estimate.scale)[1]
    store.misfitting.values[contacts] = rejected
    again = np.unique(rows[new.taxel[~rejected[new.contact]]])
    estimate.moved[again] = np.maximum(estimate.moved[again], 2 * TOLERANCE)
    return bool(len(again))


class RunningNoise:
    """Estimates the noise of a running estimate, unless it is known."""

    def __init__(self, known: bool) -> None:
        self.known, self._next = known, FIRST_CONTACTS

    def look(self, estimate: RunningEstimate) -> None:
        """Estimate the noise where it is time to, from a few taxels."""
        count = estimate.store.count
        if not self.known and count >= self._next:
            found = self._estimate(estimate, TAXELS, NOISE_TOLERANCE)
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
