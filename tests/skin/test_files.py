"""Skin files: contents of each format, round trips, refusals; real files if they are present."""

from dataclasses import replace

import numpy as np
import pytest

from meshskin.core import se3
from meshskin.core.errors import SkinError
from meshskin.geometry.body import Body
from meshskin.geometry.region import Cap
from meshskin.skin import files, slots
from meshskin.skin.files import icub, icub_layout
from meshskin.skin.skin import Skin

from ..real_data import DATA, needs_skin

ICUB = sorted(DATA.glob("icub_skin/*/*"))
FORMATS = ("csv", "txt", "urdf", "ply", "glb", "urdf_tactile", "xml", "npz", "yaml")
HANDS = {"left_hand_R1.ini", "left_hand_V2.ini", "left_hand_V2_1.ini", "left_hand_V2_2.ini"}


@pytest.fixture(scope="module")
def skin():
    return Skin.cover(
        Body.sphere(), spacing=5e-3, count=40, region=Cap((0.0, 0.6, 0.8)), disc_radius=1.5e-3
    )


def modular(modules=(2, 5)):
    """A flat skin of modules of ten taxels, 20 mm apart."""
    ids = np.concatenate([12 * m + np.array(slots.TAXELS) for m in modules])
    flat = np.concatenate([slots.OFFSETS[list(slots.TAXELS)] + [0.02 * m, 0, 0] for m in modules])
    return Skin(se3.transform(np.eye(3), flat), ids)


def assert_same(a, b, atol=1e-13):
    np.testing.assert_array_equal(a.ids, b.ids)
    np.testing.assert_allclose(a.positions, b.positions, rtol=0, atol=atol)
    np.testing.assert_allclose(a.normals, b.normals, rtol=0, atol=atol)


