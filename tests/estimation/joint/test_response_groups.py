"""Taxels of one module, or of one part of the ids, that respond otherwise than the rest."""

from types import SimpleNamespace

import numpy as np
import pytest

from meshskin.estimation.calibrate import calibrate
from meshskin.estimation.joint.departures import MIN_SCORE
from meshskin.estimation.joint.response_groups import response_groups

from .test_learned import PEAK, TAXELS, belief, recording, world


def fitted(compression, scatter=0.0):
    """Taxels whose readings bend by `compression` (n,), of an information of 100 each, and by as
    much more as `scatter` says."""
    rng, n = np.random.default_rng(0), len(compression)
    slope = 100 * compression + 10 * rng.normal(size=n) * (1 + scatter)
    return SimpleNamespace(
        data=SimpleNamespace(sigma=1.0, nominal_peak=1.0), mu=np.zeros(n), offset=np.zeros(n),
        each=lambda column: (slope, np.full(n, 100.0)),
    )  # fmt: skip


def test_parts_of_the_ids_and_modules_are_told_apart():
    ids = np.arange(96)
    found = response_groups(fitted(0.5 * (ids >= 40)), ids, None)
    assert found.score > MIN_SCORE
    assert found.where == "the taxels from id 40 on"
    odd = response_groups(fitted(0.5 * (ids // 8 == 3)), ids, 8)
    assert odd.score > MIN_SCORE
    assert "number 3," in odd.where


@pytest.mark.parametrize("scatter", [0.0, 5.0])
def test_taxels_that_differ_among_themselves_are_no_groups(scatter):
    ids = np.arange(96)
    assert response_groups(fitted(np.zeros(96), scatter), ids, 12).score < MIN_SCORE
    few = np.arange(6)
    assert response_groups(fitted(np.zeros(6)), few, None).score == 0.0


def test_two_responses_in_one_recording_are_a_named_doubt():
    """Taxels of the upper half of the ids saturate."""

    def read(pressure, rng):
        upper = np.arange(TAXELS) >= TAXELS // 2
        return np.where(upper, pressure / (1 + pressure / PEAK), pressure)

    for reader, named in ((read, True), (None, False)):
        found = calibrate(recording(*world(read=reader)), belief(contact="learned"))
        words = [text for text in found.verdict.reasons if "another response" in text]
        assert bool(words) == named
        assert found.verdict.level == ("DOUBT" if named else "PASS")
