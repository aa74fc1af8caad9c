"""The joint estimator does no work twice, and none that leads nowhere."""

import numpy as np
import pytest

from meshskin.estimation import chart
from meshskin.estimation.data.gather import gather
from meshskin.estimation.joint.contacts import LinearizedContacts
from meshskin.estimation.joint.joint_estimator import TRIED, JointEstimator
from meshskin.estimation.joint.parametrization import SurfaceParametrization


def estimator(world, off=1e-3, **belief):
    """An estimator whose global parameters stay; it begins `off` (m) from the taxels' places."""
    data = gather(world.record(0.01, 0.05), world.belief(0.01, 0.05, **belief))
    live = np.arange(len(world.ids))
    begin = world.body.closest(world.truth + np.array([off, 0.0, 0.0]))
    places = SurfaceParametrization(chart.charts_at(data.body, begin.point), 1e-3)
    weight, shared = np.ones(len(data.pressure)), data.parameters.start()
    return JointEstimator(data, live, places, weight, 30, shared=shared)


def test_taxels_without_an_optimum_stay_where_they_are(world):
    found = estimator(world)
    found.converge(steps=1)  # so that no taxel reaches its optimum in a linearization
    assert found.unconverged.all()
    assert found.problem.evaluations == pytest.approx(TRIED)
    found.converge()  # in which all are tried anew
    assert not found.unconverged.any()
    off = np.linalg.norm(found.problem.points(found.state) - world.truth, axis=1)
    assert off.max() < 0.1e-3


@pytest.mark.parametrize("unknown", [("modulus",), ("modulus", "drag")])
def test_contacts_are_linearized_once_where_they_stay(world, unknown, monkeypatch):
    made, init = [], LinearizedContacts.__init__

    def counted(self, recorded, about):
        made.append(about)
        init(self, recorded, about)

    monkeypatch.setattr(LinearizedContacts, "__init__", counted)
    found = estimator(world, unknown=unknown)
    found.converge()
    assert len(made) == 1
    s = found.state.s + 0.1
    found.relinearize(found.problem.parametrization, s)
    assert len(made) == (2 if "drag" in unknown else 1)  # drag moves the contacts
    fresh = LinearizedContacts(found.data, s)
    np.testing.assert_array_equal(found.problem.contacts.at(s).points, fresh.at(s).points)
