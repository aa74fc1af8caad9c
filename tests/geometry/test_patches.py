"""Named parts of mesh files: read from each format, kept through repairs, used as regions."""

import re

import numpy as np
import pytest
import trimesh

from meshskin import Scene, cli, explore
from meshskin.core.errors import ConfigError, MeshError, SkinError
from meshskin.geometry.body import Body
from meshskin.geometry.mesh import mesh_file, obj
from meshskin.geometry.region import Cap, Disc, Faces, HalfSpace, Patch, area
from meshskin.scene import file
from meshskin.skin.skin import Skin

RADIUS = 0.1
CAP = np.radians(40.0)


@pytest.fixture
def ball():
    return trimesh.creation.icosphere(subdivisions=3, radius=RADIUS)


def parts(ball):
    """Faces of two caps and of the rest."""
    z = ball.triangles_center[:, 2] / RADIUS
    return {
        "palm": np.flatnonzero(z < -np.cos(CAP)),
        "thumb": np.flatnonzero(z > np.cos(CAP)),
        "back": np.flatnonzero(np.abs(z) <= np.cos(CAP)),
    }


def write_obj(path, vertices, faces, groups, key="g"):
    """Groups of faces, each face with corners of its own where `vertices` are (m, 3, 3)."""
    lines = [f"v {x!r} {y!r} {z!r}" for x, y, z in vertices.reshape(-1, 3).tolist()]
    for name, rows in groups.items():
        lines.append(f"{key} {name}")
        lines += ["f " + " ".join(str(i + 1) for i in f) for f in faces[rows].tolist()]
    path.write_text("\n".join(lines) + "\n")


def write_glb(path, ball, groups):
    scene = trimesh.Scene()
    for k, (name, rows) in enumerate(groups.items()):
        part = trimesh.Trimesh(ball.vertices, ball.faces[rows], process=False)
        scene.add_geometry(part, node_name=name, geom_name=f"mesh{k}", parent_node_name=None)
    scene.export(path)


def write_stl(path, ball, groups):
    text = []
    for name, rows in groups.items():
        text.append(f"solid {name}")
        for corners in ball.triangles[rows]:
            text += ["facet normal 0 0 0", "outer loop"]
            text += [f"vertex {x!r} {y!r} {z!r}" for x, y, z in corners.tolist()]
            text += ["endloop", "endfacet"]
        text.append(f"endsolid {name}")
    path.write_text("\n".join(text) + "\n")


def assert_parts(body, ball):
    """Every name has the faces that lie where its part of the ball lies."""
    assert set(parts(ball)) <= set(body.patches)
    middles = body.mesh.triangles_center
    for name, rows in parts(ball).items():
        got = middles[body.patches[name]]
        expected = ball.triangles_center[rows]
        assert len(got) == len(expected)
        order = [np.lexsort(np.round(p, 6).T) for p in (got, expected)]
        np.testing.assert_allclose(got[order[0]], expected[order[1]], atol=1e-7)


@pytest.mark.parametrize("key", ["o", "g", "usemtl"])
def test_an_obj_names_objects_groups_and_materials(ball, tmp_path, key):
    write_obj(tmp_path / "hand.obj", ball.vertices, ball.faces, parts(ball), key)
    body = Body.load(tmp_path / "hand.obj", units="m")
    assert body.repairs == ()
    assert_parts(body, ball)


def test_a_glb_names_nodes_and_meshes(ball, tmp_path):
    write_glb(tmp_path / "hand.glb", ball, parts(ball))
    body = Body.load(tmp_path / "hand.glb")
    assert "duplicate vertices merged" in " ".join(body.repairs)  # the parts' common borders
    assert_parts(body, ball)
    np.testing.assert_array_equal(body.patches["mesh0"], body.patches["palm"])
    assert not [n for n in body.patches if n not in {*parts(ball), "mesh0", "mesh1", "mesh2"}]


