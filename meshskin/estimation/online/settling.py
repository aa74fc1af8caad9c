"""A running estimate brought to rest: all that waits is estimated anew, in a time not bounded."""

from __future__ import annotations

import numpy as np

from ..joint.rival_optima import DIRECTIONS
from .linearization import contradictions, new_readings, search
from .running_estimate import CHUNK, MIN_READINGS, TOLERANCE, RunningEstimate

SETTLED = 0.0003
"""`running_estimate.TOLERANCE` here, where time does not press: 0.001 of a standard deviation."""
MAX_ROUNDS = 8
"""Rounds; three are usual."""


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
    store, info = estimate.store, estimate.information
    contacts = np.flatnonzero(store.misfitting.values)
    if not len(contacts):
        return False
    mine = np.isin(store.contact.values, contacts)
    rows = estimate.near(store.columns["points"].values[contacts], store.taxel.values[mine])
    store.misfitting.values[contacts] = False
    new = new_readings(
        store.part_of(rows, contacts).data, info.charts[rows], info.step[rows, :2],
        info.nuisances(rows), estimate.s, info.joint_covariance(rows),
    )  # fmt: skip
    sure = estimate.fits[rows[new.taxel]]
    rejected = contradictions(new, sure, len(contacts), estimate.scale)[1]
    store.misfitting.values[contacts] = rejected
    again = np.unique(rows[new.taxel[~rejected[new.contact]]])
    estimate.moved[again] = np.maximum(estimate.moved[again], 2 * TOLERANCE)
    return bool(len(again))
