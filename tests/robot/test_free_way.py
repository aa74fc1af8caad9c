"""Ways of the indenter from outside of a body, against bodies whose openings are known."""

import numpy as np
import pytest
import trimesh

import meshskin as ms
from meshskin.core.errors import ReachError
from meshskin.robot import collision
from meshskin.robot.free_way import enclosed, free_lengths


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


@pytest.mark.parametrize(("opening", "held"), [(0.1, 0), (1.0, 4)])
def test_an_indenter_leaves_a_shell_through_its_opening_alone(opening, held):
    """Of four contacts within a shell two lead to the opening straight, two from halfway."""
    body = shell(opening)
    at = 0.15 * np.array([[0, 0, -1], [0.6, 0, -0.8], [1, 0, 0], [0, -0.96, -0.28]])
    assert enclosed(body, at, -at / 0.15, 0.01).sum() == held


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
