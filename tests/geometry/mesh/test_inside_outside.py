"""Inside or outside: folded edges, winding numbers, and meshes that intersect themselves."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from meshskin.core import codegen
from meshskin.geometry.body import Body
from meshskin.geometry.mesh import winding_number as wn
from meshskin.geometry.mesh.inside_outside import InsideOutside
from meshskin.geometry.mesh.self_intersection import edge_face_intersections
from meshskin.geometry.mesh.topology import neighbours
from meshskin.geometry.mesh.winding_number import WindingNumber
from meshskin.geometry.mesh.winding_number import winding_number as turns

from ...real_data import DATA, needs_icub


def folds(mesh):
    faces, none = np.asarray(mesh.faces), np.zeros(0, dtype=np.intp)
    return InsideOutside(
        np.asarray(mesh.vertices), faces, mesh.face_normals, none, neighbours(faces)[0]
    )


def test_no_edge_of_a_solid_is_doubtful():
    """Nearest points of a box's outside are on faces, edges and corners."""
    box = trimesh.creation.box((0.1, 0.06, 0.02))
    points = np.random.default_rng(0).uniform(-0.2, 0.2, size=(400, 3))
    foot, _, face = trimesh.proximity.closest_point(box, points)
    weight = trimesh.triangles.points_to_barycentric(box.triangles[face], foot)
    weight[weight < 1e-9] = 0.0
    assert (np.sum(weight > 0, axis=1) < 3).sum() > 200
    assert not len(folds(box).ambiguous(face, weight, points - foot))


def test_an_edge_folded_back_is_doubtful():
    """Two faces over each other, one turned: seen from above one faces, the other does not."""
    vertices = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0.05, 0.08, 0.01]])
    mesh = trimesh.Trimesh(vertices, [[0, 1, 2], [1, 0, 3], [2, 1, 3], [0, 2, 3]], process=False)
    middle = np.array([[0.5, 0.5, 0.0]])
    fold = folds(mesh)
    assert fold.closed
    assert list(fold.ambiguous(np.array([0]), middle, np.array([[0.0, -1.0, 0.3]]))) == [0]
    corner = np.array([[1.0, 0.0, 0.0]])
    assert list(fold.ambiguous(np.array([0]), corner, np.array([[-1.0, -1.0, 0.4]]))) == [0]


def test_the_rim_of_a_coarse_cylinder_is_not_doubtful():
    """Its vertices are corners of saddles: by a cap, the cap turns away, the side does not."""
    body = Body.cylinder(0.05, 0.2, faces=600)
    vertex = body.mesh.vertices
    rim = vertex[(vertex[:, 2] > 0.0999) & (np.hypot(vertex[:, 0], vertex[:, 1]) > 0.0499)]
    points = rim * [1.4, 1.4, 1.0] - [0.0, 0.0, 1e-5]
    foot, _, face = trimesh.proximity.closest_point(body.mesh, points)
    weight = trimesh.triangles.points_to_barycentric(body.mesh.triangles[face], foot)
    weight[weight < 1e-6] = 0.0
    fold, way = folds(body.mesh), points - foot
    assert not len(fold.ambiguous(face, weight, way))
    np.testing.assert_array_equal(fold.side(points), 1.0)
    assert np.all(body.closest(points).distance > 0.0)


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
    assert not len(fold.ambiguous(np.array([0]), np.array([[1.0, 0.0, 0.0]]), away))


def ball(centre=(0.0, 0.0, 0.0), radius=0.1, subdivisions=4):
    mesh = trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)
    mesh.apply_translation(centre)
    return mesh


@pytest.fixture(params=["compiled", "without a compiler"])
def each_way(request, monkeypatch):
    if request.param != "compiled":
        monkeypatch.setattr(wn, "library", lambda: None)


@pytest.mark.deep
def test_turns_are_those_of_all_triangles(each_way):
    """Two balls that overlap, and a smaller one within, wound inward: 0, 1 and 2 turns."""
    hollow = ball(radius=0.04, subdivisions=2)
    hollow.invert()
    mesh = trimesh.util.concatenate([ball(subdivisions=3), ball((0.13, 0.01, 0.0), 0.08), hollow])
    points = np.random.default_rng(0).uniform(-0.15, 0.25, size=(150, 3))
    points = np.vstack([points, mesh.triangles_center[::40] + 1e-9 * mesh.face_normals[::40]])
    expected = [round(turns(mesh.triangles, p)) for p in points]
    found = WindingNumber(mesh.vertices, mesh.faces).at(points)
    assert set(expected) == {0, 1, 2}
    np.testing.assert_array_equal(found, expected)


