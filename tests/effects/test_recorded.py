"""Effects on recorded contacts: facets, poses, offsets, joint angles, forces, sampling."""

import math
from dataclasses import replace

import numpy as np
import pytest

from meshskin.core.config import STANDARD_GRAVITY
from meshskin.core.errors import ConfigError
from meshskin.core.se3 import exp_so3, transform
from meshskin.effects.body_pose import BodyPose
from meshskin.effects.encoder import Encoder
from meshskin.effects.force_sensor import ForceSensor
from meshskin.effects.frames import FrameHistory
from meshskin.effects.gravity_error import GravityError
from meshskin.effects.indenter_offset import IndenterOffset
from meshskin.effects.joint_friction import FRICTION_SPEED, JointFriction, lever_arms
from meshskin.effects.mesh_facets import MeshFacets
from meshskin.effects.sampling import Sampling
from meshskin.geometry.body import Body

STEP = 5e-4


@pytest.fixture
def frames(glide):
    """40 contacts along 20 mm."""
    return glide(STEP * np.arange(40))


def test_facets_lie_inside_the_sphere_and_converge_with_the_mesh(context, frames):
    errors = []
    for faces in (320, 1280, 5120, 20480):
        body = Body.sphere(0.1, faces=faces)
        got = MeshFacets().build(replace(context, body=body))(frames)
        radius = np.linalg.norm(got.points, axis=1)
        assert np.all(radius <= 0.1 * (1 + 1e-12))
        flat = body.mesh.face_normals @ got.normals.T
        np.testing.assert_allclose(flat.max(axis=0), 1.0)
        errors.append(np.linalg.norm(got.points - frames.points, axis=1).max())
    slope = np.polyfit(np.log2([320, 1280, 5120, 20480]) / 2, np.log2(errors), 1)[0]
    assert slope == pytest.approx(-1.0, abs=0.25)  # the normal's error times the indenter's radius
    assert errors[2] <= MeshFacets().bound(context)


def test_facets_apply_to_contacts_moved_by_another_effect(context, frames):
    turn = BodyPose(translation=(0.0, 0.0, 0.0), rotation=(0.0, 0.01, 0.0)).build(context)
    flat = MeshFacets().build(context)
    one, other = turn(flat(frames)), flat(turn(frames))
    np.testing.assert_allclose(one.points, other.points, atol=1e-9)


def test_rotated_body_rotates_all_contacts(context, frames):
    w = (0.002, -0.003, 0.001)
    got = BodyPose(translation=(0.0, 0.0, 0.0), rotation=w).build(context)(frames)
    np.testing.assert_allclose(got.points, frames.points @ exp_so3(w).T, atol=1e-8)
    still = BodyPose(translation=(0.0, 0.0, 0.0)).build(context)(frames)
    np.testing.assert_allclose(still.points, frames.points, atol=1e-8)


def test_displacement_of_the_body_moves_contacts_only_tangentially(context, glide):
    frames = glide(np.zeros(3))
    got = BodyPose(translation=(2e-4, 0.0, 0.0)).build(context)(frames)
    shrink = 0.1 / np.linalg.norm(frames.centres[0])
    np.testing.assert_allclose(got.points[:, 0], 2e-4 * shrink, rtol=1e-3)
    deep = BodyPose(translation=(0.0, 0.0, -2e-4)).build(context)(frames)
    np.testing.assert_allclose(deep.points, frames.points, atol=1e-9)
    np.testing.assert_allclose(deep.centres[:, 2], frames.centres[:, 2] - 2e-4)


def test_indenter_offset_is_constant_in_the_world(context, glide):
    rng = np.random.default_rng(2)
    frames = glide(np.zeros(20), q=rng.uniform(-1, 1, (20, 6)))
    d = np.array([1e-4, -2e-4, 3e-4])
    got = IndenterOffset(offset=tuple(d)).build(context)(frames)
    body = context.pose(frames.q)[:, :3, :3].swapaxes(1, 2) @ d
    shrink = 0.1 / np.linalg.norm(frames.centres[0])
    shift = (got.points - frames.points)[:, :2]
    np.testing.assert_allclose(shift, shrink * body[:, :2], atol=1e-6)
    assert np.linalg.norm(got.points - frames.points, axis=1).max() <= np.linalg.norm(d)
    none = IndenterOffset(offset=(0.0, 0.0, 0.0)).build(context)(frames)
    np.testing.assert_allclose(none.points, frames.points, atol=1e-9)


def angles(recording):
    """Joint angles (k, 6) of every 40th contact."""
    columns = [recording.motion.column(f"q{k + 1}").to_numpy() for k in range(6)]
    times = recording.motion.column("time").to_numpy()
    return np.stack(columns, axis=1)[np.searchsorted(times, recording.time[::40])]


