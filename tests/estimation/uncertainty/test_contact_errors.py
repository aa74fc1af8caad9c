"""Errors of body, contact points and clocks are in the covariances as far as contacts show them."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pytest
import trimesh

import meshskin as ms
from meshskin.estimation.calibrate import METHODS
from meshskin.estimation.data.gather import gather
from meshskin.estimation.uncertainty import contact_errors, surface_errors
from meshskin.geometry.region import Cap
from meshskin.recording.recording import Recording

from ...real_data import DATA, needs_ur3e

CONTACTS = 500


def press(scene, seed=0):
    """A log in back-and-forth lanes 2 mm apart, with forces from 2.5 to 3.5 N."""
    rng, skin = np.random.default_rng(seed), scene.skin
    near = skin.positions[rng.integers(len(skin), size=CONTACTS)]
    points = scene.body.closest(near + rng.uniform(-5e-3, 5e-3, (CONTACTS, 3))).point
    lane = np.floor(points[:, 0] / 2e-3).astype(int)
    points = points[np.lexsort((points[:, 1] * np.where(lane % 2, 1, -1), lane))]
    made = ms.press(scene, points, force=rng.uniform(2.5, 3.5, CONTACTS), seed=seed)
    return Recording(made.contacts, made.readings, {})


def moved(recording, displacement):
    """The recording with its contact points moved by displacements (m, 3), m."""
    return recording.with_columns(points=recording.points + displacement)


def late(recording, frames):
    """The recording with its readings some contacts too late; negative: too early."""
    row = recording.reading_contact + frames
    kept = (row >= 0) & (row < len(recording.time))
    table = recording.readings.filter(pa.array(kept))
    time = pa.array(recording.time[row[kept]])
    table = table.set_column(table.column_names.index("time"), "time", time)
    return Recording(recording.contacts, table, {})


def test_a_taxel_that_reads_zero_leaves_the_means_of_others():
    data = SimpleNamespace(
        ids=np.arange(2), taxel=np.array([0, 0, 1]), contact=np.arange(3),
        pressure=np.array([1.0, 1.0, 0.0]),
    )  # fmt: skip
    mean, variance = surface_errors.local_means(data, np.array([1e-3, 3e-3, 5e-3]))
    np.testing.assert_allclose(mean, [2e-3, 0.0])
    assert np.isfinite(variance).all()


def stated_over_true(found, truth):
    """RMS of the stated standard deviations over that of the errors, in space."""
    error = np.linalg.norm(found.positions - truth, axis=1)
    good = np.isfinite(error)
    assert not np.any((error > 0.3e-3) & (error > 5 * found.position_sigma))
    return np.sqrt(np.mean(found.position_sigma[good] ** 2) / np.mean(error[good] ** 2))


@pytest.fixture(scope="module")
def log(noisy):
    return press(noisy)


@pytest.mark.parametrize(
    "method", ["joint", *(pytest.param(k, marks=pytest.mark.deep) for k in METHODS if k != "joint")]
)
def test_a_body_too_large_is_in_the_variance_of_every_method(noisy, log, method):
    belief = noisy.belief(body=ms.Body.sphere(0.101))
    found = ms.calibrate(log, belief, method=method)
    good = np.isfinite(found.positions[:, 0])
    normal = np.sqrt(found.covariances[good, 2, 2])
    assert normal.min() > 0.999e-3
    assert np.median(normal) == pytest.approx(1e-3, rel=0.01)
    assert 0.5 < stated_over_true(found, noisy.skin.positions) < 2


@pytest.mark.deep
@pytest.mark.parametrize("seed", [0, 1, 2])
def test_an_ellipsoid_too_large(seed):
    scene = ms.Scene.load("ellipsoid")
    log = press(scene, seed)
    exact = ms.calibrate(log, scene.belief())
    assert 0.8 < stated_over_true(exact, scene.skin.positions) < 1.25
    assert np.nanmax(exact.covariances[:, 2, 2]) < (1e-7) ** 2
    wrong = scene.belief(body=ms.Body.ellipsoid([0.1212, 0.0909, 0.0707]))
    assert 0.8 < stated_over_true(ms.calibrate(log, wrong), scene.skin.positions) < 1.25


@pytest.mark.deep
def test_a_learned_response_has_the_error_of_the_body(noisy, log):
    belief = noisy.belief(contact="learned", body=ms.Body.sphere(0.101))
    assert 0.5 < stated_over_true(ms.calibrate(log, belief), noisy.skin.positions) < 2


@pytest.mark.deep
def test_exact_contact_points_add_nothing(noisy, log):
    found = ms.calibrate(log, noisy.belief())
    shape = np.tile(10 * np.eye(2), (len(found.ids), 1, 1))
    data, rotations = gather(log, noisy.belief()), found.poses[:, :3, :3]
    more = contact_errors.systematic_covariance(data, {}, found.positions, rotations, shape)
    assert np.abs(more).max() < 1e-20
    declared = replace(data, belief=noisy.belief(surface_sigma=2e-4))
    more = contact_errors.systematic_covariance(declared, {}, found.positions, rotations, shape)
    assert more[:, 2, 2] == pytest.approx(4e-8)


@pytest.mark.deep
def test_a_declared_error_of_the_surface_holds_a_body_and_contacts_of_another_size():
    """1 % too large, both, as a learned response bears: at the end of a long capsule taxels are
    0.5 mm off along the surface."""
    scene = ms.Scene.load("capsule")
    body = ms.Body.capsule(radius=0.04, length=0.15)
    skin = ms.Skin.cover(body, spacing=6e-3, region=ms.Disc((0.04, 0.0, 0.05), radius=0.02))
    scene = scene.with_(body=body, skin=skin)
    log = press(scene)
    larger = moved(log, 0.01 * log.points)
    believed = scene.belief(body=ms.Body.capsule(radius=0.0404, length=0.1515), contact="learned")
    error = skin.positions * 0.01
    found = {
        sigma: ms.calibrate(larger, replace(believed, surface_sigma=sigma))
        for sigma in (0.0, 0.5e-3)
    }
    good = np.isfinite(found[0.0].positions[:, 0])
    assert good.sum() > 20
    np.testing.assert_allclose(
        (found[0.0].positions - skin.positions)[good], error[good], atol=0.15e-3
    )
    along = {
        sigma: np.sqrt(np.einsum("nii->n", one.covariances[good][:, :2, :2])).mean()
        for sigma, one in found.items()
    }
    assert along[0.0] < 0.1e-3
    assert along[0.5e-3] == pytest.approx(np.abs(error[good, 2]).mean(), rel=0.3)


@pytest.mark.deep
def test_waves_of_the_surface_are_in_the_normal_variance(noisy, log):
    """Contacts and taxels are on a surface with waves, 50 mm long, about the believed sphere."""

    def waves(points):
        return 0.3e-3 * np.sin(2 * np.pi * points[:, 0] / 0.05)

    found = ms.calibrate(moved(log, waves(log.points)[:, None] * log.normals), noisy.belief())
    truth = noisy.skin.positions + waves(noisy.skin.positions)[:, None] * noisy.skin.normals
    normal = np.sum((found.positions - truth) * found.poses[:, :3, 2], axis=1)
    stated = np.sqrt(found.covariances[:, 2, 2])
    assert np.corrcoef(np.abs(normal), stated)[0, 1] > 0.9  # where the waves are high
    assert 0.8 < stated_over_true(found, truth) < 1.6


def test_scatter_of_the_contact_points_averages_out(noisy, log):
    data = gather(log, noisy.belief())
    distance = np.random.default_rng(0).normal(scale=1e-4, size=len(data.points))
    mean, variance = surface_errors.local_means(data, distance)
    assert np.mean(mean**2 / variance) == pytest.approx(1.0, rel=0.3)
    concentration = np.bincount(data.taxel, data.pressure**4)
    concentration /= np.bincount(data.taxel, data.pressure**2) ** 2
    assert variance == pytest.approx(1e-8 * concentration, rel=0.2)


@pytest.mark.deep
@pytest.mark.parametrize("scatter", [pytest.param(0.0, marks=pytest.mark.deep), 1e-4])
def test_displaced_contact_points_displace_taxels(noisy, log, scatter):
    aside = np.random.default_rng(0).normal(scale=scatter, size=log.points.shape)
    aside[:, 0] += 1e-3
    found = ms.calibrate(moved(log, aside), noisy.belief())
    assert 0.95 < stated_over_true(found, noisy.skin.positions) < 1.5  # scatter is a misfit, too
    turn = found.poses[:, :3, :3]
    body = turn @ found.covariances[:, :3, :3] @ np.swapaxes(turn, 1, 2)
    along, across = np.median(np.sqrt([body[:, 0, 0], body[:, 1, 1]]), axis=1)
    assert along == pytest.approx(1e-3, rel=0.2)
    # a turn about the middle of a ball has no distances: it may be a part of the displacement
    assert 0.1e-3 < across < 0.5 * along + 3 * scatter


def test_estimated_offsets_explain_distances(noisy, log):
    """A displacement and a rotation of the contact points, which the estimated offset undoes."""
    turn, shift = np.array([0.0, 0.01, 0.0]), np.array([1e-3, -5e-4, 2e-4])
    rotation = ms.core.se3.exp_so3(turn)
    points = (log.points - shift) @ rotation
    data = gather(moved(log, points - log.points), noisy.belief())
    labels = [f"body_offset {kind}{axis}" for kind in ("", "rotation ") for axis in "xyz"]
    unknowns = {k: (v, 1e-5) for k, v in zip(labels, [*shift, *turn], strict=True)}
    rotations = np.tile(np.eye(3), (len(data.ids), 1, 1))
    shape = np.tile(10 * np.eye(2), (len(data.ids), 1, 1))
    places = np.full((len(data.ids), 3), np.nan)
    left = contact_errors.systematic_covariance(data, unknowns, places, rotations, shape)
    assert np.abs(left).max() < 1e-20
    alone = contact_errors.systematic_covariance(data, {}, places, rotations, shape)
    assert np.sqrt(alone[:, 0, 0]).mean() > 0.5e-3


@pytest.mark.deep
@pytest.mark.parametrize(
    "frames", [-2, 7, *(pytest.param(k, marks=pytest.mark.deep) for k in (1, 3))]
)
def test_late_readings_are_moved_back_and_named(noisy, log, frames):
    found = ms.calibrate(late(log, frames), noisy.belief())
    assert errors(found, noisy) < 1.2 * errors(ms.calibrate(log, noisy.belief()), noisy)
    assert found.verdict.level == "DOUBT"
    size, word = abs(frames), "late" if frames > 0 else "early"
    count = "1 frame" if size == 1 else f"{size} frames"
    assert any(f"readings are {count} too {word}" in reason for reason in found.verdict.reasons)


@pytest.mark.deep
@pytest.mark.parametrize(
    ("frames", "part"),
    [(2, 0.4), *(pytest.param(*k, marks=pytest.mark.slow) for k in ((-3, 0.4), (1, -0.3)))],
)
def test_parts_of_a_frame_are_counted_in_sigma(noisy, log, frames, part):
    along = np.diff(log.points, axis=0, append=log.points[-1:])
    found = ms.calibrate(late(moved(log, part * along), frames), noisy.belief())
    assert 0.7 < stated_over_true(found, noisy.skin.positions) < 4
    assert found.verdict.level != "PASS"


def errors(found, scene):
    """Rms error, m."""
    return np.sqrt(np.mean(np.sum((found.positions - scene.skin.positions) ** 2, axis=1)))


def test_single_wrong_contacts_are_no_displacement_of_all():
    rng = np.random.default_rng(2)
    normals = np.array([[-0.04, 0.0, 1.0]]) * rng.choice([-1.0, 1.0], (2000, 1))
    normals[:, 0] = -0.04
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    distance = rng.normal(0, 1e-6, 2000)
    distance[:7] = 5e-3
    normals[:7] = [-1.0, 0.0, 0.0]
    np.testing.assert_array_equal(contact_errors.displacement(distance, normals), 0.0)
    shift = np.array([2e-3, 0.0, 1e-4])
    found = contact_errors.displacement(distance + normals @ shift, normals)
    np.testing.assert_allclose(found[[0, 2]], shift[[0, 2]], atol=1e-5)


@pytest.mark.deep
@pytest.mark.parametrize(
    ("turn", "stretch", "most"),
    [(0.03, 0.0, 1.5), pytest.param(0.0, 0.015, 3.0, marks=pytest.mark.slow)],
)
def test_turns_and_scales_about_the_middle(turn, stretch, most):
    """Contact points on an ellipsoid, turned about a normal, or scaled: a displacement or a body of
    another size does not explain their distances."""
    scene = ms.Scene.load("ellipsoid")
    log = press(scene)
    arm = log.points - log.points.mean(axis=0)
    axis = log.normals.mean(axis=0) / np.linalg.norm(log.normals.mean(axis=0))
    wrong = moved(log, turn * np.cross(axis, arm) + stretch * arm)
    found = ms.calibrate(wrong, scene.belief())
    # patches that are wider contradict the model: that misfit is in sigma, too
    assert 0.7 < stated_over_true(found, scene.skin.positions) < most
    (reason,) = [words for words in found.verdict.reasons if "nearest to it" in words]
    assert "turned about" in reason
    if stretch:
        assert float(reason.split("scaled by ")[1].split()[0]) == pytest.approx(0.985, abs=1e-3)


@pytest.mark.slow
def test_a_body_mounted_anew_is_named_and_counted(noisy, log):
    half = (np.arange(len(log.points)) >= len(log.points) // 2)[:, None]
    along = np.cross(noisy.skin.normals.mean(axis=0), [1.0, 0.0, 0.0])
    found = ms.calibrate(moved(log, 0.5e-3 * half * along), noisy.belief(contact="auto"))
    assert 0.7 < stated_over_true(found, noisy.skin.positions) < 2.5
    assert found.verdict.level == "DOUBT"
    assert any("a jump of the contacts at 50%" in words for words in found.verdict.reasons)
    sound = ms.calibrate(log, noisy.belief(contact="auto"))
    assert sound.verdict.level == "PASS"
    assert np.median(sound.position_sigma) < 0.05e-3


@pytest.mark.slow
def test_errors_that_neighbouring_contacts_share_are_no_jump(noisy):
    """Contact points 0.1 mm off along the surface, alike within 3 mm: taken as
    independent errors of the readings they show a jump with a score of 10."""
    log, rng = press(noisy, 2), np.random.default_rng(2)
    waves, phase = rng.normal(size=(3, 3, 40)) / 3e-3, rng.uniform(0, 2 * np.pi, (3, 1, 40))
    off = np.cos(np.einsum("mi,jik->jmk", log.points, waves) + phase).sum(axis=2).T / 20**0.5
    off -= np.einsum("mi,mi->m", off, log.normals)[:, None] * log.normals
    found = ms.calibrate(moved(log, 1e-4 * off), noisy.belief(contact="hertz"))
    assert found.verdict.level == "DOUBT"
    assert not any("a jump of the contacts" in words for words in found.verdict.reasons)


def test_a_motion_points_where_the_contact_points_were_moved():
    """Points on a wavy sheet that are all moved by the same, as their distances from it show."""
    rng, moved = np.random.default_rng(0), np.array([0.3e-3, -0.2e-3, 0.5e-3])
    normals = np.column_stack([rng.normal(scale=0.4, size=(400, 2)), np.ones(400)])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    points = np.column_stack([rng.uniform(-0.05, 0.05, (400, 2)), np.zeros(400)])
    data = SimpleNamespace(
        pressure=np.ones(400), ids=np.arange(40), taxel=np.arange(400) % 40,
        contact=np.arange(400), body=ms.Body.sphere(0.05),
    )  # fmt: skip
    found = contact_errors.motion(data, points, normals @ moved, normals)
    np.testing.assert_allclose(found.at(points).mean(axis=0), moved, atol=1e-6)


@pytest.mark.deep
@pytest.mark.parametrize("shifted", [True, False])
def test_motions_of_an_egg_are_counted(shifted):
    """Shifts and turns about the middle, alike in size, and turns alone, are stated as large as
    they are, whatever slides along the surface: the turns are 6 to 13 times the distances that
    they leave. Where these had to be those of a displacement alone, 0.75 of the turns was stated in
    the mean of 96, and single ones as a tenth."""
    mesh = trimesh.creation.icosphere(4)
    mesh.vertices *= np.array([0.06, 0.05, 0.045]) * (1 + 0.15 * mesh.vertices[:, 2:])
    body = ms.Body.from_mesh(mesh)
    grid = 2e-3 * np.stack(np.meshgrid(*2 * [np.arange(-10, 11)]), axis=-1).reshape(-1, 2)
    there = body.closest(np.column_stack([np.full(len(grid), 0.06), grid]))
    data = SimpleNamespace(
        pressure=np.ones(len(grid)), ids=np.arange(49), taxel=np.arange(len(grid)) % 49,
        contact=np.arange(len(grid)), body=body,
    )  # fmt: skip
    bounds, true, stated = mesh.bounds, [], []
    middle, size = bounds.mean(axis=0), np.linalg.norm(np.ptp(bounds, axis=0)) / 2
    rng = np.random.default_rng(0)
    for _ in range(24):
        shift, turn = rng.normal(scale=0.5e-3, size=(2, 3)) * [[shifted], [1 / size]]
        if not shifted:
            turn *= np.radians(0.7) / np.linalg.norm(turn)
        points = middle + shift + (there.point - middle) @ ms.core.se3.exp_so3(turn).T
        points += rng.normal(scale=2e-5, size=points.shape)
        hit = body.closest(points)
        squares = contact_errors.motion(data, points, hit.distance, hit.normal).squares(points)
        along = np.eye(3) - there.normal[:, :, None] * there.normal[:, None, :]
        true.append(np.sum(((points - there.point)[:, None] @ along) ** 2, axis=(1, 2)).mean())
        stated.append(np.einsum("nij,nji->n", along, squares).mean())
    assert np.sqrt(np.median(true)) > 0.4e-3
    assert 0.8 < np.sqrt(np.mean(stated) / np.mean(true)) < 1.25
    assert np.max(np.divide(true, stated)) < 4.0**2


@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 2))])
def test_scatter_off_a_nearly_flat_patch_is_no_change_of_scale(seed):
    """Heights above the middle that hold the scatter would explain it, by a body of no size."""
    body, rng = ms.Body.sphere(0.5), np.random.default_rng(seed)
    there = np.column_stack([rng.uniform(-0.03, 0.03, (600, 2)), np.full(600, 0.5)])
    hit, off = body.closest(there), rng.normal(scale=0.3e-3, size=600)
    bounds = np.array([[-0.05, -0.05, 0.45], [0.05, 0.05, 0.55]])
    points = hit.point + off[:, None] * hit.normal
    found = contact_errors.Motion.explaining(bounds, points, off, hit.normal)
    assert not found.at(points).any()


@pytest.mark.deep
@needs_ur3e
def test_a_turned_frame_of_a_link_is_named():
    """By 3 degrees: turn, shift and change of scale together run far off, to first order; without
    the last, linearized again, they bring the points back to the surface."""
    body = ms.Body.load(DATA / "ur3e_meshes" / "forearm.stl", units="m")
    towards = np.random.default_rng(1).normal(size=3)
    there = ms.Skin.cover(
        body, spacing=3e-3, count=400, seed=1, region=Cap(direction=tuple(towards)),
        disc_radius=1e-3,
    ).positions  # fmt: skip
    data = SimpleNamespace(
        pressure=np.ones(len(there)), ids=np.arange(100), taxel=np.arange(len(there)) // 4,
        contact=np.arange(len(there)), body=body, indentation=1.3e-3,
    )  # fmt: skip
    points = there @ ms.core.se3.exp_so3([0.0, 0.0, np.radians(3.0)]).T
    hit = body.closest(points)
    found = contact_errors.motion(data, points, hit.distance, hit.normal)
    np.testing.assert_allclose(np.degrees(found.turn), [0.0, 0.0, 3.0], atol=0.1)
    true = np.sum((points - there) ** 2, axis=1).mean()
    assert true > (2e-3) ** 2
    assert np.einsum("nii->n", found.squares(points)).mean() > 0.6 * true


@pytest.mark.slow
def test_contact_points_of_another_place_of_the_body_may_be_anywhere_on_it():
    """Slid by 15 mm along a tube whose radius varies, which leaves most of a millimetre."""
    mesh = trimesh.creation.cylinder(radius=0.03, height=0.2, sections=90)
    mesh = mesh.subdivide_to_size(4e-3)
    grown = 1 + 0.02 * np.sin(mesh.vertices[:, 2] / 5e-3)
    mesh.vertices *= np.column_stack([grown, grown, np.ones(len(grown))])
    body = ms.Body.from_mesh(mesh)
    angle, z = np.meshgrid(np.linspace(0, 1.5, 20), np.linspace(-0.03, 0.03, 20))
    around = np.column_stack([np.cos(angle.ravel()), np.sin(angle.ravel()), 0 * z.ravel()])
    points = body.closest(0.03 * around + [0, 0, 1] * z.reshape(-1, 1)).point
    data = SimpleNamespace(
        pressure=np.ones(400), ids=np.arange(40), taxel=np.arange(400) // 10,
        contact=np.arange(400), body=body, indentation=0.2e-3,
    )  # fmt: skip
    for slid, least, most in ((0.0, 0.0, 1e-5), (0.015, 0.05, 0.2)):
        there = points + np.array([0.0, 0.0, slid])
        hit = body.closest(there)
        squares = contact_errors.motion(data, there, hit.distance, hit.normal).squares(points)
        assert least <= np.sqrt(np.einsum("nii->n", squares).mean()) <= most


@pytest.mark.deep
def test_dents_under_a_small_skin_are_no_far_motion_of_the_body():
    """A slide by 40 mm along the body explains them to first order, and does not explain them."""
    base, rng = ms.Scene.load("sphere_noisy"), np.random.default_rng(2)
    body = ms.Body.ellipsoid((0.06, 0.04, 0.12))
    towards = rng.normal(size=3)
    skin = ms.Skin.cover(
        body, spacing=6e-3, count=8, seed=2, region=Cap(direction=tuple(towards)),
        disc_radius=2e-3,
    )  # fmt: skip
    scene = base.with_(body=body, skin=skin, contact="elliptic", material=ms.Material(young=0.4e6))
    near = skin.positions[rng.integers(len(skin), size=80)]
    log = ms.press(scene, body.closest(near + rng.uniform(-5e-3, 5e-3, (80, 3))).point)
    waves, phase = rng.normal(size=(3, 40)) / 15e-3, rng.uniform(0, 2 * np.pi, 40)
    dents = 0.1e-3 * np.sqrt(2 / 40) * np.cos(log.points @ waves + phase).sum(axis=1)
    normals = body.closest(log.points).normal
    found = ms.calibrate(moved(log, dents[:, None] * normals), scene.belief())
    assert np.linalg.norm(found.positions - skin.positions, axis=1).max() < 0.1e-3
    assert found.position_sigma.max() < 2e-3


def test_contact_points_of_another_scale_count_by_half():
    """1 % larger about the origin of the frame, which a body 1 % smaller explains as well: taxels
    at 150 mm along a cylinder may be displaced along it by 1.5 mm, or not at all."""
    body, rng = ms.Body.capsule(radius=0.04, length=0.4), np.random.default_rng(0)
    angle, z = rng.uniform(-0.8, 0.8, 400), rng.uniform(0.13, 0.17, 400)
    normals = np.column_stack([np.cos(angle), np.sin(angle), np.zeros(400)])
    points = 1.01 * (0.04 * normals + z[:, None] * [0.0, 0.0, 1.0])
    data = SimpleNamespace(
        pressure=np.ones(400), ids=np.arange(40), taxel=np.arange(400) % 40,
        contact=np.arange(400), body=body, indentation=1.3e-3,
    )  # fmt: skip
    hit = body.closest(points)
    squares = contact_errors.motion(data, points, hit.distance, hit.normal).squares(points)
    assert np.sqrt(squares[:, 2, 2].mean()) == pytest.approx(1.5e-3 / 2**0.5, rel=0.05)


@pytest.mark.deep
@pytest.mark.parametrize(("top", "scatter"), [(0.0, 0.0), (0.0, 2e-5), (5e-4, 0.0)])
def test_a_flat_skin_in_the_origin_of_its_frame_tells_no_size(top, scatter):
    """The heights of its contact points about the origin are their own errors."""
    box = trimesh.creation.box((0.3, 0.1, 0.02))
    for _ in range(4):
        box = box.subdivide()
    box.apply_translation((0.0, 0.0, top - 0.01))
    body, rng = ms.Body.from_mesh(box), np.random.default_rng(0)
    disc = ms.Disc((0.08, 0.0, top), 0.03)
    skin = ms.Skin.cover(body, spacing=7e-3, count=12, seed=1, region=disc)
    scene = ms.Scene.load("sphere_noisy").with_(body=body, skin=skin)
    near = skin.positions[rng.integers(12, size=300)]
    near += rng.normal(scale=5e-3, size=(300, 3)) * [1.0, 1.0, 0.0]
    log = ms.press(scene, body.closest(near).point, seed=1)
    off = [0.0, 0.0, 0.1 * top] + scatter * rng.normal(size=(300, 3)) * [0.0, 0.0, 1.0]
    found = ms.calibrate(log.with_columns(points=log.points + off), scene.belief())
    assert found.verdict.level == "PASS"
    assert np.nanmedian(found.position_sigma) < 2e-4
