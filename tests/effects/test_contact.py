"""Friction, relaxation, cover fabric and scan order."""

from dataclasses import replace

import numpy as np
import pytest

from meshskin.core.se3 import transform
from meshskin.effects.cover_fabric import CoverFabric
from meshskin.effects.friction import Friction
from meshskin.effects.relaxation import Relaxation
from meshskin.effects.scan_order import ScanOrder

STEP = 5e-4


def arc(frames, points=None):
    """Arc length of the patch along the x axis, m."""
    p = frames.points if points is None else points
    return 0.1 * np.arctan2(p[:, 0], -p[:, 2])


def test_sliding_patch_lags_by_the_shear_at_slip(context, glide):
    effect = Friction(coefficient=0.2)
    # 1.5 mu F / k_t, with Mindlin's tangential stiffness k_t = 8 a G / (2 - nu)
    stiffness = 8 * context.contact_radius * context.shear_modulus / (2 - context.poisson)
    assert effect.slip(context) == pytest.approx(1.5 * 0.2 * 3.0 / stiffness)
    frames = glide(STEP * np.arange(60))
    got = effect.build(context)(frames)
    np.testing.assert_allclose(arc(frames)[10:] - arc(got)[10:], effect.slip(context), rtol=1e-4)
    np.testing.assert_array_equal(got.force, frames.force)
    np.testing.assert_array_equal(got.normals, frames.normals)


def test_contact_sticks_before_slip_and_after_a_reversal(context, glide):
    effect = Friction(coefficient=0.5)
    slip = effect.slip(context)
    there = np.linspace(0.0, 4 * slip, 200)
    path = np.concatenate([there, there[::-1][1:]])
    shear = path - arc(effect.build(context)(glide(path)))
    stuck = path[:200] < 0.9 * slip
    np.testing.assert_allclose(shear[:200][stuck], path[:200][stuck], rtol=1e-3, atol=1e-9)
    back = 4 * slip - path[199:]
    np.testing.assert_allclose(shear[199:], np.maximum(slip - back, -slip), rtol=5e-3, atol=2e-6)


def test_shear_grows_with_the_force_and_ends_with_the_contact(context, glide):
    frames = glide(STEP * np.arange(60), force=24.0)
    effect = Friction()
    behind = arc(frames) - arc(effect.build(context)(frames))
    assert behind[-1] == pytest.approx(4 * effect.slip(context), rel=1e-3)
    frictionless = Friction(coefficient=0.0).build(context)(frames)
    np.testing.assert_allclose(frictionless.points, frames.points, atol=1e-15)
    lost = glide(STEP * np.arange(60), period=0.02)
    np.testing.assert_allclose(effect.build(context)(lost).points, lost.points, atol=1e-15)


def test_friction_does_not_depend_on_the_batches(context, glide, split):
    frames = glide(STEP * np.sin(np.arange(60)) * np.arange(60))
    whole = Friction().build(context)(frames).points
    parts = split(Friction().build(context), frames)
    np.testing.assert_array_equal(whole, np.vstack([p.points for p in parts]))


def test_sudden_pressure_relaxes_as_the_standard_linear_solid(context, glide):
    effect = Relaxation(relaxed=0.7, time_constant=0.2)
    frames = glide(np.zeros(600))
    p = np.zeros((600, 2))
    p[400:, 0], p[:, 1] = 1.0, 1.0
    got = effect.build(context)(p, frames)
    # the force is controlled, so that the reading is G(t) / g
    age = frames.time[400:] - frames.time[400] + 0.005
    want = (0.7 + 0.3 * np.exp(-age / 0.2)) / 0.7
    np.testing.assert_allclose(got[400:, 0], want, rtol=2e-3)
    np.testing.assert_allclose(got[:, 1], 1.0, rtol=1e-12)  # constant at rest
    assert np.all(np.diff(got[400:, 0]) < 0)


