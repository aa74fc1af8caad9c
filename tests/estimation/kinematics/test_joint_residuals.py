"""What an error of each joint that varies with its angle explains of the contacts' heights."""

import numpy as np
import pytest

from meshskin import Body, Robot
from meshskin.estimation.kinematics.joint_residuals import SIGNIFICANCE, joint_residuals
from meshskin.robot.contact_kinematics import JOINT_OFFSET, JointPath
from meshskin.scene import shipped_scenes


@pytest.fixture(scope="module")
def setting():
    """The Puma with a sphere on its flange, a path, and d height / d joint (m, 6)."""
    robot = Robot.from_urdf(shipped_scenes.folder() / "puma560.urdf")
    kinematics = robot.contact_kinematics("tool0", (0.4, -0.4, 0.7), unknown={JOINT_OFFSET: 0.02})
    rng, time = np.random.default_rng(1), np.linspace(0, 40, 800)
    knots = rng.uniform(-0.6, 0.6, (9, 6))
    angles = np.stack([np.interp(time, np.linspace(0, 40, 9), k) for k in knots.T], axis=1)
    path, body = JointPath(time, angles), Body.sphere(0.1)
    centres, slopes = kinematics.centres(path, time, np.zeros(6))
    return kinematics, path, time, body, np.einsum(
        "mi,mij->mj", body.closest(centres).normal, slopes
    )  # fmt: skip


def test_an_eccentric_encoder_is_named(setting):
    kinematics, path, time, body, by_joint = setting
    k = int(np.argmax(np.std(by_joint, axis=0)))
    error = np.radians(0.5) * np.sin(path.angles[:, k])
    r = by_joint[:, k] * error + 2e-5 * np.random.default_rng(0).standard_normal(len(time))
    found = joint_residuals(kinematics, path, time, body, r, np.zeros(6))
    best = max(found, key=lambda f: f.explained)
    assert best.joint == kinematics.chain.joint_names[k]
    assert best.explained > 0.98
    assert best.error == pytest.approx(np.sqrt(np.mean(error**2)), rel=0.05)
    assert best.chance < SIGNIFICANCE
    assert best.words.startswith(f"{best.joint}: an error that varies with its angle")
    assert "check its encoder" in best.words


def test_noise_names_no_joint(setting):
    kinematics, path, time, body, _ = setting
    r = 1e-4 * np.random.default_rng(0).standard_normal(len(time))
    for found in joint_residuals(kinematics, path, time, body, r, np.zeros(6)):
        assert found.chance > SIGNIFICANCE
        assert found.words == ""


@pytest.mark.parametrize(
    "length", [0.03, *(pytest.param(k, marks=pytest.mark.slow) for k in (0.01, 0.05))]
)
def test_errors_of_the_surface_name_no_joint(setting, length):
    """Fields over the body, as of a mesh or of a stiffness that varies, and no error of a joint."""
    kinematics, path, time, body, _ = setting
    points = body.closest(kinematics.centres(path, time, np.zeros(6))[0]).point
    named = 0
    for seed in range(12):
        r = field(points, length, seed)
        found = joint_residuals(kinematics, path, time, body, r, np.zeros(6))
        named += any(one.words for one in found)
    assert named <= 1


def test_an_eccentric_encoder_is_named_beside_errors_of_the_surface(setting):
    kinematics, path, time, body, by_joint = setting
    points = body.closest(kinematics.centres(path, time, np.zeros(6))[0]).point
    k = int(np.argmax(np.std(by_joint, axis=0)))
    r = by_joint[:, k] * np.radians(0.5) * np.sin(path.angles[:, k]) + field(points, 0.03, 7)
    found = joint_residuals(kinematics, path, time, body, r, np.zeros(6))
    best = max(found, key=lambda f: f.explained)
    assert best.joint == kinematics.chain.joint_names[k]
    assert best.words


def field(points, length, seed):
    """Errors of a surface (m,), m, that are alike over a length, m, at points (m, 3), m."""
    rng = np.random.default_rng(seed)
    waves, phases = rng.normal(size=(40, 3)) / length, rng.uniform(0, 2 * np.pi, 40)
    return 5e-6 * np.cos(points @ waves.T + phases).sum(axis=1)
