"""The search for departures ends where what it finds is of another kind."""

from types import SimpleNamespace

import numpy as np
import pytest

from meshskin.core.progress import Stage
from meshskin.estimation.calibrate import Estimation, calibrate
from meshskin.estimation.joint.rival_optima import RivalOptima
from meshskin.estimation.learned import departure_search, estimate
from meshskin.estimation.learned.random_effects import MAX_IMPLAUSIBLE, MAX_ITERATIONS

from .test_estimate import RADIUS, belief, bell, recording, world
from .test_first_response import started  # noqa: F401


def test_an_estimate_that_stays_out_of_reach_is_given_up(started):  # noqa: F811
    whole, given_up = started(), started()
    assert whole.converge()
    assert not given_up.converge(lambda: False)
    assert len(given_up.iterates) - 1 == MAX_IMPLAUSIBLE < len(whole.iterates) - 1


def effects_at(objective, stage):
    return SimpleNamespace(objective=objective, stage=stage)


def searched(monkeypatch, scores, trial, steps=0):
    """What `with_departures` returns where departures have `scores`, and what it tried; trial
    (name): whether one converges, None where it is lost, and by how much it lowers the objective;
    steps: that each takes.
    """
    tried = []

    def with_departure(effects, begin, name, start):
        tried.append(name)
        converged, gain = trial(name)
        if converged is not None:
            del scores[name]
        effects.stage.done += steps
        return effects_at(effects.objective - gain, effects.stage), begin, converged

    monkeypatch.setattr(
        departure_search,
        "scores",
        lambda effects: {name: (score, np.zeros(1)) for name, score in scores.items()},
    )
    monkeypatch.setattr(departure_search, "_with_departure", with_departure)
    monkeypatch.setattr(departure_search, "_objective", lambda effects: effects.objective)
    monkeypatch.setattr(departure_search, "plausible", lambda effects, name: True)
    begin = effects_at(0.0, Stage())
    return departure_search.with_departures(begin, (None, None), ()), tried


@pytest.mark.parametrize("held", [{"drag"}, {"drag", "creep"}])
def test_lost_departures_of_the_electronics_are_not_tried_again(monkeypatch, held):
    """Once each of them was lost, also where another departure has been accepted."""
    scores = {"hysteresis": 20.0, "creep": 15.0, "crosstalk": 12.0, "drag": 8.0}
    (_, left, ended), tried = searched(
        monkeypatch, dict(scores), lambda name: (True, 1e3) if name in held else (None, 0.0)
    )
    once = ["hysteresis", "creep", "crosstalk", "drag"]
    again = ["hysteresis", "creep", "hysteresis", "crosstalk", "drag", "hysteresis", "crosstalk"]
    assert tried == (again if "creep" in held else once)
    assert set(left) == set(scores) - held
    assert ended


@pytest.mark.parametrize("converged", [True, False])
def test_a_search_ends_but_where_two_departures_do_not_converge(monkeypatch, converged):
    scores = {"drag": 20.0, "friction": 15.0, "creep": 12.0}
    (found, left, ended), tried = searched(monkeypatch, scores, lambda name: (converged, 1e3))
    assert ended is converged
    assert tried == ["drag", "friction", "creep"][: 3 if converged else 2]
    assert left == ({} if converged else {"creep": 12.0})
    assert found.objective == (-3e3 if converged else -2e3)


@pytest.mark.parametrize("last", [True, False])
def test_a_departure_that_another_brings_to_rest(monkeypatch, last):
    scores = {"drag": 20.0, "skew": 15.0}
    (_, left, ended), tried = searched(
        monkeypatch, scores, lambda name: (last and name == "skew", 1e3)
    )
    assert tried == ["drag", "skew"]
    assert ended is last
    assert left == {}


@pytest.mark.parametrize("lost", [True, False])
def test_a_search_ends_when_steps_have_come_to_nothing(monkeypatch, lost):
    """Those of departures that stay do not count."""
    scores = dict.fromkeys(("drag", "friction", "indenter_offset", "gain_drift"), 20.0)
    gain, most = 0.0 if lost else 1e3, departure_search.MAX_SPENT
    (_, left, ended), tried = searched(monkeypatch, scores, lambda name: (True, gain), most)
    assert len(tried) == (2 if lost else 4)
    assert ended is not lost
    assert set(left) == ({*scores} if lost else set())


@pytest.mark.slow
def test_displaced_contacts_are_left_out_before_departures_are_searched(monkeypatch):
    points, *others = world(bell, scatter=5e-5)
    points[::50] += np.random.default_rng(3).normal(0.0, 3e-3, points[::50].shape)
    points *= RADIUS / np.linalg.norm(points, axis=1)[:, None]
    seen = []

    def search(effects, begin, excluded):
        seen.append(len(effects.data.misfitting))
        return effects, {}, True

    monkeypatch.setattr(estimate, "with_departures", search)
    calibrate(recording(points, *others), belief(contact="learned"))
    assert len(seen) == 1
    assert 8 <= seen[0] <= 12  # 10 are displaced


@pytest.mark.deep
@pytest.mark.parametrize("ended", [False, True])
def test_rivals_are_sought_of_an_estimate_that_has_come_to_rest(monkeypatch, ended):
    """Or whose search for departures has come to an end."""
    first, sought = estimate.first_estimate, []

    def unsettled(effects):
        effects = first(effects)
        effects.iterates = (MAX_ITERATIONS + 1) * effects.iterates[:1]
        return effects

    def resolve(estimator):
        sought.append(estimator)
        return RivalOptima.none(len(estimator.live))

    monkeypatch.setattr(estimate, "first_estimate", unsettled)
    monkeypatch.setattr(estimate, "with_departures", lambda effects, *_: (effects, {}, ended))
    monkeypatch.setattr(estimate, "resolve_rivals", resolve)
    calibrate(recording(*world(bell, contacts=150)), belief(contact="learned"))
    assert bool(sought) is ended


@pytest.mark.deep
@pytest.mark.parametrize("equal", [False, True])
def test_no_response_is_learned_of_a_log_that_fails_by_itself(monkeypatch, equal):
    """Equal pressures are none, whatever the response."""
    *others, pressure = world(bell, contacts=300)
    learned = []
    monkeypatch.setattr(Estimation, "_learned", lambda self, stage: learned.append(stage))
    log = recording(*others, np.full_like(pressure, 1e4) if equal else pressure)
    found = calibrate(log, belief(contact="auto"))
    assert bool(learned) is not equal
    assert (found.verdict.level == "FAIL") >= equal
