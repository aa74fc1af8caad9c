"""Circles in planes scaled along the patches' axes: exact on ideal data, circles on a sphere."""

from dataclasses import replace

import numpy as np
import pytest

from meshskin.contact import ContactModel
from meshskin.estimation.data.gather import gather
from meshskin.estimation.trilateration import trilaterate
from meshskin.estimation.trilateration.circles import Circles, Ellipses, circles
from meshskin.estimation.uncertainty.metrics import nees_band
from meshskin.geometry.primitives import Ellipsoid

MODELS = {"elliptic": ContactModel("elliptic"), "layered": ContactModel("layered", 0.49, 4e-3)}


@pytest.fixture(scope="module", params=MODELS)
def oval(world, request):
    """Taxels on an ellipsoid with relative curvatures up to 1.8 : 1."""
    body = Ellipsoid((0.1, 0.032, 0.1))
    out = type(world)(extent=12e-3, body=body, model=MODELS[request.param])
    out.pressures = out.pressures().copy  # computed once
    return out


def error(world, fit):
    return np.linalg.norm(fit.points - world.truth, axis=1)


def test_ideal_data(oval):
    data = gather(oval.record(), oval.belief())
    assert (data.patches.second / data.patches.first).max() > 1.3
    # The disc mean's sum errs by 1e-4 of the peak, which at the patch's edge is much in distance.
    for method, limit in ((trilaterate.least_squares, 6e-6), (trilaterate.three_circles, 2e-6)):
        fit = method(data)
        assert fit.found.all()
        assert error(oval, fit).max() < limit
    mistaken = replace(data, model=ContactModel())  # ellipses taken for circles
    assert error(oval, trilaterate.least_squares(mistaken)).max() > 60e-6


def test_radii_depend_little_on_the_initial_position(oval):
    """The little by which the radius depends on the direction is renewed with the estimate."""
    data = gather(oval.record(), oval.belief())
    rng = np.random.default_rng(2)
    away = oval.body.closest(oval.truth + 0.5e-3 * rng.normal(size=oval.truth.shape)).point
    near = circles(data, oval.truth)
    far = circles(data, away)
    steep = (near.steepness > 0.3) & (near.radii > 2e-3)
    moved = np.linalg.norm(away - oval.truth, axis=1)[near.owner]
    change = np.abs(far.radii - near.radii)[steep]
    assert (change / moved[steep]).max() < 0.2  # so that passes converge
    assert change.max() > 1e-6


def test_residuals_and_equations(oval):
    data = gather(oval.record(), oval.belief())
    found = circles(data, oval.truth)
    assert isinstance(found, Ellipses)
    offset = oval.truth[found.owner] - found.centres
    distance, gradient = found.distance(offset)
    steep = found.steepness > 0.3
    assert np.abs(distance - found.radii)[steep].max() < 2e-6
    for k, axis in enumerate(1e-8 * np.eye(3)):
        change = (found.distance(offset + axis)[0] - found.distance(offset - axis)[0]) / 2e-8
        assert np.allclose(change, gradient[:, k], atol=1e-5)
    tangents = np.broadcast_to(np.eye(3)[:, :2], (len(offset), 3, 2))
    y = np.array([0.4e-3, -0.7e-3])
    c, b = found.conic(-offset, tangents)
    first, last = (found.distance(offset + z)[0] ** 2 for z in (tangents @ y, 0 * offset))
    square = sum((tangents @ y * axis).sum(axis=1) ** 2 for axis in (found.first, found.second))
    assert np.allclose(last, b, atol=1e-15)
    assert np.allclose(first, square - 2 * c @ y + b, rtol=1e-6)
    assert isinstance(found.select(steep), Ellipses)


def test_on_a_sphere_the_ellipses_are_circles(world):
    recording = world.record(0.01, 0.05)
    round_ = gather(recording, world.belief(0.01, 0.05))
    oval = gather(recording, world.belief(0.01, 0.05, contact="elliptic"))
    one, other = (circles(data, world.truth) for data in (round_, oval))
    assert type(one) is Circles
    assert np.array_equal(one.owner, other.owner)
    steep = one.steepness > 0.3
    assert np.abs(one.radii - other.radii)[steep].max() < 2e-6
    assert np.allclose(one.weights[steep], other.weights[steep], rtol=0.03)
    fits = [trilaterate.least_squares(data) for data in (round_, oval)]
    assert np.abs(fits[0].points - fits[1].points).max() < 3e-6


def test_noise_gives_the_stated_errors(oval):
    normalized = []
    for seed in range(4):
        data = gather(oval.record(0.01, 0.05, seed), oval.belief(0.01, 0.05))
        fit = trilaterate.least_squares(data)
        assert error(oval, fit).mean() < 20e-6
        local = np.einsum("nij,ni->nj", fit.rotations[:, :, :2], oval.truth - fit.points)
        weighed = np.einsum("ni,nij,nj->n", local, np.linalg.inv(fit.covariance), local)
        normalized.append(weighed.mean())
    low, high = nees_band(4 * len(oval.truth), 0.999)
    assert low < np.mean(normalized) < high


def test_pressures_above_the_maximum_are_distance_zero(oval):
    data = gather(oval.record(), oval.belief())
    strong = data.pressure > 0.8 * data.peaks[data.contact]
    lifted = replace(data, pressure=np.where(strong, 1.3 * data.pressure, data.pressure))
    found = circles(lifted, oval.truth)
    assert (found.radii == 0).sum() > 20
    assert np.isfinite(found.weights).all()
    fit = trilaterate.least_squares(lifted)
    assert fit.found.all()
    assert error(oval, fit).max() < 0.1e-3
