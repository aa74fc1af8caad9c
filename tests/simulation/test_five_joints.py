"""The closed loop of an arm of five joints, which cannot hold any pose."""

from dataclasses import replace
from itertools import groupby

import numpy as np
import pytest

import meshskin as ms
from meshskin.core.se3 import exp_so3, inverse, transform
from meshskin.geometry.region import Cap
from meshskin.robot.arm import Arm
from meshskin.scene import shipped_scenes
from meshskin.simulation.simulate import prepare, run
from meshskin.simulation.state_machine import PHASES, SLIDE


@pytest.fixture(scope="module")
def scene():
    """Two islands of skin on a sphere at the fifth link of the Puma."""
    body = ms.Body.sphere(0.06)
    parts = [
        ms.Skin.cover(body, count=4, spacing=5e-3, region=Cap(way))
        for way in ((0.4, 0.0, -1.0), (-0.4, 0.0, -1.0))
    ]
    poses = np.concatenate([part.poses for part in parts])
    scene = ms.Scene(
        body=body,
        skin=ms.Skin(poses, np.arange(len(poses))),
        arm=Arm.from_urdf(shipped_scenes.folder() / "puma560.urdf", tip="link5"),
        mount=transform(exp_so3([0.5 * np.pi, 0.0, 0.0]), [0.0, 0.1, 0.0]),
        exploration=ms.Exploration(pattern="lanes"),
    )
    return scene.with_(loop=replace(scene.loop, compile="never"))


def test_the_arm_slides_lifts_off_and_touches_again(scene):
    machine, path = prepare(scene)
    assert path.unreachable == {}
    assert len(path.segments) == 2
    for segment in path.segments:  # five joints hold every pose of the path, spin included
        tips = segment.poses @ inverse(scene.mount_pose)
        q = scene.arm.inverse_kinematics(tips, segment.postures[0])
        assert np.abs(np.diff(q, axis=0)).max() < 0.01
    found = list(run(scene, machine, path))
    order = [PHASES[phase] for phase, _ in groupby(found, key=lambda steps: steps.phase)]
    once = ["approach", "touch", "hold", "slide"]
    assert order == [*once, "leave", "next", *once]
    assert not machine.given_up
    slides = np.concatenate([steps.outputs for steps in found if steps.phase == SLIDE])
    assert slides[:, 6] == pytest.approx(3.0, abs=0.15)
    planned = path.points[:: len(path.points) // 400]
    off = np.linalg.norm(slides[:, None, :3] - planned, axis=2).min(axis=1)
    assert off.max() < 1e-3
