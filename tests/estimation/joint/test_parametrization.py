"""Positions on the surface stay on the side of the body whose contacts press them."""

from dataclasses import replace

import numpy as np
import pytest

from meshskin.estimation import chart
from meshskin.estimation.data.gather import gather
from meshskin.estimation.joint.joint_estimator import JointEstimator
from meshskin.estimation.joint.parametrization import OTHER_SIDE, SurfaceParametrization
from meshskin.geometry.body import Body


def test_a_step_past_a_rim_does_not_end_on_the_other_side():
    lens = Body.ellipsoid((0.03, 0.03, 0.002))
    rim = chart.charts_at(lens, np.array([[0.031, 0.0, 0.0]]))
    assert rim.normals[0, 0] == pytest.approx(1.0, abs=1e-3)
    down = rim.tangents[0].T @ np.array([0.0, 0.0, -2e-3])
    upper = np.array([[0.0, 0.0, 1.0]])
    free = SurfaceParametrization(rim, 5e-3).relinearized(lens, down[None])
    kept = SurfaceParametrization(rim, 5e-3, side=upper).relinearized(lens, down[None])
    assert free.charts.normals[0, 2] < OTHER_SIDE
    assert OTHER_SIDE < kept.charts.normals[0, 2] < 0.0  # on its way, and no further


def test_a_taxel_that_starts_on_the_other_side_finds_back():
    lens = Body.ellipsoid((0.03, 0.03, 0.002))
    start = lens.closest(np.array([[0.028, 0.0, -0.0008]])).point
    places = SurfaceParametrization(
        chart.charts_at(lens, start), 5e-3, side=np.array([[0.0, 0.0, 1.0]])
    )
    assert places.on_other_side.tolist() == [True]
    for _ in range(6):
        outward = places.charts.tangents[0].T @ np.array([1e-3, 0.0, 0.0])
        places = places.relinearized(lens, outward[None])
    assert places.on_other_side.tolist() == [False]


def test_the_side_of_a_taxel_is_that_of_its_contacts(world):
    data = gather(world.record(0.01, 0.05), world.belief(0.01, 0.05))
    live = np.arange(0, len(world.ids), 2)
    charts = chart.charts_at(world.body, world.truth[live])
    side = SurfaceParametrization.of(data, live, charts, 1e-3).side
    assert np.einsum("ni,ni->n", side, charts.normals).min() > 0.98


def test_taxels_on_another_side_than_their_contacts_are_not_determined(world):
    data = gather(world.record(0.01, 0.05), world.belief(0.01, 0.05))
    live, weight = np.arange(len(world.ids)), np.ones(len(data.pressure))
    places = SurfaceParametrization.of(data, live, chart.charts_at(world.body, world.truth), 1e-3)
    other = np.arange(len(live)) < 3
    turned = replace(places, side=np.where(other[:, None], -places.side, places.side))
    estimator = JointEstimator(data, live, turned, weight, 30)
    estimator.converge()
    assert estimator.unconverged.tolist() == other.tolist()