def test_a_gltf_with_its_buffers_beside_it_is_a_glb(ball, tmp_path):
    write_glb(tmp_path / "hand.glb", ball, parts(ball))
    scene = trimesh.load_scene(tmp_path / "hand.glb", process=False)
    for name, data in trimesh.exchange.gltf.export_gltf(scene).items():
        (tmp_path / name).write_bytes(data)
    body = Body.load(tmp_path / "model.gltf")
    assert_parts(body, ball)
    assert set(body.patches) == {*parts(ball), "mesh0", "mesh1", "mesh2"}


def test_an_ascii_stl_names_solids(ball, tmp_path):
    write_stl(tmp_path / "hand.stl", ball, parts(ball))
    assert_parts(Body.load(tmp_path / "hand.stl", units="m"), ball)
    ball.export(tmp_path / "one.stl")
    assert Body.load(tmp_path / "one.stl", units="m").patches == {}


def test_names_of_a_glb_go_with_places_parents_materials_and_mirrors(tmp_path):
    box = trimesh.creation.box((0.1, 0.1, 0.1))
    box.visual = trimesh.visual.TextureVisuals(
        material=trimesh.visual.material.PBRMaterial(name="rubber")
    )
    scene = trimesh.Scene(base_frame="world")
    scene.add_geometry(box, node_name="hand", geom_name="shell")
    move = trimesh.transformations.translation_matrix
    for name, at in (("left", 0.2), ("right", -0.2)):
        pose = move([at, 0.0, 0.0]) @ np.diag([np.sign(at), 1.0, 1.0, 1.0])
        tip = trimesh.creation.box((0.05, 0.05, 0.05))
        scene.add_geometry(
            tip, node_name=name, geom_name="tip", transform=pose, parent_node_name="hand"
        )
    scene.export(tmp_path / "hand.glb")
    body = Body.load(tmp_path / "hand.glb")
    assert body.repairs == ()  # no part inside out
    assert body.mesh.volume == pytest.approx(1e-3 + 2 * 1.25e-4)
    assert {n: len(f) for n, f in body.patches.items() if n in ("hand", "left", "rubber")} == {
        "hand": 36, "left": 12, "rubber": 12,
    }  # fmt: skip
    assert body.mesh.triangles_center[body.patches["right"], 0].max() < -0.17


