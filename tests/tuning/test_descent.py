"""Descent along limits: against closed forms, and in a saw's tooth."""

import numpy as np
import pytest

from meshskin.tuning.descent import descend


def run(start, limits, slopes, centre, bent):
    """From `start` towards `centre`, of a quadratic form `bent`; every point that was taken."""
    taken = []

    def model(x):
        taken.append(x)
        return bent @ (x - centre), slopes(x), bent

    def merit(x, g):
        return 0.5 * (x - centre) @ bent @ (x - centre) if g.max() <= 1e-9 else 1e9

    low, high = np.full(2, -5.0), np.full(2, 5.0)
    return *descend(start, limits, model, merit, low, high), taken


def test_it_ends_where_the_limit_and_the_form_touch():
    """Stiff in one direction by 1e4: (x - c)' H (x - c) / 2 least on x + y <= 1."""
    bent, centre, normal = np.diag([1e4, 1.0]), np.array([1.0, 1.0]), np.ones(2)
    end, g, _, _ = run(
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

    end, g, _, taken = run(np.array([0.0, 1e-4]), saw, slopes, np.array([4.0, 0.0]), np.eye(2))
    assert all(saw(x) <= 1e-9 for x in taken)
    assert g.max() <= 1e-9
    assert end[0] > 1.9  # 2 at the tooth's root
