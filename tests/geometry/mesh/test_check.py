"""Checks of meshes: findings, repairs, and the messages about what is refused."""

import numpy as np
import pytest
import trimesh

from meshskin import cli
from meshskin.cli import check
from meshskin.geometry.body import Body
from meshskin.geometry.mesh.check import check_mesh
from meshskin.geometry.mesh.self_intersection import edge_face_intersections
from meshskin.geometry.mesh.winding_number import winding_number


@pytest.fixture
def ball():
    return trimesh.creation.icosphere(subdivisions=3, radius=0.1)


def verdicts(found):
    return [(f.verdict, f.what) for f in found.findings]


def test_a_clean_mesh_has_no_findings(ball):
    found = check_mesh(ball.vertices, ball.faces)
    assert found.findings == ()
    np.testing.assert_array_equal(found.faces, ball.faces)


def test_a_hole_is_told_with_its_place_faces_and_length(ball):
    (finding,) = check_mesh(ball.vertices, ball.faces[1:]).refused
    assert "3 border edges, 1 hole, the longest" in finding.what
    gone = ball.triangles_center[0]
    assert np.linalg.norm(finding.points - gone, axis=1).max() < 0.02
    beside = [
        f for f in range(1, len(ball.faces)) if len(set(ball.faces[f]) & set(ball.faces[0])) == 2
    ]
    assert sorted(finding.faces + 1) == beside
    assert "open=True" in finding.remedy
    assert [v for v, _ in verdicts(check_mesh(ball.vertices, ball.faces[1:], open=True))] == [
        "noted"
    ]


def test_faces_are_told_by_their_numbers_in_the_file(ball):
    faces = np.vstack([ball.faces[:1], ball.faces[:1], ball.faces[2:]])  # a double, and a hole
    found = check_mesh(ball.vertices, faces)
    assert found.repairs == ("1 duplicate faces dropped",)
    hole = found.refused[0]
    shared = [len(set(faces[f]) & set(ball.faces[1])) for f in hole.faces]
    assert shared == [2, 2, 2]


def united(*parts, inverted=()):
    """Vertices and faces of parts in one mesh; those with a number in `inverted` wound inward."""
    first = np.cumsum([0, *(len(p.vertices) for p in parts)])
    faces = [
        (p.faces[:, ::-1] if k in inverted else p.faces) + first[k] for k, p in enumerate(parts)
    ]
    return np.vstack([p.vertices for p in parts]), np.vstack(faces)


