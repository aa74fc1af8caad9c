"""An estimate that begins from a former one, whose contacts were elsewhere by a little."""

from dataclasses import replace

import numpy as np
import pytest

from meshskin.core.errors import CalibrationError
from meshskin.core.progress import Stage
from meshskin.estimation.data.gather import gather
from meshskin.estimation.learned import estimate as module
from meshskin.estimation.learned.estimate import estimate
from meshskin.estimation.learned.random_effects import MOVE_TOLERANCE

from .test_estimate import RADIUS, belief, bell, recording, world


@pytest.fixture(scope="module")
def logs():
    """A log of which ten contacts are 3 mm off and some readings wrong, and the same one with its
    contacts computed anew, 20 micrometres away and off the surface no more."""
    points, force, contact, taxel, pressure = world(bell, contacts=400, scatter=5e-5)
    pressure[::71] *= 3.0
    points[::40] += np.random.default_rng(3).normal(0.0, 3e-3, points[::40].shape)
    moved = points + 2e-5 * np.sin(points / RADIUS * 9.0)[:, [1, 2, 0]]
    made = []
    for at in (points, moved):
        at *= RADIUS / np.linalg.norm(at, axis=1)[:, None]
        log = recording(at, force, contact, taxel, pressure)
        made.append(gather(log, belief(contact="learned")))
    return made


@pytest.fixture(scope="module")
def first(logs):
    return estimate(logs[0])


@pytest.mark.deep
def test_the_estimate_is_that_without_a_former_one_in_fewer_steps(logs, first, monkeypatch):
    searched = []
    monkeypatch.setattr(module, "first_estimate", lambda *_: pytest.fail("begins anew"))
    monkeypatch.setattr(module, "with_departures", lambda *given: searched.append(given))
    warm = Stage()
    found = estimate(logs[1], warm, first.former)
    assert not searched
    monkeypatch.undo()
    cold = Stage()
    alone = estimate(logs[1], cold)
    assert warm.done < cold.done / 4
    sigma = np.sqrt(np.trace(alone.covariance, axis1=1, axis2=2))
    apart = np.linalg.norm(found.points - alone.points, axis=1) / sigma
    assert np.sqrt(np.mean(apart**2)) < MOVE_TOLERANCE
    np.testing.assert_allclose(found.covariance, alone.covariance, rtol=0.1, atol=1e-11)
    left_out = first.former.effects.data.misfitting
    assert len(left_out) > 5
    np.testing.assert_array_equal(found.former.effects.data.misfitting, left_out)
    assert found.departures.keys() == alone.departures.keys()


def test_other_contacts_take_no_errors_and_weights_of_a_former_estimate(logs, first):
    later = replace(logs[1], time=logs[1].time + 1.0)
    assert not first.former.same_contacts(later)
    assert (first.former.weight(later) == 1.0).all()
    assert len(first.former.without_misfits(later).misfitting) == 0


def test_a_former_estimate_that_leads_to_none_is_left_alone(logs, first, monkeypatch):
    attempts = []

    def attempt(data, excluded, stage, former):
        attempts.append((len(data.misfitting), former))
        if former is not None:
            raise CalibrationError("lost")
        return "found"

    monkeypatch.setattr(module, "_attempt", attempt)
    assert estimate(logs[0], None, first.former) == "found"
    bad = first.former.effects.data.misfitting
    assert attempts == [(len(bad), first.former), (0, None)]


def test_departures_are_sought_again_where_others_show(logs, first, monkeypatch):
    former, sought = first.former, []
    before = {"creep": 3.0, "drag": 9.0}
    monkeypatch.setattr(module, "with_departures", lambda *given: sought.append(given))
    for now, again in (({"creep": 5.0, "drag": 11.0}, 0), ({"creep": 7.0, "drag": 1.0}, 1)):
        shown = {name: (score, np.zeros(1)) for name, score in {**now, "skew": 20.0}.items()}
        monkeypatch.setattr(module, "scores", lambda effects, shown=shown: shown)
        found = module._searched(
            former.effects, (None, None), (), replace(former, departures=before)
        )
        assert len(sought) == again
        assert again or found == (former.effects, now, former.ended)
