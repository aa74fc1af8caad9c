"""Unknowns of a robot that the readings move further than what was known before them allows."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

import meshskin as ms
from meshskin.core.se3 import hat
from meshskin.estimation.kinematics.pulled import CONTRADICTED, USUAL, contradicted, pulls, widened
from meshskin.scene.contact_motion import ContactMotion

AXIS = np.array([0.6, 0.0, 0.8])
BEFORE = np.array([[0.01, 0.0], [0.004, 0.003]])
"""Root of the covariance of two turns about the axis before the readings, rad."""


@pytest.fixture(scope="module")
def world():
    """Recording of contacts all around the taxels of a sphere, and its calibration."""
    scene = ms.Scene.load("sphere")
    off = np.linalg.norm(scene.skin.positions - scene.skin.positions.mean(axis=0), axis=1)
    kept = np.sort(np.argsort(off)[:37])
    scene = scene.with_(skin=ms.Skin(scene.skin.poses[kept], scene.skin.ids[kept]))
    around = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [1, 1, 0], [-1, -1, 0]])
    near = scene.skin.positions[:, None] + 1.5e-3 * around
    recording = ms.press(scene, scene.body.closest(near.reshape(-1, 3)).point, seed=1)
    return SimpleNamespace(recording=recording, found=ms.calibrate(recording, scene.belief()))


def turned(world, *angles):
    """The calibration as if the readings had moved joints about the axis by angles (2,), rad, from
    means that the heights tell."""
    about = np.cross(AXIS, world.recording.points)
    motion = ContactMotion(
        labels=("joint_offset a", "joint_offset b"), sigma=np.array([0.02, 0.02]),
        slopes=np.stack([about, 2 * about], axis=2), mean=np.array([0.1, -0.1]), root=BEFORE,
    )  # fmt: skip
    found = motion.mean + angles
    values = {label: (float(v), 1e-3) for label, v in zip(motion.labels, found, strict=True)}
    belief = replace(world.found.belief, contact_motion=motion)
    return replace(world.found, belief=belief, unknowns={**world.found.unknowns, **values})


def test_an_unknown_that_the_readings_move_by_chance_widens_nothing(world):
    found = turned(world, 0.99 * USUAL * 0.01, -0.99 * USUAL * 0.005)
    np.testing.assert_allclose(pulls(found)[1], [0.01, 0.005])
    assert widened(found, world.recording) is found  # although both are far from zero
    assert contradicted(found) == ()


def test_a_pull_between_chance_and_contradiction_displaces_the_taxels_by_its_share(world):
    far, pull = turned(world, 1.001 * CONTRADICTED * 0.01, 0.0), (USUAL + CONTRADICTED) / 2
    found = turned(world, pull * 0.01, 0.0)
    assert contradicted(found) == ()
    assert contradicted(far) != ()
    known = np.isfinite(found.covariances)
    added, most = (
        widened(one, world.recording).covariances[known] - one.covariances[known]
        for one in (found, far)
    )
    np.testing.assert_allclose(added, most * (pull / CONTRADICTED) ** 2 / 2, rtol=5e-3, atol=1e-15)
    value, sigma = widened(found, world.recording).unknowns["joint_offset a"]
    assert (value, sigma) == (
        pytest.approx(0.1 + pull * 0.01),
        pytest.approx(np.hypot(pull * 0.01 / np.sqrt(2), 1e-3)),
    )


def test_an_unknown_that_the_readings_move_further_displaces_the_taxels(world):
    """About the axis by the sum of both, as the contacts, and along no other direction."""
    found = turned(world, 0.04, -0.005)
    wide = widened(found, world.recording)
    (words,) = contradicted(found)
    assert words.startswith("the readings move joint_offset a by 0.04, 4 times the standard dev")
    added = wide.covariances[:, :3, :3] - found.covariances[:, :3, :3]
    rotations, positions = found.poses[:, :3, :3], found.positions
    expected = (0.04 - 2 * 0.005) * positions @ hat(AXIS).T
    in_space = rotations @ added @ np.swapaxes(rotations, 1, 2)
    for one, move in zip(in_space, expected, strict=True):
        size = np.linalg.norm(move)
        np.testing.assert_allclose(one, np.outer(move, move), atol=0.1 * size**2 + 1e-10)
    assert np.median(wide.position_sigma) > 0.5 * np.median(np.linalg.norm(expected, axis=1))
    assert wide.unknowns["joint_offset a"] == (
        pytest.approx(0.14),
        pytest.approx(np.hypot(0.04, 1e-3)),
    )
    # normals turn with the taxels over the sphere
    size = np.linalg.norm(expected, axis=1)
    more = wide.covariances[:, 3:5, 3:5] - found.covariances[:, 3:5, 3:5]
    turn = np.sqrt(np.trace(more, axis1=1, axis2=2))
    np.testing.assert_allclose(turn, size / np.linalg.norm(positions, axis=1), rtol=0.05, atol=1e-4)


def test_readings_that_do_not_fit_tell_nothing_of_the_unknowns(world):
    """Their error is then that of the heights, and what the readings moved them by."""
    found = turned(world, 0.005, 0.0)
    assert widened(found, world.recording) is found
    misfit = replace(found, fit=SimpleNamespace(good=False))
    wide = widened(misfit, world.recording)
    added = wide.covariances[:, :3, :3] - found.covariances[:, :3, :3]
    added = np.trace(added, axis1=1, axis2=2)
    turn = np.array([1, 2]) @ (BEFORE @ BEFORE.T + np.outer([0.005, 0], [0.005, 0])) @ [1, 2]
    arm = np.linalg.norm(found.positions @ hat(AXIS).T, axis=1)
    np.testing.assert_allclose(np.sqrt(added), np.sqrt(turn) * arm, rtol=0.05, atol=1e-4)
    for label, before, moved in zip(("a", "b"), (0.01, 0.005), (0.005, 0.0), strict=True):
        sigma = wide.unknowns[f"joint_offset {label}"][1]
        assert sigma == pytest.approx(np.sqrt(before**2 + moved**2 + 1e-6))


def test_unknowns_that_do_not_come_to_rest_displace_the_taxels_by_their_last_change(world):
    """Whatever the heights leave to them: they move by the sum about the axis."""
    found = turned(world, 0.0, 0.0)
    change = np.array([0.03, -0.01])
    wide = widened(found, world.recording, change)
    added = wide.covariances[:, :3, :3] - found.covariances[:, :3, :3]
    added = np.trace(added, axis1=1, axis2=2)
    expected = np.linalg.norm(0.01 * found.positions @ hat(AXIS).T, axis=1)
    np.testing.assert_allclose(np.sqrt(added), expected, rtol=0.05, atol=1e-4)
    assert wide.unknowns["joint_offset b"][1] == pytest.approx(np.hypot(0.01, 1e-3))
    assert widened(found, world.recording, 0.0 * change) is found