@pytest.mark.parametrize(
    "kind", ["csv", "urdf", "ply", "glb", "urdf_tactile", "mjcf", "npz", "yaml"]
)
def test_frames_are_read_back_whatever_the_suffix(skin, tmp_path, kind):
    skin.save(tmp_path / "skin.dat", format=kind)
    loaded = Skin.load(tmp_path / "skin.dat")
    np.testing.assert_array_equal(loaded.positions, skin.positions)
    np.testing.assert_allclose(loaded.poses, skin.poses, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(loaded.ids, skin.ids)
    assert loaded.disc_radius == 1.5e-3


KINDS = ("csv", "icub", "urdf", "urdf_tactile", "mjcf", "npz", "yaml", "ply", "glb")


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("ids", [(-3, 0, 2**40), (5, 0, 2**31 - 1), (2**60 + 1, 2**60, 3)])
def test_ids_are_read_back_or_refused(tmp_path, kind, ids):
    pose = se3.transform(np.eye(3), np.arange(9.0).reshape(3, 3))
    skin, path = Skin(pose, np.array(ids)), tmp_path / "skin.dat"
    if kind == "icub" or (kind == "urdf_tactile" and min(ids) < 0):
        with pytest.raises(SkinError, match=r"does not fit a .* file.*write another format"):
            skin.save(path, kind)
        assert not path.exists()
        return
    skin.save(path, kind)
    read = Skin.load(path)
    order = np.argsort(ids) if kind == "glb" else [0, 1, 2]
    np.testing.assert_array_equal(read.ids, np.array(ids)[order])
    np.testing.assert_array_equal(read.positions, skin.positions[order])
    if kind == "npz":
        with np.load(path) as archive:
            assert archive["taxel2pixel"].min() >= 0


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("frame", ["l'arm", 'a<b> & "c"', "left_skin_3", "Ärmel, frame=x"])
def test_the_frame_is_read_back(skin, tmp_path, kind, frame):
    skin.save(tmp_path / "skin.dat", kind, link=frame)
    read = Skin.load(tmp_path / "skin.dat")
    assert read.frame == frame
    if kind != "icub":  # which has no radius
        assert read.disc_radius == 1.5e-3


@pytest.mark.parametrize("frame", ["two\nlines", " palm", "tab\t", "\x00"])
def test_names_that_files_cannot_hold_are_refused(skin, tmp_path, frame):
    for rows in ({"link": frame}, {"link": "palm", "parent": frame}):
        with pytest.raises(SkinError, match="name of a frame must be printable"):
            skin.save(tmp_path / "skin.urdf", **rows)
    assert not (tmp_path / "skin.urdf").exists()


def test_a_skin_without_taxels_is_not_written(skin, tmp_path):
    for kind in KINDS:
        with pytest.raises(SkinError, match="without taxels"):
            Skin(skin.poses[:0], skin.ids[:0]).save(tmp_path / "skin.dat", kind)


def test_a_part_of_a_file_of_one_skin_is_refused(skin, tmp_path):
    skin.save(tmp_path / "skin.csv")
    with pytest.raises(SkinError, match=r"skin.csv holds one skin, got part 'palm'.*leave part="):
        Skin.load(tmp_path / "skin.csv", "palm")


def test_a_position_file_keeps_positions_and_normals(skin, tmp_path):
    skin.save(tmp_path / "left_arm.txt")
    assert_same(Skin.load(tmp_path / "left_arm.txt"), skin, atol=0.7e-9)
    text = (tmp_path / "left_arm.txt").read_text()
    assert text.splitlines()[0] == "name\tleft_arm"
    file = icub.read(text, "left_arm.txt")
    np.testing.assert_array_equal(file.representative[:40], np.arange(40))


def test_a_taxel_without_a_position_is_in_no_position_file(skin, tmp_path):
    poses = skin.poses.copy()
    poses[3, :3, 3] = np.nan
    with pytest.raises(SkinError, match=f"no position, got taxel {skin.ids[3]}"):
        Skin(poses, skin.ids).save(tmp_path / "left_arm.txt")


def test_a_scene_file_without_any_sigma_is_read_back(skin, tmp_path):
    unknown = Skin(skin.poses, skin.ids, sigmas=np.full(len(skin), np.nan))
    unknown.save(tmp_path / "skin.glb")
    np.testing.assert_array_equal(Skin.load(tmp_path / "skin.glb").ids, skin.ids)


def test_a_position_file_of_modules_names_thermal_pads_and_empty_modules(tmp_path):
    skin = modular()
    skin.save(tmp_path / "arm.txt")
    file = icub.read((tmp_path / "arm.txt").read_text(), "arm.txt")
    assert file.slots == 72
    listed = file.representative.reshape(6, 12)
    assert np.all(listed[[0, 1, 3, 4]] == -1)
    assert listed[5].tolist() == [63] * 6 + [-2] + [63] * 3 + [-2, 63]
    assert_same(Skin.load(tmp_path / "arm.txt"), skin, atol=0.7e-9)


def test_rows_that_are_not_taxels_are_skipped(tmp_path):
    path = tmp_path / "arm.txt"
    modular().save(path)
    lines = path.read_text().splitlines()
    lines[4 + 24 + 6] = "0.1 0.1 0.1 0 0 1"  # the thermal pad of module 2
    path.write_text("\n".join(lines))
    assert files.read(path).is_thermal().sum() == 1
    assert_same(Skin.load(path), modular(), atol=0.7e-9)


def test_rows_without_header_are_modules_if_they_fit(tmp_path):
    skin = modular((0, 1))
    rows = np.column_stack([skin.positions, skin.normals])
    np.savetxt(tmp_path / "foot.txt", rows, fmt="%.6f")
    np.testing.assert_array_equal(Skin.load(tmp_path / "foot.txt").ids, skin.ids)
    np.savetxt(tmp_path / "foot.txt", rows[::-1], fmt="%.6f")
    np.testing.assert_array_equal(Skin.load(tmp_path / "foot.txt").ids, np.arange(20))


def test_taxels_without_normal_are_nan_until_a_body_gives_them(tmp_path):
    ball = Body.sphere()
    skin = Skin.cover(ball, spacing=5e-3, count=30)
    rows = np.column_stack([skin.positions, 0 * skin.normals])
    np.savetxt(tmp_path / "bare.txt", rows, header="x", comments="#", fmt="%.6f")
    bare = Skin.load(tmp_path / "bare.txt")
    assert np.isnan(bare.normals).all()
    with pytest.raises(SkinError, match=r"without a normal.*got 30.*onto"):
        bare.save(tmp_path / "bare.csv")
    bare.save(tmp_path / "again.txt")
    assert np.isnan(Skin.load(tmp_path / "again.txt").normals).all()
    placed = bare.onto(ball)
    np.testing.assert_allclose(placed.normals, skin.normals, atol=2e-5)
    np.testing.assert_allclose(placed.positions, skin.positions, atol=1e-6)


def test_a_skin_put_on_a_body_keeps_its_spins():
    """Positions 2 mm off and normals 20 degrees off are corrected by shortest rotations."""
    ball = Body.sphere()
    skin = Skin.cover(ball, spacing=5e-3, count=60)
    rng = np.random.default_rng(0)
    axes = rng.normal(size=(60, 3))
    axes -= np.sum(axes * skin.normals, axis=1, keepdims=True) * skin.normals
    axes *= np.radians(20) / np.linalg.norm(axes, axis=1, keepdims=True)
    tilt = np.array([se3.exp_so3(a) for a in axes])
    spin = np.array([se3.exp_so3(a * n) for a, n in zip(rng.normal(size=60), skin.normals,
                                                        strict=True)])  # fmt: skip
    spun = spin @ skin.poses[:, :3, :3]
    tilted = se3.transform(tilt @ spun, skin.positions + 2e-3 * skin.normals)
    placed = replace(skin, poses=tilted).onto(ball)
    np.testing.assert_allclose(placed.positions, skin.positions, atol=1e-7)
    np.testing.assert_allclose(placed.poses[:, :3, :3], spun, atol=1e-5)  # undone by the shortest


def test_a_frame_with_opposite_normal_is_set_anew():
    ball = Body.sphere()
    skin = Skin.cover(ball, spacing=5e-3, count=10)
    inward = skin.poses.copy()
    inward[:, :3, 1:3] *= -1
    placed = replace(skin, poses=inward).onto(ball)
    np.testing.assert_allclose(placed.normals, skin.normals, atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(placed.poses[:, :3, :3]), 1.0)


def test_a_position_file_in_millimetres_with_constant_normals_is_put_on_a_body(tmp_path):
    ball = Body.sphere()
    skin = Skin.cover(ball, spacing=5e-3, count=30)
    rows = np.column_stack([1e3 * skin.positions, np.tile([1.0, 0.0, 0.0], (30, 1))])
    np.savetxt(tmp_path / "mm.txt", rows, header="x", comments="#", fmt="%.6f")
    with pytest.raises(
        SkinError, match=r"taxel \d+ is too far from the surface of sphere.*units='mm'"
    ):
        Skin.load(tmp_path / "mm.txt").onto(ball)
    with pytest.raises(SkinError, match="unknown unit, got 'km'"):
        Skin.load(tmp_path / "mm.txt", units="km")
    placed = Skin.load(tmp_path / "mm.txt", units="mm").onto(ball)
    np.testing.assert_allclose(placed.normals, skin.normals, atol=1e-6)
    np.testing.assert_allclose(placed.positions, skin.positions, atol=1e-8)


@pytest.mark.deep
@needs_skin
def test_a_real_skin_with_constant_normals_is_put_on_its_real_link():
    """The shank's file, in the link's frame, lies within millimetres of the link's mesh."""
    mesh = DATA / "icub_body/meshes/sim_sea_2-5_l_shank_prt-binary.stl"
    body = Body.load(mesh, units="mm", open=True)
    skin = Skin.load(DATA / "icub_skin/positions/left_leg_lower.txt")
    assert np.ptp(skin.normals, axis=0).max() == 0
    with pytest.raises(SkinError, match="the skin in the body's frame"):
        skin.onto(body)
    turn = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    T_link_mesh = se3.transform(turn, [0.0437090614, -0.0701002480, 0.386638])  # of the URDF
    there = skin.moved(se3.inverse(T_link_mesh))
    assert np.median(np.abs(body.closest(there.positions).distance)) < 1e-3
    placed = there.onto(body)
    assert_on_surface(placed, body)
    assert np.median(np.sum(placed.normals * there.normals, axis=1)) < 0.95  # not the file's


@needs_skin
def test_a_real_skin_without_normals_is_put_on_its_real_link():
    mesh = DATA / "icub_body/meshes/sim_sea_2-5_l_forearm_prt-binary.stl"
    body = Body.load(mesh, units="mm", open=True)
    skin = Skin.load(DATA / "icub_skin/positions/left_forearm_nomesh.txt")
    assert np.isnan(skin.normals).all()
    middle = body.mesh.bounds.mean(axis=0) - skin.positions.mean(axis=0)
    assert_on_surface(skin.moved(se3.transform(np.eye(3), middle)).onto(body, within=0.1), body)


def assert_on_surface(skin, body):
    """Every taxel is on the surface, with its normal."""
    rotation = skin.poses[:, :3, :3]
    square = rotation @ np.swapaxes(rotation, 1, 2)
    np.testing.assert_allclose(square, np.broadcast_to(np.eye(3), square.shape), atol=1e-9)
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0)
    at = body.closest(skin.positions)
    assert np.abs(at.distance).max() < 1e-8
    assert np.median(np.sum(at.normal * skin.normals, axis=1)) > 0.999999


