"""Triangular modules: rigid, on the surface, side by side, addressed by 12 * module + slot."""

import numpy as np
import pytest
from scipy.spatial import KDTree

from meshskin.core import se3
from meshskin.core.errors import SkinError
from meshskin.geometry.body import Body
from meshskin.geometry.region import Disc, Faces, HalfSpace, Whole, area
from meshskin.skin import lattice, module_layout, module_pose, slots
from meshskin.skin.module_layout import SPACING
from meshskin.skin.module_pose import MAX_OFFSET, overlapping
from meshskin.skin.skin import Modules, Skin

from ..real_data import DATA, needs_skin

TRIANGLE = np.sqrt(3.0) / 4.0 * slots.SIDE**2


def assert_valid(body, modules, least):
    """Rigid, near the surface, outward, without overlap, and covering this part of the surface."""
    local = se3.inverse(modules.poses)[:, None] @ modules.skin.poses.reshape(-1, 10, 4, 4)
    flat = np.broadcast_to(slots.OFFSETS[list(slots.TAXELS)], local[..., :3, 3].shape)
    np.testing.assert_allclose(local[..., :3, 3], flat, atol=1e-15)
    np.testing.assert_allclose(local[..., :3, :3], np.eye(3) + 0 * local[..., :3, :3], atol=1e-15)
    hit = body.closest(modules.skin.positions)
    assert np.abs(hit.distance).max() < MAX_OFFSET
    assert np.sum(hit.normal * modules.skin.normals, axis=1).min() > 0.9
    for k, pose in enumerate(modules.poses):
        assert not overlapping(pose, np.delete(modules.poses, k, axis=0)).any()
    assert len(modules) * TRIANGLE > least * area(body, Whole())


@pytest.mark.deep
@pytest.mark.parametrize(
    ("body", "least"),
    [
        pytest.param(Body.sphere(), 0.8, marks=pytest.mark.slow),
        pytest.param(Body.capsule(0.05, 0.2), 0.74, marks=pytest.mark.slow),
        pytest.param(Body.torus(0.1, 0.04), 0.74, marks=pytest.mark.slow),
        (Body.ellipsoid((0.05, 0.06, 0.09)), 0.78),
    ],
    ids=lambda value: getattr(value, "name", None),
)
def test_modules_cover_a_body_side_by_side(body, least):
    """A plane tiled at 1 mm between two modules is covered by 0.896."""
    assert_valid(body, Skin.modules(body, seed=4), least)


@pytest.mark.deep
def test_packed_modules_do_not_overlap():
    """No two are nearer than the clearance, and most have about the requested gap."""
    body, region = Body.sphere(), HalfSpace((0.0, 0.0, 1.0), 0.03)
    first = lattice.first_site(body, region, SPACING, np.random.default_rng(0))
    poses = module_layout.pack(body, region, first, SPACING)
    assert len(poses) > 50
    one, two = (
        KDTree(poses[:, :3, 3]).query_pairs(2.0 * module_pose.CIRCUMRADIUS, output_type="ndarray").T
    )
    gap, way, _ = module_pose.separation(poses[one], poses[two])
    assert gap.min() > 0.99 * module_layout.CLEARANCE
    beside = np.linalg.norm(poses[one, :3, 3] - poses[two, :3, 3], axis=1) < 1.2 * SPACING
    assert np.median(gap[beside]) > 0.5e-3
    np.testing.assert_allclose(np.linalg.norm(way, axis=1), 1.0)


def test_a_push_separates_two_modules():
    """Side to side half of the overlap remains; one hit by a corner off its centre rotates."""
    pair, inner = (np.array([0]), np.array([1])), slots.SIDE / np.sqrt(12.0)
    here = np.eye(4)
    beside = se3.transform(se3.exp_so3([0.0, 0.0, np.pi]), [0.0, -2.0 * inner + 1e-3, 0.0])
    poses = module_layout.push(np.array([here, beside]), pair, 0.5e-3)
    assert module_pose.separation(np.array([here]), beside[None])[0] == pytest.approx(-1e-3)
    assert np.linalg.norm(poses[0, :3, 3] - poses[1, :3, 3]) == pytest.approx(2.0 * inner - 0.25e-3)
    corner = se3.transform(np.eye(3), [8e-3, -3.0 * inner + 1e-3, 0.0])  # its tip under a side
    poses = module_layout.push(np.array([here, corner]), pair, 0.0)
    gap = [module_pose.separation(p[:1], p[1:])[0][0] for p in (np.array([here, corner]), poses)]
    assert gap[0] == pytest.approx(-1e-3)
    assert -1e-3 < gap[1] < -0.2e-3
    assert poses[0, 1, 0] > 1e-3  # counter-clockwise: pushed up right of its middle
    assert abs(poses[1, 1, 0]) < 1e-12  # pushed through its middle


