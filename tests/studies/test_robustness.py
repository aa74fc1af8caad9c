"""The study of robustness with one seed: the others keep their accuracy, the faulty are named."""

import numpy as np
import pytest


def slow(value):
    """A parameter of the slow suite."""
    return pytest.param(value, marks=pytest.mark.slow)


@pytest.fixture(scope="module")
def study(script):
    return script("robustness")


@pytest.fixture(scope="module")
def world(study):
    return study.World()


@pytest.mark.parametrize("share", [slow(0.2), slow(0.1)])
def test_outlying_readings_cost_little_more_than_removing_exactly_them(study, world, share):
    found = study.outlying(world, share, range(1))
    assert found["error"] < 1.06 * found["without"]
    assert found["without"] < 1.1 / np.sqrt(1 - share)
    assert 0.9 < found["named"] < 1.05


@pytest.mark.slow
def test_outlying_readings_of_some_taxels_do_not_affect_the_others(study, world):
    found = study.outlying(world, 0.2, range(1), 0.2)
    assert found["others"] < 1.02
    assert found["error"] < 1.06 * found["limit"]
    assert found["named"] > 0.9


def test_the_efficiency_is_the_fisher_information(study):
    assert study.efficiency(1e-9) == pytest.approx(1.0, abs=1e-6)
    rng, share = np.random.default_rng(0), 0.2  # the score's variance is the information
    width = (study.WILD - study.THRESHOLD) / study.NOISE
    out = rng.random(2_000_000) < share
    r = np.where(out, width * (rng.random(len(out)) - 0.5), rng.normal(size=len(out)))
    sound = (1 - share) * np.exp(-(r**2) / 2) / np.sqrt(2 * np.pi)
    information = np.mean((r * sound / (sound + share / width)) ** 2)
    assert study.efficiency(share) == pytest.approx(information / (1 - share), abs=2e-3)


def test_the_largest_share_within_ten_per_cent(study):
    errors = {e: 1 / np.sqrt(1 - e) for e in (0.05, 0.1, 0.15, 0.2)}
    assert study.largest_share(errors) == pytest.approx(1 - 1.1**-2)
    assert study.largest_share({0.05: 1.01, 0.2: 1.05}) == 0.2


def test_errors_beyond_their_limits_are_listed(study):
    alone = {"error": 1.12, "limit": 1.11, "others": float("nan"), "named": 1.0}
    spared = {"error": 1.2, "limit": 1.1, "others": 1.01, "named": 1.0}
    fault = {"others": 1.05, "named": 1.0}
    good = {"outlying 0.2": alone, "outlying 0.2 on 20%": spared, "2 dead": fault}
    assert study.shortfalls(good | {"largest share": {"share": 0.1}}) == []
    assert len(study.shortfalls({"outlying 0.2": alone | {"error": 1.15}})) == 1
    assert len(study.shortfalls({"2 dead": {"others": 1.2, "named": 0.5}})) == 2


@pytest.mark.deep
@pytest.mark.parametrize(
    "name", ["dead", *map(slow, ["dies_halfway", "stuck", "swapped", "drifting"])]
)
def test_a_fifth_of_all_taxels(study, world, name):
    found = study.faulty(world, study.FAULTS[name], 16, range(1))
    assert found["others"] < 1.1
    assert found["named"] == 1.0
    assert found["accused"] <= 4
    assert found["lost"] == 0


@pytest.mark.slow
def test_dead_taxels_do_not_make_the_fit_bad(study, world):
    bad = np.random.default_rng(2000).choice(len(world.skin), 16, replace=False)
    _, found = world.errors(world.record(0, study.dies_halfway, bad))
    assert found.fit.good
    assert set(np.flatnonzero(found.faults != "")) == set(bad)
