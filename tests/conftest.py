"""Scenes, recordings and simulators that tests of several folders share."""

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import meshskin as ms
from meshskin.geometry.body import Body
from meshskin.robot.arm import Arm
from meshskin.scene import shipped_scenes
from meshskin.simulation.simulate import prepare

STUDIES = Path(__file__).parents[1] / "studies"
sys.path += [str(STUDIES), str(STUDIES / "speed")]  # where a script finds the modules beside it


@pytest.fixture(scope="session")
def script():
    """A study's script, by its file's stem, as a module."""

    def load(name):
        spec = importlib.util.spec_from_file_location(f"{name}_study", STUDIES / f"{name}.py")
        module = importlib.util.module_from_spec(spec)
        sys.modules[spec.name] = module  # dataclasses look their module up
        spec.loader.exec_module(module)
        return module

    return load


@pytest.fixture
def no_figures(monkeypatch):
    """Pages have no figures: drawing takes most of the time of what writes a page, and has tests of
    its own."""
    monkeypatch.setattr("meshskin.report.figure_set.DRAWN", ())


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