def along(path, a=4e-3):
    """Hertz pressures of a patch that slides over points on a line, and the points."""
    positions = np.arange(-0.02, 0.06, STEP / 4)
    return np.sqrt(np.maximum(1 - ((positions - path[:, None]) / a) ** 2, 0.0)), positions


def test_relaxing_patch_leads_and_loses_contact_behind(context, glide):
    path = STEP * np.arange(80)
    p, positions = along(path)
    got = Relaxation(relaxed=0.95, time_constant=0.1).build(context)(p, glide(path))
    lead = (got @ positions / got.sum(axis=1) - path)[40:]
    assert np.all(lead > 2e-5)
    assert np.all(got[p == 0] == 0)
    excess = got[40:].sum(axis=1) / p[40:].sum(axis=1)
    assert np.all((excess > 1.0) & (excess < 1.03))
    np.testing.assert_array_equal(Relaxation(relaxed=1.0).build(context)(p, glide(path)), p)


def test_relaxation_depends_on_the_rate(context, glide):
    """Much faster or slower than the relaxation time, the skin responds as a spring."""
    path = STEP * np.arange(80)
    p, positions = along(path)

    def lead(time_constant):
        act = Relaxation(relaxed=0.9, time_constant=time_constant).build(context)
        got = act(p, glide(path))[40:]
        return float(np.mean(got @ positions / got.sum(axis=1) - path[40:]))

    # the patch of 8 mm passes at 50 mm/s in 0.16 s
    slow, middle, fast = lead(1e-3), lead(0.08), lead(20.0)
    assert middle > 5e-5
    assert abs(slow) < middle / 10
    assert abs(fast) < middle / 10


def test_relaxation_preserves_the_force_where_contact_is_kept(context, glide):
    path = STEP * np.arange(80)
    p = along(path)[0] + 1.0
    frames = glide(path, force=p.sum(axis=1))
    got = Relaxation(relaxed=0.6, time_constant=0.1).build(context)(p, frames)
    np.testing.assert_allclose(got.sum(axis=1), p.sum(axis=1), rtol=1e-12)
    assert np.abs(got - p).max() > 0.01


def test_lead_of_a_steadily_sliding_patch(context, glide):
    """The state h lags by v tau, so that the first moment leads by v tau (1 - g) / g."""
    path = STEP * np.arange(80)
    patch, positions = along(path)
    p = patch + 1.0
    frames = glide(path, force=p.sum(axis=1))
    got = Relaxation(relaxed=0.8, time_constant=0.04).build(context)(p, frames)
    lead = ((got - 1.0) @ positions / patch.sum(axis=1) - path)[60:]
    np.testing.assert_allclose(lead, 0.05 * 0.04 * 0.2 / 0.8, rtol=1e-3)


def test_relaxation_does_not_depend_on_the_batches(context, glide, split):
    path = STEP * np.arange(80)
    p, _ = along(path)
    whole = Relaxation().build(context)(p, glide(path))
    parts = split(Relaxation().build(context), glide(path), p)
    np.testing.assert_array_equal(whole, np.vstack(parts))


def plane(side=81, step=4e-4):
    """Poses of points on a square in the tangent plane at the bottom of the sphere."""
    x = step * (np.arange(side) - side // 2)
    grid = np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2)
    down = np.diag([1.0, -1.0, -1.0])  # taxel normals point outward
    return transform(down, np.column_stack([grid, np.full(len(grid), -0.1)]))


def test_cover_spreads_pressure_and_preserves_the_force(sphere, context, glide):
    frames, poses = glide([0.0]), plane()
    field = sphere.reading_model
    bare = field(frames, poses)[0]
    covered = CoverFabric(width=1e-3).build(context)(field)(frames, poses)[0]
    assert bare.sum() * 1.6e-7 == pytest.approx(3.0, rel=1e-3)
    assert covered.sum() * 1.6e-7 == pytest.approx(3.0, rel=1e-3)
    assert covered.max() < 0.97 * bare.max()
    assert np.all(covered[bare == 0] >= 0)
    assert covered[bare == 0].max() > 0


