"""Chains of postures: Newton's method in machine code, and dynamic programming."""

from dataclasses import replace
from itertools import pairwise, product
from types import SimpleNamespace

import numpy as np
import pytest

from meshskin.robot import inverse_kinematics, posture


def test_machine_code_agrees_with_the_interpreter(sphere):
    arm = sphere.arm
    if arm.newton.code is None:
        pytest.skip("no C compiler")
    interpreted = replace(arm.newton, code=None)
    rng = np.random.default_rng(0)
    goals = rng.uniform(-1.5, 1.5, (40, 6))
    targets = inverse_kinematics.pose_rows(arm.pose(goals))
    targets[0, 9:] += 9.0  # out of reach
    q, residual = arm.newton.iterate(rng.uniform(-1.5, 1.5, goals.shape), targets, 0)
    assert np.isinf(residual).all()
    made, expected = (n.iterate(q, targets, 30) for n in (arm.newton, interpreted))
    np.testing.assert_allclose(made[0], expected[0], atol=1e-9)
    np.testing.assert_allclose(made[1], expected[1], rtol=1e-6, atol=1e-12)
    there = made[1] < inverse_kinematics.TOLERANCE
    assert 20 < there.sum() < 40
    np.testing.assert_allclose(
        inverse_kinematics.pose_rows(arm.pose(made[0]))[there], targets[there], atol=1e-9
    )
    way = inverse_kinematics.pose_rows(arm.pose(np.linspace(goals[1], goals[1] + 0.1, 30)))
    for n in (arm.newton, interpreted):
        assert [x.shape for x in n.iterate(q[:0], targets[:0], 9)] == [(0, 6), (0,)]
    tracked = [n.track(goals[1], way) for n in (arm.newton, interpreted)]
    np.testing.assert_allclose(tracked[0], tracked[1], atol=1e-10)


def test_nodes_reach_their_poses_from_every_anchor(sphere):
    arm, spins = sphere.arm, 8
    angle = 2 * np.pi * np.arange(spins) / spins
    way = np.linspace(0.0, 0.2, 12)
    q = np.tile([0.2, -0.9, 0.6, 0.1, 0.8, 0.0], (12, spins, 1))
    q[..., 1] += way[:, None]
    q[..., 5] += angle
    targets = arm.pose(q)
    found = posture.solve_nodes(arm, targets, anchor_spacing=5)
    assert found.solved.any(axis=2).all()
    at = np.nonzero(found.solved)
    np.testing.assert_allclose(arm.pose(found.q[at]), targets[at[:2]], atol=1e-9)
    gap = np.abs(np.sin(0.5 * (found.q - q[:, :, None]))).max(axis=-1)
    assert np.nanmin(np.where(found.solved, gap, np.nan), axis=2).max() < 1e-8


def test_a_path_far_from_the_one_before_has_an_anchor_of_its_own(sphere):
    q = np.tile([0.2, -0.9, 0.6, 0.1, 0.8, 0.0], (12, 1, 1))
    q[:6, 0, 1] += np.linspace(0.0, 0.1, 6)
    q[6:, 0, 0] += 2.0 + np.linspace(0.0, 0.1, 6)
    targets = sphere.arm.pose(q)
    assert not posture.solve_nodes(sphere.arm, targets).solved.any(axis=(1, 2)).all()
    found = posture.solve_nodes(sphere.arm, targets, starts=np.arange(12) == 6)
    assert found.solved.any(axis=(1, 2)).all()


@pytest.mark.parametrize("seed", range(6))
def test_the_chain_is_the_cheapest_of_all(seed):
    rng = np.random.default_rng(seed)
    arm = SimpleNamespace(lower=np.array([-9.0, -1.0]), upper=np.array([9.0, 1.0]))
    m, s, b = 4, 3, 3
    q = rng.uniform(-0.35, 0.35, (m, s, b, 2))
    q[..., 0] += 2 * np.pi * rng.integers(-1, 2, (m, s, b))
    margin = rng.uniform(0.0, 0.5, (m, s, b))
    usable = rng.random((m, s, b)) < 0.5
    usable[:, 0, 2] = True
    starts = np.arange(m) == (0 if seed % 2 else 2)
    offset = rng.uniform(-0.1, 0.1, margin.shape)
    found = posture.Nodes(q, usable, margin, np.zeros((m, s, b), dtype=int), offset)

    def price(at):
        near = np.maximum(0.0, 1.0 - margin[at] / posture.LIMIT_RANGE) ** 2
        return posture.LIMIT_COST * near

    def step(k, old, new):
        if starts[k]:
            return 0.0
        move = np.abs(q[k - 1][old] - q[k][new])
        move[0] = min(move[0] % (2 * np.pi), -move[0] % (2 * np.pi))
        spun = posture.SPIN_COST * (old[0] != new[0])
        moved = (move**2).sum() + spun if move.max() <= posture.MAX_STEP else np.inf
        return min(moved, posture.BREAK_COST)

    def cost(chain):
        moves = (step(k + 1, *pair) for k, pair in enumerate(pairwise(chain)))
        return sum(moves) + sum(price((k, *node)) for k, node in enumerate(chain))

    nodes = [list(zip(*np.nonzero(usable[k]), strict=True)) for k in range(m)]
    best = min(product(*nodes), key=cost)
    chosen = posture.cheapest_chain(arm, found, usable, starts)
    np.testing.assert_array_equal(chosen.q, [q[k][node] for k, node in enumerate(best)])
    spins = [posture.SPIN_STEP * at[0] + offset[k][at] for k, at in enumerate(best)]
    turns = (chosen.spin - spins) / (s * posture.SPIN_STEP)
    np.testing.assert_allclose(turns, np.round(turns), atol=1e-12)
    breaks = [k == 0 or starts[k] or step(k, best[k - 1], best[k]) == 10.0 for k in range(m)]
    np.testing.assert_array_equal(chosen.breaks, breaks)
