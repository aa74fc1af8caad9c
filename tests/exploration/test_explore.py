"""Paths by pattern: parallels where the arm can follow them, lanes elsewhere; and `explore`."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import meshskin as ms
from meshskin.core.errors import ConfigError, ReachError
from meshskin.core.se3 import inverse
from meshskin.exploration.parallels import reachable_parallels
from meshskin.exploration.path import start_configuration
from meshskin.exploration.plan import plan_exploration
from meshskin.geometry.region import Cap

DOWN = Cap((0.0, 0.0, -1.0))


def capped(sphere, radius, count, spacing):
    body = ms.Body.sphere(radius)
    return sphere.with_(
        body=body, skin=ms.Skin.cover(body, count=count, spacing=spacing, region=DOWN)
    )


# an even number of parallels has the middle of its way at half a turn, where the last joint ends
@pytest.mark.parametrize(
    ("radius", "count", "spacing"), [(0.03, 19, 5e-3), (0.1, 14, 6.5e-3), (0.02, 19, 5e-3)]
)
def test_a_small_cap_is_turned_within_the_joint_limits(sphere, radius, count, spacing):
    scene = capped(sphere, radius, count, spacing)
    path = reachable_parallels(scene)
    tips = path.poses[::10] @ inverse(scene.mount_pose)
    q = scene.arm.inverse_kinematics(tips, path.postures[0])
    assert (q > scene.arm.lower).all()
    assert (q < scene.arm.upper).all()
    assert np.ptp(q[:, 5]) > np.pi  # a full turn of the azimuth is the last joint's to make


@pytest.mark.deep
def test_a_half_ball_is_explored_in_lanes_where_the_arm_cannot_turn_its_parallels(sphere):
    scene = capped(sphere, 0.02, 37, 6.5e-3)
    plan = plan_exploration(scene)
    assert plan.unreachable == {}
    paths = replace(scene.exploration, pattern="parallels")
    with pytest.raises(ReachError, match=r"past its limit.*pattern lanes"):
        plan_exploration(scene.with_(exploration=paths))


@pytest.mark.parametrize("radius", [0.03, 0.035])
def test_a_ball_beside_another_is_explored_in_lanes(sphere, radius):
    """Its parallels would lead to the other ball, which is as high or higher."""
    balls = [trimesh.creation.icosphere(3, r) for r in (0.03, radius)]
    balls[1].apply_translation((0.1, 0.0, 0.0))
    body = ms.Body.from_mesh(trimesh.util.concatenate(balls))
    skin = ms.Skin.cover(ms.Body.sphere(0.03), count=40, spacing=5e-3, region=Cap((0.0, 0.0, 1.0)))
    scene = sphere.with_(body=body, skin=skin, loop=replace(sphere.loop, mode="quasi_static"))
    plan = plan_exploration(scene)
    assert plan.unreachable == {}
    assert plan.path.points[:, 0].max() < 0.03
    paths = replace(scene.exploration, pattern="parallels")
    with pytest.raises(ReachError, match=r"convex about the skin.*got \d+.*pattern lanes"):
        plan_exploration(scene.with_(exploration=paths))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"force": 0.0}, "force of an exploration is out of range, got 0 N, limit: above 0 N"),
        ({"dt": -1e-3}, "dt of an exploration is out of range, got -0.001 s, limit: above 0 s"),
        ({"frame": np.nan}, "frame of an exploration must be a finite number, got nan"),
        ({"mount": np.eye(3)}, "must be a rigid transform T_tip_body"),
        ({"mount": np.diag([1.0, 1.0, -1.0, 1.0])}, "must be a rigid transform T_tip_body"),
        ({"mount": np.full((4, 4), np.nan)}, "must be a rigid transform T_tip_body"),
    ],
)
def test_numbers_that_no_exploration_has_are_refused(sphere, wrong, message):
    with pytest.raises(ConfigError, match=message):
        ms.explore(sphere.body, sphere.skin, **({"arm": sphere.arm, "mount": np.eye(4)} | wrong))


def test_the_plan_of_a_body_and_a_skin_is_followed_by_their_scene(sphere):
    scene = ms.Scene(body=sphere.body, skin=sphere.skin)
    plan = ms.explore(scene.body, scene.skin)
    q = start_configuration(scene, plan.path)
    pose = scene.body_pose(q[None])[0]
    np.testing.assert_allclose(pose[:3, :3], plan.path.poses[0, :3, :3], atol=1e-9)
    centre = np.linalg.solve(pose, [*scene.indenter.position, 1.0])[:3]
    gap = scene.body.closest(centre[None]).distance[0] - scene.indenter.radius
    assert gap == pytest.approx(scene.exploration.standoff, abs=1e-5)


def test_a_plan_for_another_arm_is_refused(sphere):
    plan = ms.explore(sphere.body, sphere.skin, mode="quasi_static")
    with pytest.raises(ConfigError, match="another arm than the scene's, got no arm, limit: 6 j"):
        start_configuration(sphere, plan.path)


@pytest.mark.parametrize("wish", [{"contacts": 3e4}, {"lane_spacing": 1e-5}])
def test_contacts_too_close_to_one_another_are_refused(sphere, wish):
    free = sphere.with_(
        loop=replace(sphere.loop, mode="quasi_static"),
        exploration=replace(sphere.exploration, pattern="lanes", **wish),
    )
    for carried in (None, "hand"):
        scene = free.with_(indenter=replace(sphere.indenter, carried_by=carried))
        with pytest.raises(ReachError, match=r"too close .* mm apart, limit: 0\.\d+ mm"):
            plan_exploration(scene)


def test_one_taxel_is_explored_from_all_sides():
    body = ms.Body.ellipsoid((0.1, 0.08, 0.06))
    skin = ms.Skin.cover(body, spacing=6e-3, count=1)
    plan = ms.explore(body, skin, mode="quasi_static")
    assert plan.unreachable == {}
