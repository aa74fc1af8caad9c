"""Random meshes, sound and spoilt: a right answer or a named error."""

import numpy as np
import pytest
import trimesh
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from meshskin.core.errors import MeshError
from meshskin.geometry.mesh.check import check_mesh
from meshskin.geometry.mesh.triangles import closest_on_triangles
from meshskin.geometry.mesh.winding_number import winding_number
from meshskin.geometry.surface.surface import Surface

SPOILS = ("nothing", "flip", "drop", "double", "split", "nan", "spare", "collapse", "invert")


@st.composite
def meshes(draw):
    """A star-shaped body of 20 to 320 faces, rough or smooth, moved anywhere, and spoilt or not."""
    mesh = trimesh.creation.icosphere(subdivisions=draw(st.integers(0, 2)))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    rough = draw(st.sampled_from([0.0, 0.01, 0.1, 0.4]))
    stretch = np.array([draw(st.floats(0.05, 1.0)) for _ in range(3)])
    vertices = mesh.vertices * (1.0 + rough * rng.uniform(-1, 1, size=(len(mesh.vertices), 1)))
    vertices = 0.1 * vertices * stretch / stretch.max()
    offset = draw(st.sampled_from([0.0, 1.0, 1000.0])) * rng.uniform(-1, 1, size=3)
    faces, spoil = mesh.faces.copy(), draw(st.sampled_from(SPOILS))
    vertices = vertices + offset
    some = rng.choice(len(faces), size=max(1, len(faces) // 10), replace=False)
    if spoil == "flip":
        faces[some] = faces[some][:, ::-1]
    elif spoil == "drop":
        faces = np.delete(faces, some, axis=0)
    elif spoil == "double":
        faces = np.vstack([faces, faces[some]])
    elif spoil == "split":
        vertices, faces = vertices[faces].reshape(-1, 3), np.arange(faces.size).reshape(-1, 3)
    elif spoil == "nan":
        vertices[faces[some[0], 0]] = np.nan
    elif spoil == "spare":
        vertices = np.vstack([vertices, [[np.nan, 0.0, 0.0]]])
    elif spoil == "collapse":
        vertices[faces[some[0], 0]] = vertices[faces[some[0], 1]]
    elif spoil == "invert":
        faces = faces[:, ::-1]
    return vertices, faces, offset, spoil, rng


def a_right_answer_or_a_named_error(mesh):
    vertices, faces, offset, spoil, rng = mesh
    found = check_mesh(vertices, faces)
    if found.refused:
        assert spoil in ("drop", "nan", "collapse")
        assert isinstance(found.refused[0].error(), MeshError)
        return
    assert spoil not in ("drop", "nan")
    surface = Surface(found)
    points = offset + 0.15 * rng.uniform(-1, 1, size=(40, 3))
    hit = surface.closest(points)
    for values in (hit.point, hit.distance, hit.normal, hit.curvature, hit.uv):
        assert np.isfinite(values).all()
    assert np.linalg.norm(hit.normal, axis=1) == pytest.approx(1.0)
    assert np.linalg.norm(points - hit.point, axis=1) == pytest.approx(np.abs(hit.distance))
    corners = (found.vertices - offset)[found.faces]
    a, b, c = corners[:, 0], corners[:, 1], corners[:, 2]
    gap = np.sqrt(closest_on_triangles((points - offset)[:, None], a, b - a, c - a)[0].min(axis=1))
    height = surface.offsets.max()
    assert np.all(np.abs(hit.distance) <= gap + height + 1e-9)
    clear = gap > height + 1e-9
    inside = np.array([winding_number(corners, p) > 0.5 for p in points - offset])
    np.testing.assert_array_equal(hit.distance[clear] < 0, inside[clear])


RELAXED = {"deadline": None, "suppress_health_check": list(HealthCheck), "database": None}


@settings(max_examples=15, derandomize=True, **RELAXED)
@given(meshes())
def test_random_meshes(mesh):
    a_right_answer_or_a_named_error(mesh)


@pytest.mark.slow
@settings(max_examples=10_000, **RELAXED)
@given(meshes())
def test_ten_thousand_random_meshes(mesh):
    a_right_answer_or_a_named_error(mesh)