@pytest.mark.parametrize("width", [3e-4, 1e-3, 3e-3])
def test_bound_of_cover_is_its_largest_change_of_a_reading(sphere, context, glide, width):
    """Twice the relative change in contact radii, which is below 2 sqrt(w a)."""
    frames, poses = glide([0.0]), plane()
    field, effect = sphere.reading_model, CoverFabric(width=width)
    change = np.abs(effect.build(context)(field)(frames, poses) - field(frames, poses)).max()
    bound = 2.0 * change / context.peak_pressure * context.contact_radius
    assert effect.bound(context) == pytest.approx(bound, rel=0.02)
    assert effect.bound(context) < 2.0 * np.sqrt(width * context.contact_radius)


def test_blur_is_exact_for_polynomials(context, glide):
    """The mean of x^4 under a Gaussian of variance w^2 is x^4 + 6 w^2 x^2 + 3 w^4."""

    def quartic(frames, poses):
        return poses[None, :, 0, 3] ** 4

    poses, w = plane(), 2e-3
    x = poses[:, 0, 3]
    got = CoverFabric(width=w).build(context)(quartic)(glide([0.0]), poses)[0]
    np.testing.assert_allclose(got, x**4 + 6 * w**2 * x**2 + 3 * w**4, rtol=1e-9)


def test_each_slot_reads_the_contact_at_its_own_time(context, glide):
    """The field is the arc length at 50 mm/s, so that a lag of 10 ms is 0.5 mm."""

    def where(frames, poses):
        return np.tile(arc(frames)[:, None], (1, len(poses)))

    frames, poses = glide(STEP * np.arange(20)), context.skin.poses
    effect = ScanOrder(slots=4, latency=0.002)
    got = effect.build(context)(where)(frames, poses)
    behind = arc(frames)[3:, None] - got[3:]
    lag = np.array([9.5e-3, 7e-3, 4.5e-3, 2e-3])
    np.testing.assert_allclose(behind, np.tile(0.05 * np.tile(lag, 20), (17, 1)), rtol=1e-4)
    assert np.all(got[0] == arc(frames)[0])
    assert effect.bound(context) == pytest.approx(0.05 * 9.5e-3)


def test_slots_follow_the_ids_where_modules_have_gaps(context, glide):
    """iCub's modules have no taxel in slots 6 and 10: the next module begins at slot 0 again."""

    def where(frames, poses):
        return np.tile(arc(frames)[:, None], (1, len(poses)))

    slots = np.delete(np.arange(12), [6, 10])
    ids = (12 * np.arange(8)[:, None] + slots).ravel()
    modular = replace(context, skin=replace(context.skin, ids=ids))
    frames = glide(STEP * np.arange(20))
    effect = ScanOrder()
    got = effect.build(modular)(where)(frames, modular.skin.poses)
    behind = arc(frames)[3:, None] - got[3:]
    lag = np.tile(effect.lags(modular)[slots], 8)
    np.testing.assert_allclose(behind, np.tile(0.05 * lag, (17, 1)), rtol=1e-4, atol=1e-12)


def test_scan_does_not_depend_on_the_batches(sphere, context, glide, split):
    frames, poses = glide(STEP * np.arange(40)), context.skin.poses
    whole = ScanOrder(latency=0.013).build(context)(sphere.reading_model)(frames, poses)
    field = ScanOrder(latency=0.013).build(context)(sphere.reading_model)
    parts = split(lambda some: field(some, poses), frames)
    np.testing.assert_allclose(np.vstack(parts), whole, rtol=1e-12, atol=1e-9)
    assert whole.max() > 0


def test_scan_does_not_look_back_over_a_lost_contact(context, glide):
    def where(frames, poses):
        return np.tile(arc(frames)[:, None], (1, len(poses)))

    frames = glide(STEP * np.arange(20), period=0.1)
    got = ScanOrder().build(context)(where)(frames, context.skin.poses)
    np.testing.assert_array_equal(got, where(frames, context.skin.poses))