def volumes(found, parts):
    """Signed volumes, m^3, of the parts of a checked mesh, given as they were united."""
    rows = np.split(np.arange(len(found.faces)), np.cumsum([len(p.faces) for p in parts])[:-1])
    corners = found.vertices[found.faces]
    six = np.einsum("mc,mc->m", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    return np.array([six[r].sum() / 6.0 for r in rows])


def shifted(ball, x, scale=1.0):
    return ball.copy().apply_scale(scale).apply_translation([x, 0.0, 0.0])


def test_a_part_with_inward_normals_is_inverted_and_a_sound_one_is_not(ball):
    parts = ball, shifted(ball, 0.3)
    found = check_mesh(*united(*parts, inverted=(1,)))
    assert found.repairs == ("orientation of 1 of 2 parts inverted: normals pointed inward",)
    np.testing.assert_allclose(volumes(found, parts), ball.volume, rtol=1e-12)
    np.testing.assert_array_equal(found.faces[: len(ball.faces)], ball.faces)
    assert check_mesh(found.vertices, found.faces).repairs == ()


@pytest.mark.parametrize(("inverted", "turned"), [((1,), False), ((0,), True)])
def test_a_part_wound_against_the_part_around_it_bounds_a_cavity(ball, inverted, turned):
    parts = ball, shifted(ball, 0.0, 0.5)
    found = check_mesh(*united(*parts, inverted=inverted))
    assert bool(found.repairs) == turned
    np.testing.assert_allclose(volumes(found, parts), ball.volume * np.array([1.0, -0.125]))
    mesh = trimesh.Trimesh(found.vertices, found.faces, process=False)
    distance = Body("hollow", mesh, crossed=found.crossed).closest(np.zeros((1, 3))).distance
    assert distance[0] == pytest.approx(0.05, rel=0.01)


@pytest.mark.parametrize("inverted", [(), (0, 1)])
def test_a_part_wound_like_the_part_around_it_is_a_solid(ball, inverted):
    parts = ball, shifted(ball, 0.0, 0.5)
    found = check_mesh(*united(*parts, inverted=inverted))
    np.testing.assert_allclose(volumes(found, parts), ball.volume * np.array([1.0, 0.125]))
    mesh = trimesh.Trimesh(found.vertices, found.faces, process=False)
    points = np.array([[0.02, 0.0, 0.0], [0.06, 0.0, 0.0], [0.11, 0.0, 0.0]])
    distance = Body("two solids", mesh, crossed=found.crossed).closest(points).distance
    np.testing.assert_allclose(distance, [-0.03, -0.01, 0.01], atol=5e-4)


def test_parts_that_intersect_are_not_inverted(ball):
    parts = ball, shifted(ball, 0.08, 0.9)
    found = check_mesh(*united(*parts, inverted=(1,)), open=True)
    assert found.repairs == ("orientation of 1 of 2 parts inverted: normals pointed inward",)
    assert (volumes(found, parts) > 0.0).all()


def test_a_part_with_a_border_keeps_its_orientation(ball):
    dome = ball.copy()
    dome.update_faces(ball.triangles_center[:, 0] > 0.0)
    dome.invert()
    parts = dome, shifted(ball, 0.4), shifted(ball, 0.8)
    found = check_mesh(*united(*parts, inverted=(2,)), open=True)
    assert "orientation of 1 of 3 parts inverted: normals pointed inward" in found.repairs
    np.testing.assert_array_equal(np.sign(volumes(found, parts)), [-1.0, 1.0, 1.0])


def test_an_open_mesh_that_points_inward_as_a_whole_stays(ball):
    parts = ball, shifted(ball, 0.3)
    found = check_mesh(*united(*parts, inverted=(0, 1)), open=True)
    assert found.repairs == ()
    assert (volumes(found, parts) < 0.0).all()


def test_open_parts_that_are_turned_inward_are_inverted(ball):
    bowl = ball.copy()
    bowl.update_faces(bowl.triangles_center[:, 2] < 0.8 * ball.bounds[1, 2])
    bowl.remove_unreferenced_vertices()
    parts = ball, shifted(bowl, 0.3), shifted(bowl, 0.6)
    found = check_mesh(*united(*parts, inverted=(2,)), open=True)
    assert "orientation of 1 of 3 parts inverted: normals pointed inward" in found.repairs
    assert (volumes(found, parts) > 0.0).all()
    sheet = trimesh.Trimesh(
        [[1, 0, 0], [1.2, 0, 0], [1.2, 0.2, 0], [1, 0.2, 0]], [[0, 2, 1], [0, 3, 2]]
    )
    flat = check_mesh(*united(ball, sheet), open=True)  # both of its sides are seen
    assert not any("inverted" in words for words in flat.repairs)
    alone = check_mesh(*united(bowl, inverted=(0,)), open=True)  # as a whole: it may be meant so
    assert not any("inverted" in words for words in alone.repairs)


def test_overlap_is_found_where_it_is(ball):
    other = ball.copy()
    other.apply_translation([0.13, 0.01, 0.005])
    both = trimesh.util.concatenate([ball, other])
    one, two, where = edge_face_intersections(both.vertices, both.faces)
    again = edge_face_intersections(both.vertices, both.faces, closed=True)
    assert len(again[0]) == len(one)
    np.testing.assert_allclose(np.sort(again[2], axis=0), np.sort(where, axis=0), atol=1e-6)
    half = len(ball.faces)
    assert np.all((one < half) != (two < half))
    assert np.all(np.abs(np.linalg.norm(where, axis=1) - 0.1) < 1.5e-3)
    assert np.all(np.abs(np.linalg.norm(where - [0.13, 0.01, 0.005], axis=1) - 0.1) < 1.5e-3)
    refused = check_mesh(both.vertices, both.faces).refused
    assert "intersects itself" in refused[0].what
    assert check_mesh(both.vertices, both.faces, open=True).refused == ()


@pytest.mark.parametrize(
    "mesh",
    [trimesh.creation.box((0.1, 0.1, 0.1)), trimesh.creation.torus(0.1, 0.03),
     trimesh.creation.cylinder(0.03, 0.2), trimesh.creation.capsule(0.1, 0.02)],
)  # fmt: skip
def test_sound_meshes_do_not_overlap(mesh):
    assert len(edge_face_intersections(mesh.vertices, mesh.faces)[0]) == 0
    fine = mesh.subdivide().subdivide()
    assert len(edge_face_intersections(fine.vertices, fine.faces)[0]) == 0


def test_an_edge_of_three_faces_is_told(ball):
    a, b = ball.faces[0][:2]
    vertices = np.vstack([ball.vertices, [[0.0, 0.0, 0.2]]])
    found = check_mesh(vertices, np.vstack([ball.faces, [[a, b, len(ball.vertices)]]]))
    assert any("1 edges of more than two faces" in f.what for f in found.refused)


def test_winding_number(ball):
    assert winding_number(ball.triangles, np.array([0.02, 0.01, 0.0])) == pytest.approx(1.0)
    assert winding_number(ball.triangles, np.array([0.2, 0.01, 0.0])) == pytest.approx(
        0.0, abs=1e-12
    )
    assert winding_number(ball.triangles[:, ::-1], np.zeros(3)) == pytest.approx(-1.0)


def test_indices_that_name_no_vertex_are_told():
    found = check_mesh(np.eye(3), np.array([[0, 1, 3]]))
    assert "refer to vertices that do not exist" in found.refused[0].what


def test_command_says_what_and_where(ball, tmp_path, capsys):
    ball.export(tmp_path / "ball.ply")
    assert cli.main(["check", str(tmp_path / "ball.ply"), "--units", "m"]) == 0
    assert "can be a body" in capsys.readouterr().out
    trimesh.Trimesh(ball.vertices, ball.faces[1:], process=False).export(tmp_path / "hole.ply")
    assert cli.main(["check", str(tmp_path / "hole.ply"), "--units", "m"]) == 1
    out = capsys.readouterr().out
    for words in ("refused", "3 border edges", "the first near (", "faces ", "remedy: fill"):
        assert words in out
    assert cli.main(["check", str(tmp_path / "hole.ply"), "--units", "m", "--open"]) == 0
    assert cli.main(["check", str(tmp_path / "ball.ply"), "--units", "mm"]) == 1
    assert "largest extent" in capsys.readouterr().out


@pytest.mark.deep
@pytest.mark.parametrize("kind", ["png", "html"])
def test_command_draws_where(ball, tmp_path, kind):
    trimesh.Trimesh(ball.vertices, ball.faces[1:], process=False).export(tmp_path / "hole.ply")
    out = tmp_path / f"hole.{kind}"
    assert cli.main(["check", str(tmp_path / "hole.ply"), "--units", "m", "--out", str(out)]) == 1
    assert out.stat().st_size > 10_000
    if kind == "html":
        assert "border edges" in out.read_text(encoding="utf-8")


def test_command_refuses_a_drawing_that_it_cannot_make(ball, tmp_path, capsys):
    ball.export(tmp_path / "ball.ply")
    line = ["check", str(tmp_path / "ball.ply"), "--units", "m", "--out", str(tmp_path / "a.gif")]
    assert cli.main(line) == 2
    assert "suffix of a drawing" in capsys.readouterr().err


def test_command_names_its_own_option(ball, tmp_path, capsys):
    trimesh.Trimesh(ball.vertices, ball.faces[1:], process=False).export(tmp_path / "hole.ply")
    cli.main(["check", str(tmp_path / "hole.ply"), "--units", "m"])
    assert "or --open (open=True in Python) if it is meant" in capsys.readouterr().out


def test_command_tells_the_unit_from_the_size(ball, tmp_path, capsys):
    for scale, unit in ((1.0, "m"), (1e3, "mm"), (1e6, "")):
        ball.copy().apply_scale(scale).export(tmp_path / "ball.stl")
        assert cli.main(["check", str(tmp_path / "ball.stl")]) == (0 if unit else 2)
        said = capsys.readouterr()
        extent = 1e3 * np.ptp(ball.vertices, axis=0).max()
        words = f"units     {unit}, by its size: the largest extent is {extent:.4g} mm then"
        assert words in said.out if unit else "give --units" in said.err
    ball.export(tmp_path / "ball.stl")
    cli.main(["check", str(tmp_path / "ball.stl"), "--units", "m"])
    said = capsys.readouterr().out
    assert "units" not in said
    assert "duplicate vertices merged" in said
    assert "the first near" not in said


def test_a_drawing_leaves_out_repairs_all_over_the_mesh(ball):
    """Every corner written by itself, as in an STL, and a hole: only the hole is shown."""
    corners = ball.triangles[1:].reshape(-1, 3)
    found = check_mesh(corners, np.arange(len(corners)).reshape(-1, 3))
    (merged, _, _, merged_text), (hole, _, _, hole_text) = check.marks(found)
    assert len(merged) == 0
    assert merged_text.endswith("duplicate vertices merged (everywhere, not drawn)")
    assert len(hole) == 3
    assert hole_text.startswith("refused: the mesh is not watertight")


def test_indenters_are_not_silently_left_out(ball, tmp_path, capsys):
    trimesh.Trimesh(ball.vertices, ball.faces[1:], process=False).export(tmp_path / "hole.ply")
    line = ["check", str(tmp_path / "hole.ply"), "--units", "m", "--indenter-radius-mm", "8"]
    assert cli.main(line) == 1
    assert "indenter  not tried on a mesh that cannot be a body" in capsys.readouterr().out


@pytest.mark.deep
def test_indenters_are_compared(ball, tmp_path, capsys):
    ball.export(tmp_path / "ball.ply")
    line = ["check", str(tmp_path / "ball.ply"), "--units", "m", "--indenter-radius-mm"]
    assert cli.main([*line, "4,8", "--force-n", "1", "--young-kpa", "400"]) == 0
    out, err = capsys.readouterr()
    assert [line.split()[0] for line in err.splitlines()] == ["check", "reach"]
    assert "indenter  4 mm reaches 100% with 1 N or less" in out
    assert "recommended: 8 mm reaches 100%, as with 4 mm" in out
    assert out.rstrip().endswith("can be a body")
    assert cli.main([*line, "8"]) == 0
    assert "recommended" not in capsys.readouterr().out
    for wrong in ("4,0", "4;8"):
        assert cli.main([*line, wrong]) == 2
        assert "argument --indenter-radius-mm" in capsys.readouterr().err
    assert cli.main([*line[:-1], "--force-n", "1", "--skin-mm", "2"]) == 2
    said = "--force-n, --skin-mm is for contacts of an indenter; give --indenter-radius-mm, too"
    assert said in capsys.readouterr().err
