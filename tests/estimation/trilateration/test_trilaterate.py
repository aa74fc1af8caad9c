"""Trilateration: exact on ideal data, consistent on noisy data, reasons where impossible."""

import numpy as np
import pytest

from meshskin.estimation.data.gather import gather
from meshskin.estimation.trilateration import trilaterate
from meshskin.estimation.uncertainty.metrics import nees_band
from meshskin.geometry.body import Body
from meshskin.geometry.primitives import Ellipsoid


def error(world, fit):
    return np.linalg.norm(fit.points - world.truth, axis=1)


@pytest.mark.parametrize("method", [trilaterate.least_squares, trilaterate.three_circles])
def test_exact_on_ideal_data(world, method):
    fit = method(gather(world.record(), world.belief()))
    assert fit.found.all()
    assert error(world, fit).max() < 1e-7
    assert np.allclose(world.body.closest(fit.points).distance, 0, atol=1e-12)


def test_exact_on_a_mesh_and_on_an_ellipsoid(world):
    meshed = gather(world.record(), world.belief(body=Body.sphere(0.1)))
    fit = trilaterate.least_squares(meshed)
    assert error(world, fit).max() < 1e-6
    other = type(world)(extent=12e-3, body=Ellipsoid((0.1, 0.103, 0.099)))
    fit = trilaterate.least_squares(gather(other.record(), other.belief()))
    assert error(other, fit).max() < 1e-6


def test_noise_gives_the_stated_errors(world):
    normalized, circles = [], []
    for seed in range(4):
        data = gather(world.record(0.01, 0.05, seed), world.belief(0.01, 0.05))
        fit = trilaterate.least_squares(data)
        assert error(world, fit).mean() < 20e-6
        local = np.einsum("nij,ni->nj", fit.rotations[:, :, :2], world.truth - fit.points)
        weighed = np.einsum("ni,nij,nj->n", local, np.linalg.inv(fit.covariance), local)
        normalized.append(weighed.mean())
        circles.append(error(world, trilaterate.three_circles(data)).mean())
    low, high = nees_band(4 * len(world.truth), 0.999)
    assert low < np.mean(normalized) < high
    assert np.mean(circles) > 3 * error(world, fit).mean()  # three circles of some fifty


def test_noise_without_a_threshold_does_not_bias_positions(world):
    data = gather(world.record(0.01, 0.0), world.belief(0.01, 0.0))
    assert len(data.pressure) > 0.4 * len(world.points) * len(world.truth)
    start = trilaterate.centroids(data)
    assert np.linalg.norm(start - world.truth, axis=1).max() < 0.6e-3
    assert error(world, trilaterate.least_squares(data)).mean() < 20e-6


@pytest.mark.parametrize("method", [trilaterate.least_squares, trilaterate.three_circles])
def test_reasons_of_undetermined_taxels(world, method):
    data = gather(world.record(), world.belief())
    middle, few, silent = 10, 11, 12
    line = np.abs(data.points[:, 1] - world.truth[middle, 1]).argmin()
    on_line = np.isclose(data.points[:, 1], data.points[line, 1], atol=1.5e-4)
    rows = np.ones(len(data.taxel), dtype=bool)
    rows[(data.taxel == middle) & ~on_line[data.contact]] = False
    rows[np.flatnonzero(data.taxel == few)[2:]] = False
    rows[data.taxel == silent] = False
    cut = data.select(rows)
    assert cut.counts[middle] > 5
    fit = method(cut)
    assert fit.reasons[middle] == trilaterate.COLLINEAR
    assert (fit.reasons[[few, silent]] == trilaterate.TOO_FEW).all()
    assert (~fit.found).sum() == 3
    assert np.isnan(fit.points[[middle, few, silent]]).all()
    assert np.isinf(fit.covariance[middle][[0, 1], [0, 1]]).all()
    assert error(world, fit)[fit.found].max() < 1e-7