@pytest.mark.deep
def test_a_plane_is_tiled_without_gaps():
    """A disc on a large sphere: as many as the spacing's own tiling."""
    body, region = Body.sphere(1.0), Disc((0.0, 0.0, 1.0), 0.12)
    modules = Skin.modules(body, region=region)
    tiles = area(body, region) / (np.sqrt(3.0) / 4.0 * (18.3e-3 * np.sqrt(3.0)) ** 2)
    assert 0.75 * tiles < len(modules) < tiles  # those across the border do not count
    middles = modules.poses[:, :3, 3]
    away = np.linalg.norm(middles[:, None] - middles, axis=2) + np.eye(len(middles))
    assert np.median(away.min(axis=1)) == pytest.approx(18.3e-3, rel=0.005)


def test_a_number_of_modules_in_a_region():
    body, region = Body.sphere(), HalfSpace((0.0, 0.0, 1.0), 0.0)
    modules = Skin.modules(body, count=12, region=region, seed=1, disc_radius=1.5e-3)
    assert len(modules) == 12
    skin = modules.skin
    assert len(skin) == 120
    np.testing.assert_array_equal(skin.ids[:12], [0, 1, 2, 3, 4, 5, 7, 8, 9, 11, 12, 13])
    assert slots.is_modular(skin.ids)
    assert skin.disc_radius == 1.5e-3
    assert body.closest(skin.positions).point[:, 2].min() >= 0.0
    np.testing.assert_array_equal(skin.positions[skin.ids % 12 == 3], modules.poses[:, :3, 3])
    again = Skin.modules(body, count=12, region=region, seed=1)
    np.testing.assert_array_equal(again.poses, modules.poses)
    other = Skin.modules(body, count=12, region=region, seed=2)
    assert np.abs(other.poses - modules.poses).max() > 1e-3


@pytest.mark.deep
def test_two_parts_of_a_region_are_both_covered():
    body = Body.sphere()
    z = body.surface.vertices[body.surface.faces].mean(axis=1)[:, 2]
    modules = Skin.modules(body, region=Faces(tuple(np.flatnonzero(np.abs(z) > 0.07).tolist())))
    up = modules.poses[:, 2, 3] > 0
    assert 5 < up.sum() < len(up) - 5


def test_overlap_by_separating_axes():
    here = np.eye(4)
    inner = slots.SIDE / np.sqrt(12.0)

    def at(x, y, turn=0.0, z=0.0):
        return se3.transform(se3.exp_so3([0, 0, turn]), [x, y, z])

    touching = at(0, -2.0 * inner - 1e-9, np.pi)
    cases = [touching, at(0, -2.0 * inner + 1e-5, np.pi), at(0, 0.0321), at(0.01, 0, 1.0)]
    assert overlapping(here, np.array(cases)).tolist() == [False, True, False, True]
    behind = at(0, 0, 0, -2e-3) @ np.diag([1.0, -1.0, -1.0, 1.0])
    assert not overlapping(here, behind[None])[0]


def test_modules_are_found_from_their_taxels():
    modules = Skin.modules(Body.sphere(), count=5)
    skin = modules.skin
    order = np.random.default_rng(0).permutation(len(skin))
    found = Modules.of(Skin(skin.poses[order], skin.ids[order]))
    np.testing.assert_allclose(found.poses, modules.poses, atol=1e-12)
    with pytest.raises(SkinError, match="does not consist of modules"):
        Modules.of(Skin(skin.poses[1:], skin.ids[1:]))
    spoiled = skin.poses.copy()
    spoiled[13, :3, 3] += 0.01
    with pytest.raises(SkinError, match="taxels of module 1 deviate"):
        Modules.of(Skin(spoiled, skin.ids))


@pytest.mark.parametrize(
    ("wrong", "match"),
    [
        ({"spacing": 15e-3}, "spacing of modules .* got 0.015 m, limit: at least 0.0173"),
        ({"spacing": float("nan")}, "spacing of modules"),
        ({"count": 0}, "number of modules"),
        (
            {"count": 400, "region": HalfSpace((0, 0, 1), 0.07)},
            "modules do not fit the region, got 400",
        ),
        ({"region": Disc((0, 0, 0.1), 5e-3)}, "limit: 0 fit"),
    ],
)
def test_impossible_layouts_are_refused(wrong, match):
    with pytest.raises(SkinError, match=match):
        Skin.modules(Body.sphere(), **wrong)


@pytest.mark.deep
def test_a_body_too_curved_for_a_rigid_module_is_refused():
    with pytest.raises(SkinError, match="less curved"):
        Skin.modules(Body.capsule(0.01, 0.2))


@needs_skin
@pytest.mark.parametrize("name", ["left_leg_lower", "left_leg_upper", "left_arm", "left_foot"])
def test_real_modules_have_a_pose_each(name):
    """Files whose normals are one constant vector: poses follow from the positions."""
    skin = Skin.load(DATA / f"icub_skin/positions/{name}.txt")
    modules = Modules.of(skin, tolerance=2e-6)
    assert 10 * len(modules) == len(skin)
    if name == "left_foot":
        np.testing.assert_allclose(np.abs(modules.poses[:, 2, 2]), 1.0, atol=1e-6)
        np.testing.assert_allclose(skin.normals[:, 0], 1.0)
