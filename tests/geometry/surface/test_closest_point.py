"""The compiled search and the one in NumPy: the same feet, and truly the nearest."""

import pickle

import numpy as np
import pytest
import trimesh

from meshskin.core import codegen
from meshskin.core.errors import MeshError
from meshskin.geometry.body import Body
from meshskin.geometry.mesh.triangles import closest_on_triangles
from meshskin.geometry.surface import compiled_search
from meshskin.geometry.surface.closest_point import ReferenceSearch
from meshskin.geometry.surface.compiled_search import CompiledSearch
from meshskin.geometry.surface.surface import Surface

from .test_surface import descended

needs_compiler = pytest.mark.skipif(codegen.find_compiler() is None, reason="no C compiler here")
BODIES = {
    "ellipsoid": lambda: Body.ellipsoid((0.1, 0.07, 0.05), faces=1280).surface,
    "torus": lambda: Body.torus(0.1, 0.04, faces=1500).surface,
    "cylinder": lambda: Body.cylinder(0.05, 0.2, faces=600).surface,
    "box": lambda: Surface(trimesh.creation.box((0.1, 0.06, 0.02))),
    "open": lambda: Surface(half_ball()),
}


def half_ball():
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    mesh.update_faces(mesh.triangles_center[:, 2] > 0)
    mesh.remove_unreferenced_vertices()
    return mesh


def cloud(surface, count, reach, seed=0):
    """Points within `reach` of the flat faces, about as many by each."""
    rng = np.random.default_rng(seed)
    corners = surface.vertices[surface.faces[rng.integers(len(surface.faces), size=count)]]
    on = np.einsum("nk,nkc->nc", rng.dirichlet((1, 1, 1), count), corners)
    return on + rng.uniform(-reach, reach, size=(count, 3))


def both(surface):
    return CompiledSearch(surface, compiled_search.library()), ReferenceSearch(surface)


@needs_compiler
@pytest.mark.parametrize("name", BODIES)
def test_compiled_and_reference_search_agree(name):
    """On a smooth surface the compiled search descends from the nearest flat face alone."""
    surface = BODIES[name]()
    points = cloud(surface, 1500, 0.015)
    compiled, reference = both(surface)

    def distance(found):
        return np.linalg.norm(points - surface.at(*found[:2]).point, axis=1)

    first = compiled.closest(points, None)
    least = distance(reference.closest(points, None))
    for found in (first, compiled.closest(points, first.face)):
        more = distance(found) - least
        assert np.all(more > -1e-9)
        assert np.all(more < 1e-9 + surface.smooth * surface.offsets.max())
        assert np.mean(more > 1e-9) < 4e-3
    derivatives = [search.derivatives(*first[:2]) for search in both(surface)]
    for one, two in zip(*derivatives, strict=True):
        np.testing.assert_allclose(one, two, rtol=0, atol=1e-13)


@pytest.mark.deep
@pytest.mark.parametrize(
    "body",
    [
        Body.ellipsoid((0.1, 0.07, 0.05), faces=5120),
        Body.torus(0.1, 0.04, faces=5120),
        Body.capsule(0.05, 0.2, faces=5120),
        Body.cylinder(0.05, 0.2, faces=5120),
    ],
    ids=lambda body: body.name,
)
def test_the_reference_search_against_exact_primitives(body, monkeypatch):
    """Near the surface, inside, and far away: to the patches' own error, largest at a seam."""
    monkeypatch.setattr(compiled_search, "library", lambda: None)
    surface = Surface(body.mesh, body.seams)
    points = np.vstack([cloud(surface, 300, 0.01), cloud(surface, 20, 1.0)])
    hit, exact = surface.closest(points), body.exact.closest(points)
    np.testing.assert_allclose(hit.distance, exact.distance, rtol=0, atol=4e-6)
    assert np.quantile(np.abs(hit.distance - exact.distance), 0.9) < 3e-7
    single = [surface.closest(point[None]).distance[0] for point in points[:5]]
    np.testing.assert_allclose(single, hit.distance[:5], rtol=0, atol=1e-15)