def across(sphere, context, q, normals):
    """Tangential Jacobian (k, 3, 6) of the indenter's centre in the body frame by the joints."""
    pose, jacobian = sphere.arm.pose(q), sphere.arm.jacobian(q)
    lever = context.indenter_position - pose[:, :3, 3]
    turning = np.cross(jacobian[:, 3:], lever[:, :, None], axis=1)
    speed = -(jacobian[:, :3] + turning)  # of the indenter as the tip sees it
    local = np.swapaxes(context.pose(q)[:, :3, :3], 1, 2) @ speed
    return local - normals[:, :, None] * (normals[:, None, :] @ local)


def test_encoder_offsets_displace_contacts_by_the_jacobian(sphere, context, recording):
    q = angles(recording)
    centres = recording.points[::40] + 0.008 * recording.normals[::40]
    effect = Encoder(offset_spread=1e-5, noise_spread=0.0)
    hit = sphere.body.closest(centres)

    def foot(x):
        found = sphere.body.closest(x)
        return found.point, found.normal

    frames = _frames(recording.time[::40], centres, hit, q, foot)
    got = effect.build(context)(frames)
    offset = 1e-5 * context.stream("encoder").standard_normal(6)
    want = across(sphere, context, q, hit.normal) @ offset
    shift = got.points - frames.points
    np.testing.assert_allclose(shift, want * 0.1 / 0.108, atol=2e-8)
    assert np.abs(shift).max() > 1e-6
    still = Encoder(offset_spread=0.0, noise_spread=0.0).build(context)(frames)
    np.testing.assert_allclose(still.points, frames.points, atol=1e-9)


def test_bound_of_encoder_is_the_largest_singular_value_over_all_postures(
    sphere, context, recording
):
    """At most 5 % above that over the simulated path."""
    moves = across(sphere, context, angles(recording), recording.normals[::40])
    lever = np.linalg.norm(moves, 2, axis=(1, 2)).max() * 0.1 / 0.108
    one, both = Encoder(1e-4, 0.0), Encoder(3e-4, 4e-4)
    assert 1.0 <= one.bound(context) / (3.44e-4 * lever) <= 1.05
    assert both.bound(context) == pytest.approx(5 * one.bound(context))
    # 3.44 in two dimensions is as rare as 3 in one
    assert np.exp(-(3.44**2) / 2) == pytest.approx(math.erfc(3 / np.sqrt(2)), rel=0.01)
    nowhere = replace(context, postures=lambda: np.zeros((0, 6)))
    assert one.bound(nowhere) == np.inf
    assert one.bound(replace(context, joints=0)) == 0.0


def _frames(time, centres, hit, q, foot):
    from meshskin.effects.frames import Frames

    force = np.full(len(time), 3.0)
    return Frames(
        time, hit.point, hit.normal, force, centres, hit.curvature, hit.direction, q, foot
    )


def test_encoder_noise_is_one_stream_over_the_batches(context, frames, split):
    whole = Encoder().build(context)(frames).points
    parts = split(Encoder().build(context), frames)
    np.testing.assert_allclose(np.vstack([p.points for p in parts]), whole, atol=1e-12)
    with pytest.raises(ConfigError, match="needs the joints of an arm"):
        Encoder().build(replace(context, joints=0))


def test_ignored_weight_reduces_the_force_where_the_skin_faces_down(context, frames):
    effect = GravityError(mass=0.1)

    def facing(rotation):
        poses = np.tile(np.eye(4), (len(frames), 1, 1))
        poses[:, :3, :3] = rotation
        return effect.build(replace(context, pose=lambda q: poses))(frames).force - frames.force

    down = facing(np.eye(3))  # the frames' normals point to -z at first
    assert down[0] == pytest.approx(-0.1 * STANDARD_GRAVITY)
    assert facing(exp_so3([np.pi, 0.0, 0.0]))[0] == pytest.approx(0.1 * STANDARD_GRAVITY)
    assert facing(exp_so3([np.pi / 2, 0.0, 0.0]))[0] == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(down, 0.1 * STANDARD_GRAVITY * frames.normals[:, 2])


def test_force_sensor_has_its_bias_and_noise(context, glide, split):
    frames, effect = glide(np.zeros(4000)), ForceSensor(noise=0.1, bias=0.3)
    got = effect.build(context)(frames)
    error = got.force - frames.force
    assert error.mean() == pytest.approx(0.3, abs=4 * 0.1 / np.sqrt(4000))
    assert error.std() == pytest.approx(0.1, rel=4 / np.sqrt(8000))
    np.testing.assert_array_equal(got.points, frames.points)
    parts = split(effect.build(context), frames)
    np.testing.assert_array_equal(np.concatenate([p.force for p in parts]), got.force)


