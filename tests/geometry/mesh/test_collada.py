"""Collada files against STL files of the same shape: units, axes, nodes, polygons."""

import sys
from importlib import metadata
from pathlib import Path

import numpy as np
import pytest
import trimesh

import meshskin as ms
from meshskin import cli
from meshskin.core.errors import MeshError
from meshskin.geometry.mesh import mesh_file

SIZE = (0.4, 0.1, 0.06)
MATRIX = np.array([[0.0, -1, 0, 30], [1, 0, 0, -20], [0, 0, 1, 5], [0, 0, 0, 1.0]])
"""Of the node that shows the box: a quarter turn, and a shift in mm."""


def written(path, unit, up, scale=1000.0, polygons=False):
    """A box of SIZE, in m divided by `scale`, placed by MATRIX in mm, as Collada text."""
    box = trimesh.creation.box(SIZE)
    pose = MATRIX.copy()
    pose[:3, 3] *= scale / 1000.0
    corners = " ".join(f"{x:.9g}" for x in (scale * box.vertices).ravel())
    faces = " ".join(str(k) for k in box.faces.ravel())
    kind, counts = "triangles", ""
    if polygons:
        kind = "polylist"
        faces = " ".join(str(k) for side in quads(box) for k in side)
        counts = f"<vcount>{'4 ' * 6}</vcount>"
    count = 6 if polygons else 12
    path.write_text(
        f"""<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset>{unit}{up}</asset>
<library_geometries><geometry id="box"><mesh>
<source id="at"><float_array id="numbers" count="24">{corners}</float_array><technique_common>
<accessor source="#numbers" count="8" stride="3"><param name="X" type="float"/>
<param name="Y" type="float"/><param name="Z" type="float"/></accessor></technique_common></source>
<vertices id="corners"><input semantic="POSITION" source="#at"/></vertices>
<{kind} count="{count}"><input semantic="VERTEX" source="#corners" offset="0"/>{counts}
<p>{faces}</p></{kind}></mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="all"><node id="turned">
<matrix>{" ".join(str(x) for x in pose.ravel())}</matrix>
<instance_geometry url="#box"/></node></visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#all"/></scene></COLLADA>"""
    )
    return path


def quads(box):
    """The corners, in order, of the six sides of a box."""
    for axis in range(3):
        for sign in (-1, 1):
            side = np.flatnonzero(np.sign(box.vertices[:, axis]) == sign)
            a, b = np.delete(box.vertices[side], axis, axis=1).T
            yield side[np.argsort(np.arctan2(b, a))]


@pytest.fixture
def stl(tmp_path):
    """The same box as an STL in m."""
    box = trimesh.creation.box(SIZE)
    pose = MATRIX.copy()
    pose[:3, 3] *= 1e-3
    box.apply_transform(pose)
    box.export(tmp_path / "box.stl")
    return mesh_file.read(tmp_path / "box.stl")


def solid(shape):
    return trimesh.Trimesh(shape.vertices, shape.faces)


MM = '<unit name="millimeter" meter="0.001"/>'


@pytest.mark.parametrize(
    ("unit", "scale"), [(MM, 1000.0), ('<unit name="inch" meter="0.0254"/>', 1 / 0.0254), ("", 1.0)]
)
@pytest.mark.parametrize("up", ["", "<up_axis>Y_UP</up_axis>", "<up_axis>Z_UP</up_axis>"])
def test_lengths_are_in_the_files_unit_and_axes_those_of_the_link(tmp_path, stl, unit, up, scale):
    pytest.importorskip("collada")
    found, same = solid(mesh_file.read(written(tmp_path / "box.dae", unit, up, scale))), solid(stl)
    np.testing.assert_allclose(found.bounds, same.bounds, atol=1e-7)
    assert found.volume == pytest.approx(np.prod(SIZE), rel=1e-6)
    np.testing.assert_allclose(found.moment_inertia, same.moment_inertia, rtol=1e-5, atol=1e-12)


def test_polygons_are_cut_into_triangles(tmp_path, stl):
    pytest.importorskip("collada")
    found = solid(mesh_file.read(written(tmp_path / "box.dae", MM, "", polygons=True)))
    assert len(found.faces) == 12
    assert found.area == pytest.approx(solid(stl).area, rel=1e-6)
    np.testing.assert_allclose(found.bounds, solid(stl).bounds, atol=1e-7)


def test_what_cannot_be_read_is_named(tmp_path, monkeypatch):
    path = tmp_path / "box.dae"
    path.touch()
    monkeypatch.setitem(sys.modules, "collada", None)
    with pytest.raises(MeshError, match=r"'box.dae' is a Collada .* pip install pycollada"):
        mesh_file.read(path)
    monkeypatch.undo()
    path.unlink()
    pytest.importorskip("collada")
    with pytest.raises(MeshError, match="the mesh file does not exist"):
        mesh_file.read(path)
    path.write_text("<COLLADA>")
    with pytest.raises(MeshError, match=r"box\.dae cannot be read"):
        mesh_file.read(path)
    text = written(path, MM, "").read_text()
    path.write_text(text.replace('<instance_geometry url="#box"/>', ""))
    with pytest.raises(MeshError, match=r"box\.dae has no faces"):
        mesh_file.read(path)


@pytest.mark.parametrize("name", ["arm_2", "arm_3", "arm_5", "arm_6"])
def test_a_robots_file_that_says_y_up_agrees_with_its_stl_as_it_is(name):
    pytest.importorskip("collada")
    try:
        every = metadata.files("example-robot-data") or []
    except metadata.PackageNotFoundError:
        pytest.skip("example-robot-data is not installed (extra: robots)")
    places = {f.name: Path(str(f.locate())) for f in every if "tiago_description" in str(f)}
    path = places[f"{name}_collision.dae"]
    assert "Y_UP" in path.read_text()
    rough, fine = mesh_file.read(path), mesh_file.read(places[f"{name}.stl"])
    for edge in (np.min, np.max):  # the one is a hull of the other
        low, same = edge(rough.vertices, axis=0), edge(fine.vertices, axis=0)
        np.testing.assert_allclose(low, same, atol=6e-3)


def test_a_body_is_loaded_and_checked_from_a_collada_file(tmp_path, capsys, monkeypatch):
    pytest.importorskip("collada")
    path = written(tmp_path / "box.dae", MM, "")
    body = ms.Body.load(path)
    np.testing.assert_allclose(sorted(body.mesh.extents), sorted(SIZE), rtol=1e-6)
    assert body.mesh.volume == pytest.approx(np.prod(SIZE), rel=1e-6)
    inches = written(tmp_path / "inch.dae", "", "", scale=1 / 0.0254)  # a file without its unit
    np.testing.assert_allclose(sorted(ms.Body.load(inches, units="in").mesh.extents), sorted(SIZE))
    assert cli.main(["check", str(path)]) == 0
    assert "100 x 400 x 60 mm\n" in capsys.readouterr().out
    monkeypatch.setitem(sys.modules, "collada", None)
    assert cli.main(["check", str(path)]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "pip install pycollada" in line


def test_geometries_and_materials_are_named_parts(tmp_path):
    pytest.importorskip("collada")
    path = tmp_path / "box.dae"
    text = written(path, MM, "").read_text().replace('id="box"', 'id="box" name="palm"')
    path.write_text(text)
    assert {name: len(rows) for name, rows in ms.Body.load(path).patches.items()} == {"palm": 12}
