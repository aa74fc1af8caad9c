"""Skin layouts: spacing, count, regions, frames, files."""

import numpy as np
import pytest
import trimesh
from scipy.spatial import KDTree
from scipy.spatial.distance import cdist

from meshskin.core.errors import OutputError, SkinError
from meshskin.geometry.body import Body
from meshskin.geometry.region import Cap, Disc, Faces, HalfSpace, Whole, area, outermost
from meshskin.skin.skin import Skin

BOTTOM = Cap((0.0, 0.0, -1.0))


@pytest.fixture(scope="module")
def ball():
    return Body.sphere()


def nearest(skin):
    return KDTree(skin.positions).query(skin.positions, k=2)[0][:, 1]


def assert_even(skin, spacing):
    near = nearest(skin)
    assert near.mean() == pytest.approx(spacing, rel=0.02)
    assert near.std() < 0.08 * near.mean()


@pytest.mark.parametrize("seed", [0, 1, 7])
def test_the_papers_skin(ball, seed):
    """80 taxels, 5 mm apart, on the bottom of the sphere."""
    skin = Skin.cover(ball, spacing=5e-3, count=80, region=BOTTOM, seed=seed)
    assert len(skin) == 80
    assert_even(skin, 5e-3)
    assert skin.disc_radius == 2e-3
    np.testing.assert_array_equal(skin.ids, np.arange(80))
    radius = np.linalg.norm(skin.positions, axis=1)
    np.testing.assert_allclose(radius, 0.1, atol=0.1e-6)
    polar = np.arccos(-skin.positions[:, 2] / radius)
    hexagonal = np.sqrt(80 * np.sqrt(3) / 2 / np.pi) * 5e-3 / 0.1  # radius of a disc of that area
    assert polar.max() == pytest.approx(hexagonal, rel=0.1)
    assert np.linalg.norm(skin.positions[:, :2].mean(axis=0)) < 1e-3


def test_frames_have_the_surface_normals_and_transported_tangents(ball):
    skin = Skin.cover(ball, spacing=5e-3, count=80, region=BOTTOM)
    rotation = skin.poses[:, :3, :3]
    np.testing.assert_allclose(
        rotation @ np.swapaxes(rotation, 1, 2), np.eye(3)[None] + 0 * rotation, atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(rotation), 1.0, atol=1e-12)
    np.testing.assert_allclose(skin.normals, skin.positions / 0.1, atol=1e-5)
    np.testing.assert_array_equal(skin.normals, rotation[:, :, 2])
    # neighbours' tangents differ by no more than their normals do, but for holonomy (cell / R^2)
    pairs = KDTree(skin.positions).query_pairs(6e-3, output_type="ndarray")
    x, z = rotation[:, :, 0], skin.normals
    turn = np.linalg.norm(x[pairs[:, 0]] - x[pairs[:, 1]], axis=1)
    tilt = np.linalg.norm(z[pairs[:, 0]] - z[pairs[:, 1]], axis=1)
    assert np.all(turn < tilt + 0.05)


def test_the_seed_rotates_and_shifts_the_lattice(ball):
    first = Skin.cover(ball, spacing=5e-3, count=80, region=BOTTOM, seed=1)
    again = Skin.cover(ball, spacing=5e-3, count=80, region=BOTTOM, seed=1)
    other = Skin.cover(ball, spacing=5e-3, count=80, region=BOTTOM, seed=2)
    np.testing.assert_array_equal(first.poses, again.poses)
    assert KDTree(first.positions).query(other.positions)[0].max() > 1e-3


@pytest.mark.deep
@pytest.mark.parametrize(
    ("body", "spacing"),
    [
        pytest.param(Body.sphere(), 10e-3, marks=pytest.mark.slow),
        (Body.ellipsoid((0.1, 0.07, 0.05)), 8e-3),
        (Body.torus(0.1, 0.04), 10e-3),
        pytest.param(Body.capsule(0.05, 0.2), 10e-3, marks=pytest.mark.slow),
    ],
    ids=["sphere", "ellipsoid", "torus", "capsule"],
)
def test_spacing_alone_fills_the_body(body, spacing):
    skin = Skin.cover(body, spacing=spacing)
    assert_even(skin, spacing)
    cell = np.sqrt(3.0) / 2.0 * spacing**2
    assert len(skin) == pytest.approx(area(body, Whole()) / cell, rel=0.15)
    gap = KDTree(skin.positions).query(body.surface.vertices)[0].max()
    assert gap < 0.95 * spacing  # no hole: a perfect lattice has 0.58


