"""The path of a scene by its pattern: parallels as far as the arm turns them, lanes elsewhere."""

from dataclasses import replace

import numpy as np
import pytest

import meshskin as ms
from meshskin.core.errors import ConfigError, ReachError
from meshskin.core.se3 import inverse
from meshskin.exploration.explore import reachable_path, route
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
    path, start = reachable_path(scene, scene.arm)
    q = scene.arm.inverse_kinematics(path.poses[::10] @ inverse(scene.mount_pose), start)
    assert (q > scene.arm.lower).all()
    assert (q < scene.arm.upper).all()
    assert np.ptp(q[:, 5]) > np.pi  # a full turn of the azimuth is the last joint's to make


def test_a_half_ball_is_explored_in_lanes_where_the_arm_cannot_turn_its_parallels(sphere):
    scene = capped(sphere, 0.02, 37, 6.5e-3)
    path, _ = route(scene)
    assert path.postures is not None
    assert path.unreachable == {}
    paths = replace(scene.exploration, pattern="parallels")
    with pytest.raises(ReachError, match=r"past its limit.*pattern lanes"):
        route(scene.with_(exploration=paths))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"force": 0.0}, "force of an exploration is out of range, got 0 N, limit: above 0 N"),
        ({"dt": -1e-3}, "dt of an exploration is out of range, got -0.001 s, limit: above 0 s"),
        ({"frame": np.nan}, "frame of an exploration must be a finite number, got nan"),
        ({"mount": np.eye(3)}, "no rigid transform"),
        ({"mount": np.diag([1.0, 1.0, -1.0, 1.0])}, "no rigid transform"),
        ({"mount": np.full((4, 4), np.nan)}, "no rigid transform"),
    ],
)
def test_numbers_that_no_exploration_has_are_refused(sphere, wrong, message):
    with pytest.raises(ConfigError, match=message):
        ms.explore(sphere.body, DOWN, **({"arm": sphere.arm, "mount": np.eye(4)} | wrong))
