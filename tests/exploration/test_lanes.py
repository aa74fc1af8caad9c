"""Geodesic lanes pass every taxel at a constant spacing, and close round whole bodies."""

from itertools import pairwise

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

from meshskin.exploration.lane_plan import _sparse, region_radius
from meshskin.exploration.lanes import (
    PointCloud,
    _offset,
    _traces,
    cover,
    geodesics_through,
)
from meshskin.exploration.spacing import MAX_SPACING, spacing_for
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
    (line,) = geodesics_through(body, np.array([0.0, 0.0, -0.1]), [np.array([1.0, 0.0, 0.0])], STEP)
    np.testing.assert_allclose(np.linalg.norm(line, axis=1), 0.1, atol=1e-7)
    assert np.abs(line[:, 1]).max() < 1e-6
    length = np.linalg.norm(np.diff(line, axis=0), axis=1).sum()
    assert length == pytest.approx(0.2 * np.pi, rel=0.01)


@pytest.mark.deep
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


def test_geodesics_that_are_followed_together_are_those_of_one_at_a_time():
    body, start = BODIES["torus"][0], np.array([0.14, 0.0, 0.0])
    ways = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])
    together = _traces(body, start, ways, STEP, None)
    assert [closed for _, closed in together] == [True, True, True]
    for way, (points, closed) in zip(ways, together, strict=True):
        ((alone, closed_alone),) = _traces(body, start, way[None], STEP, None)
        assert closed == closed_alone
        np.testing.assert_allclose(points, alone, rtol=0, atol=1e-13)  # sums round by their length


def test_distances_to_a_growing_cloud_are_those_to_all_its_points():
    rng, cloud, every = np.random.default_rng(0), PointCloud(), np.zeros((0, 3))
    at = rng.normal(size=(20, 3))
    assert np.isinf(cloud.distance(at)).all()
    for count in (5, 40, 3, 3, 200, 1):
        new = rng.normal(size=(count, 3))
        every = np.concatenate([every, new])
        cloud.add(new)
        gap = np.linalg.norm(at[:, None] - every, axis=2).min(axis=1)
        np.testing.assert_allclose(cloud.distance(at), gap, rtol=1e-12)
        near = gap < 0.5
        np.testing.assert_allclose(cloud.distance(at, 0.5), np.where(near, gap, np.inf))


def test_the_region_of_sparse_taxels_ends_where_none_feels_a_contact():
    def radius(pitch):
        sites = np.stack([pitch * np.arange(9.0), np.zeros(9), np.zeros(9)], axis=1)
        return region_radius(sites, 3e-3, 5e-3)

    assert radius(2e-3) == pytest.approx(3e-3)
    assert radius(8e-3) == pytest.approx(6e-3)
    assert radius(50e-3) == pytest.approx(7.5e-3)


@pytest.mark.deep
def test_the_lanes_of_sparse_taxels_skip_what_is_between_them():
    body = Body.capsule(0.03, 0.2)
    sites = Skin.cover(body, spacing=30e-3).positions
    pieces = cover(body, sites, SPACING, 7e-3, STEP)
    points = np.concatenate([piece.point for piece in pieces])
    assert cKDTree(points).query(sites)[0].max() < SPACING
    assert cKDTree(sites).query(points)[0].max() < 7e-3 + SPACING
    length = sum(np.linalg.norm(np.diff(p.point, axis=0), axis=1).sum() for p in pieces)
    assert length * SPACING < 0.5 * body.mesh.area


def test_a_lane_that_ended_where_it_began_has_none_beside_it():
    """A geodesic may end at its first point, between two creases: it has no direction."""
    body = Body.sphere(0.1)
    line = 0.1 * np.stack([[np.sin(t), 0.0, -np.cos(t)] for t in np.linspace(0.0, 0.4, 21)])
    whole, point = body.surface.nearest(line), body.surface.nearest(line[:1])
    assert _offset(body, [point], SPACING, STEP) == []
    (beside,) = _offset(body, [point, whole], SPACING, STEP)
    np.testing.assert_allclose(
        body.surface.nearest(beside.point).point[:, 1], -SPACING, rtol=0.02, atol=0
    )


def test_postures_are_sought_at_both_ends_of_a_path_and_where_the_normal_turns():
    points = np.zeros((30, 3))
    points[:, 0] = 1.9e-3 * np.arange(30)
    normals = np.tile([0.0, 0.0, 1.0], (30, 1))
    angle = 0.2 * np.arange(10)
    normals[20:] = np.stack([np.sin(angle), np.zeros(10), np.cos(angle)], axis=1)
    rows = _sparse(points, normals, np.array([0, 8]))
    np.testing.assert_array_equal(rows, [0, 3, 6, 7, 8, 11, 14, 17, *range(20, 30)])


def test_both_faces_of_a_thin_plate_have_lanes():
    """Lanes on one face do not count on the other, which is less than their spacing away."""
    body = Body.from_mesh(trimesh.creation.box((0.04, 0.03, 1e-3)))
    x, y, z = np.meshgrid(np.linspace(-15e-3, 15e-3, 6), np.linspace(-1e-2, 1e-2, 5), [-1, 1])
    sites = np.column_stack([x.ravel(), y.ravel(), 0.5e-3 * z.ravel()])
    points = np.concatenate([p.point for p in cover(body, sites, 2e-3, 3e-3, 0.4e-3)])
    for face in (-1, 1):
        own = points[points[:, 2] * face > 0.49e-3]
        apart = PointCloud(own).distance(sites[sites[:, 2] * face > 0])
        assert apart.max() < 2e-3


def test_geodesics_for_a_few_taxels_that_are_left_do_not_go_round_the_body(monkeypatch):
    body, sites = Body.sphere(0.1), np.random.default_rng(0).normal(size=(12, 3))
    sites *= 0.1 / np.linalg.norm(sites, axis=1)[:, None]
    searches, nearest = [], body.surface.nearest

    def counted(*args, **kwargs):
        searches.append(args)
        return nearest(*args, **kwargs)

    monkeypatch.setattr(body.surface, "nearest", counted)
    points = np.concatenate([piece.point for piece in cover(body, sites, 4e-3, 7e-3, 1.5e-3)])
    assert cKDTree(points).query(sites)[0].max() < 4e-3
    assert len(searches) < 900  # 1313 where each geodesic may cross the whole region


@pytest.mark.parametrize(("gap", "apart"), [(0.3e-3, False), (1e-3, True), (2e-3, True)])
def test_lanes_do_not_cross_gaps(gap, apart):
    """Two plates side by side, with taxels on the first or on both."""
    plate = trimesh.creation.box((0.04, 0.04, 0.01))
    other = plate.copy().apply_translation((0.04 + gap, 0.0, 0.0))
    body = Body.from_mesh(trimesh.util.concatenate([plate, other]))
    middle, grid = 0.02 + 0.5 * gap, np.linspace(-0.018, 0.018, 8)
    sites = np.array([(x, y, 5e-3) for x in grid for y in grid])
    both = np.concatenate([sites, sites + np.array([2.0 * middle, 0.0, 0.0])])
    for places in (sites, both):
        pieces = cover(body, places, SPACING, 5e-3, STEP)
        beyond = [piece.point[:, 0] > middle for piece in pieces]
        assert cKDTree(np.concatenate([p.point for p in pieces])).query(places)[0].max() < SPACING
        if apart:
            assert len({bool(side.any()) for side in beyond}) == (1 if places is sites else 2)
            assert all(side.all() or not side.any() for side in beyond)
        else:
            assert any(side.any() for side in beyond)