def test_count_alone_takes_the_spacing_from_the_area(ball):
    region = HalfSpace((1.0, 0.0, 0.0), 0.02)
    skin = Skin.cover(ball, count=300, region=region)
    assert len(skin) == 300
    ideal = np.sqrt(2.0 * area(ball, region) / (np.sqrt(3.0) * 300))
    assert nearest(skin).mean() == pytest.approx(ideal, rel=0.06)
    assert nearest(skin).std() < 0.08 * nearest(skin).mean()
    assert skin.positions[:, 0].min() >= 0.02


@pytest.mark.deep
def test_taxels_are_within_their_region(ball):
    cap = Skin.cover(ball, spacing=5e-3, region=Cap((0, 0, 2), np.radians(30)))
    assert np.all(cap.normals[:, 2] >= np.cos(np.radians(30)) - 1e-9)
    disc = Skin.cover(ball, spacing=5e-3, region=Disc((0.1, 0.0, 0.0), 0.03))
    assert np.all(0.1 * np.arccos(disc.normals[:, 0]) <= 0.03 + 1e-9)
    assert len(disc) == pytest.approx(area(ball, Disc((0.1, 0, 0), 0.03)) / 2.165e-5, rel=0.15)
    mask = tuple(np.flatnonzero(ball.mesh.triangles_center[:, 1] > 0.05).tolist())
    faces = Skin.cover(ball, spacing=5e-3, region=Faces(mask))
    assert faces.positions[:, 1].min() > 0.045
    assert np.isin(ball.closest(faces.positions).face, mask).mean() > 0.99


@pytest.mark.deep
def test_every_part_of_a_region_is_covered(ball):
    """Two caps at opposite sides, as one set of faces."""
    z = ball.mesh.triangles_center[:, 2]
    skin = Skin.cover(ball, spacing=6e-3, region=Faces(tuple(np.flatnonzero(np.abs(z) > 0.08))))
    assert_even(skin, 6e-3)
    up = skin.positions[:, 2] > 0
    assert up.sum() == pytest.approx((~up).sum(), rel=0.1)


def test_area_of_a_cap(ball):
    exact = 2.0 * np.pi * 0.01 * (1.0 - np.cos(0.5))
    assert area(ball, Cap((0.0, 1.0, 0.0), 0.5)) == pytest.approx(exact, rel=0.01)
    assert area(ball, Whole()) == pytest.approx(4.0 * np.pi * 0.01, rel=2e-3)


def test_outermost_point_of_a_direction():
    body = Body.ellipsoid((0.1, 0.07, 0.05))
    np.testing.assert_allclose(outermost(body, (0, -3, 0)).point, [[0, -0.07, 0]], atol=1e-7)


@pytest.mark.deep
@pytest.mark.parametrize(
    ("wrong", "match"),
    [
        ({}, "a skin needs a spacing or a count"),
        ({"spacing": 3e-3}, "spacing of taxels is too small, got 3 mm, limit: at least 4 mm"),
        ({"spacing": 5.0}, "larger than the body, .* give it in m"),
        (
            {"spacing": 20e-3, "count": 5, "disc_radius": 0.0},
            "disc radius of a taxel .* got 0 m, limit: above 0",
        ),
        ({"spacing": 20e-3, "count": 5, "disc_radius": -1.0}, "got -1 m, limit: above 0"),
        ({"spacing": float("nan")}, "spacing"),
        ({"count": 0}, "number of taxels"),
        ({"count": 50_000}, "spacing of taxels"),
        ({"spacing": 20e-3, "count": 1000}, "taxels do not fit the region, got 1000 taxels"),
        ({"count": 5, "region": Cap((0, 0, 0))}, "a direction must be finite"),
        ({"count": 5, "region": Faces(())}, "a region needs faces"),
        ({"spacing": 5e-3, "region": Faces((0, 6000))}, "no such face, got 6000, limit: 0 to"),
        (
            {"spacing": 5e-3, "region": HalfSpace((0, 0, 1), 0.2)},
            "the region contains no exposed surface",
        ),
    ],
)
def test_impossible_layouts_are_refused(ball, wrong, match):
    with pytest.raises(SkinError, match=match):
        Skin.cover(ball, **wrong)


