"""Meshes of MuJoCo (.msh), written by hand."""

import numpy as np
import pytest
import trimesh

import meshskin as ms


def msh(mesh, path):
    """Write a mesh with a normal and a texture coordinate of each vertex."""
    n, m = len(mesh.vertices), len(mesh.faces)
    parts = [np.array([n, n, n, m], "<i4"), mesh.vertices.astype("<f4")]
    parts += [mesh.vertex_normals.astype("<f4"), np.zeros((n, 2), "<f4"), mesh.faces.astype("<i4")]
    path.write_bytes(b"".join(part.tobytes() for part in parts))
    return path


def test_a_mesh_of_mujoco_is_read(tmp_path):
    box = trimesh.creation.box((0.04, 0.06, 0.1))
    body = ms.Body.load(msh(box, tmp_path / "box.msh"), units="m")
    np.testing.assert_allclose(body.mesh.vertices, box.vertices, atol=1e-8)
    np.testing.assert_array_equal(body.mesh.faces, box.faces)
    with pytest.raises(ms.MeshskinError, match="units="):
        ms.Body.load(tmp_path / "box.msh")


@pytest.mark.parametrize("keep", [0, 10, 16, 400])
def test_what_is_no_mesh_of_mujoco_is_refused(tmp_path, keep):
    path = msh(trimesh.creation.box((0.04, 0.06, 0.1)), tmp_path / "box.msh")
    path.write_bytes(path.read_bytes()[:keep])
    with pytest.raises(ms.MeshskinError, match=r"truncated, or not a mesh of MuJoCo.*Gmsh"):
        ms.Body.load(path, units="m")


def test_a_mesh_of_gmsh_is_refused(tmp_path):
    (tmp_path / "mesh.msh").write_text("$MeshFormat\n4.1 0 8\n$EndMeshFormat\n")
    with pytest.raises(ms.MeshskinError, match="export a mesh of Gmsh as STL"):
        ms.Body.load(tmp_path / "mesh.msh", units="m")