@pytest.mark.skipif(codegen.find_compiler() is None, reason="no C compiler here")
def test_sums_over_clusters_are_near_integers():
    centre = [0.13, 0.01, 0.0]
    mesh = trimesh.util.concatenate([ball(subdivisions=3), ball(centre, 0.08, 3)])
    points = np.random.default_rng(0).uniform(-0.15, 0.25, size=(3000, 3))
    height = np.linalg.norm(points, axis=1) - 0.1, np.linalg.norm(points - centre, axis=1) - 0.08
    clear = np.all(np.abs(height) > 2e-3, axis=0)
    total = WindingNumber(mesh.vertices, mesh.faces)._by_clusters(wn.library(), points)
    assert np.abs(total - np.sum(np.less(height, 0.0), axis=0))[clear].max() < 0.03


@pytest.mark.deep
def test_winding_numbers_of_many_nested_surfaces():
    """48 spheres 0.1 mm apart: errors of the clusters add up, and all triangles are summed."""
    mesh = trimesh.util.concatenate(
        [ball(radius=r, subdivisions=2) for r in np.linspace(0.1, 0.104, 48)]
    )
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(600, 3))
    radius = np.concatenate([rng.uniform(0.02, 0.095, 300), rng.uniform(0.106, 0.2, 300)])
    points = radius[:, None] * direction / np.linalg.norm(direction, axis=1)[:, None]
    found = WindingNumber(mesh.vertices, mesh.faces).at(points)
    np.testing.assert_array_equal(found, np.where(radius < 0.1, 48, 0))


def test_holes_of_a_body_are_closed_and_a_sheet_reaches_far(each_way):
    """A ball's holes have lids; a well hangs below a shallow dome, to infinity."""
    mesh = ball(subdivisions=5)
    cut = WindingNumber(mesh.vertices, mesh.faces[np.abs(mesh.triangles_center[:, 2]) < 0.09])
    assert not cut.closed
    points = [[0, 0, 0.0], [0.05, 0, 0.08], [0, 0, 3.0], [0, 0, -3.0], [0.2, 0, 0], [0.1, 0, 0.5]]
    np.testing.assert_array_equal(cut.at(np.array(points)), [1, 1, 0, 0, 0, 0])
    dome = WindingNumber(mesh.vertices, mesh.faces[mesh.triangles_center[:, 2] > 0.096])
    points = [[0, 0, 0.08], [0, 0, -3.0], [0, 0, 0.12], [0.2, 0, 0.07], [0.2, 0, -1.0]]
    np.testing.assert_array_equal(dome.at(np.array(points)), [1, 1, 0, 0, 0])


@pytest.mark.deep
@pytest.mark.skipif(codegen.find_compiler() is None, reason="no C compiler here")
def test_far_borders_count_by_their_loops():
    """A ball cut into panels that face either way: a sheet of many loops, each extruded."""
    mesh, rng = ball(subdivisions=5), np.random.default_rng(0)
    cell = np.floor((mesh.triangles_center + 1.0) / 0.013).astype(int)
    kept = (cell % 4 != 0).all(axis=1)
    panel = np.unique(cell[kept], axis=0, return_inverse=True)[1].ravel()
    turned = (rng.random(panel.max() + 1) < 0.5)[panel]
    faces = mesh.faces[kept]
    sheet = WindingNumber(mesh.vertices, np.where(turned[:, None], faces[:, ::-1], faces))
    points = rng.normal(scale=0.08, size=(400, 3))
    total = sheet._by_clusters(wn.library(), points)
    exact = np.round(sheet._exact(points))
    assert len(sheet.border) > 4000
    assert len(np.unique(exact)) > 1
    np.testing.assert_allclose(total, exact, atol=0.03)