def test_the_published_module():
    """Ten taxels 6.533 mm apart, the centre one at the origin, in a triangle of 30 mm."""
    flat = slots.OFFSETS[list(slots.TAXELS), :2]
    between = np.linalg.norm(flat[:, None] - flat[None], axis=2) + np.eye(10)
    np.testing.assert_allclose(between.min(axis=1), 6.534e-3, atol=0.01e-3)
    np.testing.assert_array_equal(slots.OFFSETS[slots.CENTRE], 0)
    sides = np.linalg.norm(slots.CORNERS - np.roll(slots.CORNERS, 1, axis=0), axis=1)
    np.testing.assert_allclose(sides, slots.SIDE)
    for outline in (slots.OFFSETS, slots.TWELVE_OFFSETS):
        for a, b in zip(slots.CORNERS, np.roll(slots.CORNERS, -1, axis=0), strict=True):
            inward = np.cross([0, 0, 1], b - a) / slots.SIDE
            assert np.min((outline - a) @ inward) > 2e-3  # a disc of 2 mm fits


def test_a_layout_is_a_flat_skin_of_its_triangles(tmp_path):
    text = "[SENSORS]\n# kind\ntriangle_10pad 3 100 50 90 5 1\nfingertip 1 0 0 0 4 0\n"
    text += "triangle 2 0 0 0 5 0\n"
    (tmp_path / "arm.ini").write_text(text)
    flat = Skin.load(tmp_path / "arm.ini")
    assert len(flat) == 22
    np.testing.assert_array_equal(np.unique(slots.module(flat.ids)), [2, 3])
    np.testing.assert_allclose(flat.positions[flat.ids == 39], [[0.1, 0.05, 0]], atol=1e-15)
    # slot 0 is 6.533 mm along x: mirrored, then turned by 90 degrees
    np.testing.assert_allclose(
        flat.positions[flat.ids == 36], [[0.1, 0.05 - 6.533e-3, 0]], atol=1e-15
    )
    assert icub_layout.parse(text, "arm.ini")[1].kind == "fingertip"


