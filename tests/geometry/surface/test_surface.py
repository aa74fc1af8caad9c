"""The smooth surface against exact ones: accuracy, order, hops, signs, creases and borders."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree

from meshskin.core.errors import MeshError
from meshskin.geometry import primitives
from meshskin.geometry.body import Body
from meshskin.geometry.mesh.topology import neighbours
from meshskin.geometry.mesh.triangles import closest_on_triangles
from meshskin.geometry.surface import newton
from meshskin.geometry.surface.surface import Facets, Surface

from ...real_data import DATA, needs_ur3e


def descended(surface, points, face):
    """Distances (n,), m, at which Newton's descents from faces (n,) or one end."""
    face = np.broadcast_to(face, len(points))
    at = newton.descend(surface, face, points, newton.point_distance)
    return np.linalg.norm(surface.at(*at).point - points, axis=1)


def rms(x):
    return float(np.sqrt(np.mean(np.square(x))))


def degrees(a, b):
    return np.degrees(np.linalg.norm(np.cross(a, b), axis=1))


def near(surface, count, height, seed=0):
    """Points near the surface: on random faces, moved by a normal deviate of `height` (m)."""
    rng = np.random.default_rng(seed)
    corners = surface.vertices[surface.faces[rng.integers(len(surface.faces), size=count)]]
    on = np.einsum("nk,nkc->nc", rng.dirichlet((1.0, 1.0, 1.0), count), corners)
    return on + height * rng.normal(size=(count, 3))


def errors(ours, exact):
    scale = np.maximum(np.abs(exact.curvature).max(axis=1, keepdims=True), 1e-3)
    return SimpleNamespace(
        point=np.linalg.norm(ours.point - exact.point, axis=1),
        distance=np.abs(ours.distance - exact.distance),
        normal=degrees(ours.normal, exact.normal),
        curvature=np.abs(ours.curvature - exact.curvature) / scale,
    )


def irregular(radii, subdivisions, jitter=0.25, seed=3):
    """An ellipsoid of uneven triangles: vertices shaken by `jitter` edges, put back on it."""
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions)
    rng = np.random.default_rng(seed)
    edge = mesh.edges_unique_length.mean()
    v = mesh.vertices + jitter * edge * rng.uniform(-1, 1, size=mesh.vertices.shape)
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    return SimpleNamespace(vertices=v * radii, faces=mesh.faces)


def test_default_sphere_is_exact_to_a_tenth_of_a_micrometre():
    body = Body.sphere()
    points = near(body.surface, 5000, 3e-3)
    e = errors(body.closest(points), body.exact.closest(points))
    assert e.point.max() < 0.1e-6
    assert e.distance.max() < 0.1e-6
    assert e.normal.max() < 1e-3
    assert e.curvature.max() < 1e-3


def test_irregular_ellipsoid_of_20480_faces():
    radii = (0.1, 0.07, 0.05)
    surface = Surface(irregular(radii, 5))
    points = near(surface, 5000, 1e-3)
    e = errors(surface.closest(points), primitives.Ellipsoid(radii).closest(points))
    assert rms(e.point) < 0.1e-6
    assert rms(e.normal) < 1e-3
    assert rms(e.curvature) < 1e-3


def test_torus_of_20_thousand_faces():
    body = Body.torus(0.1, 0.04, faces=20480)
    points = near(body.surface, 5000, 1e-3)
    e = errors(body.closest(points), body.exact.closest(points))
    assert rms(e.point) < 0.1e-6
    assert rms(e.normal) < 1e-3
    assert rms(e.curvature) < 1e-3


def test_capsule_is_smooth_up_to_its_seams():
    body = Body.capsule(0.05, 0.2, faces=20480)
    points = near(body.surface, 4000, 1e-3)
    e = errors(body.closest(points), body.exact.closest(points))
    assert rms(e.point) < 0.1e-6
    assert e.distance.max() < 1e-6
    assert rms(e.normal) < 2e-3
    off_seam = np.abs(np.abs(points[:, 2]) - 0.1) > 1e-3
    assert rms(e.curvature[off_seam]) < 2e-3


def test_a_flat_ellipsoid_is_meshed_to_suit_its_bends():
    body = Body.ellipsoid((0.1, 0.03, 0.01), faces=20480)
    points = near(body.surface, 4000, 0.2e-3)
    e = errors(body.closest(points), body.exact.closest(points))
    assert rms(e.distance) < 0.1e-6
    assert rms(e.normal) < 0.05


