"""The exploration path: it covers the cap, faces the indenter, and is as smooth as it says."""

import numpy as np
import pytest

from meshskin.contact.indenter import Indenter
from meshskin.exploration.path import Path, lanes, parallels, plan
from meshskin.geometry.body import Body
from meshskin.scene.settings import Exploration

DT = 0.01
AXIS = np.array([0.0, 0.0, -1.0])
PLACE = np.array([0.4, -0.4, 0.7])
GAP = 0.008
EXTENT = np.radians(13.0)


@pytest.fixture(scope="module")
def path():
    body = Body.sphere(0.1)
    return plan(
        body, AXIS, EXTENT, Exploration(), indenter=Indenter(position=tuple(PLACE.tolist())),
        gap=GAP, heading=0.3, dt=DT,
    )  # fmt: skip


def test_the_indenter_stays_at_its_gap_under_the_contact_point(path):
    r, t = path.poses[:, :3, :3], path.poses[:, :3, 3]
    np.testing.assert_allclose(
        np.einsum("kij,kj->ki", r, path.normals), [[0, 0, -1]] * len(t), atol=1e-9
    )
    indenter = np.einsum("kji,kj->ki", r, PLACE - t)
    np.testing.assert_allclose(indenter, path.points + GAP * path.normals, atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(r), 1.0, atol=1e-12)


def test_lanes_cover_the_cap_with_at_most_their_spacing(path):
    polar = np.arccos(np.clip(path.normals @ AXIS, -1, 1))
    assert polar.max() == pytest.approx(EXTENT + 0.03, abs=1e-4)
    rng = np.random.default_rng(1)
    theta, phi = EXTENT * np.sqrt(rng.uniform(size=300)), rng.uniform(0, 2 * np.pi, 300)
    probe = 0.1 * np.stack(
        [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), -np.cos(theta)], axis=1
    )
    gap = np.linalg.norm(probe[:, None] - path.points, axis=2).min(axis=1)
    assert gap.max() < 0.5 * 3.5e-3 + 0.5e-3


def test_speeds_stay_within_their_limits_and_twists_carry_the_poses(path):
    speed = np.linalg.norm(np.diff(path.points, axis=0), axis=1) / DT
    assert speed.max() <= 0.05 * 1.01
    turn = np.linalg.norm(path.twists[:, 3:], axis=1)
    assert turn.max() <= 2.5 * 1.01
    shift = path.poses[:-1, :3, 3] + DT * path.twists[:-1, :3]
    np.testing.assert_allclose(shift, path.poses[1:, :3, 3], atol=1e-12)
    assert np.abs(np.diff(path.twists[:, 5])).max() < 2.5 * np.pi / 2 * DT / 0.1 * 1.1


def test_the_spin_comes_back():
    angles = parallels(lanes(EXTENT, 0.1, Exploration()), 0.1, Exploration(), DT)
    assert np.abs(angles[:, 1]).max() <= np.pi + 1e-12
    assert np.all(np.diff(angles[:, 0]) >= 0)


def test_a_long_path_is_shortened_place_by_place():
    rows = np.arange(30.0).reshape(10, 3)
    whole = Path(
        1e-3, rows, rows, np.tile(np.eye(4), (10, 1, 1)), np.zeros((10, 6)), np.arange(10),
        breaks=(4, 7), postures=np.arange(3.0)[:, None],
    )  # fmt: skip
    short = whole.first(6)
    assert len(short.points) == len(short.poses) == len(short.faces) == 6
    assert short.breaks == (4,)
    np.testing.assert_array_equal(short.postures, [[0.0], [1.0]])
    assert [len(place.points) for place in short.places] == [4, 2]


def test_a_thinned_path_goes_the_same_way_in_longer_steps_on_another_mesh(path):
    coarse = Body.sphere(0.1, faces=320)
    thin = path.thinned(5 * DT, coarse)
    np.testing.assert_array_equal(thin.poses, path.poses[::5])
    corners = coarse.mesh.vertices[coarse.mesh.faces[thin.faces]]
    assert (
        np.linalg.norm(corners.mean(axis=1) - thin.points, axis=1).max() < 0.02
    )  # an edge is 35 mm
    moved = thin.poses[:-1, :3, 3] + 5 * DT * thin.twists[:-1, :3]
    np.testing.assert_allclose(moved, thin.poses[1:, :3, 3], atol=1e-12)
