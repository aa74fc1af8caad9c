"""Friction: the shear of the skin under a contact that sticks until it slides."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import meshskin as ms
from meshskin.effects.friction import Friction
from meshskin.estimation.joint.friction import shears

LIMIT = 1e-3
STEP = 0.25e-3


def path(x, y=None, time=None):
    """Contacts on the plane z = 0."""
    points = np.column_stack([x, np.zeros_like(x) if y is None else y, np.zeros_like(x)])
    time = 0.01 * np.arange(len(x)) if time is None else time
    normals = np.tile([0.0, 0.0, 1.0], (len(x), 1))
    return SimpleNamespace(points=points, normals=normals, time=time)


def test_it_sticks_slides_and_sticks_again_where_the_motion_turns():
    there = STEP * np.arange(11)
    back = there[-1] - STEP * np.arange(1, 11)
    found = shears(path(np.concatenate([there, back])), LIMIT)[0]
    expected = [*np.minimum(there, LIMIT), *np.maximum(LIMIT - STEP * np.arange(1, 11), -LIMIT)]
    assert np.allclose(found, np.column_stack([expected, np.zeros((21, 2))]), atol=1e-12)


def test_a_pause_releases_the_skin():
    time = 0.01 * np.arange(20) + np.where(np.arange(20) < 10, 0.0, 1.0)
    found = shears(path(STEP * np.arange(20.0), time=time), LIMIT)[0]
    assert found[9, 0] == pytest.approx(LIMIT)
    assert found[10, 0] == 0.0
    assert found[11, 0] == pytest.approx(STEP)


@pytest.mark.parametrize("limit", [0.2e-3, 0.9e-3, -0.4e-3])
def test_the_derivative_in_the_limit(limit):
    turn = np.linspace(0.0, 6.0, 200)
    made = path(4e-3 * np.sin(turn), 2e-3 * np.sin(3.1 * turn))
    shear, slope = shears(made, limit)
    ahead, behind = (shears(made, limit + h)[0] for h in (1e-9, -1e-9))
    assert np.allclose((ahead - behind) / 2e-9, slope, atol=1e-4)
    assert np.allclose(shear, -shears(made, -limit)[0])


@pytest.mark.slow
@pytest.mark.parametrize("coefficient", [0.15, 0.3])
def test_the_effect_friction_is_estimated(noisy, coefficient):
    scene = replace(noisy, effects=(*noisy.effects, Friction(coefficient=coefficient)))
    found = ms.calibrate(ms.simulate(scene, seed=1), replace(noisy.belief(), contact="auto"))
    off = np.linalg.norm(found.positions - noisy.skin.positions, axis=1)
    rms = np.sqrt(np.mean(off**2))
    assert rms < 0.012e-3
    assert 0.8 < np.sqrt(np.mean(found.position_sigma**2)) / rms < 1.25
    limit, sigma = found.unknowns["friction"]
    assert limit == pytest.approx(coefficient * 2.96e-3, rel=0.02)  # Friction.slip
    assert sigma < 0.01e-3
    assert found.verdict.level == "PASS"
