"""Results in words, as page and terminal say them."""

from types import SimpleNamespace

import numpy as np
import pytest

from meshskin.report.words import force_notes, modulus_words


@pytest.mark.parametrize(
    ("sigma", "between", "words"),
    [(None, "+-", "263.193 kPa, given"), (1234.5, "+-", "263.2 +- 1.2 kPa"),
     (1.2, "±", "263.1930 ± 0.0012 kPa"), (43e3, "±", "263 ± 43 kPa"),
     (0.0, "±", "263.193 ± 0 kPa")],
)  # fmt: skip
def test_the_modulus_has_its_standard_deviation(sigma, between, words):
    found = SimpleNamespace(modulus=263_193.0, modulus_sigma=sigma)
    assert modulus_words(found, between) == words


def test_the_force_is_said_as_far_as_it_is_known():
    force = {"reference_n": 3.0, "settling_s": 0.0449, "overshoot": 0.123, "disturbance": 0.006}
    said = ["reference 3 N", "settled in 44.9 ms", "overshoot 12.3 %", "then within 0.6 %"]
    assert force_notes(force) == said
    assert force_notes(force | {"disturbance": 2e-7})[-1] == "then within 0.1 %"
    left = {"departure": "37 N", "settling_s": np.inf, "overshoot": 0.0}
    assert force_notes(left) == [
        "not settled before it slides", "no overshoot", "left its reference later: see above",
    ]  # fmt: skip
    assert force_notes({"lighter_references_n": [1.5, 0.75]}) == [
        "contacts of 1.5 and 0.75 N scaled to it"
    ]
