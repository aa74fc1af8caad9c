"""Ways of the indenter from outside of a body, against bodies whose openings are known."""

import numpy as np
import pytest
import trimesh

import meshskin as ms
from meshskin.core.errors import ReachError
from meshskin.robot import collision
from meshskin.robot.accessibility import DIRECTIONS, enclosed, free_lengths, spread_directions


def shell(opening):
    """A ball of 0.15 m with its skin inside, cut off where z is above `opening`, m."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.15)
    faces = ball.faces[ball.triangles_center[:, 2] < opening][:, ::-1]
    return ms.Body.from_mesh(trimesh.Trimesh(ball.vertices, faces), open=True)


def test_the_way_of_a_sphere_ends_at_the_opposite_wall():
    body = ms.Body.torus(0.06, 0.02)
    start = np.array([[0.03, 0.0, 0.0], [0.03, 0.0, 0.0], [0.2, 0.0, 0.0]])
    ways = np.array([[-1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
    length = free_lengths(body, start, ways, 0.01)
    assert length[0] == pytest.approx(0.06, abs=1e-3)  # from x = 0.03 to -0.03 m
    assert np.isinf(length[1:]).all()


@pytest.mark.parametrize(
    ("opening", "held"), [(0.1, 0), pytest.param(1.0, 4, marks=pytest.mark.slow)]
)
def test_an_indenter_leaves_a_shell_through_its_opening_alone(opening, held):
    """Of four contacts within a shell two lead to the opening straight, two from halfway."""
    body = shell(opening)
    at = 0.15 * np.array([[0, 0, -1], [0.6, 0, -0.8], [1, 0, 0], [0, -0.96, -0.28]])
    assert enclosed(body, at, -at / 0.15, 0.01).sum() == held


def test_directions_leave_no_wide_gap():
    anywhere = np.random.default_rng(0).normal(size=(4000, 3))
    anywhere /= np.linalg.norm(anywhere, axis=1)[:, None]
    nearest = np.arccos(np.clip(anywhere @ spread_directions(DIRECTIONS).T, -1, 1)).min(axis=1)
    assert np.degrees(nearest.max()) < 10.0


@pytest.mark.deep
@pytest.mark.parametrize("seed", [0, 1, *(pytest.param(k, marks=pytest.mark.slow) for k in (2, 3))])
def test_a_deep_cup_is_open_however_it_is_turned(seed):
    """0.6 m deep, 0.3 m wide: its opening is 14 degrees wide, seen from the middle of its end."""
    cup = trimesh.creation.cylinder(0.15, 0.6, sections=48).subdivide_to_size(0.06)
    faces = cup.faces[cup.triangles_center[:, 2] < 0.299][:, ::-1]
    turn = trimesh.transformations.random_rotation_matrix(np.random.default_rng(seed).random(3))
    mesh = trimesh.Trimesh(trimesh.transform_points(cup.vertices, turn), faces)
    body = ms.Body.from_mesh(mesh, open=True)
    at = np.array([[0.15, 0, 0], [0, 0.15, -0.2], [-0.1, -0.1118, -0.1], [0, 0, -0.3]])
    inward = np.array([[-1.0, 0, 0], [0, -1, 0], [0.667, 0.745, 0], [0, 0, 1]])
    inward /= np.linalg.norm(inward, axis=1)[:, None]
    at, inward = at @ turn[:3, :3].T, inward @ turn[:3, :3].T
    assert not enclosed(body, at, inward, 0.01).any()


def test_the_outside_of_a_hollow_body_is_free():
    body = ms.Body.torus(0.06, 0.02)
    points = ms.Skin.cover(body, spacing=0.01, seed=1).positions
    hit = body.closest(points)
    assert not enclosed(body, hit.point, hit.normal, 0.005).any()


def test_a_plan_leaves_out_what_is_enclosed():
    body = shell(1.0)
    skin = ms.Skin.cover(body, spacing=5e-3, count=20, seed=1)
    with pytest.raises(ReachError, match="nothing of the skin can be explored: enclosed") as caught:
        ms.explore(body, skin, mode="quasi_static")
    assert "change the indenter" in str(caught.value)
    assert "position_m" not in str(caught.value)  # there is no arm


def test_a_plan_within_an_open_shell_is_followed():
    body = shell(0.1)
    skin = ms.Skin.cover(body, spacing=5e-3, count=20, seed=1)
    plan = ms.explore(body, skin, mode="quasi_static")
    assert collision.ENCLOSED not in plan.unreachable.values()
