"""The capsules of an arm's links enclose its shapes, meshes included, closely."""

import sys
import xml.etree.ElementTree as ET
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import trimesh

import meshskin as ms
from meshskin.core.errors import ArmError, MeshError
from meshskin.geometry.mesh.link_mesh import find_mesh
from meshskin.robot import collision, link_shapes

from .test_real_arms import urdf

TOY = """<robot name="toy"><link name="base"/>
  <joint name="turn" type="continuous"><parent link="base"/><child link="bar"/><axis xyz="0 0 1"/>
    <origin xyz="0 0 0.2"/></joint>
  <link name="bar"><inertial><mass value="1"/><inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0"
    ixz="0" iyz="0"/></inertial>
    <collision><origin xyz="0.2 0 0" rpy="0 0 0"/><geometry><mesh
      filename="package://toy/meshes/bar.stl" scale="0.001 0.001 0.001"/></geometry></collision>
    <visual><geometry><sphere radius="9"/></geometry></visual></link>
  <joint name="flange" type="fixed"><parent link="bar"/><child link="tool"/>
    <origin xyz="0.4 0 0"/></joint><link name="tool"/></robot>"""


def off(points, capsule):
    """Distances (k,) of points from a capsule's surface, negative inside."""
    way = capsule.end - capsule.start
    part = np.clip((points - capsule.start) @ way / max(way @ way, 1e-30), 0.0, 1.0)
    return np.linalg.norm(points - capsule.start - part[:, None] * way, axis=1) - capsule.radius


@pytest.fixture
def toy(tmp_path):
    """An arm of one bar of 0.4 x 0.1 x 0.1 m, in mm in its file."""
    bar = trimesh.creation.box((400.0, 100.0, 100.0))
    (tmp_path / "toy" / "meshes").mkdir(parents=True)
    bar.export(tmp_path / "toy" / "meshes" / "bar.stl")
    (tmp_path / "toy" / "robots").mkdir()
    path = tmp_path / "toy" / "robots" / "toy.urdf"
    path.write_text(TOY)
    return path


def capsules(text, folders=()):
    link = ET.fromstring(f"<link name='a'><collision>{text}</collision></link>")
    return link_shapes.link_capsules(link, folders)


@pytest.mark.parametrize("seed", range(4))
def test_a_capsule_encloses_its_points_and_touches_them(seed):
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(200, 3)) * [0.3, 0.1, 0.05] @ np.linalg.qr(rng.normal(size=(3, 3)))[0]
    found = link_shapes.enclosing_capsule(points)
    assert off(points, found).max() == pytest.approx(0.0, abs=1e-12)
    box = np.prod(np.sort(np.ptp(points, axis=0)))
    assert found.volume < 2.0 * box


def test_primitives_are_enclosed():
    (ball,), _ = capsules("<origin xyz='1 2 3'/><geometry><sphere radius='0.3'/></geometry>")
    np.testing.assert_array_equal(ball.start, [1.0, 2.0, 3.0])
    assert (ball.start == ball.end).all()
    assert ball.radius == 0.3
    (can,), _ = capsules("<geometry><cylinder radius='0.1' length='0.6'/></geometry>")
    turn = np.linspace(0, 2 * np.pi, 100)
    rim = np.stack([0.1 * np.cos(turn), 0.1 * np.sin(turn), np.full(100, 0.3)], axis=1)
    assert off(np.concatenate([rim, rim * [1, 1, -1]]), can).max() < 1e-12
    assert can.radius == pytest.approx(0.1, rel=0.02)
    (box,), _ = capsules("<geometry><box size='0.6 0.1 0.2'/></geometry>")
    assert box.radius == pytest.approx(0.5 * np.hypot(0.1, 0.2))
    (pill,), _ = capsules("<geometry><capsule radius='0.1' length='0.4'/></geometry>")
    np.testing.assert_allclose([pill.start, pill.end], [[0, 0, -0.2], [0, 0, 0.2]], atol=1e-15)
    assert pill.radius == 0.1
    assert capsules("<geometry><sphere radius='0'/></geometry>") == ([], [])
    found, notes = capsules("<geometry><cone radius='0.1'/></geometry>")
    assert (found, len(notes)) == ([], 1)
    assert "cone" in notes[0]
    with pytest.raises(ArmError, match="bad size"):
        capsules("<geometry><box size='0.6 wide'/></geometry>")


