"""Which neighbours crosstalk, where few or others are compared."""

import numpy as np
import pytest

from meshskin.estimation.joint import leaks
from meshskin.estimation.joint.leaks import Leaks


def test_weights_change_although_other_pairs_are_neighbours():
    """Places move, and with them the pairs that are compared."""
    before = Leaks(np.array([1, 3, 6]), np.array([1.0, 0.5, 0.2]))
    after = Leaks(np.array([1, 6]), np.array([0.9, 0.3]))
    assert after.change_from(before) == pytest.approx(0.5)
    assert before.change_from(before) == 0.0


def test_no_neighbours_do_not_crosstalk(monkeypatch):
    none = np.empty(0, dtype=int), np.empty(0), np.empty(0)
    monkeypatch.setattr(leaks, "_shares", lambda *_: none)

    class Fitted:
        points = np.zeros((1, 3))

    assert leaks.leaking_pairs(Fitted(), 0.1) is None
