"""The joint estimator does no work twice, and none that leads nowhere."""

from types import SimpleNamespace

import numpy as np
import pytest

from meshskin.estimation import chart
from meshskin.estimation.data.gather import gather
from meshskin.estimation.joint.contacts import LinearizedContacts
from meshskin.estimation.joint.joint_estimator import TRIED, JointEstimator
from meshskin.estimation.joint.optimum import model_dependence
from meshskin.estimation.joint.parametrization import SurfaceParametrization
from meshskin.estimation.joint.variable_projection import LEAST_PART


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


def test_steps_of_few_taxels_count_by_their_time(world):
    """They take a tenth of the time of those of all, at least."""
    found, steps = estimator(world), 3
    found.problem.evaluations = 0.0
    found.problem.solve_inner(found.state, np.arange(1), most=steps)
    assert len(found.live) > 1 / LEAST_PART
    assert found.problem.evaluations == pytest.approx(steps * LEAST_PART)


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


def test_a_distance_from_the_weighted_mean_counts_from_the_least_one(world):
    found, fit = estimator(world), SimpleNamespace(reduced=4.0)
    found.converge()
    square = np.trace(model_dependence(found, fit), axis1=1, axis2=2)
    middle = float(np.median(square))
    least = (middle / (1 - 1 / fit.reduced)) ** 0.5
    far = np.trace(model_dependence(found, fit, least), axis1=1, axis2=2)
    np.testing.assert_array_equal(far[far > 0], square[far > 0])
    assert 0 < (far > 0).sum() < len(far)
    assert square[far == 0].max() <= 1.02 * middle <= 1.04 * far[far > 0].min()
