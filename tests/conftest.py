"""Scenes, recordings and simulators that tests of several folders share."""

from dataclasses import replace

import numpy as np
import pytest

import meshskin as ms
from meshskin.geometry.body import Body
from meshskin.robot.arm import Arm
from meshskin.scene import shipped_scenes
from meshskin.simulation.simulate import prepare


@pytest.fixture(scope="session")
def sphere():
    """The paper's scene, interpreted: with "auto" a test that compiles would change the others'
    last digits."""
    scene = ms.Scene.load("sphere")
    return scene.with_(loop=replace(scene.loop, compile="never"))


@pytest.fixture(scope="session")
def recording(sphere):
    """Its recording, without noise."""
    return ms.simulate(sphere, seed=1)


@pytest.fixture(scope="session")
def noisy():
    """The paper's scene with 1 % noise, interpreted."""
    scene = ms.Scene.load("sphere_noisy")
    return scene.with_(loop=replace(scene.loop, compile="never"))


@pytest.fixture(scope="session")
def noisy_recording(noisy):
    """Its recording."""
    return ms.simulate(noisy, seed=1)


@pytest.fixture(scope="session")
def body():
    """The paper's body by itself."""
    return Body.sphere(0.1)


@pytest.fixture(scope="session")
def arm():
    """The paper's arm by itself."""
    return Arm.from_urdf(shipped_scenes.folder() / "puma560.urdf")


@pytest.fixture(scope="session")
def prepared(sphere):
    """Simulator and path of the paper's scene, by mode."""
    made = {}

    def get(mode="arm", **loop):
        key = (mode, *sorted(loop.items()))
        if key not in made:
            scene = sphere.with_(loop=replace(sphere.loop, mode=mode, compile="never", **loop))
            made[key] = prepare(scene)
        simulator, path = made[key]
        simulator.reset()
        return simulator, path

    return get


@pytest.fixture(scope="session")
def along(prepared, sphere):
    """Joint angles (k, 6) along the path of the paper's scene."""
    simulator, path = prepared()
    simulator.reset()
    poses = path.poses @ np.linalg.inv(sphere.mount_pose)
    return simulator.loop.arm.inverse_kinematics(poses, simulator.state[:6])
