"""Taxels that were never pressed: without a threshold their noise gives readings everywhere."""

import numpy as np
import pytest

from meshskin.estimation.calibrate import calibrate
from meshskin.estimation.data.gather import gather
from meshskin.estimation.trilateration import coactivation
from meshskin.estimation.uncertainty.metrics import position_errors
from meshskin.recording.recording import Recording


def pressed_on_one_side(world, noise, threshold, seed=0):
    """A recording of the contacts on the side of positive x, and which taxels these can press."""
    whole = world.record(noise, threshold, seed)
    keep = whole.points[:, 0] > 0
    part = Recording(
        whole.contacts.filter(keep), whole.readings.filter(keep[whole.reading_contact]),
        whole.metadata,
    )  # fmt: skip
    reach = world.a.max() + 2e-3
    return part, world.truth[:, 0] > -reach


@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 2))])
def test_taxels_that_were_never_pressed_are_undetermined(world, seed):
    recording, near = pressed_on_one_side(world, 0.01, 0.0, seed)
    assert 0.2 < near.mean() < 0.8
    assert (np.bincount(recording.reading_taxel)[world.ids] > 100).all(), "all of them answer"
    found = calibrate(recording, world.belief(0.01, 0.0))
    assert np.isnan(found.positions[~near]).all()
    placed = np.isfinite(found.positions[:, 0])
    assert placed[world.truth[:, 0] > 0].all()
    sigma = found.position_sigma[placed]
    assert (position_errors(found, world.skin)[placed] < 5 * sigma).all()


@pytest.mark.parametrize("threshold", [pytest.param(0.0, marks=pytest.mark.slow), 0.3])
def test_pressed_taxels_are_found_in_noise_as_large_as_the_signal(world, threshold):
    recording, belief = world.record(0.3, threshold), world.belief(0.3, threshold)
    data = gather(recording, belief)
    nowhere = np.full((len(data.ids), 3), np.nan)
    assert not coactivation.responsive(data, nowhere).all(), "no single reading tells"
    assert coactivation.responsive(data, world.truth).all(), "all about their places do"
    found = calibrate(recording, belief)
    assert np.isfinite(found.positions[:, 0]).mean() > 0.9  # some are too weakly determined
    assert np.nanmean(position_errors(found, world.skin)) < 1e-3
