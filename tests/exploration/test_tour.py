"""Paths in time along contact paths: where they are cut."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import meshskin as ms
from meshskin.exploration.plan import plan_exploration


@pytest.fixture(scope="module")
def grooved():
    """A cylinder with a groove about it, 1 mm wide: its curvature is 2.4 times the indenter's."""
    z = np.concatenate([np.linspace(-0.03, -2e-3, 9), np.linspace(-1.6e-3, 1.6e-3, 33)])
    z = np.concatenate([z, -z[8::-1]])
    radius = 0.04 - 5e-5 * np.exp(-((z / 0.5e-3) ** 2))
    profile = np.column_stack([np.r_[0.0, radius, 0.0], np.r_[z[0], z, z[-1]]])
    return ms.Body.from_mesh(trimesh.creation.revolve(profile, sections=64))


@pytest.mark.deep
def test_a_path_is_cut_at_a_groove_between_the_samples_of_its_lanes(sphere, grooved):
    region = ms.Cap(direction=(1.0, 0.0, 0.0), angle=np.radians(25))
    scene = sphere.with_(
        body=grooved,
        skin=ms.Skin.cover(grooved, spacing=5e-3, count=12, seed=1, region=region),
        loop=replace(sphere.loop, mode="quasi_static"),
        indenter=ms.Indenter.sphere(6e-3), contact="elliptic", material=ms.Material(young=8e6),
        exploration=replace(sphere.exploration, pattern="lanes", lane_spacing=4e-3),
    )  # fmt: skip
    plan = plan_exploration(scene)
    hit = scene.body.surface.nearest(plan.path.points)
    assert (scene.invalid_reasons(hit.curvature) == "").all()
    sides = [np.sign(segment.points[:, 2]) for segment in plan.segments]
    assert all((side == side[0]).all() for side in sides)
    assert {side[0] for side in sides} == {-1.0, 1.0}
