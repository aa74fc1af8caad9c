"""The paper's demonstration on taxels that were active together."""

import numpy as np
import pytest

import meshskin as ms
from meshskin.core.errors import CalibrationError
from meshskin.estimation.demonstration import demonstrate


def test_the_demonstration_needs_half_of_the_taxels(noisy):
    close = np.argsort(np.linalg.norm(noisy.skin.positions - noisy.skin.positions[0], axis=1))
    rows = np.append(close[:2], close[-3:])  # two neighbours, and three far from them
    skin = ms.Skin(noisy.skin.poses[rows], np.arange(5), noisy.skin.disc_radius)
    between = skin.positions[:2].mean(axis=0)
    recording = ms.press(noisy.with_(skin=skin), np.tile(between, (4, 1)), seed=1)
    with pytest.raises(CalibrationError, match=r"fewer than half .*, got 2 of 5"):
        demonstrate(skin.poses, skin.ids, recording)
    assert len(demonstrate(skin.poses[:4], skin.ids[:4], recording).rows) == 2
    with pytest.raises(CalibrationError, match="taxels that the belief does not know, got ids 1,"):
        demonstrate(skin.poses[:1], skin.ids[:1], recording)
