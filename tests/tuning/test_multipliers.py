"""Multipliers of limits, against closed forms."""

import numpy as np
import pytest

from meshskin.tuning.feasible_sqp import QuadraticModel


def corner(third):
    """Least -x - y (nearly linear) with x + 2y <= 0, 2x + y <= 0 and x + y <= `third`; worst: z."""
    slopes = np.array([[1.0, 2.0, 0.0], [2.0, 1.0, 0.0], [1.0, 1.0, 0.0]])
    slope, limits = np.array([-1.0, -1.0, 0.0]), np.array([0.0, 0.0, -third])
    end = np.full(3, 1.0)
    return QuadraticModel(slope, limits, slopes, 1e-4 * np.eye(3), -end, end)


def test_of_two_limits_that_meet_each_has_its_multiplier():
    """-c = A^T p: p = (1/3, 1/3) where the third limit is far."""
    model = corner(third=1.0)
    limits, ranges = model.multipliers()
    assert limits == pytest.approx([1 / 3, 1 / 3, 0.0])
    assert not ranges.any()
    assert model.predicted_decrease() == pytest.approx(0.0, abs=1e-9)
    both = model.one_sided_multipliers(np.array([True, False, False]), 1e-3)
    assert both == pytest.approx((1 / 3, 1 / 3), rel=1e-5)


def test_where_a_third_limit_meets_them_relaxing_gains_nothing_and_tightening_costs():
    """x + y <= 0 holds the objective alone: only what is tightened below it costs."""
    both = corner(third=0.0).one_sided_multipliers(np.array([True, False, False]), 1e-3)
    assert both == pytest.approx((0.0, 1 / 3), abs=1e-6)


def test_the_end_of_a_range_has_its_multiplier_and_the_predicted_decrease_is_that_of_the_model():
    free = corner(third=1.0)
    walled = QuadraticModel(
        free.gradient,
        free.limits - 1.0,
        free.jacobian,
        np.eye(3),
        free.low,
        np.array([0.0, 1.0, 1.0]),
    )
    limits, ranges = walled.multipliers()
    assert not limits.any()
    assert ranges == pytest.approx([0.0, 0.0, 0.0, 1.0, 0.0, 0.0])
    # downhill in y alone: y - y^2 / 2 of a step of 0.05
    assert walled.predicted_decrease() == pytest.approx(0.05 - 0.05**2 / 2)
