"""Large lattices: grown coarse and refined, decimated to a number, without holes."""

import numpy as np
import pytest
from scipy.spatial import KDTree

from meshskin.geometry.body import Body
from meshskin.geometry.region import Disc, HalfSpace, Whole, area
from meshskin.skin import lattice
from meshskin.skin.skin import Skin


@pytest.mark.parametrize(
    "body",
    [
        Body.torus(0.1, 0.04),
        pytest.param(Body.sphere(), marks=pytest.mark.slow),
        pytest.param(Body.capsule(0.05, 0.2), marks=pytest.mark.slow),
    ],
    ids=lambda b: b.name,
)
def test_a_large_number_covers_a_body_evenly_and_without_a_hole(body):
    skin = Skin.cover(body, count=2000, seed=3, disc_radius=1e-3)
    assert len(skin) == 2000
    near = KDTree(skin.positions).query(skin.positions, k=2)[0][:, 1]
    ideal = np.sqrt(area(body, Whole()) / (lattice.ROW * 2000))
    assert near.mean() == pytest.approx(ideal, rel=0.08)
    assert near.std() < 0.08 * near.mean()
    gap = KDTree(skin.positions).query(body.surface.vertices)[0].max()
    assert gap < 1.05 * ideal  # a perfect lattice has 0.58, one with a site missing 1.15


def test_a_refined_lattice_fills_its_region_to_the_border():
    body, region = Body.sphere(), HalfSpace((0.0, 1.0, 0.0), 0.01)
    skin = Skin.cover(body, spacing=4e-3, region=region, disc_radius=1e-3)
    assert len(skin) > 3000
    assert skin.positions[:, 1].min() >= 0.01
    inside = body.surface.vertices[body.surface.vertices[:, 1] > 0.01]
    assert KDTree(skin.positions).query(inside)[0].max() < 1.1 * 4e-3


def test_decimation_keeps_the_given_number_and_relaxes():
    body = Body.sphere()
    region = Disc((0.0, 0.0, 0.1), 0.06)
    first = lattice.first_site(body, region, 6e-3, np.random.default_rng(0))
    sites = lattice.fill(body, region, 6e-3, first)
    count = len(sites) - 20
    fewer = lattice.decimate(body, region, sites, count)
    assert len(fewer) == count
    assert region.contains(body, fewer.at).all()
    assert fewer.spacing()[0] > sites.spacing()[0]


def test_the_area_of_a_disc_counts_faces_at_its_border_in_part():
    exact = 2.0 * np.pi * 0.01 * (1.0 - np.cos(0.3))
    assert area(Body.sphere(), Disc((0.0, 0.0, 0.1), 0.03)) == pytest.approx(exact, rel=0.01)
