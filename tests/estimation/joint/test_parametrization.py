"""Positions on the surface stay on the side of the body whose contacts press them."""

import numpy as np
import pytest

from meshskin.estimation import chart
from meshskin.estimation.data.gather import gather
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
    assert places.charts.normals[0, 2] < OTHER_SIDE
    for _ in range(6):
        outward = places.charts.tangents[0].T @ np.array([1e-3, 0.0, 0.0])
        places = places.relinearized(lens, outward[None])
    assert places.charts.normals[0, 2] > OTHER_SIDE


def test_the_side_of_a_taxel_is_that_of_its_contacts(world):
    data = gather(world.record(0.01, 0.05), world.belief(0.01, 0.05))
    live = np.arange(0, len(world.ids), 2)
    charts = chart.charts_at(world.body, world.truth[live])
    side = SurfaceParametrization.of(data, live, charts, 1e-3).side
    assert np.einsum("ni,ni->n", side, charts.normals).min() > 0.98
