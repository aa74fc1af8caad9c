"""Geodesic lanes pass every taxel at a constant spacing, and close round whole bodies."""

from itertools import pairwise

import numpy as np
import pytest
from scipy.spatial import cKDTree

from meshskin.exploration.lanes import MAX_SPACING, both_ways, cover, spacing_for
from meshskin.geometry.body import Body
from meshskin.geometry.region import Cap
from meshskin.skin.skin import Skin

SPACING, KEEP, STEP = 3.5e-3, 4e-3, 2e-3
BODIES = {
    "sphere": (Body.sphere(0.1), Cap((0.0, 0.0, -1.0))),
    "capsule": (Body.capsule(0.05, 0.12), Cap((1.0, 0.0, -1.0))),
    "torus": (Body.torus(0.1, 0.04), Cap((1.0, 0.0, -1.0))),
    "ellipsoid": (Body.ellipsoid((0.12, 0.09, 0.07)), Cap((0.0, -1.0, 0.0))),
}


@pytest.mark.parametrize("name", BODIES)
def test_lanes_pass_every_taxel_and_keep_their_distance(name):
    body, region = BODIES[name]
    sites = Skin.cover(body, count=80, spacing=5e-3, region=region).positions
    pieces = cover(body, sites, SPACING, KEEP, STEP)
    points = np.concatenate([piece.point for piece in pieces])
    assert np.abs(body.closest(points).distance).max() < 1e-9
    assert cKDTree(points).query(sites)[0].max() < 0.5 * SPACING + STEP / 2
    for one, two in pairwise(pieces[3:-3]):
        gap = cKDTree(two.point).query(one.point[2:-2])[0]
        beside = gap[gap < 1.5 * SPACING]
        assert len(beside) > len(gap) / 2
        # the nearest of samples 2 mm apart is up to 0.14 mm farther than the lane
        assert beside.min() > 0.99 * SPACING
        assert np.median(beside) < 1.05 * SPACING
    length = sum(np.linalg.norm(np.diff(p.point, axis=0), axis=1).sum() for p in pieces)
    region_area = 80 * 0.5 * np.sqrt(3) * 5e-3**2
    assert length * SPACING < 1.4 * region_area


def test_a_geodesic_of_a_sphere_is_a_great_circle_that_closes():
    body = BODIES["sphere"][0]
    way = both_ways(body, np.array([0.0, 0.0, -0.1]), np.array([1.0, 0.0, 0.0]), STEP)
    np.testing.assert_allclose(np.linalg.norm(way, axis=1), 0.1, atol=1e-7)
    assert np.abs(way[:, 1]).max() < 1e-6
    length = np.linalg.norm(np.diff(way, axis=0), axis=1).sum()
    assert length == pytest.approx(0.2 * np.pi, rel=0.01)


def test_a_whole_body_is_covered_about_once():
    body = Body.capsule(0.03, 0.06)
    sites = Skin.cover(body, spacing=6e-3).positions
    pieces = cover(body, sites, SPACING, KEEP + 1e-3, STEP)
    points = np.concatenate([piece.point for piece in pieces])
    assert cKDTree(points).query(sites)[0].max() < SPACING
    length = sum(np.linalg.norm(np.diff(p.point, axis=0), axis=1).sum() for p in pieces)
    assert 0.9 < length * SPACING / body.mesh.area < 1.3


def test_two_separate_regions_are_covered():
    body = BODIES["sphere"][0]
    sites = np.concatenate(
        [
            Skin.cover(body, count=20, spacing=5e-3, region=Cap(way)).positions
            for way in ((0.0, 0.0, -1.0), (0.0, 1.0, 0.2))
        ]
    )
    pieces = cover(body, sites, SPACING, KEEP, STEP)
    points = np.concatenate([piece.point for piece in pieces])
    assert cKDTree(points).query(sites)[0].max() < SPACING
    assert cKDTree(sites).query(points)[0].max() < KEEP + SPACING


def test_the_spacing_gives_the_wanted_number_of_contacts():
    reach, step = 6e-3, 0.5e-3
    spacing = spacing_for(reach, 100.0, step)
    assert np.pi * reach**2 / (spacing * step) == pytest.approx(100.0)
    assert spacing_for(reach, 4.0, step) == pytest.approx(MAX_SPACING * reach)
