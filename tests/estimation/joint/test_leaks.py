"""Which taxels crosstalk, by quadratic likelihoods of their shares."""

from dataclasses import replace

import numpy as np
import pytest

from meshskin.estimation.joint import leaks
from meshskin.estimation.joint.leaks import DISTANT, LAST_ID, NEIGHBOURS, NEXT_ID, Leaks, _Shares

SHARE = 0.03


def test_weights_change_although_other_pairs_are_neighbours():
    """Places move, and with them the pairs that are compared."""
    before = Leaks(np.array([1, 3, 6]), np.array([1.0, 0.5, 0.2]), np.zeros(3))
    after = Leaks(np.array([1, 6]), np.array([0.9, 0.3]), np.zeros(2))
    assert after.change_from(before) == pytest.approx(0.5)
    assert before.change_from(before) == 0.0


def ring(has, noise=1.0, seed=0):
    """Shares of 30 taxels in a ring, each of which reads of the six nearest, where `has`
    (180,) bool: what the readings tell, but for two combinations that displace the taxel, and one
    that all have in common; and the owners of both directions of each pair."""
    n, rng = 30, np.random.default_rng(seed)
    step = np.array([-3, -2, -1, 1, 2, 3])
    first, second = np.repeat(np.arange(n), 6), (np.arange(n)[:, None] + step).ravel() % n
    order = np.argsort(first * n + second)
    first, second, step = first[order], second[order], np.tile(step, n)[order]
    at = first, np.tile(np.arange(6), n)
    own = np.zeros((n, 6, 6))
    for i in range(n):
        turn = np.pi / 3 * np.arange(6)[:, None]
        moved = np.linalg.qr(np.concatenate([np.cos(turn), np.sin(turn)], axis=1))[0]
        own[i] = 2e4 * (np.eye(6) - moved @ moved.T)
    common = np.full((len(first), 1), 0.3 * (2e4 / len(first)) ** 0.5)
    made = _Shares(
        first * n + second, np.abs(step) == 1, np.where(np.abs(step) == 1, NEIGHBOURS, DISTANT),
        at, own, common, np.zeros(len(first)),
    )  # fmt: skip
    errors = np.einsum("nst,nt->ns", own, rng.normal(size=(n, 6)))[at] / np.sqrt(2e4)
    right = made.product(SHARE * has(first, second)) + noise * errors
    pair = np.minimum(first, second) * n + np.maximum(first, second)
    owner = np.unique(pair, return_inverse=True)[1]
    return replace(made, right=right), has(first, second).astype(bool), owner, (first, second)


@pytest.mark.parametrize("seed", range(4))
def test_members_of_modules_are_told_from_others(seed):
    """Two combinations of each taxel's shares are those of a displacement: alone, no share is
    determined."""
    made, truth, owner, _ = ring(lambda a, b: (a // 5 == b // 5) * 1.0, seed=seed)
    found = max((made.mixture(owner, r) for r in leaks.STARTS), key=lambda leaks: leaks.gain)
    assert np.mean(found.weight[truth] > 0.5) > 0.9
    assert np.mean(found.weight[~truth] < 0.5) > 0.9
    assert found.gain > made.uniform() + 20
    lost = found.weight * (1 - found.weight)
    assert np.all(found.variance > lost)  # evidence counts in part


def test_without_crosstalk_there_is_no_gain():
    gains = [ring(lambda a, b: 0.0 * a, seed=seed)[0] for seed in range(20)]
    found = [made.mixture(np.arange(180)).gain for made in gains]
    assert max(found) < 5.0


def test_a_share_of_the_other_sign_is_none():
    made, _, owner, _ = ring(lambda a, b: (a // 5 == b // 5) * -1.0)
    assert made.mixture(owner).gain == 0.0


def test_channels_that_are_read_one_after_another():
    """The taxel that was read before leaks into the next one, not the other way round."""
    made, truth, owner, (first, second) = ring(lambda a, b: (b == a - 1) * 1.0)
    apart = second - first
    kind = np.where(apart == 1, NEXT_ID, np.where(apart == -1, LAST_ID, made.kind))
    found = replace(made, kind=kind).mixture(np.arange(len(first)))
    assert found.weight[truth].min() > 0.9 > 0.1 > found.weight[~truth].max()
    assert found.gain > made.mixture(owner).gain + 20


def test_the_same_share_of_all_neighbours_is_uniform():
    made, truth, owner, _ = ring(lambda a, b: np.isin(np.abs(a - b), (1, 29)) * 1.0)
    np.testing.assert_array_equal(truth, made.near)
    assert made.uniform() > 20
    assert made.mixture(owner).gain < made.uniform() + 3.0