@pytest.mark.deep
@pytest.mark.parametrize("turned", [False, True])
def test_panels_of_a_link_do_not_put_each_other_inside(tmp_path, turned):
    """A ball whose lid is a part of its own, and a rib that runs through it: signs as of a ball.

    The lid's border, closed at infinity, ran through the ball, and most of its front was inside.
    """
    mesh = ball(subdivisions=4)
    lid = mesh.triangles_center[:, 2] > 0.06
    rib = trimesh.creation.box((0.02, 0.02, 0.02))
    rib.apply_translation((0.09, 0.001, 0.002))
    parts = [mesh.submesh([rows], append=True) for rows in (lid, ~lid)]
    parts[0].apply_scale(1.002)  # so that the borders stay apart
    both = trimesh.util.concatenate([*parts, rib])
    if turned:
        both.invert()
    body = loaded(both, tmp_path)
    points = around(mesh, 0.01, 2000)
    points = points[np.linalg.norm(points - [0.09, 0, 0], axis=1) > 0.03]
    points = points[np.abs(points[:, 2] - 0.06) > 0.01]
    inside = np.linalg.norm(points, axis=1) < np.where(points[:, 2] > 0.06, 0.1002, 0.1)
    assert len(body.crossed)
    assert wrong(body, points, inside != turned) == 0


@pytest.mark.slow
def test_a_flange_does_not_put_the_tube_inside(tmp_path):
    """The flange's border, closed at infinity, swallowed the tube: most fronts were inside."""
    tube = trimesh.creation.annulus(0.048, 0.05, 0.2).subdivide_to_size(0.02)
    flange = trimesh.creation.annulus(0.049, 0.07, 0.01, sections=40).subdivide_to_size(0.02)
    flange.update_faces(flange.triangles_center[:, 2] > 0.0049)  # its upper side alone
    flange.apply_translation((0.0, 0.0, 0.09))
    body = loaded(trimesh.util.concatenate([tube, flange]), tmp_path)
    assert len(body.crossed)
    angle, z = np.random.default_rng(0).uniform([-np.pi, -0.08], [np.pi, 0.05], (500, 2)).T
    for r, inside in ((0.047, False), (0.049, True), (0.051, False), (0.07, False)):
        points = np.column_stack([r * np.cos(angle), r * np.sin(angle), z])
        np.testing.assert_array_equal(body.closest(points).distance < 0.0, inside)


def test_every_soup_is_closed_to_whole_turns():
    """Triangles dropped and turned at random, edges of several faces: whole numbers still."""
    rng = np.random.default_rng(0)
    mesh = trimesh.util.concatenate([ball(subdivisions=2), ball((0.1, 0.0, 0.0), subdivisions=2)])
    faces = mesh.faces[rng.random(len(mesh.faces)) < 0.8]
    turned = rng.random(len(faces)) < 0.2
    faces = np.where(turned[:, None], faces[:, ::-1], faces)
    soup = WindingNumber(mesh.vertices, faces)
    points = rng.uniform(-0.15, 0.25, size=(100, 3))
    total = soup._exact(points)
    np.testing.assert_allclose(total, np.round(total), atol=1e-9)
    np.testing.assert_array_equal(soup.at(points), np.round(total))


def loaded(mesh, folder, **options):
    mesh.export(folder / "mesh.ply")
    return Body.load(folder / "mesh.ply", units="m", open=True, **options)


def wrong(body, points, inside):
    """How many signs are wrong of points that are farther off than the patches from the mesh."""
    hit = body.closest(points)
    clear = np.abs(hit.distance) > body.surface.offsets[hit.face]
    assert clear.sum() > 0.4 * len(points)
    return int(np.sum((hit.distance < 0.0)[clear] != inside[clear]))


def crossed_balls():
    """Two balls of 0.1 m that overlap, 0.12 m apart."""
    return trimesh.util.concatenate([ball(), ball((0.12, 0.013, 0.007))])


def around(mesh, reach, count, seed=0):
    """Points at random, within reach (m) of the places on the mesh."""
    rng = np.random.default_rng(seed)
    places = mesh.triangles_center[rng.integers(len(mesh.faces), size=count)]
    return places + rng.uniform(-reach, reach, size=(count, 3))


@pytest.mark.deep
@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("hole", [False, True])
def test_parts_that_run_into_each_other_have_one_inside(tmp_path, hole, turned):
    """Near the sheets within too; with a hole in one, away from it; inside out, all signs turn."""
    mesh = crossed_balls()
    if hole:
        mesh.update_faces(mesh.triangles_center[:, 0] > -0.09)
    if turned:
        mesh.invert()
    body = loaded(mesh, tmp_path)
    points = around(mesh, 0.02, 4000)
    points = points[points[:, 0] > -0.06]
    first = np.linalg.norm(points, axis=1) < 0.1
    second = np.linalg.norm(points - [0.12, 0.013, 0.007], axis=1) < 0.1
    inside = (first | second) != turned
    assert wrong(body, points, inside) == 0
    near = np.flatnonzero(first & second)
    warm = body.surface.closest(points[near], body.closest(points[near]).face)
    np.testing.assert_array_equal(warm.distance < 0.0, inside[near])
    assert wrong(replace(body, crossed=None), points, inside) > 50