def test_order_of_convergence():
    """Quartic jets: distance at least h^5, normal h^4, curvature h^3 (Cazals and Pouget)."""
    radii = (0.1, 0.08, 0.06)
    exact, logs = primitives.Ellipsoid(radii), []
    for level in (3, 4, 5):
        surface = Surface(irregular(radii, level))
        points = near(surface, 3000, 1e-4)
        e = errors(surface.closest(points), exact.closest(points))
        size = 2.0**-level
        logs.append(np.log([size, rms(e.distance), rms(e.normal), rms(e.curvature)]))
    h, *rest = np.array(logs).T
    slopes = [np.polyfit(h, values, 1)[0] for values in rest]
    assert slopes[0] > 4.5
    assert slopes[1] > 3.5
    assert slopes[2] > 2.5


@pytest.mark.parametrize(("sections", "worst"), [(32, 0.2e-6), (64, 5e-6)])
def test_a_meshed_cylinder_is_smooth_up_to_its_rims(sections, worst):
    """A CAD cylinder of two rings of vertices; its facets alone are off by 36 to 144 um."""
    surface = Surface(trimesh.creation.cylinder(0.03, 0.2, sections=sections))
    points = near(surface, 4000, 1e-3)
    e = errors(surface.closest(points), primitives.Cylinder(0.03, 0.2).closest(points))
    assert e.distance.max() < worst
    assert rms(e.distance) < 0.1e-6


@pytest.mark.parametrize("sections", [8, 12, 16, 24])
def test_a_coarse_cylinder_never_bulges(sections):
    surface = Surface(trimesh.creation.cylinder(0.03, 0.2, sections=sections))
    points = near(surface, 2000, 1e-3)
    e = errors(surface.closest(points), primitives.Cylinder(0.03, 0.2).closest(points))
    assert e.distance.max() < 1.01 * 0.03 * (1.0 - np.cos(np.pi / sections))


def test_a_coarse_capsule_takes_its_seam_for_a_crease():
    """Long faces beside short ones: nobody names the seam. The facets alone are off by 240 um."""
    mesh = trimesh.creation.capsule(0.2, 0.05, count=[32, 32])
    mesh.apply_translation([0.0, 0.0, -mesh.bounds.mean(axis=0)[2]])
    surface = Surface(mesh)
    points = near(surface, 4000, 1e-3)
    e = errors(surface.closest(points), primitives.Capsule(0.05, 0.2).closest(points))
    assert rms(e.distance) < 2e-6
    assert e.distance.max() < 30e-6


def test_cylinder_of_5_thousand_faces():
    body = Body.cylinder(0.05, 0.2)
    points = near(body.surface, 4000, 1e-3)
    ours, exact = body.closest(points), body.exact.closest(points)
    on_rim = np.hypot(*exact.point[:, :2].T) + np.abs(exact.point[:, 2]) > 0.15 - 1e-9
    assert np.abs(ours.distance - exact.distance).max() < 0.2e-6
    assert degrees(ours.normal, exact.normal)[~on_rim].max() < 0.01
    assert on_rim.any()


@pytest.mark.deep
def test_noise_lowers_the_degree_and_widens_the_rings():
    """10 um on every vertex of 20,480 faces: smoother than the noise; quartics alone gave 19 %."""
    radii = (0.1, 0.07, 0.05)
    mesh = irregular(radii, 5)
    rng = np.random.default_rng(1)
    mesh.vertices = mesh.vertices + 10e-6 * rng.normal(size=mesh.vertices.shape)
    surface = Surface(mesh)
    assert np.mean(surface.jets.degree == 2) > 0.8
    points = near(surface, 4000, 1e-3)
    e = errors(surface.closest(points), primitives.Ellipsoid(radii).closest(points))
    assert rms(e.distance) < 4e-6
    assert rms(e.curvature) < 0.07


@pytest.mark.deep
@pytest.mark.parametrize("name", ["forearm", "wrist3", "base"])
@needs_ur3e
def test_no_query_ends_in_a_local_minimum(name):
    """On creased links every end of a walk from 20 other faces is as far away or farther."""
    surface = Surface(trimesh.load_mesh(DATA / "ur3e_meshes" / f"{name}.stl"))
    points = near(surface, 1000, 3e-3)
    found = np.abs(surface.closest(points).distance)
    middles = surface.vertices[surface.faces].mean(axis=1)
    faces = KDTree(middles).query(points, k=80)[1]
    for k in range(0, 80, 4):
        other = descended(surface, points, faces[:, k])
        assert np.all(found <= other + 20e-6)  # two minima in one patch


