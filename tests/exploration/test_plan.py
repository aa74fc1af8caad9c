"""Plans for an arm: within its limits, broken where they end, with reasons for what is left out."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from scipy.spatial import cKDTree

import meshskin as ms
from meshskin.core.errors import ReachError, UnknownNameError
from meshskin.core.se3 import inverse
from meshskin.exploration.lane_plan import LIMIT, OUT_OF_REACH
from meshskin.exploration.left_out import NOT_COVERED, ONE_LINE, taxels_left_out
from meshskin.exploration.parallels import is_cap
from meshskin.exploration.path import ROWS, Path
from meshskin.exploration.plan import plan_exploration
from meshskin.geometry.region import Cap, HalfSpace
from meshskin.robot import collision

LANES = ms.Exploration(pattern="lanes")
SPARSE = ms.Exploration(pattern="lanes", lane_spacing=6e-3)


def angles(scene, plan):
    """Joint angles (k, n) along each segment of a plan, followed from its posture."""
    for segment in plan.segments:
        poses = segment.poses[::5] @ inverse(scene.mount_pose)
        yield scene.arm.inverse_kinematics(poses, segment.postures[0])


@pytest.fixture(scope="module", params=["ellipsoid", "capsule", "torus"])
def scene(request):
    return ms.Scene.load(request.param)


@pytest.fixture(scope="module")
def plan(scene):
    return plan_exploration(scene)


def test_the_plan_covers_the_shipped_bodies_within_all_limits(scene, plan):
    assert plan.unreachable == {}
    points = plan.path.points
    assert cKDTree(points).query(scene.skin.positions)[0].max() < 0.5 * plan.spacing + 0.5e-3
    assert np.linalg.norm(np.diff(points, axis=0), axis=1).max() < 1.05 * 0.05 * plan.path.dt
    assert np.linalg.norm(plan.path.twists[:, 3:], axis=1).max() < 2.5
    for q in angles(scene, plan):  # raises ReachError beyond a joint limit
        assert (q > scene.arm.lower).all()
        assert (q < scene.arm.upper).all()
        rate = np.abs(np.diff(q, axis=0)).max(axis=0) / (5 * plan.path.dt)
        assert (rate < scene.arm.velocity_limit).all()


def test_the_indenter_meets_the_body_where_the_path_says(scene, plan):
    path = plan.path
    turn = plan.headings[::50]
    np.testing.assert_allclose(np.linalg.det(turn), 1.0, atol=1e-12)
    centre = np.einsum("kji,kj->ki", turn, scene.indenter.position - path.poses[::50, :3, 3])
    hit = scene.body.closest(centre)
    gap = scene.indenter.radius - scene.patch.depth
    np.testing.assert_allclose(hit.distance, gap, atol=2e-5)
    assert np.linalg.norm(hit.point - path.points[::50], axis=1).max() < 0.1e-3
    down = np.einsum("kij,kj->ki", turn, hit.normal)
    assert down[:, 2].max() < -np.cos(np.radians(2.0))


def test_the_skin_of_the_sphere_is_a_cap(sphere, scene):
    assert is_cap(sphere)
    assert not is_cap(scene)
    with pytest.raises(UnknownNameError, match="did you mean lanes"):
        ms.Exploration(pattern="lane")


@pytest.mark.deep
def test_a_region_without_taxels_and_a_body_without_an_arm():
    body = ms.Body.sphere(0.05)
    region = HalfSpace((0.0, 0.0, 1.0), 0.04)
    plan = ms.explore(body, region, exploration=LANES, mode="quasi_static")
    assert plan.unreachable == {}
    assert plan.path.postures is None
    assert len(plan.segments) == 1
    wide = ms.explore(body, region,
                      exploration=replace(LANES, contacts=20.0), mode="quasi_static")  # fmt: skip
    assert wide.spacing > 1.2 * plan.spacing
    assert len(wide.path.points) < len(plan.path.points)


@pytest.mark.deep
def test_the_spacing_of_lanes_follows_the_contact_patch():
    body, region = ms.Body.sphere(0.05), HalfSpace((0.0, 0.0, 1.0), 0.045)
    plain, small = (
        ms.explore(
            body, region, indenter=ms.Indenter.sphere(radius), force=force, mode="quasi_static"
        )
        for radius, force in ((0.01, 3.0), (0.004, 1.0))
    )
    assert plain.spacing == pytest.approx(3.5e-3, rel=0.15)
    assert small.spacing < 0.5 * plain.spacing
    assert plain.unreachable == small.unreachable == {}


def test_a_body_far_from_the_arm_is_out_of_reach(sphere):
    far = sphere.with_(exploration=LANES, indenter=ms.Indenter.sphere(0.01, (2.0, 0.0, 0.7)))
    with pytest.raises(ReachError, match=f"nothing of the skin .*{OUT_OF_REACH}.*80 taxels"):
        plan_exploration(far)


def test_a_joint_that_cannot_turn_enough_is_named(sphere):
    stiff = replace(sphere.arm, lower=sphere.arm.lower.copy(), upper=sphere.arm.upper.copy())
    stiff.lower[4], stiff.upper[4] = -0.05, 0.05
    with pytest.raises(ReachError, match=f"{LIMIT} of joint5"):
        plan_exploration(sphere.with_(exploration=LANES, arm=stiff))


@pytest.mark.deep
def test_taxels_beyond_a_joint_limit_are_listed_and_the_others_explored(sphere):
    arm = replace(sphere.arm, lower=sphere.arm.lower.copy(), upper=sphere.arm.upper.copy())
    wide = ms.Skin.cover(sphere.body, count=24, spacing=16e-3, region=Cap((0.0, 0.0, -1.0)))
    arm.lower[4], arm.upper[4] = -1.2, -0.9
    scene = sphere.with_(exploration=LANES, arm=arm, skin=wide)
    plan = plan_exploration(scene)
    assert 0 < len(plan.unreachable) < 24
    assert set(plan.unreachable.values()) == {f"{LIMIT} of joint5"}
    for q in angles(scene, plan):
        assert q[:, 4].min() > -1.2
        assert q[:, 4].max() < -0.9


@pytest.mark.slow
def test_the_inside_of_a_narrow_ring_is_left_out_with_the_reason():
    body = ms.Body.torus(0.06, 0.04)
    skin = ms.Skin.cover(body, spacing=10e-3, region=HalfSpace((0.0, 1.0, 0.0), 0.005))
    radial = skin.positions * [1, 1, 0]
    outward = (skin.normals * radial).sum(axis=1) / np.linalg.norm(radial, axis=1)
    inside, outside = set(skin.ids[outward < -0.97]), set(skin.ids[outward > 0.0])
    assert len(inside) > 4
    small = ms.explore(
        body, skin, indenter=ms.Indenter.sphere(0.005), force=1.0, exploration=LANES,
        mode="quasi_static", dt=5e-3,
    )  # fmt: skip
    assert not outside & set(small.unreachable)
    assert {small.unreachable.get(k) for k in inside} == {collision.SUPPORT}  # the ring's far side
    large = ms.Indenter(radius=0.04, support_radius=1e-3, support_height=1e-3)
    plan = ms.explore(
        body, skin, indenter=large, force=10.0, exploration=SPARSE, mode="quasi_static", dt=5e-3
    )
    assert not outside & set(plan.unreachable)
    assert {plan.unreachable.get(k) for k in inside} == {collision.HOLLOW}


@pytest.mark.deep
def test_the_arm_avoids_the_support_and_the_body(sphere):
    plan = plan_exploration(sphere.with_(exploration=LANES))
    q = np.concatenate(list(angles(sphere, plan)))[::20]
    poses = sphere.arm.pose(q) @ sphere.mount_pose
    held = collision.allowed_collisions(sphere.arm, sphere.body, sphere.mount_pose)
    assert not collision.arm_reasons(sphere.arm, sphere.body, q, poses, sphere.indenter, held).any()
    wall = ms.Indenter(support_radius=0.004, support_height=0.6)
    # a column through the forearm: the indenter's place moved onto a link
    ends = collision.arm_capsules(sphere.arm).at(q[:1])[0]
    middle = ends[-1].mean(axis=0)
    pierced = replace(wall, position=(middle[0], middle[1], middle[2] + 0.3))
    why = collision.arm_reasons(sphere.arm, sphere.body, q[:1], poses[:1], pierced, held)
    assert why[0] == collision.ARM_SUPPORT
    shifted = poses[:1].copy()
    shifted[0, :3, 3] = ends[0].mean(axis=0)  # the body about the upper arm
    why = collision.arm_reasons(sphere.arm, sphere.body, q[:1], shifted, sphere.indenter, held)
    assert why[0] == collision.ARM_BODY


def test_contacts_on_the_far_face_of_a_plate_do_not_cover_a_taxel():
    grid = np.stack(np.meshgrid(*[np.arange(-4.0, 5.0) * 1e-3] * 2), axis=-1).reshape(-1, 2)
    points = np.column_stack([grid, np.full(len(grid), 1.5e-3)])
    up = np.tile([0.0, 0.0, 1.0], (len(grid), 1))
    path = Path(
        1e-3, points, up, np.tile(np.eye(4), (len(grid), 1, 1)), np.zeros((len(grid), 6)),
        np.zeros(len(grid), dtype=int),
    )  # fmt: skip
    poses = np.tile(np.eye(4), (2, 1, 1))
    poses[:, 2, 3] = 1.5e-3, -1.5e-3
    poses[1, :3, :3] = np.diag([1.0, -1.0, -1.0])
    left_out = taxels_left_out(ms.Skin(poses, np.array([0, 1])), 5e-3, [path], [])
    assert left_out == {1: NOT_COVERED}
    line = replace(path, **{name: getattr(path, name)[:9] for name in ROWS})
    skin = ms.Skin(poses[:1], np.array([0]))
    assert taxels_left_out(skin, 8e-3, [line], []) == {0: ONE_LINE}
    single = replace(path, **{name: getattr(path, name)[:1] for name in ROWS})
    assert taxels_left_out(skin, 8e-3, [single], []) == {0: NOT_COVERED}


@pytest.mark.deep
def test_lanes_too_far_apart_are_named_with_the_remedy(sphere):
    scene = sphere.with_(
        loop=replace(sphere.loop, mode="quasi_static"),
        exploration=replace(sphere.exploration, pattern="lanes", lane_spacing=0.02),
    )
    felt = scene.rig.sensing_radius
    left_out = plan_exploration(scene).path.unreachable
    assert len(left_out) > 20
    for why in left_out.values():
        assert "lanes are 20 mm apart, contacts felt within" in why
    closer = replace(scene.exploration, lane_spacing=0.75 * felt)
    assert why.endswith(f"bring lanes to {750 * felt:.2g} mm")
    assert not plan_exploration(scene.with_(exploration=closer)).path.unreachable


@pytest.mark.deep
def test_no_slide_leads_through_a_thin_plate():
    plate = trimesh.creation.box((0.06, 0.04, 0.003))
    body = ms.Body.from_mesh(plate)
    base = ms.Scene.load("sphere")
    scene = base.with_(
        body=body,
        skin=ms.Skin.cover(body, spacing=1e-2, disc_radius=2e-3),
        exploration=LANES,
        loop=replace(base.loop, mode="quasi_static"),
    )
    path = plan_exploration(scene).path
    segments = path.segments
    sides = [np.sign(segment.points[[0, -1], 2]) for segment in segments]
    assert {-1.0, 1.0} == set(np.ravel(sides))
    for segment in segments:
        assert np.ptp(np.sign(segment.points[:, 2])) == 0
    for force in np.unique(path.forces):  # one side after the other
        own = [side for side, at in zip(sides, path.forces, strict=True) if at == force]
        assert np.count_nonzero(np.diff(np.ravel(own))) <= 1
