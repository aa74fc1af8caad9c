"""CasADi functions at many points at once."""

import casadi as ca
import numpy as np
import pytest

from meshskin.core.many_points import BATCH, POINTS, ColumnFunction, RowFunction


def example():
    x = ca.SX.sym("x", 3)
    inside = ca.fmax(x[0], 1e-12)
    return x, ca.vertcat(ca.atan2(x[1], x[2]), ca.sqrt(inside) / (1 + x[1]))


@pytest.mark.parametrize("compiler", ["", "none"])
@pytest.mark.parametrize("count", [0, 1, POINTS - 1, 2 * POINTS + 3])
def test_values_are_those_of_the_expressions(monkeypatch, count, compiler):
    if compiler:
        monkeypatch.setenv("MESHSKIN_COMPILER", compiler)
        monkeypatch.setattr("meshskin.core.codegen._warn", lambda text: None)  # once a process
    rng = np.random.default_rng(0)
    first, pair = rng.uniform(-2, 2, count), rng.uniform(0, 3, (count, 2))
    pair[:2] *= [[1.0, 0.0]]  # on the axes, too
    found = ColumnFunction("example", *example())(count, first, pair)
    value = np.sqrt(np.maximum(first, 1e-12)) / (1 + pair[:, 0])
    expected = np.stack([np.arctan2(*pair.T), value])
    assert found.shape == (2, count)
    assert np.allclose(found, expected, rtol=1e-14, atol=0)


def test_numbers_are_the_same_at_all_points():
    found = ColumnFunction("example", *example())(4, 0.5, 1.0, np.arange(1.0, 5.0))
    assert np.allclose(found[0], np.arctan2(1.0, np.arange(1.0, 5.0)), rtol=1e-14)
    assert np.allclose(found[1], np.sqrt(0.5) / 2, rtol=1e-14)


@pytest.mark.parametrize("count", [0, 1, BATCH - 1, BATCH, 2 * BATCH + 3])
def test_every_row_has_its_own_output(count):
    x = ca.SX.sym("x", 3)
    function = RowFunction.compiled("rows", x, ca.vertcat(x[0] * x[1], ca.sin(x[2]), 0.0, x[1]))
    rows = np.random.default_rng(0).normal(size=(3, count)).T
    first, second, third = rows.T
    expected = np.stack([first * second, np.sin(third), 0.0 * first, second], axis=1)
    np.testing.assert_allclose(function(rows), expected, rtol=1e-15)