def test_a_saved_skin_is_loaded_by_its_content(ball, tmp_path):
    skin = Skin.cover(ball, spacing=5e-3, count=80, region=BOTTOM, disc_radius=1.5e-3)
    skin.save(tmp_path / "skin.csv")
    assert [p.name for p in tmp_path.iterdir()] == ["skin.csv"]
    loaded = Skin.load((tmp_path / "skin.csv").rename(tmp_path / "renamed.txt"))
    np.testing.assert_allclose(loaded.poses, skin.poses, atol=1e-14)
    np.testing.assert_array_equal(loaded.positions, skin.positions)
    np.testing.assert_array_equal(loaded.ids, skin.ids)
    assert loaded.disc_radius == 1.5e-3


def edited(path, line, change):
    lines = path.read_text().splitlines()
    lines[line] = change(lines[line])
    path.write_text("\n".join(lines))


@pytest.mark.parametrize(
    ("line", "change", "match"),
    [
        (1, lambda s: s.replace("qw", "w"), "is not a skin file"),
        (3, lambda s: s + ",1", "taxel line 2"),
        (3, lambda s: s.replace(s.split(",")[2], "nan"), "taxel line 2"),
        (3, lambda s: s.replace(s.split(",")[2], "east"), "taxel line 2.*east"),
        (3, lambda s: "0" + s[1:], "names a taxel twice, got 0"),
        (
            4,
            lambda s: s.rsplit(",", 1)[0] + ",3.0",
            "taxel line 3: the frame must be a rotation, got quaternion of norm",
        ),
        (
            4,
            lambda s: ",".join([*s.split(",")[:-4], "0,0,0,0"]),
            "the frame must be a rotation, got axes that are not orthonormal",
        ),
        (0, lambda s: "# disc_radius_m=wide", "disc radius"),
    ],
)
def test_invalid_skin_files_are_refused(ball, tmp_path, line, change, match):
    path = tmp_path / "skin.csv"
    Skin.cover(ball, spacing=5e-3, count=7, region=BOTTOM).save(path)
    edited(path, line, change)
    with pytest.raises(SkinError, match=match):
        Skin.load(path)


def test_files_that_are_not_skins_are_refused(ball, tmp_path):
    (tmp_path / "bytes").write_bytes(b"\xff\xfe\x00\x81")
    (tmp_path / "empty.csv").write_text("")
    for name in ("bytes", "empty.csv", "nowhere.csv"):
        with pytest.raises(SkinError):
            Skin.load(tmp_path / name)
    skin = Skin.cover(ball, spacing=5e-3, count=7, region=BOTTOM)
    with pytest.raises(SkinError, match="format of a skin file"):
        skin.save(tmp_path / "skin.docx")
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError):
        skin.save(tmp_path / "file" / "skin.csv")


def test_ids_must_be_distinct_integers(ball):
    poses = Skin.cover(ball, spacing=5e-3, count=3, region=BOTTOM).poses
    with pytest.raises(SkinError, match="must be distinct, got 7 twice"):
        Skin(poses, np.array([7, 1, 7]))
    with pytest.raises(SkinError, match="must be integers, got type float64"):
        Skin(poses, np.array([0.5, 1.0, 2.0]))


def test_ids_beyond_32_bits_are_kept(ball, tmp_path):
    ids = np.array([0, 2**31, 2**40], dtype=np.int64)
    skin = Skin(Skin.cover(ball, spacing=5e-3, count=3, region=BOTTOM).poses, ids)
    for kind in ("csv", "urdf", "ply", "glb"):
        skin.save(tmp_path / f"skin.{kind}")
        np.testing.assert_array_equal(Skin.load(tmp_path / f"skin.{kind}").ids, ids)
    with pytest.raises(SkinError, match="a taxel id does not fit a position file"):
        skin.save(tmp_path / "skin.txt")


@pytest.mark.parametrize(
    "matrix",
    [
        np.diag([2.0, 2.0, 2.0, 1.0]),
        np.diag([-1.0, 1.0, 1.0, 1.0]),
        np.full((4, 4), np.nan),
        np.eye(3),
        "left",
    ],
)
def test_a_skin_is_moved_by_rigid_transforms_only(ball, matrix):
    skin = Skin.cover(ball, spacing=5e-3, count=3, region=BOTTOM)
    with pytest.raises(SkinError, match="T_b_a must be a rigid transform"):
        skin.moved(matrix)