def test_patches_meet_at_creases():
    """A cylinder's side and caps end on one circle."""
    surface = Surface(trimesh.creation.cylinder(0.03, 0.2, sections=24))
    face, corner = np.nonzero(surface.fans.sharp)
    for t in (0.1, 0.37, 0.8):
        weight = np.zeros((len(face), 3))
        rows = np.arange(len(face))
        weight[rows, (corner + 1) % 3], weight[rows, (corner + 2) % 3] = 1 - t, t
        here = surface.at(face, weight[:, 1:]).point
        beyond, slot = surface.neighbours[face, corner], surface.slot[face, corner]
        weight[:] = 0.0
        weight[rows, (slot + 1) % 3], weight[rows, (slot + 2) % 3] = t, 1 - t
        np.testing.assert_allclose(here, surface.at(beyond, weight[:, 1:]).point, atol=1e-12)
        np.testing.assert_allclose(np.hypot(*here[:, :2].T), 0.03, atol=3e-6)


def test_patches_meet_at_shared_edges():
    surface = Surface(irregular((0.1, 0.07, 0.05), 4))
    across, slot = neighbours(surface.faces)
    t = np.linspace(0.0, 1.0, 5)
    rng = np.random.default_rng(0)
    for f in rng.integers(len(surface.faces), size=50):
        for k in range(3):
            here, there = np.zeros((5, 3)), np.zeros((5, 3))
            here[:, (k + 1) % 3], here[:, (k + 2) % 3] = t, 1 - t
            q = slot[f, k]
            there[:, (q + 2) % 3], there[:, (q + 1) % 3] = t, 1 - t
            a = surface.at(np.full(5, f), here[:, 1:])
            b = surface.at(np.full(5, across[f, k]), there[:, 1:])
            np.testing.assert_allclose(a.point, b.point, atol=1e-14)
            assert degrees(a.normal, b.normal).max() < 0.05


def test_warm_start_from_any_face_gives_the_same_answer():
    body = Body.ellipsoid((0.1, 0.07, 0.05))
    points = near(body.surface, 500, 2e-3)
    cold = body.closest(points)
    far = np.random.default_rng(5).integers(len(body.surface.faces), size=500)
    warm = body.closest(points, face=far)
    np.testing.assert_allclose(warm.distance, cold.distance, atol=1e-9)
    close = body.closest(points, face=cold.face)
    np.testing.assert_allclose(close.point, cold.point, atol=1e-9)


@pytest.mark.parametrize(
    "body", [Body.ellipsoid((0.1, 0.07, 0.05), faces=2000), Body.cylinder(0.03, 0.1)], ids=repr
)
def test_a_warm_start_from_far_away_finds_the_global_minimum(body):
    """Deep inside, where each side has a local minimum that a walk over few faces ends in."""
    surface, rng = body.surface, np.random.default_rng(0)
    points = rng.uniform(-0.06, 0.06, size=(20_000, 3))
    far = rng.integers(len(surface.faces), size=len(points))
    more = np.abs(surface.closest(points, far).distance) - np.abs(surface.closest(points).distance)
    assert more.max() < 1e-9


def test_the_foot_is_the_nearest_point_and_the_offset_is_along_the_normal():
    body = Body.torus(0.1, 0.04)
    points = near(body.surface, 1000, 10e-3)
    hit = body.closest(points)
    back = hit.point + hit.distance[:, None] * hit.normal
    np.testing.assert_allclose(back, points, atol=3e-6)  # on a seam, its kink times the height
    from_vertices = np.linalg.norm(points[:, None] - body.surface.vertices[None, ::7], axis=2)
    assert np.all(np.abs(hit.distance) <= from_vertices.min(axis=1) + 1e-9)


def test_distance_is_negative_inside():
    body = Body.sphere()
    hit = body.closest([[0.0, 0.0, 0.09], [0.0, 0.0, 0.11]])
    np.testing.assert_allclose(hit.distance, [-0.01, 0.01], atol=1e-8)
    assert np.all(hit.curvature > 9.9)
    assert np.all(hit.curvature[:, 0] >= hit.curvature[:, 1])


