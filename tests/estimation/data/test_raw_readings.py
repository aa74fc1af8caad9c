"""The polarity of raw readings."""

import numpy as np
import pytest

from meshskin.estimation.data.raw_readings import falls_with_pressure


@pytest.mark.parametrize("dense", [True, False])
@pytest.mark.parametrize("sign", [1, -1])
def test_the_polarity_is_found_beside_outlying_readings(dense, sign):
    """Bells of 36 taxels on a plane, with noise and 0.3 % of outlying readings."""
    rng = np.random.default_rng(0)
    taxels = 5.0 * np.array([[x, y] for x in range(6) for y in range(6)])
    points = np.column_stack([rng.uniform(-5, 30, (900, 2)), np.zeros(900)])
    square = np.sum((points[:, None, :2] - taxels) ** 2, axis=2)
    level = 200 * np.exp(-square / 18) + rng.normal(size=square.shape)
    far = rng.random(level.shape) < 0.003
    level[far] = rng.uniform(0, 400, int(far.sum()))
    contact, taxel = np.nonzero(np.ones_like(level) if dense else level > 10)
    values = sign * np.round(level[contact, taxel])
    assert falls_with_pressure(values, contact, taxel, points) == (sign < 0)
