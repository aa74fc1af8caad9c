import casadi as ca
import numpy as np
import pytest

from meshskin.core.row_function import BATCH, RowFunction


@pytest.mark.parametrize("count", [0, 1, BATCH - 1, BATCH, 2 * BATCH + 3])
def test_every_row_has_its_own_output(count):
    x = ca.SX.sym("x", 3)
    function = RowFunction.compiled("rows", x, ca.vertcat(x[0] * x[1], ca.sin(x[2]), 0.0, x[1]))
    rows = np.random.default_rng(0).normal(size=(3, count)).T
    first, second, third = rows.T
    expected = np.stack([first * second, np.sin(third), 0.0 * first, second], axis=1)
    np.testing.assert_allclose(function(rows), expected, rtol=1e-15)
