"""The response and the variances that a part of the taxels shows, as the start of all."""

from dataclasses import replace

import numpy as np
import pytest

from meshskin.core.progress import Stage
from meshskin.estimation.data.gather import gather
from meshskin.estimation.joint.pressure import OBSERVED
from meshskin.estimation.learned import start as module
from meshskin.estimation.learned.estimate import with_learned_response
from meshskin.estimation.learned.start import _part, begin, with_first_response
from meshskin.estimation.trilateration import trilaterate

from .test_estimate import TAXELS, TRUTH, belief, bell, recording, world


@pytest.fixture(scope="module")
def started():
    """Estimates at their start of a bell-shaped profile with scattered contacts."""
    log = recording(*world(bell, contacts=600, scatter=2e-4))
    data = gather(log, belief(contact="learned"))
    start = trilaterate.least_squares(data)

    def make():
        response = with_learned_response(data, TRUTH)
        return begin(response, np.arange(TAXELS), start, Stage())

    return make


@pytest.fixture
def small_parts(monkeypatch):
    """Two regions of nine taxels, for skins of 36 taxels and more."""
    for name, value in {"PARTS": 2, "SIZE": 9, "LEAST": 2}.items():
        monkeypatch.setattr(module, name, value)


def test_a_part_reads_what_all_taxels_read(started):
    """Readings, their contacts and the references of the response are those of the whole."""
    effects, taxels = started(), np.array([3, 4, 11, 30])
    u, rng = effects.unknowns, np.random.default_rng(1)
    errors = rng.standard_normal(u.errors.shape) * [1e-4, 1e-4, 0.05]
    effects.move(replace(u, s=0.05 * rng.standard_normal(len(u.s)), errors=errors))
    part, rows = _part(effects, taxels), effects.readings.of(taxels)
    assert len(part.data.points) < len(effects.data.points)
    np.testing.assert_allclose(part.mu, effects.mu[rows], rtol=1e-12)
    np.testing.assert_allclose(part.jacobian, effects.jacobian[rows], rtol=1e-9, atol=1e-12)
    read = part.readings.kind == OBSERVED
    pressure = part.data.pressure[part.readings.source[read]]
    np.testing.assert_array_equal(pressure, part.readings.level[read])
    np.testing.assert_array_equal(taxels[part.readings.taxel], effects.readings.taxel[rows])


def test_all_taxels_take_fewer_steps_to_the_same_optimum(started, small_parts):
    alone, first = started(), with_first_response(started())
    assert first.deviations.position == pytest.approx(2e-4, rel=0.3)  # that of a part
    steps = []
    for effects in (alone, first):
        begun = len(effects.iterates)
        assert effects.converge()
        steps.append(len(effects.iterates) - begun)
    assert steps[1] <= steps[0] - 3
    covariance = alone.system().covariances()[0][:, :2, :2]
    information = np.linalg.inv(covariance)
    points = (x.unknowns.parametrization for x in (alone, first))
    apart = np.subtract(*(x.points() for x in points))
    along = np.einsum("nik,ni->nk", alone.unknowns.parametrization.charts.tangents, apart)
    moved = np.einsum("ni,nij,nj->n", along, information, along)
    assert np.sqrt(np.mean(moved)) < 0.1
    assert first.deviations.position == pytest.approx(alone.deviations.position, rel=0.05)


def test_a_part_that_does_not_converge_changes_nothing(started, small_parts, monkeypatch):
    effects = started()
    before, deviations = effects.unknowns, effects.deviations
    monkeypatch.setattr(type(effects), "converge", lambda effects: False)
    assert with_first_response(effects) is effects
    assert effects.unknowns is before
    assert effects.deviations is deviations


def test_few_taxels_are_estimated_together(started, monkeypatch):
    monkeypatch.setattr(module, "_part", lambda *arguments: pytest.fail("a part"))
    with_first_response(started())
