"""Operations on groups of rows, against loops."""

import numpy as np
import pytest

from meshskin.core.arrays import (
    cross,
    huber_weights,
    means_by_group,
    ranges,
    rows_by_key,
    runs,
    spread_rows,
    sums_by_group,
)


def test_ranges_are_concatenated():
    first, count = np.array([3, 0, 7]), np.array([2, 0, 3])
    assert ranges(first, count).tolist() == [3, 4, 7, 8, 9]


def test_runs_are_the_slices_of_true_values():
    mask = np.array([True, True, False, True, False, False, True])
    assert runs(mask) == [slice(0, 2), slice(3, 4), slice(6, 7)]
    assert runs(~mask) == [slice(2, 3), slice(4, 6)]
    assert runs(mask[:0]) == []


def test_sums_by_group_of_any_shape():
    rng = np.random.default_rng(0)
    values, group = rng.normal(size=(20, 2, 3)), rng.integers(0, 4, 20)
    expected = [values[group == k].sum(axis=0) for k in range(6)]
    np.testing.assert_allclose(sums_by_group(values, group, 6), expected, atol=1e-14)
    assert sums_by_group(values, group).shape == (group.max() + 1, 2, 3)


def test_means_by_group_are_weighted():
    rng = np.random.default_rng(0)
    values, group, weight = rng.normal(size=(20, 2, 3)), rng.integers(0, 4, 20), rng.random(20)
    weight[group == 2] = 0.0
    found = means_by_group(values, group, 6, weight)
    for k in (0, 1, 3):
        expected = np.average(values[group == k], axis=0, weights=weight[group == k])
        np.testing.assert_allclose(found[k], expected, atol=1e-14)
    assert np.isnan(found[[2, 4, 5]]).all()
    plain = means_by_group(values[:, 0, 0], group)
    np.testing.assert_allclose(plain[1], values[group == 1, 0, 0].mean(), atol=1e-14)


def test_spread_rows_fills_the_others():
    found = spread_rows(np.array([[1.0, 2.0], [3.0, 4.0]]), np.array([2, 0]), 3, [np.inf, 0.0])
    assert found.tolist() == [[3.0, 4.0], [np.inf, 0.0], [1.0, 2.0]]


def test_huber_weights_fall_beyond_one_and_a_half_sigma():
    r = np.array([0.0, -0.29, 0.6, -1.2])
    np.testing.assert_allclose(huber_weights(r, 0.2), 25 * np.array([1.0, 1.0, 0.5, 0.25]))


def test_rows_by_key_keep_their_order():
    groups = rows_by_key(np.array([5, 1, 5, 1, 9]))
    assert [g.tolist() for g in groups] == [[1, 3], [0, 2], [4]]


@pytest.mark.parametrize("shape", [(3,), (1, 3), (5, 4, 3)])
def test_cross_products_are_those_of_numpy(shape):
    a, b = np.random.default_rng(0).standard_normal((2, *shape))
    np.testing.assert_array_equal(cross(a, b), np.cross(a, b))