def test_transforms_place_modules(tmp_path):
    line = "transform_A_TRIANGLE4 = iDynTree.Transform(iDynTree.Rotation(0,-1,0,  \\\n1,0,0, \\\n"
    (tmp_path / "sole").write_text(line + "0,0,1), \\\n iDynTree.Position(10,-20,5)) // toe\n")
    skin = Skin.load(tmp_path / "sole")
    np.testing.assert_array_equal(skin.ids, 48 + np.array(slots.TAXELS))
    np.testing.assert_allclose(skin.positions[0], [0.01, -0.02 + 6.533e-3, 0.005], atol=1e-15)


def test_a_part_of_a_urdf_is_chosen(skin, tmp_path):
    skin.save(tmp_path / "left.urdf")
    text = (tmp_path / "left.urdf").read_text()
    assert 'name="left_skin_0"' in text
    joints = text[text.index("<link name") : text.rindex("</robot>")]
    both = text.replace("</robot>", joints.replace("left_skin", "right_skin") + "</robot>")
    (tmp_path / "both.urdf").write_text(both)
    with pytest.raises(SkinError, match="limit: left, right; choose one"):
        Skin.load(tmp_path / "both.urdf")
    assert_same(Skin.load(tmp_path / "both.urdf", part="right"), skin)


