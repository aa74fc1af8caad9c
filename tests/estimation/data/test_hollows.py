"""Contacts beside a wall: under such a patch the surface is a hollow tighter than the indenter."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import meshskin as ms
from meshskin.core.se3 import transform
from meshskin.estimation.data.gather import gather

WALL, FLOOR, DEPTH = 0.05, 0.02, 0.12
"""x of the wall, height of the floor, and the body's depth, m."""


def angle():
    """A floor and a wall of 3 cm above it."""
    outline = [(0, 0), (0.12, 0), (0.12, FLOOR), (WALL, FLOOR), (WALL, 0.05), (0, 0.05)]
    n = np.arange(6)
    front, back = (np.insert(outline, 1, y, axis=1) for y in (0.0, DEPTH))
    end = np.array([[0, 1, 2], [0, 2, 3], [0, 3, 4], [0, 4, 5]])
    after = np.roll(n, -1)
    sides = [np.column_stack([n, n + 6, after]), np.column_stack([after, n + 6, after + 6])]
    faces = np.vstack([end, end[:, ::-1] + 6, *sides])
    mesh = trimesh.Trimesh(np.vstack([front, back]), faces)
    return ms.Body.from_mesh(mesh.subdivide().subdivide())


@pytest.fixture(scope="module")
def scene():
    """Taxels on the floor, from 6 mm beside the wall on."""
    x, y = np.meshgrid(WALL + 6e-3 + 5e-3 * np.arange(5), 0.04 + 5e-3 * np.arange(6))
    points = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, FLOOR)])
    skin = ms.Skin(transform(np.broadcast_to(np.eye(3), (30, 3, 3)), points), np.arange(30))
    known = {"contact": "elliptic", "material": ms.Material(young=0.4e6)}
    return ms.Scene.load("sphere_noisy").with_(body=angle(), skin=skin, **known)


@pytest.fixture(scope="module")
def recording(scene):
    """600 contacts, a ninth of them within 1 to 3 mm of the wall."""
    rng = np.random.default_rng(0)
    low, high = np.array([1e-3, -5e-3]), np.array([31e-3, 30e-3])
    x, y = rng.uniform(low, high, (600, 2)).T
    x[:67] = rng.uniform(1e-3, 3e-3, 67)
    points = np.column_stack([WALL + x, 0.04 + y, np.full(600, FLOOR)])
    made = ms.press(scene, points[rng.permutation(600)], force=rng.uniform(2.5, 3.5, 600), seed=1)
    return ms.Recording(made.contacts, made.readings, {})


def test_contacts_in_hollows_are_left_out_where_the_response_is_learned(scene, recording):
    data = gather(recording, scene.belief(contact="learned"))
    beside = recording.points[:, 0] - WALL
    kept = beside[data.recorded]
    assert data.left_out == 600 - len(kept)
    assert 60 < data.left_out < 150
    assert kept.min() > np.sort(beside)[60]
    assert np.isfinite(data.patches.first).all()


@pytest.mark.slow
def test_a_wrong_scale_is_learned_beside_a_wall(scene, recording):
    """It ended in a ContactError about the hollow."""
    log = replace(recording.with_columns(pressure=3 * recording.pressure), metadata={})
    found = ms.calibrate(log, scene.belief(contact="auto"))
    assert found.verdict.level == "DOUBT"
    assert any("3 times those of the contact model" in words for words in found.verdict.reasons)
    assert any(
        "contacts in which the contact model does not hold" in words for words in found.factors
    )
    ok = np.isfinite(found.positions[:, 0])
    error = np.linalg.norm(found.positions - scene.skin.positions, axis=1)[ok]
    assert ok.sum() >= 24
    assert np.sqrt(np.mean(error**2)) < 1.3 * np.sqrt(np.mean(found.position_sigma[ok] ** 2))
