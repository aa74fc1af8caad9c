"""Changes of posture in the air: lift off, move in joint space, descend, and touch again."""

from dataclasses import replace
from itertools import groupby

import numpy as np
import pytest

import meshskin as ms
from meshskin.core.errors import ReachError
from meshskin.core.se3 import inverse
from meshskin.exploration import lane_plan
from meshskin.exploration.lanes import cover
from meshskin.exploration.plan import plan_exploration
from meshskin.geometry.region import Cap
from meshskin.simulation import transfer
from meshskin.simulation.closed_loop_model import ClosedLoopModel
from meshskin.simulation.simulate import prepare, run
from meshskin.simulation.state_machine import PHASES, SLIDE

WALL = ms.Indenter(position=(-0.6, -0.15, 0.5), direction=(1.0, 0.0, 0.0))


def two_islands(radius, tilt, **parts):
    """Two islands of skin on a sphere, too far apart to slide from one to the other."""
    body = ms.Body.sphere(radius)
    skins = [
        ms.Skin.cover(body, count=4, spacing=5e-3, region=Cap((x, 0.0, -1.0)))
        for x in (tilt, -tilt)
    ]
    poses = np.concatenate([skin.poses for skin in skins])
    skin, exploration = ms.Skin(poses, np.arange(len(poses))), ms.Exploration(pattern="lanes")
    return ms.Scene(body=body, skin=skin, exploration=exploration, **parts)


@pytest.fixture(scope="module")
def islands():
    return two_islands(0.1, 0.5)


@pytest.mark.parametrize("indenter", [ms.Indenter(), pytest.param(WALL, marks=pytest.mark.slow)])
def test_the_arm_lifts_off_changes_its_posture_and_touches_again(islands, indenter):
    scene = islands.with_(indenter=indenter, loop=replace(islands.loop, compile="never"))
    machine, path = prepare(scene)
    assert len(path.segments) == len(path.postures) == 2
    found = list(run(scene, machine, path))
    order = [PHASES[phase] for phase, _ in groupby(found, key=lambda steps: steps.phase)]
    once = ["approach", "touch", "hold", "slide"]
    assert order == [*once, "leave", "next", *once]
    q = np.concatenate([steps.q for steps in found])
    rate = np.abs(np.diff(q, axis=0)).max(axis=0) / scene.loop.dt
    assert (rate < scene.arm.velocity_limit).all()
    assert (q > scene.arm.lower).all()
    assert (q < scene.arm.upper).all()
    slides = np.concatenate([steps.outputs for steps in found if steps.phase == SLIDE])
    assert slides[:, 6] == pytest.approx(3.0, abs=0.1)
    near = np.linalg.norm(slides[:, None, :3] - scene.skin.positions, axis=2).min(axis=0)
    assert near.max() < 3e-3


@pytest.mark.deep
def test_the_metadata_hold_the_reasons_of_taxels_that_are_left_out(islands):
    arm = replace(islands.arm, lower=islands.arm.lower.copy())
    free = plan_exploration(islands)
    poses = np.concatenate([place.poses[::40] for place in free.segments])
    bend = [islands.arm.solve(pose @ inverse(islands.mount_pose))[4] for pose in poses]
    arm.lower[4] = np.median(bend)
    scene = islands.with_(arm=arm, loop=replace(islands.loop, compile="never"))
    plan = plan_exploration(scene)
    recording = ms.simulate(scene, 1)
    assert recording.metadata["unreachable"] == {str(k): w for k, w in plan.unreachable.items()}
    assert set(recording.reading_taxel) >= set(scene.skin.ids) - set(plan.unreachable)


def followed(scene, plan):
    """Joint angles along each segment, from its posture, at which the arm is at its first pose.

    The default mount is that of the planned skin. Raises ReachError beyond a joint limit.
    """
    found = []
    for place in plan.segments:
        tips = place.poses[::20] @ inverse(scene.mount_pose)
        found.append(scene.arm.inverse_kinematics(tips, place.postures[0]))
        assert np.abs(found[-1][0] - place.postures[0]).max() < 0.02
    return found


@pytest.mark.deep
@pytest.mark.parametrize("seed", [None, 1, 2, 3])
def test_joint_limits_break_lanes_of_any_order(seed, monkeypatch):
    if seed is not None:  # the order and the direction of lanes are the planner's own business
        rng = np.random.default_rng(seed)

        def shuffled(*args):
            lanes = cover(*args)
            order = rng.permutation(len(lanes))
            return [lanes[k].take(slice(None, None, rng.choice([-1, 1]))) for k in order]

        monkeypatch.setattr(lane_plan, "cover", shuffled)
    scene = ms.Scene.load("capsule")
    skin = ms.Skin.cover(scene.body, count=30, spacing=5e-3, region=Cap((1.0, 0.0, 0.0)))
    scene = scene.with_(skin=skin)
    q = np.concatenate(followed(scene, plan_exploration(scene)))
    # each joint's way cut in the middle, where other postures of the arm are as good
    cut = [(j, 0.5 * (q[:, j].min() + q[:, j].max())) for j in range(6) if np.ptp(q[:, j]) > 0.2]
    broken = 0
    for joint, middle in cut:
        arm = replace(scene.arm, upper=scene.arm.upper.copy())
        arm.upper[joint] = middle
        limited = scene.with_(arm=arm)
        try:
            plan = plan_exploration(limited)
        except ReachError:
            continue
        broken += len(plan.segments) > 1 or bool(plan.unreachable)
        followed(limited, plan)
    assert broken


@pytest.mark.parametrize("indenter", [ms.Indenter(), WALL])
def test_the_transfer_between_postures_avoids_the_indenter(islands, indenter):
    islands = islands.with_(indenter=indenter)
    arm, mount = islands.arm, islands.mount_pose
    plan = plan_exploration(islands)
    loop = ClosedLoopModel.of(islands)
    lifted = []
    for segment, seed in zip(plan.segments, plan.path.postures, strict=True):
        above = np.repeat(segment.poses[:1], 8, axis=0)
        above[:, :3, 3] += np.linspace(0.0, 7e-3, 8)[:, None] * indenter.axis
        lifted.append(arm.inverse_kinematics(above @ inverse(mount), seed)[-1])
    q = transfer.joint_path(loop, islands.body, *lifted)
    np.testing.assert_allclose(q[-1], lifted[1], atol=1e-9)
    centres = loop.indenter_centres(loop.body_poses(q[::10]))
    assert islands.body.closest(centres).distance.min() > 0.01
    assert (np.abs(np.diff(q, axis=0)) / 1e-3).max() <= transfer.MAX_JOINT_SPEED * 1.6
    high = arm.pose(transfer.lift_path(loop, lifted[0], 0.03)) - arm.pose(lifted[0])
    np.testing.assert_allclose(high[-1, :3, 3], 0.03 * indenter.axis, atol=1e-8)
    assert np.abs(high[:, :3, :3]).max() < 1e-8
    with pytest.raises(ReachError, match="no collision-free path over the indenter"):
        transfer.joint_path(replace(loop, indenter_radius=0.5), islands.body, *lifted)
