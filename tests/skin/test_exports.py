"""Skin files as the programs read them that they are for."""

import numpy as np
import pytest

from meshskin.core import se3
from meshskin.core.errors import SkinError
from meshskin.geometry.body import Body
from meshskin.geometry.region import Cap
from meshskin.skin.skin import Skin


@pytest.fixture(scope="module")
def skin():
    return Skin.cover(
        Body.sphere(), spacing=5e-3, count=12, region=Cap((0.0, 0.6, 0.8)), disc_radius=1.5e-3
    )


def test_mujoco_places_the_sites_and_senses_a_touch(skin, tmp_path):
    mujoco = pytest.importorskip("mujoco")
    skin.save(tmp_path / "ball.xml")
    spec = mujoco.MjSpec.from_file(str(tmp_path / "ball.xml"))
    spec.body("ball").add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.1, 0, 0])
    pressed = 3  # a small ball falls on this taxel, along its normal
    position, normal = skin.positions[pressed], skin.normals[pressed]
    probe = spec.worldbody.add_body(pos=position + 9.9e-3 * normal)
    probe.add_joint(type=mujoco.mjtJoint.mjJNT_SLIDE, axis=normal)
    probe.add_geom(type=mujoco.mjtGeom.mjGEOM_SPHERE, size=[0.01, 0, 0], mass=0.1)
    spec.option.gravity = -9.81 * normal
    model = spec.compile()
    data = mujoco.MjData(model)
    for _ in range(500):
        mujoco.mj_step(model, data)
    names = [f"ball_skin_{taxel}" for taxel in skin.ids]
    placed = np.array([data.site(name).xpos for name in names])
    turned = np.array([data.site(name).xmat.reshape(3, 3) for name in names])
    np.testing.assert_allclose(placed, skin.positions, atol=1e-12)
    np.testing.assert_allclose(turned, skin.poses[:, :3, :3], atol=1e-12)
    force = np.array([data.sensor(name).data[0] for name in names])
    assert force.argmax() == pressed
    assert force[pressed] == pytest.approx(0.981, rel=0.02)
    assert np.delete(force, pressed).max() == 0


@pytest.mark.parametrize("kind", ["urdf", "urdf_tactile"])
def test_pinocchio_reads_the_urdf(skin, tmp_path, kind):
    pin = pytest.importorskip("pinocchio")
    path = tmp_path / "arm.urdf"
    skin.save(path, format=kind)
    model = pin.buildModelFromUrdf(str(path))
    assert model.existFrame("arm")
    if kind == "urdf":
        data = model.createData()
        pin.framesForwardKinematics(model, data, pin.neutral(model))
        for taxel, pose in zip(skin.ids, skin.poses, strict=True):
            placed = data.oMf[model.getFrameId(f"arm_skin_{taxel}")].homogeneous
            np.testing.assert_allclose(placed, pose, atol=1e-12)


def test_yourdfpy_reads_the_urdf(skin, tmp_path):
    yourdfpy = pytest.importorskip("yourdfpy")
    skin.save(tmp_path / "arm.urdf")
    robot = yourdfpy.URDF.load(str(tmp_path / "arm.urdf"), load_meshes=False)
    for taxel, pose in zip(skin.ids, skin.poses, strict=True):
        placed = robot.get_transform(f"arm_skin_{taxel}", "arm")
        np.testing.assert_allclose(placed, pose, atol=1e-12)


def test_a_tactile_sensor_has_what_its_parser_asks_for(skin, tmp_path):
    """The attributes that the parser of urdf_tactile refuses to miss."""
    from xml.etree import ElementTree

    skin.save(tmp_path / "arm.urdf", format="urdf_tactile")
    sensor = ElementTree.parse(tmp_path / "arm.urdf").getroot().find("sensor")
    assert sensor.get("name")
    assert sensor.find("parent").get("link") == "arm"
    assert sensor.find("tactile").get("channel") == "arm"
    taxels = sensor.findall("tactile/taxel")
    assert [int(taxel.get("idx")) for taxel in taxels] == skin.ids.tolist()
    assert all(float(taxel.find("geometry/cylinder").get("radius")) == 1.5e-3 for taxel in taxels)


def test_a_mounted_tactile_sensor_is_read_in_the_frame_of_its_link(tmp_path):
    path = tmp_path / "hand.urdf"
    path.write_text(
        '<robot name="r"><link name="palm"/><sensor name="s" update_rate="100">'
        '<parent link="palm"/><origin xyz="0 0 0.1" rpy="0 1.5707963267948966 0"/>'
        '<tactile channel="c"><taxel idx="7" xyz="0.01 0 0" rpy="0 0 0"/></tactile>'
        "</sensor></robot>"
    )
    skin = Skin.load(path)
    assert skin.ids.tolist() == [7]
    np.testing.assert_allclose(skin.positions, [[0, 0, 0.09]], atol=1e-15)
    np.testing.assert_allclose(skin.normals, [[1, 0, 0]], atol=1e-15)


def test_static_transforms_are_yaml(skin, tmp_path):
    yaml = pytest.importorskip("yaml")
    skin.save(tmp_path / "arm.yaml")
    message = yaml.safe_load((tmp_path / "arm.yaml").read_text())
    for taxel, pose, sent in zip(skin.ids, skin.poses, message["transforms"], strict=True):
        assert sent["header"] == {"frame_id": "arm"}
        assert sent["child_frame_id"] == f"arm_skin_{taxel}"
        at, turn = sent["transform"]["translation"], sent["transform"]["rotation"]
        assert [at[k] for k in "xyz"] == pose[:3, 3].tolist()
        np.testing.assert_allclose(
            [turn[k] for k in "xyzw"], se3.quaternion(pose[:3, :3]), atol=1e-15
        )


def test_an_archive_has_poses_and_a_pixel_for_each_taxel(skin, tmp_path):
    skin.save(tmp_path / "arm.npz")
    with np.load(tmp_path / "arm.npz") as archive:
        np.testing.assert_array_equal(archive["poses"], skin.poses[:, :3])
        np.testing.assert_array_equal(archive["poses"][:, :, 2], skin.normals)
        pixels = archive["taxel2pixel"]
    assert np.issubdtype(pixels.dtype, np.integer)
    assert pixels.min() >= 0
    assert len(np.unique(pixels, axis=0)) == len(skin)


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("a.npz", b"PK\x03\x04", "not a NumPy archive"),
        ("a.yaml", b"transforms:\n- {}\n", "line 2"),
        ("a.yaml", b"transforms:\n", "no transforms"),
        ("a.xml", b"<mujoco><worldbody/></mujoco>", "no skin"),
        ("a.xml", b'<mujoco><site name="a_skin_1" euler="0 0 1"/></mujoco>', "euler"),
        (
            "a.urdf",
            b'<robot><sensor><parent link="l"/><tactile><taxel idx="x"/></tactile></sensor>'
            b"</robot>",
            "taxel 'x'",
        ),
    ],
)
def test_damaged_files_are_refused_in_one_line(tmp_path, name, content, words):
    (tmp_path / name).write_bytes(content)
    with pytest.raises(SkinError, match=words):
        Skin.load(tmp_path / name)
