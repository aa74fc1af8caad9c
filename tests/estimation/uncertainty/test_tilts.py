"""Contacts that are computed under a surface that is tilted against the believed one."""

from types import SimpleNamespace

import numpy as np
import pytest

from meshskin.estimation.uncertainty.tilts import tilts


@pytest.mark.parametrize("slope", [0.0, 0.03])
def test_contacts_under_a_tilted_surface_are_displaced_by_the_radius(slope):
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(-5e-3, 5e-3, (300, 2)), np.zeros(300)])
    data = SimpleNamespace(
        ids=np.arange(2),
        taxel=np.repeat([0, 1], 150),
        contact=np.arange(300),
        pressure=rng.uniform(1.0, 2.0, 300),
        belief=SimpleNamespace(indenter=SimpleNamespace(radius=0.01)),
    )
    height = slope * points[:, 0] + rng.normal(0.0, 1e-6, 300)
    found = tilts(data, points, height)
    np.testing.assert_allclose(found, np.tile([0.01 * slope, 0.0, 0.0], (2, 1)), atol=1e-5)
