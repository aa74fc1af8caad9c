"""Geodesics and parallel transport against their theory on the sphere."""

from itertools import islice

import numpy as np
import pytest
import trimesh

from meshskin.core.se3 import shortest_rotation
from meshskin.geometry.body import Body
from meshskin.geometry.geodesics import (
    geodesic,
    march,
    onto,
    transport,
    transport_along,
    within,
)
from meshskin.geometry.region import Disc
from meshskin.skin.skin import Skin

SPHERE = Body.sphere(0.1)
POLE = np.array([0.0, 0.0, 0.1])
X, Y, Z = np.eye(3)


def test_a_geodesic_of_a_sphere_is_a_great_circle():
    for at, ahead in islice(geodesic(SPHERE, POLE, X, 1e-3), 200):
        assert abs(at.point[0, 1]) < 1e-7
        assert abs(ahead @ at.normal[0]) < 1e-12


def test_march_follows_arcs_of_a_sphere():
    start = SPHERE.closest(np.array([POLE, POLE]))
    end, carried = march(SPHERE, start, np.array([X, Y]), np.array([Y, Y]), 0.01)
    arc = np.arccos(end.point @ POLE / 0.1**2) * 0.1
    assert np.allclose(arc, 0.01, rtol=1e-3)
    assert np.allclose(carried[0], Y, atol=1e-7)
    assert np.allclose(carried[1], np.cross(X, end.normal[1]) * -1.0, atol=1e-6)


@pytest.mark.parametrize("off", [0.0, 1e-9, 1e-3, 1.0])
def test_transport_to_opposite_normals_is_a_rotation(off):
    after = -Z + off * Y
    after = np.repeat(after[None] / np.linalg.norm(after), 2, axis=0)
    moved = transport(np.array([X, Y]), np.array([Z, Z]), after)
    assert np.allclose(moved @ moved.T, np.eye(2), atol=1e-9)
    assert np.allclose(moved @ after[0], 0.0, atol=1e-9)


def test_transport_round_an_octant_rotates_by_its_solid_angle():
    """The holonomy of a closed path on the unit sphere is the solid angle inside: pi / 2 here."""
    angle = np.linspace(0.0, np.pi / 2, 2000)[:, None]
    sides = [np.cos(angle) * a + np.sin(angle) * b for a, b in ((Z, X), (X, Y), (Y, Z))]
    tangents = transport_along(np.concatenate(sides))
    assert np.arccos(tangents[-1] @ tangents[0]) == pytest.approx(np.pi / 2, abs=1e-3)


def test_a_vector_along_its_normal_becomes_a_unit_tangent():
    tangents = onto(np.array([Z, X + Z]), np.array([Z, Z]))
    assert np.allclose(np.linalg.norm(tangents, axis=1), 1.0)
    assert np.allclose(tangents @ Z, 0.0)
    assert np.allclose(tangents[1], X)


def test_transport_is_the_shortest_rotation_of_the_normal():
    rng = np.random.default_rng(3)
    before, after = (v / np.linalg.norm(v, axis=1)[:, None] for v in rng.normal(size=(2, 50, 3)))
    tangents = onto(rng.normal(size=(50, 3)), before)
    rotated = np.einsum("nij,nj->ni", shortest_rotation(before, after), tangents)
    np.testing.assert_allclose(transport(tangents, before, after), rotated, atol=1e-9)


def test_a_geodesic_starts_in_its_direction():
    points = [at.point[0] for at, _ in islice(geodesic(SPHERE, POLE, X, 0.01), 4)]
    angles = [np.arctan2(point[0], point[2]) for point in points]
    assert np.allclose(angles, np.arange(4) * np.arctan(0.1), atol=1e-5)


@pytest.mark.parametrize("cut", [None, 5e-3])
@pytest.mark.parametrize("rim", [0.04, 0.005])
def test_points_behind_a_thin_wall_are_as_far_as_the_way_over_its_rim(cut, rim):
    """The way over the rim, unfolded, is straight; from node to node it is longer."""
    plate = trimesh.creation.box((0.08, 0.06, 1.5e-3))
    body = Body.from_mesh(plate if cut is None else plate.subdivide_to_size(cut))
    middle, radius = body.closest([[0.04 - rim, 0.0, 1e-3]]), 0.01
    x, y = np.meshgrid(np.linspace(0.0302, 0.0398, 20), np.linspace(-9.5e-3, 9.5e-3, 20))
    behind = body.closest(np.column_stack([x.ravel(), y.ravel(), np.full(x.size, -1e-3)]))
    found = within(body, middle, behind, radius)
    way = np.hypot(rim + 1.5e-3 + 0.04 - x.ravel(), y.ravel())
    assert not found[way > radius].any()
    assert found[way < radius / 1.19].all()
    assert within(body, middle, body.closest(behind.point * [1, 1, -1]), 0.05).all()


def test_a_disc_on_a_thin_plate_has_no_taxels_behind_it():
    body = Body.from_mesh(trimesh.creation.box((0.08, 0.06, 1.5e-3)).subdivide_to_size(5e-3))
    skin = Skin.cover(body, spacing=4e-3, seed=1, region=Disc((0.0, 0.0, 1e-3), 0.01))
    assert len(skin) > 20
    assert (skin.positions[:, 2] > 0).all()


def test_arcs_about_a_ball_and_a_tube_are_geodesics():
    for body, radius in ((SPHERE, 0.1), (Body.capsule(0.01, 0.1), 0.01)):
        middle, behind = body.closest([X]), body.closest([-X])
        assert within(body, middle, behind, 1.001 * np.pi * radius).all()
        assert not within(body, middle, behind, 0.999 * np.pi * radius).any()
