"""The paper's figure 9: the relaxation against closed forms, the errors over the noise."""

import numpy as np
import pytest

import meshskin as ms
from meshskin.core import se3
from meshskin.core.errors import CalibrationError
from meshskin.estimation import paper_pipeline
from meshskin.estimation.data.gather import gather
from meshskin.estimation.demonstration import aligned, demonstrate


def turned(rng, n):
    return se3.transform(se3.exp_so3(rng.normal(size=(n, 3))), rng.normal(size=(n, 3)))


def test_two_poses_meet_half_way():
    rng = np.random.default_rng(0)
    first, step = turned(rng, 1)[0], turned(rng, 1)[0]
    off = np.array([4e-3, 0.0, -2e-3])
    second = first @ step
    second[:3, 3] += off
    edges = np.array([[0, 1]])
    moved = paper_pipeline.relaxed(np.stack([first, second]), edges, step[None], 1)
    assert np.allclose(moved[1, :3, 3], second[:3, 3] - 0.5 * off)
    assert np.allclose(moved[0, :3, 3], first[:3, 3] + 0.5 * off)
    assert np.allclose(moved[:, :3, :3], [first[:3, :3], second[:3, :3]])


def test_exact_displacements_are_restored_and_a_lone_pose_stays():
    rng = np.random.default_rng(1)
    true = turned(rng, 9)
    edges = np.array([(i, j) for i in range(8) for j in range(i + 1, 8) if j - i < 3])
    measured = se3.inverse(true[edges[:, 0]]) @ true[edges[:, 1]]
    start = paper_pipeline.perturbed(true, 5e-3, rng)
    assert np.linalg.norm(start[:, :3, 3] - true[:, :3, 3], axis=1).mean() == pytest.approx(
        5e-3 * np.sqrt(8 / np.pi), rel=0.4
    )
    found = paper_pipeline.relaxed(start, edges, measured, 500)
    assert np.allclose(found[8], start[8])
    goal = true[:8, :3, 3]
    assert np.abs(aligned(found[:8, :3, 3], goal) - goal).max() < 1e-9
    assert np.abs(se3.inverse(found[0]) @ found[1] - measured[0]).max() < 1e-9


def test_errors_grow_with_the_noise_and_iterations_reduce_them(world):
    data = gather(world.record(), world.belief())
    near = np.linalg.norm(world.truth[:, None] - world.truth, axis=2) < 1.1 * world.spacing
    pairs = np.argwhere(np.triu(near, 1))
    poses = se3.transform(np.tile(np.eye(3), (len(world.truth), 1, 1)), world.truth)
    found = paper_pipeline.noisy_poses(data, poses, pairs, [0.2e-3, 1e-3], seeds=2)
    assert found.relaxed.shape == (2, 2, len(paper_pipeline.ITERATIONS))
    start, after = found.initial.mean(axis=1), found.relaxed.mean(axis=1)
    assert start.min() > 0.8e-3  # readings of discs
    assert (after[0] < [0.7 * start[0], 0.3 * start[0], 0.3 * start[0]]).all()
    assert after[1, 2] > 3 * after[0, 2]  # five times the noise, drawn anew
    assert not np.allclose(after[1, 2] / after[0, 2], 5.0, rtol=1e-3)


def test_the_demonstration_needs_half_of_the_taxels(noisy):
    close = np.argsort(np.linalg.norm(noisy.skin.positions - noisy.skin.positions[0], axis=1))
    rows = np.append(close[:2], close[-3:])  # two neighbours, and three far from them
    skin = ms.Skin(noisy.skin.poses[rows], np.arange(5), noisy.skin.disc_radius)
    between = skin.positions[:2].mean(axis=0)
    recording = ms.press(noisy.with_(skin=skin), np.tile(between, (4, 1)), seed=1)
    with pytest.raises(CalibrationError, match=r"fewer than half .*, got 2 of 5"):
        demonstrate(skin.poses, skin.ids, recording)
    assert len(demonstrate(skin.poses[:4], skin.ids[:4], recording).rows) == 2
