"""Edges of more than two faces: split where parts touch, refused where the order is uncertain."""

import numpy as np
import pytest
import trimesh

from meshskin.geometry.body import Body
from meshskin.geometry.mesh.check import check_mesh
from meshskin.geometry.mesh.winding_number import winding_number

from ...height_field import height_field


def box(low, high):
    mesh = trimesh.creation.box(np.subtract(high, low))
    mesh.apply_translation(np.add(low, high) / 2.0)
    return mesh


def touching(*boxes):
    return trimesh.util.concatenate([box(*b) for b in boxes])


def plate(n=9, pinched=((4, 4), (4, 5))):
    """A plate of 0.1 x 0.1 x 0.01 m, its top pressed down to its bottom at some nodes."""
    top = np.full((n, n), 0.005)
    for i, j in pinched:
        top[i, j] = -0.005
    above, upper = height_field(lambda x, y: top, 0.05, n)
    vertices = np.vstack([above, above * [1.0, 1.0, 0.0] - [0.0, 0.0, 0.005]])
    k = np.arange(n - 1)
    rim = np.concatenate([k * n, (n - 1) * n + k, n * n - 1 - k * n, n - 1 - k])
    end = np.roll(rim, -1)
    low = rim + n * n, end + n * n
    sides = np.vstack([np.column_stack([end, rim, low[0]]), np.column_stack([end, *low])])
    return trimesh.Trimesh(
        vertices, np.vstack([upper, upper[:, ::-1] + n * n, sides]), process=False
    )


def load(mesh, folder):
    mesh.export(folder / "mesh.ply")
    return Body.load(folder / "mesh.ply", units="m")


def signs_are_right(body, points):
    hit = body.closest(points)
    clear = np.abs(hit.distance) > body.surface.offsets[hit.face] + 1e-9
    assert clear.sum() > 0.5 * len(points)
    inside = np.array([winding_number(body.mesh.triangles, p) > 0.5 for p in points])
    np.testing.assert_array_equal(hit.distance[clear] < 0.0, inside[clear])


def test_boxes_that_share_an_edge_are_two(tmp_path):
    mesh = touching(((0, 0, 0), (0.1, 0.1, 0.1)), ((0.1, 0.1, 0), (0.2, 0.2, 0.1)))
    body = load(mesh, tmp_path)
    assert body.repairs[-1] == "1 edges of more than two faces split: parts touch there"
    assert body.mesh.is_watertight
    assert body.mesh.volume == pytest.approx(2e-3)
    assert len(body.crossed) == 4
    signs_are_right(body, np.random.default_rng(0).uniform(0.02, 0.18, size=(400, 3)))


def test_a_box_in_an_inner_corner_does_not_turn_the_sign(tmp_path):
    """Inside the angle of an L, the edge where the box touches is the nearest for both."""
    outline = np.array([[0, 0], [0.2, 0], [0.2, 0.1], [0.1, 0.1], [0.1, 0.2], [0, 0.2]])
    caps = np.array([[0, 1, 3], [1, 2, 3], [0, 3, 5], [3, 4, 5]])
    vertices = np.vstack([np.column_stack([outline, np.full(6, z)]) for z in (0.0, 0.1)])
    sides = [[[i, (i + 1) % 6, 6 + (i + 1) % 6], [i, 6 + (i + 1) % 6, 6 + i]] for i in range(6)]
    faces = np.vstack([caps[:, ::-1], caps + 6, np.reshape(sides, (-1, 3))])
    wedge = np.array([[0.1, 0.1], [0.2, 0.14], [0.14, 0.2]])
    tip = np.vstack([np.column_stack([wedge, np.full(3, z)]) for z in (0.0, 0.1)])
    sides = [[[i, (i + 1) % 3, 3 + (i + 1) % 3], [i, 3 + (i + 1) % 3, 3 + i]] for i in range(3)]
    tips = np.vstack([[[2, 1, 0], [3, 4, 5]], np.reshape(sides, (-1, 3))])
    both = trimesh.Trimesh(np.vstack([vertices, tip]), np.vstack([faces, tips + 12]), process=False)
    body = load(both, tmp_path)
    assert "faces split" in body.repairs[-1]
    assert body.mesh.is_watertight
    points = np.random.default_rng(0).uniform([0.06, 0.06, 0.02], [0.14, 0.14, 0.08], (600, 3))
    signs_are_right(body, points)


@pytest.mark.parametrize("pinched", [((4, 4), (4, 5)), ((3, 4), (4, 4), (5, 4)), ((2, 2), (3, 3))])
def test_a_plate_pinched_along_edges_stays_one(tmp_path, pinched):
    body = load(plate(pinched=pinched), tmp_path)
    assert f"{len(pinched) - 1} edges of more than two faces split" in body.repairs[-1]
    assert body.mesh.is_watertight
    assert body.mesh.body_count == 1
    points = np.random.default_rng(0).uniform([-0.04, -0.04, -0.02], [0.04, 0.04, 0.02], (400, 3))
    signs_are_right(body, points)


def test_three_boxes_about_one_edge_are_split(tmp_path):
    """Six faces about an edge; a hexagon of which every other sixth is solid."""
    angle = np.radians([0, 60, 120, 180, 240, 300])
    ring = 0.1 * np.column_stack([np.cos(angle), np.sin(angle)])
    parts = []
    for k in (0, 2, 4):
        flat = np.vstack([[0.0, 0.0], ring[k], ring[k + 1]])
        corners = np.vstack([np.column_stack([flat, np.full(3, z)]) for z in (0.0, 0.1)])
        sides = [[[i, (i + 1) % 3, 3 + (i + 1) % 3], [i, 3 + (i + 1) % 3, 3 + i]] for i in range(3)]
        faces = np.vstack([[[2, 1, 0], [3, 4, 5]], np.reshape(sides, (-1, 3))])
        parts.append(trimesh.Trimesh(corners, faces, process=False))
    body = load(trimesh.util.concatenate(parts), tmp_path)
    assert body.mesh.is_watertight
    assert body.mesh.body_count == 3


def test_what_is_not_sure_is_refused():
    """A fin on a box: an odd number of faces; two boxes with a common side: faces at one place."""
    one = box((0, 0, 0), (0.1, 0.1, 0.1))
    a, b = one.faces[0][:2]
    fin = np.vstack([one.vertices, [[0.3, 0.3, 0.3]]])
    refused = check_mesh(fin, np.vstack([one.faces, [[a, b, 8]]])).refused
    assert any("edges of more than two faces" in f.what for f in refused)
    flush = touching(((0, 0, 0), (0.1, 0.1, 0.1)), ((0.1, 0, 0), (0.2, 0.1, 0.1)))
    flush.merge_vertices()
    found = check_mesh(flush.vertices, flush.faces)
    assert not any("faces split" in words for words in found.repairs)
    assert found.refused


def test_parting_moves_no_face():
    mesh = plate()
    before = mesh.triangles
    found = check_mesh(mesh.vertices, mesh.faces)
    np.testing.assert_array_equal(found.vertices[found.faces], before[np.argsort(found.row)])