@pytest.mark.deep
def test_no_taxel_is_where_two_parts_touch():
    """A box on a larger one: the faces between them are within the body, and no skin is there."""
    low = trimesh.creation.box((0.1, 0.1, 0.04)).subdivide_to_size(0.015)
    high = trimesh.creation.box((0.052, 0.048, 0.04)).subdivide_to_size(0.015)
    high.apply_translation((0.0, 0.0, 0.04))
    body = Body.from_mesh(trimesh.util.concatenate([low, high]))
    skin = Skin.cover(body, spacing=5e-3, seed=1)
    x, y, z = np.abs(skin.positions - [0.0, 0.0, 0.02]).T
    assert np.sum(z < 1e-6) > 150
    assert not ((x < 0.0259) & (y < 0.0239) & (z < 1e-3)).any()


@pytest.mark.deep
def test_a_sheet_below_another_one_is_covered_too():
    """Open sheets 5 cm apart, which close to bodies that contain each other."""
    sheet = trimesh.creation.box((0.1, 0.1, 0.02)).subdivide_to_size(0.02)
    sheet.update_faces(sheet.face_normals[:, 2] > 0.9)
    above = sheet.copy()
    above.apply_translation((0.0, 0.0, 0.05))
    body = Body.from_mesh(trimesh.util.concatenate([sheet, above]), open=True)
    low = Skin.cover(body, spacing=5e-3, seed=1).positions[:, 2] < 0.03
    assert 0.45 < np.mean(low) < 0.55


@pytest.mark.slow
def test_a_small_part_at_the_centre_does_not_hold_all_taxels():
    """The outermost point is on a button: the taxels nearest to it are on the ball, too."""
    button = trimesh.creation.icosphere(subdivisions=3, radius=0.01)
    button.apply_translation((0.0, 0.0, 0.115))
    large = trimesh.creation.icosphere(subdivisions=4, radius=0.1)
    body = Body.from_mesh(trimesh.util.concatenate([large, button]))
    skin = Skin.cover(body, spacing=5e-3, count=120, region=Cap((0.0, 0.0, 1.0)))
    z = skin.positions[:, 2]
    assert len(skin) == 120
    assert 20 < np.sum(z > 0.1001) < 60
    assert z.min() > 0.08


@pytest.mark.parametrize("thickness", [2e-3, 3e-3, 4e-3, 6e-3])
@pytest.mark.parametrize("spacing", [pytest.param(4e-3, marks=pytest.mark.slow), 6e-3, 8e-3])
def test_both_sides_of_a_thin_plate_are_covered(thickness, spacing):
    """As densely as a plate too thick for its sides to be near each other, without crowds."""
    body = Body.from_mesh(trimesh.creation.box((0.08, 0.06, thickness)).subdivide())
    skin = Skin.cover(body, spacing=spacing, seed=1)
    apart = cdist(skin.positions, skin.positions)
    apart[skin.normals @ skin.normals.T < -0.9] = np.inf  # of the other side
    assert np.sort(apart)[:, 1].mean() == pytest.approx(spacing, rel=0.03)
    flat = 0.08 * 0.06 / (np.sqrt(0.75) * spacing**2)  # of a perfect lattice
    for side in (1.0, -1.0):
        own = skin.positions[side * skin.normals[:, 2] > 0.9]
        assert 0.75 < len(own) / flat < 1.15
        assert KDTree(own).query(own, k=2)[0][:, 1].min() > 0.6 * spacing
        corners = np.stack(np.meshgrid([-0.035, 0.0, 0.035], [-0.025, 0.0, 0.025]), -1)
        reach = KDTree(own[:, :2]).query(corners.reshape(-1, 2))[0]
        assert reach.max() < 1.2 * spacing  # no hole


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_taxels_keep_their_distance_round_the_tip_of_a_cone(seed):
    """Its sides are opposite, but not those of a plate: they meet at the tip."""
    cone = trimesh.creation.cone(0.01, 0.08, sections=48).subdivide().subdivide()
    skin = Skin.cover(Body.from_mesh(cone), spacing=6e-3, seed=seed)
    assert KDTree(skin.positions).query(skin.positions, k=2)[0][:, 1].min() > 4e-3
