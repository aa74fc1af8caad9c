"""The reduced problem: derivatives, IPOPT, and the speed study's result."""

from dataclasses import replace

import numpy as np
import pytest

from meshskin.core.errors import CalibrationError
from meshskin.estimation import chart
from meshskin.estimation.data.gather import gather
from meshskin.estimation.joint import maximum_likelihood, reduced_nlp
from meshskin.estimation.joint.contacts import LinearizedContacts
from meshskin.estimation.joint.joint_estimator import JointEstimator
from meshskin.estimation.joint.likelihood import Likelihood
from meshskin.estimation.joint.parametrization import SurfaceParametrization
from meshskin.estimation.joint.readings import select
from meshskin.estimation.joint.reduced_nlp import minimize
from meshskin.estimation.joint.variable_projection import ReducedProblem
from meshskin.estimation.uncertainty.metrics import bound_mm
from meshskin.skin.skin import Skin


@pytest.fixture(scope="module")
def problem(world):
    belief = world.belief(0.01, 0.05, unknown=("modulus", "force_offset", "gain"))
    data = gather(world.record(0.01, 0.05), belief)
    s, live = np.zeros(2), np.arange(len(world.ids))
    heard, silent = np.ones(len(data.pressure)), np.ones(len(live))
    readings = select(
        data, live, world.truth, data.body.closest(world.truth).normal, 0.0, heard, silent
    )
    places = SurfaceParametrization(chart.charts_at(world.body, world.truth), 2e-3)
    likelihood = Likelihood(data, readings)
    return ReducedProblem(likelihood, places, LinearizedContacts(data, s))


def test_the_reduced_gradient_is_that_of_the_reduced_cost(problem):
    about = np.array([0.05, -0.1])
    state = problem.start(about)
    problem.solve_inner(state)
    assert state.decrement.max() < 1e-8
    reduced = problem.reduce(state)
    for k, h in enumerate((1e-4, 1e-3)):
        step = h * np.eye(2)[k]
        ahead, behind = (
            problem.reduce(problem.solved_at(state, about + q * step)) for q in (1, -1)
        )
        assert (ahead.cost - behind.cost) / (2 * h) == pytest.approx(
            reduced.gradient[k], rel=1e-3, abs=1e-3 * np.abs(reduced.gradient).max()
        )
        curvature = (ahead.gradient - behind.gradient) / (2 * h)
        assert np.allclose(curvature, reduced.hessian[k], rtol=0.15)  # Gauss-Newton's


def test_the_gradient_is_that_of_the_cost_where_a_taxel_stays_off_its_optimum(problem):
    about, resting = np.array([0.05, -0.1]), np.arange(problem.parametrization.count) == 3
    there = replace(problem, resting=resting)
    state = there.start(about, resting[:, None] * [3e-4, -3e-4, 0.0])
    there.solve_inner(state)
    reduced = there.reduce(state)
    for k, h in enumerate((1e-4, 1e-3)):
        step = h * np.eye(2)[k]
        ahead, behind = (there.reduce(there.solved_at(state, about + q * step)) for q in (1, -1))
        slope = (ahead.cost - behind.cost) / (2 * h)
        assert slope == pytest.approx(reduced.gradient[k], rel=1e-4)
    assert not np.allclose(problem.reduce(state).gradient, reduced.gradient, rtol=5e-3)


def test_ipopt_finds_the_optimum(problem):
    state = problem.start(np.array([0.3, 0.2]))
    problem.solve_inner(state)
    costs = []
    found, status = minimize(
        problem, state, 30, lambda state: costs.append(problem.reduce(state).cost)
    )
    assert status == "User_Requested_Stop"  # at the tolerance of the decrement
    assert problem.reduce(found).decrement < 1e-8
    assert (np.diff(costs) < 0).all()


def test_the_search_follows_the_curvature_of_a_cost_whose_model_misfits(world):
    """Of pressures in another unit; steps of Gauss and Newton take 113 evaluations."""
    data, live = gather(world.record(0.01, 0.05), world.belief(0.01, 0.05)), np.arange(37)
    data = replace(data, pressure=0.5 * data.pressure)
    places = SurfaceParametrization(chart.charts_at(world.body, world.truth), 2e-3)
    estimator = JointEstimator(data, live, places, np.ones(len(data.pressure)), 30)
    problem, state = estimator.problem, estimator.state
    problem.solve_inner(state)
    problem.evaluations = 0.0
    found, _ = minimize(problem, state, 30, lambda state: None, tolerance=1e-4)
    assert problem.reduce(found).decrement < 1e-4
    assert problem.evaluations < 80


def test_a_search_that_takes_too_long_is_refused(world, monkeypatch):
    far = gather(world.record(0.01, 0.05), world.belief(0.01, 0.05, young=2.5 * world.young))
    monkeypatch.setattr(reduced_nlp, "MAX_EVALUATIONS", (1.0, 0.0))
    said = r"did not converge.*\d evaluations of all taxels.*scale of pressures"
    with pytest.raises(CalibrationError, match=said):
        maximum_likelihood.optimum(far)


def test_a_move_of_the_contacts_that_raises_the_cost_is_taken_back(world):
    belief = world.belief(0.01, 0.05, unknown=("modulus", "body_offset"))
    data, live = gather(world.record(0.01, 0.05), belief), np.arange(len(world.ids))
    places = SurfaceParametrization(chart.charts_at(world.body, world.truth), 2e-3)
    estimator = JointEstimator(data, live, places, np.ones(len(data.pressure)), 30)
    estimator.converge()
    found, places = estimator.state.s.copy(), estimator.problem.parametrization

    def there():
        return estimator.problem, estimator.likelihood, estimator.selected_at, estimator.state

    def at(s):
        estimator.relinearize(estimator.problem.parametrization, s, estimator.state.z)
        estimator.problem.solve_inner(estimator.state)

    before, far = there(), found + np.array([0.5, *6 * [0.0]])
    at(far)
    assert not estimator._decreases(before, 40)
    assert np.array_equal(estimator.state.s, found)
    assert np.allclose(estimator.problem.parametrization.points(), places.points(), atol=1e-7)
    assert not estimator.unconverged.any()
    at(far)
    before = there()
    at(found + 0.1 * (found - far))  # a little beyond the optimum
    assert estimator._decreases(before, 40)
    assert not np.array_equal(estimator.state.s, far)


def test_taxels_are_optimized_independently(problem, world):
    z = np.zeros((len(world.ids), 3))
    z[5, :2] = 4e-3  # one taxel far off holds no other up
    state, plain = problem.start(np.zeros(2), z), problem.start(np.zeros(2))
    problem.solve_inner(state)
    problem.solve_inner(plain)
    others = np.arange(len(z)) != 5
    assert np.allclose(state.z[others], plain.z[others], atol=1e-12)


@pytest.mark.slow
def test_the_speed_study_finds_every_taxel(script):
    study = script("speed/joint")
    row, (recording, belief, truth) = study.measure(80), study.world(80)
    skin = Skin(chart.poses(truth, chart.frames(belief.body.closest(truth).normal)), np.arange(80))
    assert row["lost"] == 0
    # the mean of 80 taxels scatters by 6 % about the bound
    assert row["error_mm"] == pytest.approx(bound_mm(recording, belief, skin)["mean"], rel=0.2)
    assert 3500 < row["readings"] < 4500
