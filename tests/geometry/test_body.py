"""Bodies: what is loaded, what is repaired, what is refused, and rays."""

import subprocess
import sys
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from meshskin.core.errors import MeshError
from meshskin.geometry import primitives
from meshskin.geometry.body import FACES, Body

from ..real_data import DATA, needs_ur3e

CORNERS = np.eye(3)
"""vertices of one triangle"""


@pytest.fixture
def ball():
    return trimesh.creation.icosphere(subdivisions=3, radius=100.0)  # in mm


@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "off"])
def test_formats_without_units_need_them(ball, tmp_path, suffix):
    path = tmp_path / f"ball.{suffix}"
    ball.export(path)
    body = Body.load(path, units="mm")
    assert body.name == "ball"
    assert body.mesh.is_watertight
    np.testing.assert_allclose(np.linalg.norm(body.surface.vertices, axis=1), 0.1, rtol=1e-6)
    with pytest.raises(MeshError, match="the file has no length unit"):
        Body.load(path)


def test_glb_is_in_metres(ball, tmp_path):
    ball.apply_scale(1e-3)
    ball.export(tmp_path / "ball.glb")
    body = Body.load(tmp_path / "ball.glb")
    np.testing.assert_allclose(body.surface.scale, 0.2, rtol=1e-3)


def test_a_mesh_in_memory_is_checked_like_a_file(ball, tmp_path):
    ball.export(tmp_path / "ball.stl")
    loaded, made = Body.load(tmp_path / "ball.stl", units="mm"), Body.from_mesh(ball, "mm", "ball")
    assert (made.name, len(made.mesh.faces)) == (loaded.name, len(loaded.mesh.faces))
    outside = [[0.0, 0.02, 0.15]]
    np.testing.assert_allclose(
        made.closest(outside).distance, loaded.closest(outside).distance, rtol=1e-6
    )
    inverted = SimpleNamespace(vertices=ball.vertices, faces=np.asarray(ball.faces)[:, ::-1])
    assert Body.from_mesh(inverted, "mm").mesh.volume > 0


@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        ("ball.stl", "a mesh needs vertices and faces, got 'ball.stl'"),
        (
            SimpleNamespace(vertices=np.eye(3), faces=[[0, 1, 3]]),
            "got 3, limit: integers from 0 to 2",
        ),
        (SimpleNamespace(vertices=np.eye(3), faces=[[0, 1, 0.5]]), "got 0.5, limit: integers"),
        (SimpleNamespace(vertices=np.eye(3), faces=np.zeros((0, 3))), "the mesh has no faces"),
        (
            SimpleNamespace(vertices=np.eye(4), faces=[[0, 1, 2]]),
            r"shape \(4, 4\), limit: \(n, 3\)",
        ),
    ],
)
def test_a_mesh_in_memory_is_refused(mesh, message):
    with pytest.raises(MeshError, match=message):
        Body.from_mesh(mesh)


@pytest.mark.parametrize(("units", "scale"), [("cm", 1.0), ("in", 2.54)])
def test_units(ball, tmp_path, units, scale):
    ball.apply_scale(0.1)  # 10 units of radius
    ball.export(tmp_path / "ball.ply")
    body = Body.load(tmp_path / "ball.ply", units=units)
    np.testing.assert_allclose(body.surface.scale, 0.2 * scale, rtol=1e-3)


def test_an_unknown_unit_is_refused(ball, tmp_path):
    ball.export(tmp_path / "ball.stl")
    with pytest.raises(MeshError, match="unknown units of a mesh, got 'furlong'"):
        Body.load(tmp_path / "ball.stl", units="furlong")


def test_the_likely_unit_is_named(ball, tmp_path):
    ball.export(tmp_path / "ball.stl")
    with pytest.raises(MeshError, match=r"200 m, .*likely millimetres: units='mm'.*radius_mm"):
        Body.load(tmp_path / "ball.stl", units="m")
    ball.apply_scale(1e-3)
    ball.export(tmp_path / "small.stl")
    with pytest.raises(MeshError, match=r"0.0002 m, .*units='m'"):
        Body.load(tmp_path / "small.stl", units="mm")


