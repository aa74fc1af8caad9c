"""The offset of the clocks that the contacts of a log are moved by before they are calibrated."""

from dataclasses import dataclass
from typing import Any

import numpy as np
import pytest

import meshskin as ms
from meshskin.estimation.kinematics import calibrate_log
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
    moved = calibrate_log._with_clock(found, 0.037)
    assert moved.unknowns["clock_offset"] == pytest.approx((0.041, 2e-4))

    def within_the_table(calibration):
        table = calibration.belief.contact_motion
        stated = np.array([calibration.unknowns[label][0] for label in labels])
        return np.linalg.pinv(table.root) @ (stated - table.mean)

    np.testing.assert_allclose(within_the_table(moved), within_the_table(found), atol=1e-12)
    assert calibrate_log._with_clock(found, 0.0) is found