def test_the_closest_point_of_a_triangle_agrees_with_trimesh():
    rng = np.random.default_rng(0)
    corners, points = rng.random((500, 3, 3)), 2 * rng.random((500, 3)) - 0.5
    a, b, c = np.swapaxes(corners, 0, 1)
    gap2, weight = closest_on_triangles(points, a, b - a, c - a)
    foot = a + weight[:, :1] * (b - a) + weight[:, 1:] * (c - a)
    want = trimesh.triangles.closest_point(corners, points)
    np.testing.assert_allclose(foot, want, atol=1e-12)
    np.testing.assert_allclose(np.sqrt(gap2), np.linalg.norm(points - want, axis=1), atol=1e-12)


@needs_compiler
@pytest.mark.parametrize("name", BODIES)
def test_the_nearest_flat_face_is_the_nearest(name):
    """Against every face in turn, near and far, from a batch and from single queries."""
    surface = BODIES[name]()
    points = np.vstack([cloud(surface, 300, 0.02), cloud(surface, 50, 3.0)])
    search = both(surface)[0]
    a, b, c = np.swapaxes(surface.vertices[surface.faces], 0, 1)
    gap2 = closest_on_triangles(points[:, None], a, b - a, c - a)[0]
    search.sharp = True  # all are told of their flat faces
    flat = search.closest(points, None).flat
    np.testing.assert_allclose(flat.distance, np.sqrt(gap2.min(axis=1)), rtol=1e-12, atol=1e-15)
    rows = np.arange(len(points))
    np.testing.assert_allclose(flat.distance, np.sqrt(gap2[rows, flat.face]), rtol=1e-9, atol=1e-12)
    foot = np.column_stack([1 - flat.uv.sum(axis=1), flat.uv])
    foot = np.einsum("nk,nkc->nc", foot, surface.vertices[surface.faces[flat.face]])
    np.testing.assert_allclose(np.linalg.norm(points - foot, axis=1), flat.distance, atol=1e-12)
    alone = [search.closest(p[None], None).flat.distance[0] for p in points]
    np.testing.assert_allclose(alone, flat.distance, rtol=1e-12, atol=1e-15)


@pytest.mark.deep
@needs_compiler
@pytest.mark.parametrize("step", [8, pytest.param(1, marks=pytest.mark.slow)])
def test_the_sharp_search_looks_at_every_face_that_may_be_nearer(step):
    """On a coarse rough body, no walk from any face at all ends nearer."""
    mesh = trimesh.creation.icosphere(subdivisions=2, radius=0.1)
    rng = np.random.default_rng(3)
    mesh.vertices *= 1.0 + 0.1 * rng.uniform(-1, 1, size=(len(mesh.vertices), 1))
    surface = Surface(mesh)
    assert not surface.smooth
    points = 0.15 * rng.uniform(-1, 1, size=(60, 3))
    found = np.abs(surface.closest(points).distance)
    for face in range(0, len(surface.faces), step):
        assert np.all(found <= descended(surface, points, face) * 1.0001)


@needs_compiler
def test_flat_faces_behind_nearer_curved_ones_are_looked_at():
    """Within a coarse cylinder, where the cap is nearer than the side but not than its facets."""
    surface = Body.cylinder(0.05, 0.2, faces=600).surface
    rng = np.random.default_rng(0)
    angle, depth = rng.uniform(0.0, 2.0 * np.pi, 400), rng.uniform(0.005, 0.03, 400)
    radius = 0.05 - depth - rng.uniform(1e-4, 1e-3, 400)
    points = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), 0.1 - depth])
    distance = surface.closest(points).distance
    np.testing.assert_allclose(distance, -depth, rtol=1e-4)


def test_a_face_of_no_mesh_is_refused():
    surface = Body.sphere(0.1, faces=320).surface
    for face in (-1, 320):
        with pytest.raises(MeshError, match=rf"no such face .*, got {face}, limit: 0 to 319"):
            surface.closest([[0.0, 0.0, 0.12]], face=[face])
        with pytest.raises(MeshError, match="no such face"):
            surface.at([face], [[0.3, 0.3]])


def test_a_surface_is_pickled_with_its_search():
    surface = Body.cylinder(0.05, 0.2, faces=600).surface
    points = cloud(surface, 50, 0.02)
    before = surface.closest(points)
    after = pickle.loads(pickle.dumps(surface)).closest(points)
    np.testing.assert_array_equal(before.distance, after.distance)


def test_no_points_have_no_feet():
    for make in BODIES.values():
        hit = make().closest(np.zeros((0, 3)))
        assert hit.distance.shape == (0,)