def test_a_torn_stl_is_named(ball, tmp_path):
    whole = ball.export(file_type="stl")
    (tmp_path / "torn.stl").write_bytes(whole[:20_000])
    limit = rf"is truncated, or not an STL file, got 20000 bytes, limit: {len(whole)} by its header"
    with pytest.raises(MeshError, match=limit):
        Body.load(tmp_path / "torn.stl", units="mm")
    (tmp_path / "text.stl").write_text("no mesh")
    with pytest.raises(MeshError, match="got 7 bytes, limit: a header of 84"):
        Body.load(tmp_path / "text.stl", units="mm")


@pytest.mark.parametrize("suffix", ["stl", "off"])
def test_text_in_another_encoding(ball, tmp_path, monkeypatch, suffix):
    monkeypatch.setitem(sys.modules, "charset_normalizer", None)  # which trimesh would ask for
    text = ball.export(file_type="stl_ascii" if suffix == "stl" else "off")
    first, rest = text.split("\n", 1)
    title = "solid Träger" if suffix == "stl" else f"{first}\n# Träger"
    (tmp_path / f"a.{suffix}").write_bytes(f"{title}\n{rest}".encode("latin-1"))
    body = Body.load(tmp_path / f"a.{suffix}", units="mm")
    assert len(body.mesh.faces) == len(ball.faces)


def test_a_faceless_or_missing_file_is_refused(tmp_path):
    (tmp_path / "points.ply").write_text(
        "ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
        "property float z\nend_header\n0 0 0\n"
    )
    with pytest.raises(MeshError, match="no faces"):
        Body.load(tmp_path / "points.ply", units="m")
    with pytest.raises(MeshError, match="the mesh file does not exist"):
        Body.load(tmp_path / "nowhere.stl", units="m")
    with pytest.raises(MeshError, match="unknown format of a mesh"):
        Body.load(tmp_path / "points.step", units="m")


@pytest.mark.parametrize("path", [None, 3, b"ball.stl"])
def test_a_path_of_another_type_is_refused(path):
    with pytest.raises(MeshError, match="a mesh file must be a path, got"):
        Body.load(path, units="mm")


@pytest.mark.parametrize(
    "make",
    [
        lambda: Body.sphere(-0.1),
        lambda: Body.sphere(float("nan")),
        lambda: Body.ellipsoid((0.1, 0.0, 0.1)),
        lambda: Body.capsule(0.05, -1.0),
        lambda: Body.cylinder(0.0, 0.1),
        lambda: Body.torus(0.1, -0.02),
        lambda: Body.torus(0.04, 0.05),
    ],
)
def test_impossible_primitives_are_refused(make):
    with pytest.raises(MeshError):
        make()


def test_a_sphere_of_100_metres_is_refused_with_the_likely_unit():
    with pytest.raises(MeshError, match=r"200 m.*likely millimetres"):
        Body.sphere(100.0)
    with pytest.raises(MeshError, match="largest extent"):
        Body.sphere(1e-4)


def test_documented_default_of_faces():
    assert len(Body.sphere().mesh.faces) == FACES == 5120


@pytest.mark.parametrize(
    "body",
    [
        Body.sphere(),
        Body.ellipsoid((0.1, 0.07, 0.05)),
        Body.capsule(0.05, 0.2),
        Body.cylinder(0.05, 0.2),
        Body.cylinder(0.05, 0.004, faces=300),
        Body.capsule(0.05, 0.013, faces=900),
        Body.torus(0.1, 0.04),
        Body.torus(0.1, 0.04, faces=777),
    ],
)
def test_primitives_are_closed_and_outward(body):
    assert body.mesh.is_watertight
    assert body.mesh.is_winding_consistent
    assert body.mesh.volume > 0
    np.testing.assert_allclose(body.exact.closest(body.surface.vertices).distance, 0, atol=1e-12)


@pytest.mark.parametrize(
    "body",
    [
        Body.sphere(0.08),
        Body.ellipsoid((0.1, 0.07, 0.05)),
        Body.capsule(0.05, 0.2),
        Body.cylinder(0.04, 0.1),
        Body.torus(0.1, 0.04),
    ],
)
def test_a_primitive_is_meshed_anew(body):
    fine = replace(body, degree=2).remeshed(20_480)
    assert len(fine.mesh.faces) == pytest.approx(20_480, rel=0.3)
    assert fine.exact == body.exact
    assert fine.degree == 2
    assert fine.facets is fine.remeshed(320).facets
    assert fine.robot_mesh is not None
    assert fine == replace(fine, robot_mesh=body.mesh)