def test_a_mesh_is_found_by_its_package_and_cut_into_slabs(toy):
    arm = ms.Arm.from_urdf(toy, tip="tool")
    found = collision.arm_capsules(arm)
    assert found.notes == ()
    assert found.names == ("base", *["bar"] * 6)
    assert (found.radii[1:] > np.hypot(0.05, 0.05)).all()
    assert (found.radii[1:] < 0.08).all()
    ends = found.at(np.array([[np.pi / 2]]))[0, 1:]
    assert ends[..., 1].min() > 0.0  # turned: along y now
    assert ends[..., 1].max() < 0.4
    np.testing.assert_allclose(ends[..., 2], 0.2, atol=1e-9)
    # the same file by other names, and from elsewhere with the folder given
    elsewhere = toy.parents[2] / "elsewhere.urdf"
    for name in ("file://" + str(toy.parents[1] / "meshes" / "bar.stl"), "meshes/bar.stl"):
        elsewhere.write_text(TOY.replace("package://toy/meshes/bar.stl", name))
        assert not collision.arm_capsules(
            ms.Arm.from_urdf(elsewhere, "tool", [toy.parents[1]])
        ).notes


def test_a_collada_mesh_has_the_capsules_of_the_same_stl(toy):
    pytest.importorskip("collada")
    bar = trimesh.load_mesh(toy.parents[1] / "meshes" / "bar.stl")
    (toy.parents[1] / "meshes" / "bar.dae").write_bytes(trimesh.exchange.dae.export_collada(bar))
    stl = collision.arm_capsules(ms.Arm.from_urdf(toy, tip="tool"))
    toy.write_text(TOY.replace("bar.stl", "bar.dae"))
    found = collision.arm_capsules(ms.Arm.from_urdf(toy, tip="tool"))
    assert found.notes == ()
    np.testing.assert_allclose(found.radii, stl.radii, rtol=1e-5)
    q = np.zeros((1, 1))
    np.testing.assert_allclose(found.at(q), stl.at(q), atol=1e-5)


def test_a_collada_mesh_without_pycollada_gives_a_note(toy, monkeypatch):
    monkeypatch.setitem(sys.modules, "collada", None)
    (toy.parents[1] / "meshes" / "arm.dae").write_text("<COLLADA/>")
    toy.write_text(TOY.replace("bar.stl", "arm.dae").replace("<sphere", "<cone"))
    (note,) = collision.arm_capsules(ms.Arm.from_urdf(toy, tip="tool")).notes
    assert note.startswith("link bar: the mesh 'arm.dae' is a Collada file")
    assert "pip install pycollada" in note


def test_a_scene_file_names_the_folders(toy):
    file = toy.parents[2] / "scene.toml"
    arm = 'urdf = "toy/robots/toy.urdf"\ntip = "tool"\nfolders = ["here", "there"]'
    file.write_text(f'extends = "sphere"\n[arm]\n{arm}\n')
    folders = ms.Scene.load(file).arm.folders
    assert folders[:3] == (
        *(str(toy.parents[2] / name) for name in ("here", "there")),
        str(toy.parent),
    )


def test_a_mesh_that_is_not_there_is_named_in_the_plan(toy, sphere):
    lone = toy.parents[2] / "lone"
    lone.mkdir()
    (lone / "toy.urdf").write_text(TOY.replace("<sphere radius", "<cone radius"))
    arm = replace(ms.Arm.from_urdf(lone / "toy.urdf", tip="tool"), folders=(str(lone),))
    found = collision.arm_capsules(arm)
    assert found.names == ("base", "bar")
    assert found.radii[1] == collision.LINK_RADIUS
    (note,) = found.notes
    assert "link bar: the mesh 'package://toy/meshes/bar.stl'" in note
    assert "folders=" in note
    with pytest.raises(MeshError, match="in none of the folders"):
        find_mesh("package://toy/meshes/none.stl", arm.folders)
    # and the plan of the Puma with that link's mesh says so, too
    elbow = '<link name="link3">'
    assert elbow in sphere.arm.urdf
    shape = '<collision><geometry><mesh filename="elbow.stl"/></geometry></collision>'
    puma = replace(sphere.arm, urdf=sphere.arm.urdf.replace(elbow, elbow + shape))
    plan = ms.explore(
        sphere.body, sphere.skin, arm=puma, mount=sphere.mount_pose, indenter=sphere.indenter
    )
    assert [note.partition(":")[0] for note in plan.notes] == ["link link3", "link link4"]


