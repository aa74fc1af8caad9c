"""Geodesics and parallel transport against their theory on the sphere."""

from itertools import islice

import numpy as np
import pytest

from meshskin.core.se3 import shortest_rotation
from meshskin.geometry.body import Body
from meshskin.geometry.geodesics import geodesic, march, onto, transport, transport_along

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
    tangents = transport_along(np.concatenate(sides), X)
    assert np.arccos(tangents[-1] @ X) == pytest.approx(np.pi / 2, abs=1e-3)


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