def test_a_mesh_of_its_own_is_not_meshed_anew(ball, tmp_path):
    ball.export(tmp_path / "ball.stl")
    with pytest.raises(MeshError, match="not a primitive"):
        Body.load(tmp_path / "ball.stl", units="mm").remeshed(320)


def test_rays_hit_the_smooth_surface():
    body = Body.ellipsoid((0.1, 0.07, 0.05))
    rng = np.random.default_rng(0)
    on = body.exact.closest(rng.normal(size=(500, 3)))
    oblique = -on.normal + 0.5 * rng.uniform(-1, 1, size=(500, 3))
    oblique /= np.linalg.norm(oblique, axis=1, keepdims=True)
    hit = body.project(on.point - 0.02 * oblique, 3.0 * oblique)
    np.testing.assert_allclose(hit.point, on.point, atol=3e-7)
    np.testing.assert_allclose(hit.distance, 0.02, atol=3e-7)


def test_a_ray_that_misses_says_so():
    hit = Body.sphere().project([[0, 0, 1.0], [0, 0, 1.0]], [[0, 0, -1.0], [1.0, 0, 0]])
    assert hit.face[0] >= 0
    assert hit.face[1] == -1
    np.testing.assert_allclose(hit.point[0], [0, 0, 0.1], atol=1e-8)
    assert np.isnan(hit.point[1]).all()
    with pytest.raises(MeshError, match="ray"):
        Body.sphere().project([[0, 0, 1.0]], [[0, 0, 0.0]])


@needs_ur3e
@pytest.mark.parametrize("name", ["forearm", "wrist3", "shoulder"])
def test_a_real_link_answers_near_its_flat_mesh(name):
    """Creased, coarse CAD meshes: finite answers, within the facets' sag of the flat answer."""
    body = Body.load(DATA / "ur3e_meshes" / f"{name}.stl", units="m")
    rng = np.random.default_rng(0)
    points = body.mesh.triangles_center + 3e-3 * rng.normal(size=(len(body.mesh.faces), 3))
    hit = body.closest(points)
    for values in (hit.point, hit.distance, hit.normal, hit.curvature):
        assert np.isfinite(values).all()
    in_mm = body.mesh.copy()
    in_mm.apply_scale(1e3)
    flat = trimesh.proximity.closest_point(in_mm, 1e3 * points)[1] * 1e-3
    assert np.abs(np.abs(hit.distance) - flat).max() < 5e-3
    assert np.median(np.abs(np.abs(hit.distance) - flat)) < 0.1e-3


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("version.glb", b"glTF" + bytes(50), "version.glb cannot be read"),
        ("short.obj", b"v 1 2\nf 1 2 3\n", "line 1: a vertex needs three coordinates"),
        ("torn.ply", b"ply\nformat ascii 1.0\nelement vertex 3\n", "torn.ply"),
    ],
)
def test_damaged_files_are_one_line(tmp_path, name, content, message):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(MeshError, match=message) as caught:
        Body.load(tmp_path / name, units="mm")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("level", range(4))
def test_the_mesh_of_a_sphere_is_the_icosphere_of_trimesh(level):
    vertices, faces = primitives.sphere_mesh(20 * 4**level)
    oracle = trimesh.creation.icosphere(subdivisions=level)
    assert np.array_equal(faces, oracle.faces)
    assert vertices == pytest.approx(np.asarray(oracle.vertices), abs=1e-15)


@pytest.mark.deep
def test_a_body_is_used_without_imports_that_take_long():
    code = """
import sys, meshskin as ms
body, case = ms.Body.sphere(0.1), dict(force=3.0, curvature=(10.0, 9.0), indenter_radius=0.01)
body.closest([[0, 0, 0.2]])
ms.contact.solve(model="elliptic", modulus=2e5, poisson=0.49, **case)
assert not {"trimesh", "scipy.optimize"} & set(sys.modules)
assert body.mesh.volume > 4.1e-3 and type(body.mesh) is sys.modules["trimesh"].Trimesh
"""
    subprocess.run([sys.executable, "-c", code], check=True)
