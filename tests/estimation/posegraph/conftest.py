"""Pose graphs of taxels on a sphere of 0.1 m, 5 mm apart: fixtures that make them."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from meshskin.core import se3
from meshskin.estimation.posegraph import PoseGraph


def make_poses(count, rng, spacing=5e-3, radius=0.1):
    """Taxel poses (count, 4, 4) on a spherical cap: z is the normal, x any tangent."""
    k = np.arange(count) + 0.5
    height = min(2 * radius, count * spacing**2 / (2 * np.pi * radius))
    z = radius - height * k / count
    angle, ring = k * np.pi * (3 - np.sqrt(5)), np.sqrt(radius**2 - z**2)
    positions = np.stack([ring * np.cos(angle), ring * np.sin(angle), z], axis=1)
    normals = positions / radius
    tangents = np.cross(rng.normal(size=(count, 3)), normals)
    tangents /= np.linalg.norm(tangents, axis=1)[:, None]
    rotations = np.stack([tangents, np.cross(normals, tangents), normals], axis=2)
    return se3.transform(rotations, positions)


def noise(sigma, rng):
    """Small transforms (m, 4, 4) with local deviations `sigma` (m, 6): translation, rotation."""
    steps = sigma * rng.normal(size=sigma.shape)
    return steps[:, :3], se3.exp_so3(steps[:, 3:])


def make_graph(count=80, seed=0, sigma=(1e-3, 0.02), edges=None, poses=None):
    """A graph of `count` taxels: displacements between neighbours up to two spacings apart.

    `sigma`: deviations in m and rad. Returns it and the true poses.
    """
    rng = np.random.default_rng(seed)
    truth = make_poses(count, rng) if poses is None else poses
    if edges is None:
        edges = cKDTree(truth[:, :3, 3]).query_pairs(12e-3, output_type="ndarray")
    i, j = np.asarray(edges).T
    measured = se3.inverse(truth[i]) @ truth[j]
    each = np.repeat(np.array(sigma, dtype=float), 3)
    shift, turn = noise(np.tile(each, (len(i), 1)), rng)
    measured[:, :3, 3] += shift
    measured[:, :3, :3] = measured[:, :3, :3] @ turn
    return PoseGraph(truth, edges, measured, np.diag(each**-2.0)), truth


@pytest.fixture
def skin_poses():
    return make_poses


@pytest.fixture
def skin_graph():
    return make_graph
