"""Folds: told from edges of solids, and the side of a point by the mesh's winding."""

import numpy as np
import pytest
import trimesh

from meshskin.geometry.folds import Folds


def folds(mesh):
    return Folds(np.asarray(mesh.vertices), np.asarray(mesh.faces), mesh.face_normals)


def test_no_edge_of_a_solid_is_doubtful():
    """Nearest points of a box's outside are on faces, edges and corners."""
    box = trimesh.creation.box((0.1, 0.06, 0.02))
    points = np.random.default_rng(0).uniform(-0.2, 0.2, size=(400, 3))
    foot, _, face = trimesh.proximity.closest_point(box, points)
    weight = trimesh.triangles.points_to_barycentric(box.triangles[face], foot)
    weight[weight < 1e-9] = 0.0
    assert (np.sum(weight > 0, axis=1) < 3).sum() > 200
    assert not len(folds(box).doubtful(face, weight, points - foot))


def test_an_edge_folded_back_is_doubtful():
    """Two faces over each other, one turned: seen from above one faces, the other does not."""
    vertices = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0.05, 0.08, 0.01]])
    mesh = trimesh.Trimesh(vertices, [[0, 1, 2], [1, 0, 3], [2, 1, 3], [0, 2, 3]], process=False)
    middle = np.array([[0.5, 0.5, 0.0]])
    fold = folds(mesh)
    assert fold.closed
    assert list(fold.doubtful(np.array([0]), middle, np.array([[0.0, -1.0, 0.3]]))) == [0]
    corner = np.array([[1.0, 0.0, 0.0]])
    assert list(fold.doubtful(np.array([0]), corner, np.array([[-1.0, -1.0, 0.4]]))) == [0]


@pytest.mark.parametrize("turned", [False, True])
def test_the_winding_tells_the_side(turned):
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    if turned:
        ball.invert()
    points = np.array([[0.0, 0.0, 0.05], [0.0, 0.09, 0.0], [0.0, 0.0, 0.12], [1.0, 2.0, 3.0]])
    expected = np.array([-1.0, -1.0, 1.0, 1.0]) * (-1.0 if turned else 1.0)
    np.testing.assert_array_equal(folds(ball).side(points), expected)


def test_an_open_mesh_has_no_doubts():
    ball = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    ball.update_faces(ball.triangles_center[:, 2] > 0)
    fold = folds(ball)
    assert not fold.closed
    away = -ball.triangles_center[:1]
    assert not len(fold.doubtful(np.array([0]), np.array([[1.0, 0.0, 0.0]]), away))