def test_few_faces_tell_the_level_of_a_large_part(monkeypatch):
    """Two overlapping balls, one with a hole: as by the fronts of all faces, from 44 % of them."""
    mesh = crossed_balls()
    mesh.update_faces(mesh.triangles_center[:, 0] > -0.09)
    across, crossed = neighbours(mesh.faces)[0], edge_face_intersections(mesh.vertices, mesh.faces)
    inside = InsideOutside(
        mesh.vertices, mesh.faces, mesh.face_normals, np.unique(crossed[:2]), across
    )
    asked, at = [], WindingNumber.at
    monkeypatch.setattr(WindingNumber, "at", lambda w, p: asked.append(len(p)) or at(w, p))
    level = inside.level
    assert sum(asked) < 0.45 * len(mesh.faces)
    fronts = inside._in_front(inside._winding, np.arange(len(mesh.faces)))
    assert np.mean(level == fronts) > 0.99
    assert (level > 0).sum() > 500


def rolled(height, count=300):
    """A sheet along y over a curve in x, z with four loops; their height (m) is signed."""
    t = np.linspace(-2.0, 2.0, count)
    x, z = 0.04 * t + 0.016 * np.sin(2 * np.pi * t), -height * np.cos(2 * np.pi * t)
    curve = np.column_stack([x, z])
    y = np.linspace(-0.05, 0.05, 11)
    n, k = len(curve), len(y)
    vertices = np.column_stack(
        [np.repeat(curve[:, 0], k), np.tile(y, n), np.repeat(curve[:, 1], k)]
    )
    i, j = (g.ravel() for g in np.meshgrid(range(n - 1), range(k - 1), indexing="ij"))
    a, b, c, d = i * k + j, (i + 1) * k + j, (i + 1) * k + j + 1, i * k + j + 1
    faces = np.vstack([np.column_stack([a, b, c]), np.column_stack([a, c, d])])
    return curve, trimesh.Trimesh(vertices, faces, process=False)


@pytest.mark.deep
@pytest.mark.parametrize("height", [0.012, -0.012])
def test_a_sheet_that_runs_through_itself(tmp_path, height):
    """Signed crossings of a ray straight up tell how often the sheet winds about a point."""
    curve, mesh = rolled(height)
    body = loaded(mesh, tmp_path)
    assert len(body.crossed)
    assert body.mesh.face_normals[:, 2].mean() > 0.2
    points = np.random.default_rng(1).uniform([-0.07, -0.04, -0.03], [0.07, 0.04, 0.03], (4000, 3))
    ahead = curve[1:, 0] > curve[:-1, 0]
    turn = np.zeros(len(points), dtype=int)
    for p, q, way in zip(curve[:-1], curve[1:], ahead, strict=True):
        t = (points[:, 0] - p[0]) / (q[0] - p[0])
        above = p[1] + t * (q[1] - p[1]) > points[:, 2]
        turn += np.where((t >= 0) & (t < 1) & above, 1 if way else -1, 0)
    assert set(turn) >= {0, 1}
    assert set(turn) & {-1, 2}
    assert wrong(body, points, turn > 0) == 0
    assert wrong(replace(body, crossed=None), points, turn > 0) > 20


@pytest.mark.deep
@needs_icub
@pytest.mark.parametrize("part", ["l_forearm", "l_hand", "l_shank"])
def test_links_of_a_robot_that_run_into_themselves(part):
    """iCub's links, as they come: no wrong sign beyond the height of the patches."""
    path = DATA / "icub_body" / "meshes" / f"sim_sea_2-5_{part}_prt-binary.stl"
    body = Body.load(path, units="mm", open=True)
    assert len(body.crossed)
    places = body.mesh.triangles_center[body.crossed]
    rng = np.random.default_rng(0)
    near = np.concatenate([body.mesh.triangles_center, np.repeat(places, 20, axis=0)])
    near = near[rng.integers(len(near), size=300)] + rng.uniform(-0.02, 0.02, size=(300, 3))
    inside = np.array([turns(body.mesh.triangles, p) > 0.5 for p in near])
    assert wrong(body, near, inside) == 0
