"""The paper's figure 9: the relaxation against closed forms, the errors over the noise."""

import numpy as np
import paper_noise
import pytest

import meshskin as ms
from meshskin.core import se3
from meshskin.estimation.data.gather import gather
from meshskin.estimation.demonstration import aligned


def turned(rng, n):
    return se3.transform(se3.exp_so3(rng.normal(size=(n, 3))), rng.normal(size=(n, 3)))


def test_two_poses_meet_half_way():
    rng = np.random.default_rng(0)
    first, step = turned(rng, 1)[0], turned(rng, 1)[0]
    off = np.array([4e-3, 0.0, -2e-3])
    second = first @ step
    second[:3, 3] += off
    edges = np.array([[0, 1]])
    moved = paper_noise.relaxed(np.stack([first, second]), edges, step[None], 1)
    assert np.allclose(moved[1, :3, 3], second[:3, 3] - 0.5 * off)
    assert np.allclose(moved[0, :3, 3], first[:3, 3] + 0.5 * off)
    assert np.allclose(moved[:, :3, :3], [first[:3, :3], second[:3, :3]])


def test_exact_displacements_are_restored_and_a_lone_pose_stays():
    rng = np.random.default_rng(1)
    true = turned(rng, 9)
    edges = np.array([(i, j) for i in range(8) for j in range(i + 1, 8) if j - i < 3])
    measured = se3.inverse(true[edges[:, 0]]) @ true[edges[:, 1]]
    start = paper_noise.perturbed(true, 5e-3, rng)
    assert np.linalg.norm(start[:, :3, 3] - true[:, :3, 3], axis=1).mean() == pytest.approx(
        5e-3 * np.sqrt(8 / np.pi), rel=0.4
    )
    found = paper_noise.relaxed(start, edges, measured, 500)
    assert np.allclose(found[8], start[8])
    goal = true[:8, :3, 3]
    assert np.abs(aligned(found[:8, :3, 3], goal) - goal).max() < 1e-9
    assert np.abs(se3.inverse(found[0]) @ found[1] - measured[0]).max() < 1e-9


@pytest.mark.deep
def test_errors_grow_with_the_noise_and_iterations_reduce_them(noisy):
    skin = ms.Skin.cover(noisy.body, spacing=5e-3, count=30, seed=1)
    points = np.random.default_rng(0).normal(scale=2.5e-3, size=(10, 30, 3)) + skin.positions
    scene = noisy.with_(skin=skin)
    data = gather(ms.press(scene, points.reshape(-1, 3)), scene.belief())
    near = np.linalg.norm(skin.positions[:, None] - skin.positions, axis=2) < 1.1 * skin.spacing
    pairs = np.argwhere(np.triu(near, 1))
    found = paper_noise.noisy_poses(data, skin.poses, pairs, [0.2e-3, 1e-3], seeds=2)
    assert found.relaxed.shape == (2, 2, len(paper_noise.ITERATIONS))
    start, after = found.initial.mean(axis=1), found.relaxed.mean(axis=1)
    assert start.min() > 0.8e-3  # readings of discs
    assert (after[0] < [0.7 * start[0], 0.3 * start[0], 0.3 * start[0]]).all()
    assert after[1, 2] > 3 * after[0, 2]  # five times the noise, drawn anew
    assert not np.allclose(after[1, 2] / after[0, 2], 5.0, rtol=1e-3)
