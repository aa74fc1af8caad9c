"""Descent along limits: against closed forms, and in a saw's tooth."""

import numpy as np
import pytest

from meshskin.tuning.feasible_sqp import QuadraticModel, descend


def run(start, limits, slopes, centre, bent):
    """From `start` towards `centre`, of a quadratic form `bent`; every point that was taken."""
    taken = []

    def model(x):
        taken.append(x)
        low, high = np.full(2, -5.0) - x, np.full(2, 5.0) - x
        return QuadraticModel(bent @ (x - centre), limits(x), slopes(x), bent, low, high)

    def merit(x, g):
        return 0.5 * (x - centre) @ bent @ (x - centre) if g.max() <= 1e-9 else 1e9

    end, _ = descend(start, model, limits, merit)
    return end, limits(end), taken


def test_it_ends_where_the_limit_and_the_form_touch():
    """Stiff in one direction by 1e4: (x - c)' H (x - c) / 2 least on x + y <= 1."""
    bent, centre, normal = np.diag([1e4, 1.0]), np.array([1.0, 1.0]), np.ones(2)
    end, g, _ = run(
        np.zeros(2), lambda x: np.array([x.sum() - 1.0]), lambda x: normal[None], centre, bent
    )
    inverse = np.linalg.inv(bent)
    exact = centre - inverse @ normal * (normal @ centre - 1.0) / (normal @ inverse @ normal)
    assert end == pytest.approx(exact, abs=1e-6)
    assert g == pytest.approx([0.0], abs=1e-6)


def test_in_a_tooth_it_goes_along_and_keeps_the_limit():
    """The limit is a saw over y whose teeth rise 50 times as fast as x gains."""

    def saw(x):
        return np.array([10.0 * np.abs((50.0 * x[1] + 0.5) % 1.0 - 0.5) + 0.1 * x[0] - 0.2])

    def slopes(x):
        rising = np.sign((50.0 * x[1] + 0.5) % 1.0 - 0.5)
        return np.array([[0.1, 500.0 * rising]])

    end, g, taken = run(np.array([0.0, 1e-4]), saw, slopes, np.array([4.0, 0.0]), np.eye(2))
    assert all(saw(x) <= 1e-9 for x in taken)
    assert g.max() <= 1e-9
    assert end[0] > 1.9  # 2 at the tooth's root


def test_of_the_largest_of_two_every_one_counts():
    """Along the crest of x / 9 + |y - x| <= 0.1: by the slope of one side alone it stalls."""

    def limits(x):
        aside = x[1] - x[0]
        return np.array([x[0] / 9.0 + aside, x[0] / 9.0 - aside]) - 0.1

    def slopes(x):
        return np.array([[1.0 / 9.0 - 1.0, 1.0], [1.0 / 9.0 + 1.0, -1.0]])

    start, goal = np.array([0.0, 0.0]), np.array([5.0, 0.0])
    end, g, taken = run(start, limits, slopes, goal, np.eye(2))
    assert end == pytest.approx([0.9, 0.9], abs=1e-9)
    assert g == pytest.approx([0.0, 0.0], abs=1e-9)
    assert len(taken) <= 8

    def largest(x):  # the same limit as one: it has one side's slope
        return limits(x).max(keepdims=True)

    def one(x):
        return slopes(x)[[np.argmax(limits(x))]]

    stalled, _, steps = run(start, largest, one, goal, np.eye(2))
    assert len(steps) > len(taken)
    assert stalled[0] < 0.9 - 1e-5