def test_slow_sampling_holds_the_last_sample(context, frames):
    got = Sampling(rate=25.0).build(context)(frames)
    np.testing.assert_array_equal(got.time, frames.time)
    np.testing.assert_array_equal(got.points, frames.points[4 * (np.arange(40) // 4)])
    same = Sampling(rate=100.0).build(context)(frames)
    np.testing.assert_allclose(same.points, frames.points, atol=1e-12)


def test_late_samples_lag_by_the_delay(context, frames):
    got = Sampling(rate=100.0, delay=0.025).build(context)(frames)
    behind = np.linalg.norm(got.points - frames.points, axis=1)[5:]
    np.testing.assert_allclose(behind, 0.05 * 0.03, rtol=1e-3)  # 2.5 periods, the third whole
    assert behind.max() <= Sampling(rate=100.0, delay=0.025).bound(context)


def test_sampling_does_not_depend_on_the_batches(context, frames, split):
    effect = Sampling(rate=30.0, delay=0.05)
    whole = effect.build(context)(frames).points
    parts = split(effect.build(context), frames)
    np.testing.assert_allclose(np.vstack([p.points for p in parts]), whole, atol=1e-15)


def test_interpolated_directions_are_unit_tangents_for_any_signs(glide):
    """The sign of a principal direction is arbitrary; on a sphere it is any tangent."""
    frames = glide(5e-4 * np.arange(6))
    flipped = replace(frames, directions=frames.directions * [[1], [-1], [1], [-1], [-1], [1]])
    history = FrameHistory(0.1, 0.01)
    history.append(flipped)
    at = history.interpolate(np.linspace(0.0, 0.05, 37))
    np.testing.assert_allclose(np.linalg.norm(at.directions, axis=1), 1.0, rtol=1e-12)
    np.testing.assert_allclose(np.sum(at.directions * at.normals, axis=1), 0.0, atol=1e-12)


def test_sample_at_the_time_of_the_last_frame_before_a_loss_of_contact(glide):
    """A time above that of the last frame by rounding must not give the next contact."""
    frames = glide(5e-4 * np.arange(6))
    time = np.array([0.0, 0.01, 0.02, 0.5, 0.51, 0.52])
    history = FrameHistory(0.1, 0.01)
    history.append(replace(frames, time=time))
    at = history.interpolate(np.nextafter(time, 1.0))
    np.testing.assert_allclose(at.points, frames.points, atol=1e-12)


def test_friction_of_one_joint_acts_over_its_lever_arm(context, glide):
    """A joint about the y axis, 0.4 m beside the contact: T / 0.4 m with the sign of its speed."""

    def swing(q):
        turn = exp_so3(np.outer(q[:, 0], [0.0, 1.0, 0.0]))
        middle = np.array([0.4, 0.0, 0.0])
        return transform(turn, middle - turn @ middle)

    one = replace(context, joints=1, pose=swing)
    for rate in (0.3, -0.3, 0.0):
        frames = glide(np.zeros(20), q=rate * 0.01 * np.arange(20)[:, None] - 1e-9)
        more = JointFriction(0.2).build(one)(frames).force - frames.force
        # n points down, and turning on lifts what lies at 0.4 m less x: h = -0.4 cos(q)
        lever = lever_arms(one, frames.q, frames.points, frames.normals)[:, 0]
        want = np.sign(rate) * np.tanh(0.3 / FRICTION_SPEED) * 0.2 / lever
        np.testing.assert_allclose(more[1:], want[1:], rtol=1e-9)
        assert abs(lever[0]) == pytest.approx(0.4, rel=1e-6)
        assert more[0] == 0.0  # not known to move yet


def test_lever_arms_equal_the_jacobian_along_the_normal(context, sphere, frames):
    """By the Jacobian of the arm at the tip, transferred to the contact point."""
    rng = np.random.default_rng(4)
    q = rng.uniform(-1.0, 1.0, (len(frames), 6))
    pose, jacobian = context.pose(q), np.stack([sphere.arm.jacobian(one) for one in q])
    tip = sphere.arm.pose(q)[:, :3, 3]
    place = np.einsum("kij,kj->ki", pose[:, :3, :3], frames.points) + pose[:, :3, 3]
    normal = np.einsum("kij,kj->ki", pose[:, :3, :3], frames.normals)
    arm = np.cross(np.swapaxes(jacobian[:, 3:], 1, 2), (place - tip)[:, None])
    want = np.einsum("kij,kj->ki", np.swapaxes(jacobian[:, :3], 1, 2) + arm, normal)
    np.testing.assert_allclose(
        lever_arms(context, q, frames.points, frames.normals), want, atol=1e-9
    )


def test_joint_friction_needs_an_arm(context):
    with pytest.raises(ConfigError, match="joints of an arm"):
        JointFriction(0.1).build(replace(context, joints=0))
    assert JointFriction(0.2).bound(context) == pytest.approx(2 * JointFriction(0.1).bound(context))


def test_joint_friction_does_not_depend_on_the_batches(context, glide, split):
    frames = glide(STEP * np.arange(30), q=np.cumsum(np.full((30, 6), 1e-3), axis=0))
    whole = JointFriction(0.1).build(context)(frames).force
    parts = split(JointFriction(0.1).build(context), frames)
    np.testing.assert_allclose(np.concatenate([p.force for p in parts]), whole, rtol=1e-12)
