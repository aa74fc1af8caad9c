"""The exploration path: parallels cover a cap, face the indenter, and keep their speeds."""

import numpy as np
import pytest

from meshskin.exploration.parallels import lane_angles, parallels, polar_angles
from meshskin.exploration.path import Path
from meshskin.geometry.body import Body
from meshskin.scene.settings import Exploration

DT = 0.01


@pytest.fixture(scope="module")
def path(sphere):
    return parallels(sphere, 0.3, DT)


@pytest.fixture(scope="module")
def extent(sphere):
    """Largest angle of a taxel's normal to the skin's axis, rad."""
    return float(np.arccos((sphere.skin.normals @ sphere.axis).min()))


def test_the_indenter_stays_at_its_gap_under_the_contact_point(sphere, path):
    r, t = path.poses[:, :3, :3], path.poses[:, :3, 3]
    np.testing.assert_allclose(
        np.einsum("kij,kj->ki", r, path.normals), [[0, 0, -1]] * len(t), atol=1e-9
    )
    indenter = np.einsum("kji,kj->ki", r, sphere.indenter.position - t)
    gap = sphere.indenter.radius - sphere.patch.depth
    np.testing.assert_allclose(indenter, path.points + gap * path.normals, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(r), 1.0, atol=1e-12)


def test_lanes_cover_the_cap_with_at_most_their_spacing(sphere, path, extent):
    polar = np.arccos(np.clip(path.normals @ sphere.axis, -1, 1))
    assert polar.max() == pytest.approx(extent + 0.03, abs=1e-4)
    rng = np.random.default_rng(1)
    around = rng.normal(size=(3000, 3))
    around /= np.linalg.norm(around, axis=1)[:, None]
    probe = 0.1 * around[around @ sphere.axis > np.cos(extent)]
    assert len(probe) > 20
    gap = np.linalg.norm(probe[:, None] - path.points, axis=2).min(axis=1)
    assert gap.max() < 0.5 * 3.5e-3 + 0.5e-3


def test_speeds_are_within_their_limits_and_twists_integrate_to_the_poses(path):
    speed = np.linalg.norm(np.diff(path.points, axis=0), axis=1) / DT
    assert speed.max() <= 0.05 * 1.01
    turn = np.linalg.norm(path.twists[:, 3:], axis=1)
    assert turn.max() <= 2.5 * 1.01
    shift = path.poses[:-1, :3, 3] + DT * path.twists[:-1, :3]
    np.testing.assert_allclose(shift, path.poses[1:, :3, 3], atol=1e-12)
    assert np.abs(np.diff(path.twists[:, 5])).max() < 2.5 * np.pi / 2 * DT / 0.1 * 1.1


def test_the_azimuth_stays_within_half_a_turn(extent):
    angles = lane_angles(polar_angles(extent, 0.1, Exploration()), 0.1, Exploration(), DT)
    assert np.abs(angles[:, 1]).max() <= np.pi + 1e-12
    assert np.all(np.diff(angles[:, 0]) >= -1e-12)


def test_a_path_is_truncated_with_its_segments():
    rows = np.arange(30.0).reshape(10, 3)
    whole = Path(
        1e-3, rows, rows, np.tile(np.eye(4), (10, 1, 1)), np.zeros((10, 6)), np.arange(10),
        breaks=(4, 7), postures=np.arange(3.0)[:, None],
    )  # fmt: skip
    short = whole.truncated(6)
    assert len(short.points) == len(short.poses) == len(short.faces) == 6
    assert short.breaks == (4,)
    np.testing.assert_array_equal(short.postures, [[0.0], [1.0]])
    assert [len(segment.points) for segment in short.segments] == [4, 2]


def test_a_resampled_path_has_the_same_poses_in_longer_steps_on_another_mesh(path):
    coarse = Body.sphere(0.1, faces=320)
    thin = path.resampled(5 * DT, coarse)
    np.testing.assert_array_equal(thin.poses, path.poses[::5])
    corners = coarse.mesh.vertices[coarse.mesh.faces[thin.faces]]
    assert (
        np.linalg.norm(corners.mean(axis=1) - thin.points, axis=1).max() < 0.02
    )  # an edge is 35 mm
    moved = thin.poses[:-1, :3, 3] + 5 * DT * thin.twists[:-1, :3]
    np.testing.assert_allclose(moved, thin.poses[1:, :3, 3], atol=1e-12)
