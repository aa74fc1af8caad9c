"""Patches over a surface whose curvature jumps, as at the creases of a mesh."""

import numpy as np

from meshskin.contact import Patches
from meshskin.estimation.joint.patch_derivatives import MAX_CHANGE, SurfaceGradients


def test_a_steep_gradient_changes_no_patch_beyond_its_limit():
    size = np.full(2, 4e-3)
    at = Patches(size, size, np.full(2, 1e5), np.full(2, 1e-3), np.full(2, 0.5))
    slope = np.array([[1e3, 0.0, 0.0], [20.0, 0.0, 0.0]])
    none = np.zeros((2, 3))
    found = SurfaceGradients(slope, -slope, none, -slope, none).patches(
        at, np.array([[0.5, 0.0, 0.0], [1e-3, 0.0, 0.0]])
    )
    np.testing.assert_allclose(found.first / size, np.exp([MAX_CHANGE, 0.02]))
    np.testing.assert_allclose(found.second / size, np.exp([-MAX_CHANGE, -0.02]))
    assert np.isfinite(found.peak).all()