@pytest.mark.parametrize("point", [[0.0, 0.0, 0.0], [1e-9, 0.0, 0.0], [0.0, 0.0, 40.0]])
def test_centre_and_far_points_have_finite_answers(point):
    body = Body.sphere()
    hit = body.closest([point])
    for values in (hit.point, hit.distance, hit.normal, hit.curvature):
        assert np.isfinite(values).all()
    assert hit.distance[0] == pytest.approx(np.linalg.norm(point) - 0.1, abs=1e-6)


def test_a_point_that_is_not_finite_is_refused():
    with pytest.raises(MeshError, match="row 1"):
        Body.sphere().closest([[0.0, 0.0, 0.1], [np.nan, 0.0, 0.0]])


def test_no_points_no_answers():
    hit = Body.sphere().closest(np.zeros((0, 3)))
    assert hit.point.shape == (0, 3)
    assert hit.curvature.shape == (0, 2)


@pytest.mark.parametrize("cuts", [0, 3])
def test_a_box_keeps_its_edges_and_corners(cuts):
    """Faces and creases are exact: the answer is the box's, in closed form."""
    mesh = trimesh.creation.box((0.2, 0.1, 0.06))
    for _ in range(cuts):
        mesh = mesh.subdivide()
    surface = Surface(mesh)
    rng = np.random.default_rng(2)
    half = np.array([0.1, 0.05, 0.03])
    points = rng.uniform(-1.5, 1.5, size=(2000, 3)) * half
    outside = np.maximum(np.abs(points) - half, 0.0)
    inside = np.minimum(np.max(np.abs(points) - half, axis=1), 0.0)
    exact = np.linalg.norm(outside, axis=1) + inside
    np.testing.assert_allclose(surface.closest(points).distance, exact, atol=1e-9)


def test_a_face_without_area_does_no_harm():
    """An edge of a box split on one side only, closed by a sliver of no area."""
    mesh = trimesh.creation.box((0.2, 0.1, 0.06))
    faces, vertices = mesh.faces.tolist(), mesh.vertices.tolist()
    a, b, c = faces.pop(0)
    m = len(vertices)
    vertices.append(np.mean([vertices[a], vertices[b]], axis=0).tolist())
    faces += [[a, m, c], [m, b, c], [a, b, m]]
    surface = Surface(SimpleNamespace(vertices=vertices, faces=faces))
    assert np.all(surface.neighbours >= 0)
    sliver = surface.at([len(faces) - 1], [[0.3, 0.3]])
    assert np.linalg.norm(sliver.normal) == pytest.approx(1.0)
    np.testing.assert_array_equal(sliver.curvature, 0.0)
    half = np.array([0.1, 0.05, 0.03])
    points = np.random.default_rng(2).uniform(-1.5, 1.5, size=(2000, 3)) * half
    hit = surface.closest(points)
    outside = np.linalg.norm(np.maximum(np.abs(points) - half, 0.0), axis=1)
    inside = np.minimum(np.max(np.abs(points) - half, axis=1), 0.0)
    np.testing.assert_allclose(hit.distance, outside + inside, atol=1e-9)
    assert np.isfinite(hit.normal).all()


def test_signs_hold_at_sharp_edges_and_corners():
    """A spike, whose faces' normals alone tell inside from outside wrongly near its edges."""
    vertices = np.array([[0.1, 0, 0], [-0.05, 0.02, 0], [-0.05, -0.02, 0], [-0.05, 0, 0.01]])
    faces = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]])
    surface = Surface(SimpleNamespace(vertices=vertices, faces=faces))
    points = np.random.default_rng(6).uniform(-1, 1, size=(4000, 3)) * [0.15, 0.05, 0.05]
    a, b, c = vertices[faces[:, 0]], vertices[faces[:, 1]], vertices[faces[:, 2]]
    normal = np.cross(b - a, c - a)
    inside = np.all(np.einsum("nfc,fc->nf", points[:, None] - a, normal) < 0, axis=1)
    assert inside.any()
    np.testing.assert_array_equal(surface.closest(points).distance < 0, inside)


