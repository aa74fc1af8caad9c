"""Point pressures of the speed studies: Hertz in the tangent plane; machine code as NumPy."""

import numpy as np
import pytest
from point_readings import PointReadings

from meshskin.contact import hertz
from meshskin.core import codegen
from meshskin.simulation.simulate import run


def test_point_readings_are_hertz_in_the_tangent_plane(prepared, sphere):
    simulator, path = prepared("quasi_static")
    x = sphere.skin.positions
    simulator.reset()
    for steps in run(sphere, simulator, path):
        if steps.phase == 3:
            break
    readings = PointReadings(simulator.loop, np.vstack([x, -x]))(steps.outputs)
    k = len(steps.time) // 2
    point, normal, force = steps.outputs[k, :3], steps.outputs[k, 3:6], steps.outputs[k, 6]
    offset = x - point
    r = np.linalg.norm(offset - np.outer(offset @ normal, normal), axis=1)
    a = hertz.contact_radius(force, 1 / 110, simulator.loop.effective_modulus)
    expected = 1.5 * force / (np.pi * a**2) * np.sqrt(np.maximum(1 - (r / a) ** 2, 0))
    assert np.count_nonzero(expected) > 1
    np.testing.assert_allclose(readings[k, :80], expected, atol=1e-4 * expected.max())
    assert not readings[:, 80:].any()  # the far side of the body


@pytest.mark.skipif(codegen.find_compiler() is None, reason="no C compiler here")
def test_compiled_readings_are_those_of_numpy(prepared, sphere):
    simulator, path = prepared()
    simulator.reset()
    found, total = [], 0
    for steps in run(sphere, simulator, path):
        found.append(steps.outputs)
        total += len(steps.time)
        if total >= 2000:
            break
    outputs = np.concatenate(found)[:2000]
    taxels = np.vstack([sphere.skin.positions, -sphere.skin.positions])
    slow = PointReadings(simulator.loop, taxels)(outputs)
    for dtype, error in ((np.float64, 1e-9), (np.float32, 1e-3)):
        fast = PointReadings(simulator.loop, taxels, dtype, compiled=True)(outputs)
        assert fast.dtype == dtype
        np.testing.assert_allclose(fast, slow, atol=error * slow.max())
    assert np.count_nonzero(slow) > 1000
