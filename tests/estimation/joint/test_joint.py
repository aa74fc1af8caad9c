"""The joint estimate: exact on ideal data, at the Cramér-Rao bound with noise, wrong starts."""

from dataclasses import replace

import numpy as np
import pytest

from meshskin.core.errors import CalibrationError
from meshskin.estimation import chart
from meshskin.estimation.calibrate import calibrate
from meshskin.estimation.data.gather import gather
from meshskin.estimation.joint import maximum_likelihood
from meshskin.estimation.trilateration import trilaterate
from meshskin.estimation.uncertainty.metrics import cramer_rao, nees, nees_band, position_errors
from meshskin.geometry.primitives import Ellipsoid


def error(world, found):
    return np.linalg.norm(found.points - world.truth, axis=1)


def test_exact_on_ideal_data_with_the_wrong_modulus(world):
    for factor in (1.0, 2.5):
        found = maximum_likelihood.optimum(
            gather(world.record(), world.belief(young=factor * world.young))
        ).result()
        assert error(world, found).max() < 1e-7
        assert found.modulus == pytest.approx(world.modulus, rel=1e-5)


def test_exact_on_an_ellipsoid(world):
    other = type(world)(extent=12e-3, body=Ellipsoid((0.1, 0.103, 0.099)))
    found = maximum_likelihood.optimum(gather(other.record(), other.belief())).result()
    assert error(other, found).max() < 1e-6
    assert np.abs(other.body.closest(found.points).distance).max() < 1e-9


def many(world, seeds, sigma=0.01):
    """Mean errors over the bound's expectation, and mean NEES, of each seed."""
    belief = world.belief(sigma, 5 * sigma)
    ratio, normalized = [], []
    for seed in range(seeds):
        recording = world.record(sigma, 5 * sigma, seed)
        bound = cramer_rao(recording, belief, world.skin)
        found = calibrate(recording, belief)
        ratio.append(position_errors(found, world.skin).mean() / bound.mean)
        normalized.append(nees(found, world.skin).mean())
    return np.array(ratio), np.array(normalized)


@pytest.mark.deep
def test_reaches_the_bound_with_consistent_covariance(world):
    seeds = 6
    ratio, normalized = many(world, seeds)
    # The mean of n errors, each Rayleigh-like, scatters by 0.52 / sqrt(n) of itself.
    assert abs(ratio.mean() - 1) < 4 * 0.52 / np.sqrt(seeds * len(world.truth))
    low, high = nees_band(seeds * len(world.truth), 0.999)
    assert low < normalized.mean() < high


@pytest.mark.slow
@pytest.mark.parametrize("sigma", [0.01, 0.03])
def test_reaches_the_bound_over_forty_seeds(world, sigma):
    ratio, normalized = many(world, 40, sigma)
    assert ratio.mean() == pytest.approx(1.0, abs=0.05)
    low, high = nees_band(40 * len(world.truth))
    assert low < normalized.mean() < high


def test_without_a_noise_model_the_residuals_scale_the_covariance(world):
    recording = world.record(0.01, 0.05)
    known = maximum_likelihood.optimum(gather(recording, world.belief(0.01, 0.05))).result()
    unknown = maximum_likelihood.optimum(gather(recording, world.belief(None, 0.05))).result()
    assert unknown.covariance == pytest.approx(known.covariance, rel=0.5, abs=3e-11)
    assert error(world, unknown).mean() < 20e-6


@pytest.mark.slow
def test_silent_readings_keep_the_modulus_unbiased(world):
    bias = []
    for seed in range(3):
        data = gather(world.record(0.1, 0.1, seed), world.belief(0.1, 0.1))
        pair = (data, replace(data, noise=None))  # the noise is estimated, then
        bias.append(
            [maximum_likelihood.optimum(d).result().modulus / world.modulus - 1 for d in pair]
        )
    # without the silent readings it is more than 2 %
    assert np.abs(np.mean(bias, axis=0)).max() < 0.02


def test_a_wrong_start_is_restarted_from_the_centroid(world):
    data = gather(world.record(0.01, 0.05), world.belief(0.01, 0.05))
    good = trilaterate.least_squares(data)
    points = good.points.copy()
    wrong = [3, 17, 30]  # 10 mm off
    points[wrong] = world.body.closest(points[wrong] + [7e-3, -7e-3, 0]).point
    hit = world.body.closest(points)
    start = replace(good, points=points, rotations=chart.frames(hit.normal))
    found = maximum_likelihood.optimum(data, start).result()
    reference = maximum_likelihood.optimum(data).result()
    assert set(found.restarted) <= set(wrong)
    assert len(found.restarted)
    assert np.allclose(found.points, reference.points, atol=1e-8)
    assert len(reference.restarted) == 0


def test_a_defective_taxel_misfits_and_does_not_affect_the_others(world):
    recording = world.record(0.01, 0.05)
    broken = recording.reading_taxel == world.ids[20]
    bent = recording.with_columns(pressure=np.where(broken, 1.6, 1.0) * recording.pressure)
    found = maximum_likelihood.optimum(gather(bent, world.belief(0.01, 0.05))).result()
    assert np.argmax(found.chi2) == 20
    assert found.chi2[20] > 50 * np.median(found.chi2)
    assert np.delete(error(world, found), 20).mean() < 25e-6


def test_iterates_start_at_the_trilateration_and_end_at_the_estimate(world):
    data = gather(world.record(0.01, 0.05), world.belief(0.01, 0.05))
    found = maximum_likelihood.optimum(data).result()
    start = trilaterate.least_squares(data)
    assert np.allclose(found.iterates[0], start.points, atol=1e-9)
    assert np.allclose(found.iterates[-1], found.points, atol=1e-8)
    assert len(found.iterates) > 2


def test_nothing_determined_is_refused(world):
    data = gather(world.record(), world.belief())
    first = np.unique(data.taxel, return_index=True)[1]
    one = replace(data, **{n: getattr(data, n)[first] for n in ("contact", "taxel", "pressure")})
    with pytest.raises(CalibrationError, match=r"no taxel is determined.*fewer than three"):
        maximum_likelihood.optimum(one).result()
