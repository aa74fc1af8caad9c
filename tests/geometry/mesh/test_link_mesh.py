"""Bodies of the links of URDF files: scale, origin, folders, refusals."""

import numpy as np
import pytest
import trimesh

import meshskin as ms
from meshskin.core.errors import MeshError, UnknownNameError
from meshskin.core.se3 import from_rpy

from ...real_data import DATA, needs_icub

URDF = """<robot name="toy">
<link name="palm"><visual><origin xyz="0.01 0.02 0.03" rpy="0.1 0.2 0.3"/>
<geometry><mesh filename="package://toy/meshes/box.stl" scale="0.001 0.001 {z}"/></geometry>
</visual>
<collision><geometry><mesh filename="meshes/box.stl" scale="0.002 0.002 0.002"/></geometry>
</collision></link>
<link name="finger"><visual>
<geometry><cylinder radius="0.01" length="0.1"/></geometry></visual></link>
<link name="pair">
<visual><geometry><mesh filename="meshes/box.stl" scale="1e-3 1e-3 1e-3"/></geometry></visual>
<visual><origin xyz="0.2 0 0"/>
<geometry><mesh filename="meshes/box.stl" scale="1e-3 1e-3 1e-3"/></geometry></visual></link>
<link name="flat"><visual>
<geometry><mesh filename="meshes/box.stl" scale="1 1"/></geometry></visual></link>
</robot>"""
SIZE = (40.0, 20.0, 60.0)


@pytest.fixture
def box():
    """A box whose centre is off the origin, mm."""
    return trimesh.creation.box(SIZE).apply_translation([20.0, 10.0, 30.0])


@pytest.fixture
def urdf(tmp_path, box):
    (tmp_path / "toy" / "meshes").mkdir(parents=True)
    (tmp_path / "toy" / "urdf").mkdir()
    box.export(tmp_path / "toy" / "meshes" / "box.stl")
    path = tmp_path / "toy" / "urdf" / "toy.urdf"
    path.write_text(URDF.format(z=0.001))
    return path


@pytest.mark.parametrize("z", [0.001, -0.001])
def test_scale_and_origin_place_the_mesh_in_the_links_frame(urdf, box, z):
    """Also of a mesh that a negative scale mirrors: its normals still point outward."""
    urdf.write_text(URDF.format(z=z))
    body = ms.Body.from_urdf(urdf, "palm")
    assert (body.name, body.repairs[1:]) == ("palm", ())  # an STL file repeats its vertices
    assert body.mesh.volume == pytest.approx(np.prod(SIZE) * 1e-9, rel=1e-5)
    placed = (box.vertices * [1e-3, 1e-3, z]) @ from_rpy([0.1, 0.2, 0.3]).T + [0.01, 0.02, 0.03]
    far = np.linalg.norm(body.mesh.vertices[:, None] - placed, axis=2)
    assert max(far.min(axis=0).max(), far.min(axis=1).max()) < 1e-8


def test_collision_meshes_and_several_meshes_of_a_link(urdf):
    body = ms.Body.from_urdf(urdf, "palm", kind="collision")
    np.testing.assert_allclose(body.mesh.bounds, [np.zeros(3), 2e-3 * np.array(SIZE)], atol=1e-8)
    pair = ms.Body.from_urdf(urdf, "pair").mesh
    np.testing.assert_allclose(pair.bounds[:, 0], [0.0, 0.24], atol=1e-8)
    assert pair.volume == pytest.approx(2.0 * np.prod(SIZE) * 1e-9, rel=1e-5)


def test_a_mesh_elsewhere_is_found_by_its_folder(urdf, tmp_path):
    away = tmp_path / "away"
    away.mkdir()
    moved = urdf.rename(away / "toy.urdf")
    (tmp_path / "toy").rename(tmp_path / "description")
    with pytest.raises(MeshError, match=r"'package://toy/meshes/box.stl' is in none .* folders="):
        ms.Body.from_urdf(moved, "palm")
    body = ms.Body.from_urdf(moved, "palm", folders=[tmp_path / "description"])
    assert body.mesh.is_volume


def test_what_cannot_be_a_body_is_named(urdf, tmp_path):
    with pytest.raises(UnknownNameError, match=r"palmm.* in toy\.urdf.*palm"):
        ms.Body.from_urdf(urdf, "palmm")
    with pytest.raises(MeshError, match=r"visual mesh of link 'finger' in toy\.urdf, got cylinder"):
        ms.Body.from_urdf(urdf, "finger")
    with pytest.raises(MeshError, match=r"bad scale of link 'flat' in toy\.urdf, got '1 1'"):
        ms.Body.from_urdf(urdf, "flat")
    with pytest.raises(UnknownNameError, match="collisions"):
        ms.Body.from_urdf(urdf, "palm", kind="collisions")
    with pytest.raises(MeshError, match="cannot read the URDF file"):
        ms.Body.from_urdf(tmp_path / "none.urdf", "palm")
    with pytest.raises(MeshError, match="a URDF file must be a path, got None"):
        ms.Body.from_urdf(None, "palm")


@needs_icub
def test_the_skin_modules_of_the_icub_lie_on_its_forearm():
    """Its URDF gives them in the frame of the link; the mesh is in mm, and turned by its origin."""
    folder = DATA / "icub_body"
    urdf = folder / "iCubGazeboV2_5.urdf"
    body = ms.Body.from_urdf(urdf, "l_forearm", folders=[folder / "meshes"], open=True)
    table = (folder / "skin_triangle_frames_iCubGazeboV2_5.csv").read_text().splitlines()
    rows = [line.split(",")[2:5] for line in table if line.startswith("l_forearm,")]
    distance = np.abs(body.closest(np.array(rows, dtype=float)).distance)
    assert len(rows) > 20
    assert np.median(distance) < 0.8e-3
    assert distance.max() < 1.5e-3
