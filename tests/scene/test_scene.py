"""Scenes: fields, default mount, budget, and the files that they are loaded from."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import meshskin as ms
from meshskin.core.errors import ConfigError, SkinError, UnknownNameError
from meshskin.geometry.region import Cap


def test_a_misspelt_field_names_the_known_ones(sphere):
    with pytest.raises(UnknownNameError, match="unknown field 'indentor' of a Scene; did you mean"):
        ms.Scene(body=sphere.body, skin=sphere.skin, indentor=sphere.indenter)
    with pytest.raises(UnknownNameError, match="unknown field 'paylod' of a scene"):
        sphere.with_(paylod=1.0)


def test_the_default_mount_turns_the_skin_outward_along_the_tip(sphere):
    pose = sphere.with_(mount=None).mount_pose
    np.testing.assert_allclose(pose[:3, :3] @ sphere.axis, [0.0, 0.0, 1.0], atol=1e-12)
    np.testing.assert_allclose(np.linalg.det(pose[:3, :3]), 1.0)
    lowest = (sphere.body.mesh.vertices @ pose[:3, :3].T + pose[:3, 3])[:, 2].min()
    assert lowest == pytest.approx(0.02)


def test_a_skin_all_round_a_body_has_no_default_mount_on_an_arm():
    body = ms.Body.sphere(0.05)
    scene = ms.Scene(body=body, skin=ms.Skin.cover(body, spacing=12e-3))
    with pytest.raises(ConfigError, match=r"all round its body .* give mount=T_tip_body"):
        _ = scene.mount_pose
    np.testing.assert_array_equal(scene.axis, [0.0, 0.0, 1.0])
    assert np.isfinite(scene.with_(loop=replace(scene.loop, mode="quasi_static")).mount_pose).all()
    given = np.eye(4)
    np.testing.assert_array_equal(scene.with_(mount=given).mount_pose, given)


@pytest.mark.parametrize(
    "mount", [np.eye(3), np.diag([1.0, 1.0, -1.0, 1.0]), np.full((4, 4), np.nan)]
)
def test_a_mount_must_be_rigid(sphere, mount):
    with pytest.raises(ConfigError, match="must be a rigid transform T_tip_body"):
        sphere.with_(mount=mount)


def test_a_body_or_skin_table_that_is_missing_is_named(tmp_path):
    file = tmp_path / "bare.toml"
    file.write_text("[skin]\ncount = 3\n")
    with pytest.raises(ConfigError, match=r"the table \[body\] is missing in bare; add \[body\]"):
        ms.Scene.load(file)


def test_a_body_of_another_shape_replaces_that_of_the_parent(tmp_path):
    file = tmp_path / "tube.toml"
    file.write_text(
        'extends = "sphere"\n[body]\nshape = "capsule"\nradius_mm = 60\nlength_mm = 100\n'
        "[skin]\ncount = 10\nspacing_mm = 6\ndirection = [1, 0, 0]\nangle_deg = 30\n"
    )
    scene = ms.Scene.load(file)
    assert scene.name == "tube"
    assert np.ptp(scene.body.mesh.bounds[:, 2]) == pytest.approx(0.22)
    assert scene.axis[0] > 0.9


def test_relative_paths_start_from_the_file_they_are_written_in(tmp_path):
    base, child = tmp_path / "base", tmp_path / "made" / "child"
    for folder in (base / "parts", child):
        folder.mkdir(parents=True)
    trimesh.creation.icosphere(subdivisions=3, radius=50.0).export(base / "parts" / "ball.stl")
    (base / "ball.toml").write_text(
        '[body]\nmesh = "parts/ball.stl"\nunits = "mm"\n[skin]\ncount = 10\nspacing_mm = 6\n'
        '[arm]\nurdf = "puma560.urdf"\n'
    )
    (tmp_path / "made" / "softer.toml").write_text(
        'extends = "../base/ball.toml"\n[material]\nyoung_kpa = 300\n'
    )
    (child / "own.toml").write_text('extends = "../softer"\n[material]\npoisson = 0.4\n')
    scene = ms.Scene.load(child / "own.toml")
    assert np.ptp(scene.body.mesh.bounds[:, 2]) == pytest.approx(0.1, rel=0.01)
    assert (scene.material.young, scene.material.poisson) == (300e3, 0.4)


def test_effects_may_come_from_any_iterable(sphere):
    noise = ms.effects.find("gaussian_noise")(sigma_relative=0.01)
    scene = sphere.with_(effects=(effect for effect in [noise]))
    assert scene.effects == (noise,)
    assert scene.belief().noise_sigma > 0.0


def test_an_unknown_contact_model_is_refused_at_once(sphere):
    with pytest.raises(UnknownNameError, match="did you mean hertz"):
        sphere.with_(contact="hertzz")


def test_the_angle_of_a_skin_needs_a_direction(tmp_path):
    text = '[body]\nshape = "sphere"\nradius_mm = 100\n[skin]\nspacing_mm = 20\nangle_deg = 30\n'
    (tmp_path / "a.toml").write_text(text)
    with pytest.raises(ConfigError, match="needs the direction"):
        ms.Scene.load(tmp_path / "a.toml")


def test_a_cap_has_an_angle_in_radians():
    with pytest.raises(ConfigError, match=r"got 30 rad, limit: at most 3\.14"):
        Cap((0.0, 0.0, 1.0), 30.0)


def test_a_file_that_an_extended_scene_lacks_is_sought_beside_that_scene(tmp_path):
    (tmp_path / "sub").mkdir()
    parent = 'extends = "sphere"\n[skin]\nfile = "taxels.csv"\n'
    (tmp_path / "sub" / "parent.toml").write_text(parent)
    (tmp_path / "child.toml").write_text('extends = "sub/parent"\n')
    with pytest.raises(SkinError, match=r"sub.taxels\.csv"):
        ms.Scene.load(tmp_path / "child.toml")
