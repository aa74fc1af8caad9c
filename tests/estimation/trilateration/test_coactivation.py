"""Initial estimates from co-activation: independent of pressure, close enough to converge."""

from dataclasses import replace

import numpy as np
import pytest

from meshskin.estimation.data.gather import gather
from meshskin.estimation.joint import maximum_likelihood
from meshskin.estimation.trilateration import coactivation, trilaterate


@pytest.fixture(scope="module")
def data(world):
    return gather(world.record(0.01, 0.05), world.belief(0.01, 0.05))


@pytest.fixture(scope="module")
def best(data, world):
    return maximum_likelihood.optimum(data).result()


def errors(world, fit):
    return np.linalg.norm(fit.points - world.truth, axis=1)


def test_no_pressure_enters(world, data):
    alone = coactivation.contact_centroid_start(data)
    blind = replace(data, pressure=np.random.default_rng(0).uniform(1, 2, len(data.pressure)))
    assert np.array_equal(coactivation.contact_centroid_start(blind).points, alone.points)
    assert alone.found.all()
    error = errors(world, alone)
    assert error.mean() < 1.5e-3
    assert error.max() < 4.5e-3  # at the border of the contacts
    sigma = np.sqrt(np.trace(alone.covariance, axis1=1, axis2=2))
    assert np.all(error < 2 * sigma)
    assert np.abs(world.body.closest(alone.points).distance).max() < 1e-9


def test_the_joint_estimate_reaches_its_optimum_from_there(world, data, best):
    found = maximum_likelihood.optimum(data, coactivation.contact_centroid_start(data)).result()
    assert np.allclose(found.points, best.points, atol=1e-8)


def test_the_contact_centroid_replaces_a_failed_trilateration(world, data, best):
    right = trilaterate.least_squares(data)
    points, reasons = right.points.copy(), right.reasons.copy()
    points[4] = world.body.closest(points[4] + [0.0, 12e-3, 0.0]).point
    points[9], reasons[9] = np.nan, trilaterate.COLLINEAR
    failed = replace(right, points=points, reasons=reasons)
    start = coactivation.initial_estimate(data, failed)
    alone = coactivation.contact_centroid_start(data)
    same = np.flatnonzero(np.all(start.points == alone.points, axis=1))
    assert list(same) == [4, 9]
    assert start.found.all()
    found = maximum_likelihood.optimum(data, trilaterated=failed).result()
    assert np.allclose(found.points, best.points, atol=1e-8)


@pytest.mark.parametrize(
    "error_mm", [4, 12, *(pytest.param(k, marks=pytest.mark.slow) for k in (0.5, 2, 6))]
)
def test_the_joint_estimate_converges_from_displaced_starts(world, data, best, error_mm):
    rng = np.random.default_rng(1)
    angle = rng.uniform(-np.pi, np.pi, len(world.truth))
    x, y = np.moveaxis(best.rotations[:, :, :2], 2, 0)
    away = np.cos(angle)[:, None] * x + np.sin(angle)[:, None] * y
    off = world.body.closest(best.points + 1e-3 * error_mm * away).point
    start = replace(trilaterate.least_squares(data), points=off)
    found = maximum_likelihood.optimum(data, start).result()
    assert np.allclose(found.points, best.points, atol=1e-6)


def test_reasons_of_taxels_without_a_start(world, data):
    few = np.flatnonzero(data.taxel == 3)[:2]
    line = np.flatnonzero((data.taxel == 5) & (np.abs(data.points[data.contact, 1]
                          - data.points[data.contact[data.taxel == 5][0], 1]) < 1e-4))  # fmt: skip
    others = np.flatnonzero(~np.isin(data.taxel, [3, 5]))
    rows = np.concatenate([few, line, others])
    columns = {n: getattr(data, n)[rows] for n in ("contact", "taxel", "pressure")}
    rng = np.random.default_rng(0)
    wild = columns["taxel"] == 8  # it answers wherever the skin is touched
    columns["contact"][wild] = rng.integers(len(data.points), size=wild.sum())
    fit = coactivation.contact_centroid_start(replace(data, **columns))
    reasons = {3: trilaterate.TOO_FEW, 5: trilaterate.COLLINEAR, 8: coactivation.EVERYWHERE}
    for row, why in reasons.items():
        assert fit.reasons[row] == why
        assert np.isnan(fit.points[row]).all()
    assert fit.found.sum() == len(world.truth) - 3


@pytest.mark.slow
def test_false_responses_all_over_the_body(world):
    sigma, threshold = 0.2, 0.2  # a third of all contacts and taxels
    belief = world.belief(sigma, threshold)
    for seed in range(2):
        data = gather(world.record(sigma, threshold, seed), belief)
        near = coactivation.without_distant_readings(data)
        assert len(near.pressure) < 0.6 * len(data.pressure)
        start = coactivation.initial_estimate(near, trilaterate.least_squares(near))
        assert errors(world, start).max() < 4e-3
        right = maximum_likelihood.optimum(data, replace(start, points=world.truth)).result()
        found = maximum_likelihood.optimum(data).result()
        assert np.allclose(found.points, right.points, atol=1e-6)
        assert errors(world, found).mean() < 0.35e-3


def test_false_responses_to_sparse_contacts(world, data):
    """The contact about which a taxel read most is millimetres beside it where contacts are few."""
    rng = np.random.default_rng(3)
    kept = rng.choice(len(data.points), len(data.points) // 40, replace=False)
    sparse = data.select(np.isin(data.contact, kept))
    taxel = np.repeat(np.unique(sparse.taxel), 2)
    contact = np.concatenate([
        rng.choice(kept[np.linalg.norm(data.points[kept] - point, axis=1) > 15e-3], 2)
        for point in world.truth[taxel[::2]]
    ])  # fmt: skip
    false = replace(
        sparse,
        contact=np.append(sparse.contact, contact),
        taxel=np.append(sparse.taxel, taxel),
        pressure=np.append(sparse.pressure, np.full(len(taxel), 0.04 * world.peak_reference)),
    )
    found = coactivation.without_distant_readings(false)
    assert np.array_equal(found.pressure[: len(sparse.pressure)], sparse.pressure)
    assert len(found.pressure) - len(sparse.pressure) < 0.1 * len(taxel)


def test_sound_recordings_are_unchanged(data):
    assert coactivation.without_distant_readings(data) is data
