from itertools import product
from types import SimpleNamespace

import numpy as np

from meshskin.robot.whole_turns import with_whole_turns

TURN = 2 * np.pi


def test_all_postures_within_the_limits_that_whole_turns_give_are_found_once():
    arm = SimpleNamespace(lower=np.array([-5.0, -1.0, -4.0]), upper=np.array([5.0, 1.0, 6.0]))
    rng = np.random.default_rng(0)
    q = rng.uniform(-3.0, 3.0, (4, 5, 2, 3)) * [1.0, 0.5, 1.0]
    q[1, 2, 1] = np.nan
    found = with_whole_turns(arm, q)
    np.testing.assert_array_equal(found[:, :, :2], q)
    for own, more in zip(q.reshape(-1, 2, 3), found[:, :, 2:].reshape(20, -1, 3), strict=True):
        expected = [
            one + TURN * np.array(turns)
            for one in own[np.isfinite(own[:, 0])]
            for turns in product((-1, 0, 1), (0,), (-1, 0, 1))
            if any(turns)
        ]
        inside = [x for x in expected if np.all((x >= arm.lower) & (x <= arm.upper))]
        mine = more[np.isfinite(more[:, 0])]
        assert len(mine) == len(inside)
        if inside:
            order = [np.lexsort(np.round(x, 9).T) for x in (mine, np.array(inside))]
            np.testing.assert_allclose(mine[order[0]], np.array(inside)[order[1]], atol=1e-12)