def test_a_border_ends_the_surface():
    """Beyond the rim of a half sphere the closest point is on the rim."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.1)
    kept = ball.triangles_center[:, 2] > 0
    surface = Surface(SimpleNamespace(vertices=ball.vertices, faces=ball.faces[kept]))
    face, edge = np.nonzero(surface.neighbours < 0)
    t = np.linspace(0.0, 1.0, 101)
    weight = np.zeros((len(face), 101, 3))
    weight[np.arange(len(face)), :, (edge + 1) % 3] = t
    weight[np.arange(len(face)), :, (edge + 2) % 3] = 1.0 - t
    uv = weight[..., 1:].reshape(-1, 2)
    rim = surface.at(np.repeat(face, 101), uv).point
    angle = np.linspace(0.0, 2.0 * np.pi, 40)
    ring = np.column_stack([0.1 * np.cos(angle), 0.1 * np.sin(angle), np.full(40, -0.05)])
    exact = np.array([np.linalg.norm(rim - p, axis=1).min() for p in ring])
    hit = surface.closest(ring)
    np.testing.assert_allclose(np.abs(hit.distance), exact, atol=1e-6)
    above = near(surface, 1000, 1e-3)
    above = above[above[:, 2] > 0.02]
    hit = surface.closest(above)
    np.testing.assert_allclose(hit.distance, np.linalg.norm(above, axis=1) - 0.1, atol=0.1e-6)


def test_triangle_distances_against_trimesh():
    rng = np.random.default_rng(4)
    corners, points = rng.normal(size=(200, 3, 3)), rng.normal(size=(200, 3))
    foot = trimesh.triangles.closest_point(corners, points)
    ab, ac = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    ours = np.sqrt(closest_on_triangles(points, corners[:, 0], ab, ac)[0])
    np.testing.assert_allclose(ours, np.linalg.norm(points - foot, axis=1), atol=1e-9)


def test_an_edge_of_three_faces_has_no_neighbours():
    faces = np.array([[0, 1, 2], [1, 0, 3], [1, 0, 4]])
    across, _ = neighbours(faces)
    assert np.all(across == -1)
    across, _ = neighbours(faces[:2])
    assert across[0, 2] == 1
    assert across[1, 2] == 0


@pytest.mark.parametrize("body", [Body.ellipsoid((0.1, 0.07, 0.05)), Body.torus(0.1, 0.04)])
def test_principal_direction_is_the_exact_one(body):
    rng = np.random.default_rng(5)
    points = body.exact.closest(rng.normal(scale=0.08, size=(300, 3))).point
    hit, exact = body.closest(points), body.exact.closest(points)
    sine = np.linalg.norm(np.cross(hit.direction, exact.direction), axis=1)
    # a direction is told as well as its shape operator: off by twist / (k1 - k2)
    twist = sine * (exact.curvature[:, 0] - exact.curvature[:, 1])
    assert twist.max() < 5e-3 * np.abs(exact.curvature).max()


def test_the_degree_is_a_choice():
    """Against the exact sphere, whose heights are even: quadrics and cubics alike, not quartics."""
    off = []
    for degree in (2, 3, 4):
        body = replace(Body.sphere(0.1, faces=1280), degree=degree)
        points = 0.11 * body.exact.closest(np.random.default_rng(1).normal(size=(200, 3))).normal
        off.append(np.abs(body.closest(points).distance - 0.01).max())
    assert off[1] == pytest.approx(off[0], rel=0.5)
    assert off[0] > 20 * off[2] > 0


def test_edges_are_found_once_and_are_the_rims_of_a_cylinder():
    surface = Body.cylinder(0.05, 0.2).surface
    edges = surface.edges
    np.testing.assert_allclose(np.abs(edges[..., 2]), 0.1)
    np.testing.assert_allclose(np.hypot(edges[..., 0], edges[..., 1]), 0.05)
    length = np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1).sum()
    assert length == pytest.approx(4.0 * np.pi * 0.05, rel=0.01)
    assert surface.edges is edges
    assert not len(Body.capsule(0.05, 0.2).surface.edges)


def test_facets_without_area_have_no_normal():
    vertices = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [2.0, 0.0, 0.0]])
    facets = Facets(trimesh.Trimesh(vertices, [[0, 1, 2], [0, 1, 3]], process=False))
    point, normal = facets.closest(np.array([[0.2, 0.2, 0.1], [1.8, 0.0, 0.1]]))
    np.testing.assert_allclose(point, [[0.2, 0.2, 0.0], [1.8, 0.0, 0.0]], atol=1e-12)
    np.testing.assert_array_equal(normal, [[0.0, 0.0, 1.0], [0.0, 0.0, 0.0]])


def test_the_extents_are_computed_once():
    """The closed loop asks for them at every block of steps."""
    surface = Body.ellipsoid((0.11, 0.1, 0.09)).surface
    assert surface.bounds is surface.bounds
    assert surface.bounds == pytest.approx(
        np.array([[-0.11, -0.1, -0.09], [0.11, 0.1, 0.09]]), rel=1e-3
    )
