"""The study of robustness with one seed: the others keep their accuracy, the faulty are named."""

import importlib.util
from pathlib import Path

import numpy as np
import pytest

SCRIPT = Path(__file__).parents[2] / "studies" / "robustness.py"


@pytest.fixture(scope="module")
def study():
    spec = importlib.util.spec_from_file_location("robustness_study", SCRIPT)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture(scope="module")
def world(study):
    return study.World()


@pytest.mark.parametrize("share", [0.1, 0.2])
def test_outlying_readings_cost_little_more_than_leaving_just_them_out(study, world, share):
    found = study.outlying(world, share, range(1))
    assert found["error"] < 1.06 * found["without"]
    assert found["without"] < 1.1 / np.sqrt(1 - share)
    assert 0.9 < found["named"] < 1.05


@pytest.mark.parametrize("name", ["dead", "dies", "stuck", "swapped", "thermal"])
def test_a_fifth_of_all_taxels(study, world, name):
    found = study.faulty(world, study.FAULTS[name], 16, range(1))
    assert found["others"] < 1.1
    assert found["named"] == 1.0
    assert found["accused"] <= 4
    assert found["lost"] == 0


def test_what_dead_taxels_do_not_say_is_not_held_against_the_model(study, world):
    bad = np.random.default_rng(2000).choice(len(world.skin), 16, replace=False)
    _, found = world.errors(world.record(0, study.dies, bad))
    assert found.fit.good
    assert set(np.flatnonzero(found.faults != "")) == set(bad)
