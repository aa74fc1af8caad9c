"""Flat faces: the nearest of all of them, by trimesh; with a compiler and without."""

import numpy as np
import pytest
import trimesh

from meshskin.core import codegen
from meshskin.geometry.surface import compiled_search
from meshskin.geometry.surface.closest_point import ReferenceFlat
from meshskin.geometry.surface.surface import Facets

MESHES = {
    "sphere": lambda: trimesh.creation.icosphere(subdivisions=3, radius=0.1),
    "needles": lambda: trimesh.creation.cylinder(radius=0.05, height=0.3, sections=60),
    "box": lambda: trimesh.creation.box((0.1, 0.06, 0.02)),
}


@pytest.mark.parametrize("interpreted", [False, True])
@pytest.mark.parametrize("name", MESHES)
def test_the_nearest_flat_face_is_the_nearest_of_all(name, interpreted, monkeypatch):
    if interpreted:
        monkeypatch.setattr(compiled_search, "library", lambda: None)
    elif codegen.find_compiler() is None:
        pytest.skip("no C compiler here")
    mesh = MESHES[name]()
    made = Facets(mesh)
    assert isinstance(made._search, ReferenceFlat) is interpreted
    rng = np.random.default_rng(1)
    points = np.array(mesh.sample(200, seed=2)) + rng.uniform(-4e-3, 4e-3, (200, 3))
    found, normals = made.closest(points)
    gaps = np.linalg.norm(every_foot(mesh, points) - points[:, None], axis=2)
    np.testing.assert_allclose(np.linalg.norm(points - found, axis=1), gaps.min(axis=1), atol=1e-12)
    alone = np.flatnonzero(np.sort(gaps, axis=1)[:, 1] > gaps.min(axis=1) + 1e-9)  # not at an edge
    assert len(alone) > 60
    face = gaps.argmin(axis=1)[alone]
    np.testing.assert_allclose(normals[alone], mesh.face_normals[face], atol=1e-9)


def every_foot(mesh, points):
    """The nearest points (n, m, 3) on each of m faces, by trimesh."""
    many = np.repeat(points, len(mesh.faces), axis=0)
    corners = np.tile(mesh.triangles, (len(points), 1, 1))
    found = trimesh.triangles.closest_point(corners, many)
    return found.reshape(len(points), len(mesh.faces), 3)


def test_no_points_have_no_faces():
    found, normals = Facets(MESHES["box"]()).closest(np.zeros((0, 3)))
    assert found.shape == normals.shape == (0, 3)


def test_the_face_at_an_edge_does_not_depend_on_the_points_before():
    """Over a convex mesh many points are as near to two faces."""
    made = Facets(MESHES["sphere"]())
    points = np.random.default_rng(0).normal(size=(3000, 3))
    points *= 0.11 / np.linalg.norm(points, axis=1)[:, None]
    whole = made.closest(points)[1]
    parts = np.concatenate([made.closest(part)[1] for part in np.split(points, 300)])
    np.testing.assert_array_equal(parts, whole)