def test_the_width_of_a_link_counts(toy):
    arm = ms.Arm.from_urdf(toy, tip="tool")
    thin = replace(arm, urdf=TOY.replace("bar.stl", "none.stl").replace("<sphere", "<cone"))
    body, q, far = ms.Body.sphere(0.02), np.zeros((1, 1)), np.eye(4)[None] + 0.0
    far[0, 2, 3] = 5.0
    beside = ms.Indenter(position=(0.2, 0.06, 0.3), support_radius=5e-3, support_height=0.2)
    assert collision.arm_reasons(arm, body, q, far, beside)[0] == collision.ARM_SUPPORT
    assert collision.arm_reasons(thin, body, q, far, beside)[0] == ""
    away = replace(beside, position=(0.2, 0.09, 0.3))
    assert collision.arm_reasons(arm, body, q, far, away)[0] == ""
    near = np.eye(4)[None] + 0.0
    near[0, :3, 3] = [0.1, 0.0, 0.3]  # its lowest point 30 mm over the bar's face
    assert collision.arm_reasons(arm, body, q, near, replace(away, position=(5, 5, 5)))[0] == ""
    near[0, 2, 3] = 0.255
    assert collision.arm_reasons(arm, body, q, near, away)[0] == collision.ARM_BODY
    assert collision.arm_reasons(thin, body, q, near, away)[0] == ""


@pytest.mark.parametrize(
    ("name", "tip"),
    [
        ("ur5_robot.urdf", "tool0"),
        pytest.param("panda.urdf", "panda_hand", marks=pytest.mark.slow),
    ],
)
def test_a_real_arm_agrees_with_coal_on_what_meets_the_support(name, tip):
    """coal's exact distances of the meshes from the column, at random configurations."""
    pin = pytest.importorskip("pinocchio")
    coal = pytest.importorskip("coal")
    arm = ms.Arm.from_urdf(urdf(name), tip=tip)
    assert collision.arm_capsules(arm).notes == ()
    parents = [str(Path(folder)) for folder in arm.folders]
    model = pin.buildModelFromUrdf(str(urdf(name)))
    geometry = pin.buildGeomFromUrdf(model, str(urdf(name)), pin.COLLISION, package_dirs=parents)
    chain = set(collision.arm_capsules(arm).names)
    chosen = [g for g in geometry.geometryObjects if model.frames[g.parentFrame].name in chain]
    assert len(chosen) >= 6
    place = ms.Indenter(position=(0.3, 0.2, 0.5), support_radius=0.01, support_height=0.3)
    low = place.position[2] - place.radius - place.support_height
    column = coal.Cylinder(place.column_radius, place.position[2] - low)
    middle = np.array([*place.position[:2], 0.5 * (place.position[2] + low)])
    data, places = model.createData(), geometry.createData()
    rng, body = np.random.default_rng(0), ms.Body.sphere(0.02)
    q = rng.uniform(np.maximum(arm.lower, -3), np.minimum(arm.upper, 3), (300, len(arm.lower)))
    far = np.eye(4)[None] + 0.0
    far[0, 2, 3] = 9.0
    ours = collision.arm_reasons(arm, body, q, np.repeat(far, len(q), axis=0), place)
    gap = np.empty(len(q))
    for k, one in enumerate(q):
        whole = pin.neutral(model)
        whole[: len(one)] = one
        pin.updateGeometryPlacements(model, data, geometry, places, whole)
        each = []
        for shape in chosen:
            at = places.oMg[geometry.getGeometryId(shape.name)]
            result = coal.DistanceResult()
            each.append(
                coal.distance(
                    shape.geometry, coal.Transform3s(at.rotation, at.translation), column,
                    coal.Transform3s(np.eye(3), middle), coal.DistanceRequest(), result,
                )
            )  # fmt: skip
        gap[k] = min(each)
    assert (ours[gap <= 0.0] == collision.ARM_SUPPORT).all()
    assert (gap <= 0.0).sum() > 5
    said = gap[ours != ""]
    assert said.max() < 0.06  # capsules stand out by up to so much
    assert np.median(np.maximum(said, 0.0)) < 0.02
