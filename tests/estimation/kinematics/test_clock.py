"""The offset of the clocks that the contacts of a log are moved by before they are calibrated."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

import meshskin as ms
from meshskin.estimation.kinematics.clock import first_offset, with_clock
from meshskin.robot.contact_kinematics import JointPath
from meshskin.scene.contact_motion import ContactMotion


@dataclass(frozen=True)
class Found:
    """What is taken of a calibration."""

    unknowns: dict[str, tuple[float, float]]
    belief: Any


def test_the_contacts_of_a_calibration_stay_where_its_own_unknowns_put_them():
    """The offset that it states is the whole one; its table is about that of before."""
    labels = ("joint_offset a", "clock_offset")
    motion = ContactMotion(
        labels, np.array([0.02, 0.05]), np.ones((4, 3, 2)), mean=np.array([0.01, 0.002])
    )
    belief = ms.Belief(
        body=ms.Body.sphere(0.05), indenter=ms.Indenter.sphere(0.01), material=ms.Material(),
        taxel_ids=[1], contact_motion=motion,
    )  # fmt: skip
    found = Found({"joint_offset a": (0.013, 1e-3), "clock_offset": (0.004, 2e-4)}, belief)
    moved = with_clock(found, 0.037)
    assert moved.unknowns["clock_offset"] == pytest.approx((0.041, 2e-4))

    def within_the_table(calibration):
        table = calibration.belief.contact_motion
        stated = np.array([calibration.unknowns[label][0] for label in labels])
        return np.linalg.pinv(table.root) @ (stated - table.mean)

    np.testing.assert_allclose(within_the_table(moved), within_the_table(found), atol=1e-12)
    assert with_clock(found, 0.0) is found


class Sliding:
    """An indenter whose centre is given over time, on a clock that is not known."""

    def __init__(self):
        self.columns = {"clock_offset": slice(0, 1)}

    def centres(self, path, time, s):
        return path.at(time)[0], None


@pytest.mark.parametrize("seed", [1, *(pytest.param(k, marks=pytest.mark.slow) for k in (2, 3))])
def test_a_few_touches_do_not_move_the_clock_by_seconds(seed):
    """Beside the touches the robot stands still, so that the contacts would spread least there."""
    rng, step = np.random.default_rng(seed), 0.02
    ways = [np.linspace(*rng.uniform(-0.02, 0.02, (2, 3)), 40) for _ in range(3)]
    still = [np.repeat(way[-1:], 60, axis=0) for way in ways]
    centres = np.concatenate([part for pair in zip(ways, still, strict=True) for part in pair])
    time, pressed = step * np.arange(len(centres)), np.tile(np.arange(100) < 40, 3)
    taxels = rng.uniform(-0.02, 0.02, (30, 3))
    far = np.linalg.norm(centres[pressed, None] - taxels, axis=2)
    readings = np.exp(-((far / 5e-3) ** 2))
    found = first_offset(
        Sliding(), JointPath(time, centres), time[pressed] + 0.03, readings, np.zeros(1)
    )
    assert abs(found) < 0.1
