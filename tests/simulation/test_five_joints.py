"""The closed loop of an arm of five joints, which cannot hold any pose."""

from dataclasses import replace
from itertools import groupby

import numpy as np
import pytest

from meshskin.core.se3 import exp_so3, inverse, transform
from meshskin.robot.arm import Arm
from meshskin.scene import shipped_scenes
from meshskin.simulation.simulate import prepare, run
from meshskin.simulation.state_machine import PHASES, SLIDE

from ..exploration.test_regrasp import two_islands


@pytest.fixture(scope="module")
def scene():
    """Two islands of skin on a sphere at the fifth link of the Puma."""
    scene = two_islands(
        0.06,
        0.4,
        arm=Arm.from_urdf(shipped_scenes.folder() / "puma560.urdf", tip="link5"),
        mount=transform(exp_so3([0.5 * np.pi, 0.0, 0.0]), [0.0, 0.1, 0.0]),
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
