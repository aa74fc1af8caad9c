"""What a coarse mesh leaves open of its surface, and what the heights of contacts then tell."""

import numpy as np
import pytest
import trimesh

import meshskin as ms
from meshskin.estimation.data.registration import CELL, cells
from meshskin.estimation.kinematics.mesh_error import MeshError

RADIUS = 0.0375


def tube(sides):
    """A tube of RADIUS, m, by a prism whose faces have its volume, as decimation leaves it."""
    outer = RADIUS * np.sqrt(2 * np.pi / sides / np.sin(2 * np.pi / sides))
    profile = [[0, 0], *([outer, z] for z in np.linspace(0, 0.2, 20)), [0, 0.2]]
    return ms.Body.from_mesh(trimesh.creation.revolve(np.array(profile), sections=sides))


def about(body):
    """Points of the body nearest to the real tube, and how far off it they are, m."""
    rng = np.random.default_rng(1)
    turn = rng.uniform(0, 2 * np.pi, 400)
    real = np.stack([RADIUS * np.cos(turn), RADIUS * np.sin(turn), rng.uniform(0.05, 0.15, 400)], 1)
    hit = body.closest(real)
    return hit, hit.distance


@pytest.mark.parametrize(
    "sides", [14, *(pytest.param(k, marks=pytest.mark.slow) for k in (10, 28))]
)
def test_the_error_of_a_coarse_mesh_is_a_plausible_one(sides):
    """Of a uniform distribution no value is beyond sqrt(3) standard deviations."""
    body = tube(sides)
    hit, off = about(body)
    error = MeshError.of(body, hit)
    assert 0.5 < np.sqrt(np.mean(off**2)) / error.sigma < np.sqrt(3)
    assert error.cell >= CELL


def test_a_primitive_leaves_nothing_open():
    body = ms.Body.sphere(radius=0.05)
    hit = body.closest(0.06 * np.eye(3))
    assert MeshError.of(body, hit) == MeshError()
    assert MeshError.of(body, hit, 2e-4).sigma == 2e-4


def test_weights_are_those_of_the_dense_covariance():
    rng = np.random.default_rng(2)
    points, columns = rng.uniform(0, 0.05, (60, 3)), rng.normal(size=(60, 4))
    weight, error = rng.uniform(1e8, 1e10, 60), MeshError(2e-4, 0.02)
    cell = cells(points, error.cell)
    covariance = np.diag(1 / weight) + error.sigma**2 * (cell[:, None] == cell)
    expected = np.linalg.solve(covariance, columns)
    np.testing.assert_allclose(error.without(points, weight, columns), expected, rtol=1e-9)
    plain = MeshError().without(points, weight, columns)
    np.testing.assert_array_equal(plain, weight[:, None] * columns)