def test_names_survive_repairs_that_renumber_faces(ball, tmp_path):
    """Corners written one by one, flipped, pointed and duplicate faces, a vertex too many."""
    groups = parts(ball)
    corners = np.concatenate([ball.triangles[rows] for rows in groups.values()])
    corners[::7] = corners[::7, ::-1]
    sizes = np.cumsum([0, *(len(rows) for rows in groups.values())])
    names = {n: np.arange(a, b) for n, a, b in zip(groups, sizes, sizes[1:], strict=False)}
    faces = np.arange(corners.size // 3).reshape(-1, 3)
    pointed, double = [[0, 0, 1]], faces[names["thumb"][:5]]
    faces = np.vstack([pointed, faces, double, double])
    names = {n: rows + 1 for n, rows in names.items()}
    last = len(faces)
    names = {"flat": [0], **names, "again": np.arange(last - 5, last)}
    write_obj(tmp_path / "hand.obj", np.vstack([corners.reshape(-1, 3), [[9, 9, 9]]]), faces, names)
    body = Body.load(tmp_path / "hand.obj", units="m")
    done = " ".join(body.repairs)
    for words in ("merged", "unreferenced", "without area", "duplicate faces", "wound"):
        assert words in done
    assert_parts(body, ball)
    assert len(body.patches["flat"]) == 0
    assert set(body.patches["again"]) < set(body.patches["thumb"])  # by the faces that stayed
    with pytest.raises(SkinError, match="patch 'flat' of hand has no faces after repairs"):
        Skin.cover(body, spacing=6e-3, region="flat")


@pytest.mark.deep
def test_a_skin_is_laid_on_a_patch_by_its_name(ball, tmp_path):
    write_obj(tmp_path / "hand.obj", ball.vertices, ball.faces, parts(ball))
    body = Body.load(tmp_path / "hand.obj", units="m")
    rows = body.patches["palm"]
    assert area(body, Patch("palm")) == pytest.approx(body.mesh.area_faces[rows].sum(), rel=1e-9)
    by_name = Skin.cover(body, spacing=1e-2, region="palm", seed=2)
    mask = np.zeros(len(body.mesh.faces), dtype=bool)
    mask[rows] = True
    for region in (Patch("palm"), Faces(mask), Faces(tuple(rows.tolist()))):
        same = Skin.cover(body, spacing=1e-2, region=region, seed=2)
        np.testing.assert_array_equal(same.positions, by_name.positions)
    assert np.isin(body.closest(by_name.positions).face, rows).mean() > 0.99
    expected = area(body, Patch("palm")) / (np.sqrt(0.75) * 1e-2**2)
    assert len(by_name) == pytest.approx(expected, rel=0.12)
    modules = Skin.modules(body, region="palm")
    assert np.isin(body.closest(modules.skin.positions).face, rows).all()
    assert explore(body, "palm", mode="quasi_static").segments


@pytest.mark.parametrize(
    ("name", "match"),
    [
        ("plam", r"no patch 'plam' on hand; did you mean palm\? it has back, palm, thumb"),
        ("elbow", r"no patch 'elbow' on hand; it has back, palm, thumb"),
    ],
)
def test_an_unknown_patch_is_refused_with_the_names_there_are(ball, tmp_path, name, match):
    write_obj(tmp_path / "hand.obj", ball.vertices, ball.faces, parts(ball))
    body = Body.load(tmp_path / "hand.obj", units="m")
    with pytest.raises(SkinError, match=match):
        Skin.cover(body, spacing=6e-3, region=name)


@pytest.mark.parametrize("suffix", ["ply", "off"])
def test_a_format_without_names_says_which_have_them(ball, tmp_path, suffix):
    ball.export(tmp_path / f"hand.{suffix}")
    body = Body.load(tmp_path / f"hand.{suffix}", units="m")
    with pytest.raises(SkinError, match=r"its file has no named parts .*OBJ.*GLB"):
        Skin.cover(body, spacing=6e-3, region="palm")


@pytest.mark.parametrize(
    ("faces", "match"),
    [(np.zeros(3, dtype=bool), "shape of a face mask"), ([0.5], "no such face, got 0.5")],
)
def test_wrong_masks_are_refused(faces, match):
    with pytest.raises(SkinError, match=match):
        Skin.cover(Body.sphere(), spacing=6e-3, region=Faces(faces))


TEXT = """mtllib none.mtl
v 0 0 0 1 0 0
v 1 0 0
v 1 1 0
v 0 1 0
vn 0 0 1
o big box
g bottom palm
usemtl red
f 1//1 2//1 3//1 4//1   # a polygon
g top
f -4 \\
  -3 -2
v 5 5 5
f -1/1/1 1/1/1 2/1/1
g
f 1 2 3
"""


def test_an_obj_is_read_in_the_order_of_its_lines():
    vertices, faces, names = obj.read(TEXT, "a.obj")
    assert vertices.tolist() == [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [5, 5, 5]]
    assert faces.tolist() == [[0, 1, 2], [0, 2, 3], [0, 1, 2], [4, 0, 1], [0, 1, 2]]
    assert {name: rows.tolist() for name, rows in names.items()} == {
        "big box": [0, 1, 2, 3, 4],
        "bottom": [0, 1],
        "palm": [0, 1],
        "red": [0, 1, 2, 3, 4],
        "top": [2, 3],
    }


@pytest.mark.parametrize(
    ("line", "match"),
    [
        ("f 1 2", "line 2: a face needs three"),
        ("f # 1", "needs three"),
        ("v 1 x 2", "line 2: .*'x'"),
        ("v 1", "line"),
    ],
)
def test_a_wrong_line_of_an_obj_is_named(tmp_path, line, match):
    (tmp_path / "a.obj").write_text(f"v 0 0 0\n{line}\n")
    with pytest.raises(MeshError, match=match):
        mesh_file.read(tmp_path / "a.obj")


def test_an_obj_whose_faces_name_no_vertices_is_refused(tmp_path):
    for face in ("f 1 2 0", "f 1 2 9", "f -9 1 2"):
        (tmp_path / "a.obj").write_text(f"v 0 0 0\nv 1 0 0\nv 0 1 0\n{face}\n")
        with pytest.raises(MeshError, match="refer to vertices that do not exist"):
            Body.load(tmp_path / "a.obj", units="m")


def scene_tables(folder, region):
    (folder / "scene.toml").write_text(
        'extends = "sphere"\n[body]\nmesh = "hand.obj"\nunits = "m"\n'
        f"[skin]\nspacing_mm = 8\nregion = {region}\n"
    )
    return file.read_tables(folder / "scene.toml")


@pytest.mark.deep
@pytest.mark.parametrize(
    ("table", "region"),
    [
        ('{patch = "palm"}', Patch("palm")),
        ("{direction = [0, 0, -2], angle_deg = 50}", Cap((0, 0, -1), np.radians(50))),
        ("{point_mm = [0, 0, 100], radius_mm = 60}", Disc((0, 0, 0.1), 0.06)),
        ("{normal = [0, 1, 0], offset_mm = 40}", HalfSpace((0, 1, 0), 0.04)),
        (f"{{faces = {[*range(40)]}}}", Faces(range(40))),
    ],
)
def test_every_region_can_be_given_in_a_scene(ball, tmp_path, table, region):
    write_obj(tmp_path / "hand.obj", ball.vertices, ball.faces, parts(ball))
    data, folder = scene_tables(tmp_path, table)
    del data["skin"]["count"]
    file.check_tables(data)
    scene = Scene.from_tables(data, folder)
    expected = Skin.cover(scene.body, spacing=8e-3, region=region)
    np.testing.assert_allclose(scene.skin.positions, expected.positions, atol=1e-12)


@pytest.mark.parametrize(
    ("table", "match"),
    [
        ('"palm"', r"""write region = {patch = "palm"}"""),
        ("{}", "key of one kind of region, got none"),
        ('{patch = "palm", radius_mm = 3}', r"unknown key 'radius_mm' in \[skin.region\]"),
        ('{patch = "palm", faces = [1]}', "got patch and faces"),
        ("{point = [0, 0, 1], radius_mm = 3}", "point needs a unit in its name"),
        ("{point_mm = [0, 0, 100], radius_mm = -3}", "disc.radius is out of range"),
        ("{point_mm = [0, 0, 100]}", "lacks radius"),
        ("{normal = [0, 0, 0], offset_mm = 0}", "normal must be a nonzero vector of 3"),
        ("{direction = 3}", "region.direction must be a nonzero vector of 3 numbers"),
    ],
)
def test_wrong_regions_in_a_scene_are_refused(tmp_path, table, match):
    data, _ = scene_tables(tmp_path, table)
    with pytest.raises(ConfigError, match=match):
        file.check_tables(data)


def test_the_command_lists_the_patches_with_their_areas(ball, tmp_path, capsys):
    write_obj(tmp_path / "hand.obj", ball.vertices, ball.faces, parts(ball))
    assert cli.main(["check", str(tmp_path / "hand.obj"), "--units", "m"]) == 0
    out = capsys.readouterr().out
    for name, rows in parts(ball).items():
        found = re.search(rf"patch +{name}: (\d+) faces, ([\d.]+) cm2", out)
        assert int(found[1]) == len(rows)
        assert float(found[2]) == pytest.approx(1e4 * ball.area_faces[rows].sum(), rel=1e-3)