@pytest.mark.parametrize("pitch", [np.pi / 2, -np.pi / 2, 1.0])
def test_a_frame_at_gimbal_lock_is_read_back(tmp_path, pitch):
    rotation = se3.exp_so3([0, 0, 0.4]) @ se3.exp_so3([0, pitch, 0]) @ se3.exp_so3([0.7, 0, 0])
    one = Skin(se3.transform(rotation[None], [[0.1, 0.2, 0.3]]), np.array([7]))
    one.save(tmp_path / "one.urdf")
    np.testing.assert_allclose(Skin.load(tmp_path / "one.urdf").poses, one.poses, atol=1e-9)


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("name x\n[calibration]\n0 0 0 0 0 0\n", "only rows of zeros"),
        ("name x\n[calibration]\n", "holds no taxels"),
        ("name x\n[calibration]\n1 2 3\n", "line 3, got 3 numbers"),
        ("1 2 3 4 5 6\n1 2 3 4 5 six\n", "line 2.*six"),
        ("1 2 nan 4 5 6\n", "numbers of taxel 0 must be finite"),
        ("<robot", "not XML"),
        ("<robot/>", "has no skin"),
        ("ply\nformat ascii 1.0\nelement vertex 3\nend_header\n", "mesh without taxels"),
        ("ply\nformat ascii 1.0\nelement taxel 1\nend_header\n1 2 3\n", "taxel row 1, got 2 "),
        ("ply\nformat ascii 1.0\nelement taxel x\nend_header\n", "rows of taxels"),
        ("[SENSORS]\npalmL 8 0 0 0 4 0\n", "contains no triangular modules, got palmL"),
        ("[SENSORS]\ntriangle 8 left\n", "line 2"),
        ("x = iDynTree.Transform(iDynTree.Rotation(1), iDynTree.Position(1))", "no taxels"),
        ("x_TAXEL1 = iDynTree.Transform(iDynTree.Rotation(1), iDynTree.Position(1))", "TAXEL1"),
        ('<robot><joint name="a_skin_1" type="fixed"><origin xyz="1 2"/></joint></robot>', "3 num"),
    ],
)
def test_invalid_files_are_refused(tmp_path, text, match):
    (tmp_path / "skin").write_text(text)
    with pytest.raises(SkinError, match=match):
        Skin.load(tmp_path / "skin")


def test_invalid_glb_files_are_refused(skin, tmp_path):
    path = tmp_path / "skin.glb"
    skin.save(path)
    whole = path.read_bytes()
    for data in (whole[:8], whole[:300], b"glTF" + bytes(100), whole.replace(b"taxel_", b"texel_")):
        path.write_bytes(data)
        with pytest.raises(SkinError):
            Skin.load(path)


