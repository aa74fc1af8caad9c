"""Errors that neighbouring contacts share: fields over the body beside scatter."""

import numpy as np
import pytest

from meshskin.estimation.calibrate import calibrate
from meshskin.estimation.learned import contact_correlations

from .test_estimate import RADIUS, belief, errors, hertz, recording, world


def displaced(seed, alike):
    """Contact points off by 0.15 mm along each axis: a field correlated over 0.9 mm, or the same
    displacements in another order."""
    points, *rest = world(hertz, seed, contacts=500)
    rng = np.random.default_rng([seed, 1])
    waves, phases = rng.normal(size=(3, 100)) / 0.9e-3, rng.uniform(0, 2 * np.pi, (3, 100))
    off = np.cos((points @ waves)[:, None] + phases).sum(axis=2) * np.sqrt(2 / 100) * 0.15e-3
    moved = points + (off if alike else rng.permutation(off))
    moved *= RADIUS / np.linalg.norm(moved, axis=1)[:, None]
    return recording(moved, *rest)


@pytest.mark.slow
def test_displacements_that_neighbours_share_widen_the_variances():
    """As of contact points on the facets of a mesh; their correlation is that of scatter by eye."""
    found = calibrate(displaced(0, alike=True), belief(contact="learned"))
    error, stated = errors(found)
    response = found.response
    assert response.contact_correlation < contact_correlations.MAX_CORRELATION
    assert np.argmax(response.alike_parts) == 0
    assert response.alike_contacts > 1.5
    assert 0.8 < stated / error < 1.5
    assert any("errors of contact points are alike" in words for words in found.verdict.reasons)


@pytest.mark.deep
def test_scatter_widens_nothing():
    found = calibrate(displaced(0, alike=False), belief(contact="learned"))
    assert found.response.alike_contacts == 1.0
    assert found.verdict.level == "PASS"


def test_an_estimate_of_few_contacts_has_no_correlogram():
    found = calibrate(recording(*world(hertz, contacts=19)), belief(contact="learned"))
    assert found.response.alike_contacts == 1.0


@pytest.mark.slow
def test_stated_deviations_hold_under_displacements_that_neighbours_share():
    error, stated, widened = [], [], []
    for seed in range(6):
        found = calibrate(displaced(seed, alike=True), belief(contact="learned"))
        for values, value in zip((error, stated), errors(found), strict=True):
            values.append(value)
        widened.append(found.response.alike_contacts)
    independent = np.sqrt(np.mean(np.square(stated) / widened))
    assert independent / np.sqrt(np.mean(np.square(error))) < 0.9
    assert 0.8 < np.sqrt(np.mean(np.square(stated)) / np.mean(np.square(error))) < 1.25
