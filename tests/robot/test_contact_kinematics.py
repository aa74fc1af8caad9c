"""The indenter in the body frame by joint angles: against the poses of the arm, and derivatives."""

import numpy as np
import pytest

import meshskin as ms
from meshskin.core.errors import ArmError, ConfigError, UnknownNameError
from meshskin.core.se3 import exp_so3, inverse, transform, transform_points
from meshskin.robot.arm import Arm
from meshskin.robot.contact_kinematics import SIGMAS, JointPath

from .test_arm import PUMA

MOUNT = transform(exp_so3([0.3, -0.2, 0.5]), np.array([0.01, 0.02, 0.1]))
CENTRE = np.array([0.424, -0.424, 0.7])


@pytest.fixture(scope="module")
def path():
    time = np.arange(0.0, 2.0, 0.02)
    phase, rng = np.arange(6.0), np.random.default_rng(0)
    start = rng.uniform(-1, 1, 6)
    return JointPath(time, start + 0.3 * np.sin(1.5 * time[:, None] + phase))


def kinematics(**options):
    return ms.Robot.from_urdf(PUMA).contact_kinematics("tool0", CENTRE, mount=MOUNT, **options)


def test_centres_agree_with_the_arm(path):
    model = kinematics()
    time = np.array([0.1, 0.73, 1.4])
    centres, _ = model.centres(path, time, np.zeros(len(model.labels)))
    names = model.chain.joint_names
    assert names == tuple(f"joint{k}" for k in range(6, 0, -1))  # from the body to the base
    arm = Arm.from_urdf(PUMA)
    for centre, q in zip(centres, path.at(time)[0], strict=True):
        body = arm.pose(q[::-1]) @ MOUNT
        np.testing.assert_allclose(centre, transform_points(inverse(body), CENTRE), atol=1e-14)


def test_slopes_are_derivatives_away_from_zero(path):
    model = kinematics(unknown=SIGMAS)
    s = np.random.default_rng(1).normal(size=len(model.labels)) * model.sigma
    time = np.array([0.31, 0.9, 1.2])
    slopes = model.centres(path, time, s)[1]
    for k, label in enumerate(model.labels):
        step = 1e-4 * model.sigma[k] * np.eye(len(s))[k]
        high, low = (model.centres(path, time, s + sign * step)[0] for sign in (1, -1))
        expected = (high - low) / (2 * step[k])
        np.testing.assert_allclose(slopes[:, :, k], expected, atol=1e-7, err_msg=label)
    still = [label for k, label in enumerate(model.labels) if not slopes[:, :, k].any()]
    assert still == ["indenter_radius", "mesh_scale"]


def test_offsets_and_clock_are_those_of_the_readings(path):
    """Readings that are 1 degree low and stamped 37 ms late give the true centre again."""
    model = kinematics(unknown={name: SIGMAS[name] for name in ("joint_offset", "clock_offset")})
    time, offsets = np.linspace(0.2, 1.7, 9), np.radians([1, -1, 1, 1, -1, 1])
    true = kinematics(unknown={}).centres(path, time, np.empty(0))[0]
    read = JointPath(path.time, path.angles - offsets)
    found = model.centres(read, time + 0.037, np.append(offsets, 0.037))[0]
    np.testing.assert_allclose(found, true, atol=1e-14)
    assert np.abs(model.centres(read, time + 0.037, np.zeros(7))[0] - true).max() > 5e-3


def test_labels_and_priors():
    model = kinematics(unknown={"mount": 1e-3, "joint_offset": 0.02})
    assert model.labels[:2] == ("joint_offset joint6", "joint_offset joint5")
    assert model.labels[6:] == tuple(
        f"mount {axis}" for axis in ("x", "y", "z", "rotation x", "rotation y", "rotation z")
    )
    np.testing.assert_allclose(model.sigma, [0.02] * 6 + [1e-3] * 3 + [1e-2] * 3)
    assert model.value("clock_offset", np.zeros(12)) == 0.0


@pytest.mark.parametrize(
    ("options", "error", "message"),
    [
        ({"unknown": {"clock": 0.1}}, UnknownNameError, "did you mean clock_offset"),
        ({"unknown": {"mount": 0.0}}, ConfigError, "standard deviation of mount is out of range"),
        ({"unknown": ["mount"]}, ConfigError, "must be a Mapping"),
        ({"carrier": "hand"}, UnknownNameError, "unknown link 'hand'"),
    ],
)
def test_bad_input_is_one_line(options, error, message):
    with pytest.raises(error, match=message):
        kinematics(**options)


def test_a_centre_or_mount_of_another_shape():
    robot = ms.Robot.from_urdf(PUMA)
    with pytest.raises(ArmError, match="centre of the indenter must be 3 numbers"):
        robot.contact_kinematics("tool0", [0.1, 0.2])
    with pytest.raises(ArmError, match="centre of the indenter must be numbers, got 'tip'"):
        robot.contact_kinematics("tool0", "tip")
    with pytest.raises(ArmError, match="centre of the indenter must be finite"):
        robot.contact_kinematics("tool0", [0.1, 0.2, np.nan])
    with pytest.raises(ArmError, match="mount must be numbers"):
        robot.contact_kinematics("tool0", CENTRE, mount="flange")
    with pytest.raises(ArmError, match="rigid transform"):
        robot.contact_kinematics("tool0", CENTRE, mount=2 * np.eye(4))


def test_names_without_deviations_are_refused_with_a_remedy():
    with pytest.raises(ConfigError, match=r'unknown=\{"joint_offset": 0.017\}'):
        kinematics(unknown=("joint_offset",))


@pytest.mark.parametrize("start", [-np.pi, 0.0])
def test_the_path_of_an_endless_joint_crosses_its_jump_by_a_turn(start):
    time = np.arange(0.0, 20.0, 0.02)
    wrapped = (0.7 * time - start) % (2 * np.pi) + start
    angles, rates = JointPath(time, wrapped[:, None]).at(time[1:-2] + 0.013)
    off = (angles[:, 0] - 0.7 * (time[1:-2] + 0.013)) / (2 * np.pi)
    np.testing.assert_allclose(off, np.round(off[0]), atol=1e-9)
    np.testing.assert_allclose(rates, 0.7, rtol=1e-6)