@needs_skin
@pytest.mark.parametrize(
    "path",
    [pytest.param(p, marks=() if k % 6 == 0 else pytest.mark.slow) for k, p in enumerate(ICUB)],
    ids=lambda p: p.name,
)
def test_every_icub_file_is_read_and_written_to_the_printed_digits(path, tmp_path):
    if path.name in HANDS:
        with pytest.raises(SkinError, match="contains no triangular modules"):
            Skin.load(path)
        return
    skin = Skin.load(path)
    assert len(skin) >= 10
    normals = np.isfinite(skin.normals).all()
    for kind in FORMATS if normals else ("txt",):
        skin.save(tmp_path / f"again.{kind}")
        assert_same(Skin.load(tmp_path / f"again.{kind}"), skin, atol=0.7e-9)


@needs_skin
def test_the_rows_of_a_real_file_are_those_written():
    path = DATA / "icub_skin/positions/left_forearm_mesh.txt"
    file = icub.read(path.read_text(), path.name)
    assert file.slots == 384
    np.testing.assert_array_equal(file.positions[0], [-0.031, -0.075, 0.008])
    np.testing.assert_array_equal(file.normals[0], [-0.976, 0.065, 0.146])
    counts = {p.name: len(Skin.load(p)) for p in path.parent.iterdir()}
    assert counts["torso.txt"] == 440
    assert counts["left_leg_upper.txt"] == 680
    assert counts["left_forearm_V2.txt"] == 240


@needs_skin
def test_the_urdf_of_icub_agrees_with_its_derived_table():
    import csv

    path = DATA / "icub_body/iCubGazeboV2_5.urdf"
    table = next((DATA / "icub_body").glob("*.csv"))
    with table.open() as lines:
        rows = list(csv.DictReader(lines))
    for part, count in {"l_forearm": 24, "r_lower_leg": 38, "l_sole": 25}.items():
        skin = Skin.load(path, part=part)
        assert len(skin) == count
        mine = {r["skin_frame"]: r for r in rows if r["skin_frame"].startswith(f"{part}_skin")}
        for taxel, pose in zip(skin.ids, skin.poses, strict=True):
            row = mine[f"{part}_skin_{taxel}"]
            place = [float(row[k]) for k in ("x_m", "y_m", "z_m")]
            np.testing.assert_allclose(pose[:3, 3], place, atol=1e-9)
            turn = np.array([float(row[k]) for k in ("qx", "qy", "qz", "qw")])
            assert abs(se3.quaternion(pose[:3, :3]) @ turn) == pytest.approx(1.0, abs=1e-8)


@needs_skin
def test_the_sole_is_the_same_in_two_files():
    """Transforms of its triangles and rows of its taxels place the same modules."""
    a = Skin.load(DATA / "icub_skin/cad/l_sole_transforms.txt")
    b = Skin.load(DATA / "icub_skin/cad/left_foot_mesh.txt")
    np.testing.assert_array_equal(a.ids, b.ids + 12)  # one counts from 1, the other from 0
    np.testing.assert_allclose(a.positions, b.positions, atol=2e-6)


def test_a_truncated_ply_file_is_refused(tmp_path):
    skin = Skin.cover(Body.sphere(0.1), spacing=6e-3, count=9)
    skin.save(tmp_path / "skin.ply")
    text = (tmp_path / "skin.ply").read_text()
    (tmp_path / "truncated.ply").write_text(text[:-20])
    with pytest.raises(SkinError, match="taxel row 9, got 6 numbers"):
        Skin.load(tmp_path / "truncated.ply")


def test_rotations_of_three_digits_are_read(skin, tmp_path):
    np.savez(tmp_path / "short.npz", poses=np.round(skin.poses, 3)[:, :3])
    assert_same(Skin.load(tmp_path / "short.npz"), replace(skin, ids=np.arange(40)), atol=2e-3)
