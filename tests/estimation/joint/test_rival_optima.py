"""Rival optima: mirror images of taxels that were touched along a line; the faces of a plate."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

import meshskin as ms
from meshskin.contact.reading import same_sheet
from meshskin.core.se3 import exp_so3
from meshskin.effects.gaussian_noise import GaussianNoise
from meshskin.estimation.chart import charts_at
from meshskin.estimation.data.gather import gather
from meshskin.estimation.joint import rival_optima
from meshskin.estimation.joint.joint_estimator import JointEstimator
from meshskin.estimation.joint.parametrization import SurfaceParametrization
from meshskin.estimation.joint.pressure import OBSERVED
from meshskin.estimation.joint.readings import Readings
from meshskin.estimation.joint.rival_optima import find_rivals, open_sectors, resolve_rivals


@pytest.fixture(scope="module")
def line(sphere):
    """A scene with 10 % noise, its calibration, and the row of its outermost taxel: touched in
    a strip 0.7 mm wide whose middle is 1.5 mm beside it."""
    scene = sphere.with_(
        effects=(GaussianNoise(sigma_relative=0.1),),
        readout=replace(sphere.readout, threshold_relative=0.2),
    )
    distance = np.linalg.norm(scene.skin.positions - scene.skin.positions.mean(axis=0), axis=1)
    far = int(np.argmax(distance))
    return scene, ms.calibrate(strip_recording(scene, far), scene.belief()), far


def strip_recording(scene, far):
    """Contacts in the strip beside the taxel `far`, and about the middle of the skin."""
    points, normals = scene.skin.positions, scene.skin.normals
    inward = points.mean(axis=0) - points[far]
    side = inward - normals[far] * (inward @ normals[far])
    side /= np.linalg.norm(side)
    steps, zigzag = np.linspace(-4e-3, 4e-3, 17)[:, None], (-1.0) ** np.arange(17)[:, None]
    strip = points[far] + (1.5e-3 + 0.35e-3 * zigzag) * side
    strip = strip + steps * np.cross(normals[far], side)
    middle = points.mean(axis=0) + np.random.default_rng(0).normal(scale=6e-3, size=(400, 3))
    away = np.linalg.norm(middle - points[far], axis=1) > 14e-3
    return ms.press(scene, np.concatenate([strip, middle[away]]), seed=3)


@pytest.mark.deep
def test_a_taxel_touched_along_a_line_has_a_rival_at_its_mirror_image(line):
    scene, calibration, far = line
    truth, estimate = scene.skin.positions[far], calibration.positions[far]
    rival = calibration.rivals[far]
    errors = [np.linalg.norm(estimate - truth), np.linalg.norm(rival - truth)]
    assert min(errors) < 0.5e-3
    assert max(errors) == pytest.approx(3e-3, rel=0.2)  # twice the distance of the strip's middle
    assert calibration.position_sigma[far] > 0.9 * np.linalg.norm(rival - estimate)
    assert "second position" in calibration.faults[far]


@pytest.mark.deep
def test_the_likelier_of_two_optima_is_the_estimate(line):
    """The odds are the difference of the costs at both optima, from whichever it starts."""
    scene, calibration, far = line
    data = gather(strip_recording(scene, far), scene.belief())
    live = np.flatnonzero(np.isfinite(calibration.positions[:, 0]))
    places, row = calibration.positions[live], int(np.searchsorted(live, far))
    charts = charts_at(data.body, places, calibration.poses[live, :3, :3])
    parametrization = SurfaceParametrization(charts, float(np.median(data.radii)) / 2)
    estimator = JointEstimator(data, live, parametrization, np.ones(len(data.pressure)), 30)
    odds, costs = [], []
    for _ in range(2):
        estimator.converge()
        rivals = find_rivals(estimator)
        odds.append(rivals.log_odds[row])
        costs.append(estimator.state.moments.cost[row])
        places[row] = rivals.points[row]
        estimator.start_at(places, select_anew=True)
    difference = costs[1] - costs[0]
    assert odds == pytest.approx([difference, -difference], rel=0.1)
    assert resolve_rivals(estimator).log_odds[row] == pytest.approx(abs(difference), rel=0.1)
    assert estimator.state.moments.cost[row] == pytest.approx(min(costs), rel=0.01)


def test_no_taxel_is_confidently_wrong(line):
    scene, calibration, _ = line
    error = np.linalg.norm(calibration.positions - scene.skin.positions, axis=1)
    assert not np.any((error > 0.3e-3) & (error > 5 * calibration.position_sigma))


@pytest.mark.deep
def test_taxels_among_their_contacts_have_no_rivals(noisy, noisy_recording):
    calibration = ms.calibrate(noisy_recording, noisy.belief())
    assert not np.isfinite(calibration.rivals).any()


def test_a_wrong_optimum_among_the_contacts_is_left(noisy, noisy_recording):
    """Its readings misfit, though contacts surround it."""
    data = gather(noisy_recording, noisy.belief())
    places, row = noisy.skin.positions.copy(), 40
    places[row] = noisy.body.closest(places[[row]] + 1.5e-3 * noisy.skin.poses[[row], :3, 0]).point
    parametrization = SurfaceParametrization(
        charts_at(data.body, places), float(np.median(data.radii)) / 2
    )
    live = np.arange(len(data.ids))
    estimator = JointEstimator(data, live, parametrization, np.ones(len(data.pressure)), 30)
    assert open_sectors(estimator, places)[row] < rival_optima.OPEN_SECTOR
    rivals = find_rivals(estimator)
    assert rivals.log_odds[row] < -100.0
    assert np.linalg.norm(rivals.points[row] - noisy.skin.positions[row]) < 0.1e-3
    assert not np.isfinite(np.delete(rivals.log_odds, row)).any()


def test_rivals_are_saved(line, tmp_path):
    _, calibration, _ = line
    calibration.save(tmp_path / "calibration")
    again = ms.Calibration.load(tmp_path / "calibration")
    assert np.array_equal(again.rivals, calibration.rivals, equal_nan=True)


@pytest.mark.deep
@pytest.mark.parametrize("thickness", [3.0, pytest.param(5.0, marks=pytest.mark.slow)])
def test_taxels_of_a_plate_are_estimated_on_their_own_face(noisy, tmp_path, thickness):
    box = trimesh.creation.box((50, 40, thickness))
    for _ in range(3):
        box = box.subdivide()
    box.export(tmp_path / "plate.stl")
    body = ms.Body.load(tmp_path / "plate.stl", units="mm")
    whole = ms.Skin.cover(body, spacing=8e-3, seed=1)
    on_face = np.abs(whole.normals[:, 2]) > 0.9
    skin = ms.Skin(whole.poses[on_face], np.arange(on_face.sum()), whole.disc_radius)
    scene = noisy.with_(
        body=body, skin=skin, contact="hertz", indenter=ms.Indenter.sphere(8e-3),
        material=ms.Material(young=0.4e6),
    )  # fmt: skip
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (700, 3)) * [22e-3, 17e-3, 0.0]
    points[:, 2] = np.where(rng.random(700) < 0.5, 0.5e-3, -0.5e-3) * thickness
    calibration = ms.calibrate(ms.press(scene, points, seed=1), scene.belief())
    found = np.isfinite(calibration.positions[:, 0])
    pressed = (np.abs(skin.positions[:, :2]) < [22e-3, 17e-3]).all(axis=1)
    assert pressed.sum() > 40  # of both sides
    assert found[pressed].all()
    side = np.sign(calibration.positions[found, 2])
    assert np.array_equal(side, np.sign(skin.positions[found, 2]))


def test_points_of_a_sphere_within_60_degrees_are_on_one_sheet():
    angle = np.radians([1.0, 20.0, 59.0, 61.0, 120.0])
    normal = np.einsum("kij,j->ki", exp_so3(angle[:, None] * [1.0, 0.0, 0.0]), [0.0, 0.0, 1.0])
    for radius in (0.1, -0.1):  # convex and concave
        offset = radius * (normal - [0.0, 0.0, 1.0])
        same = same_sheet(offset, np.tile([0.0, 0.0, 1.0], (5, 1)), normal)
        assert same.tolist() == [True, True, True, False, False]


def test_steps_and_far_sides_are_other_sheets():
    up = np.array([0.0, 0.0, 1.0])
    offset = np.array([[2.0, 0.0, -0.9], [2.0, 0.0, -1.3], [0.1, 0.0, -3.0], [1.0, 0.0, 0.0]])
    taxel = np.array([up, up, -up, up])
    assert same_sheet(offset, np.tile(up, (4, 1)), taxel).tolist() == [True, False, False, True]


@pytest.mark.deep
def test_a_rival_is_found_without_knowing_the_noise(line):
    """10 % noise, ten times what is assumed where a belief names none."""
    scene, calibration, far = line
    recording = strip_recording(scene, far)
    blind = ms.calibrate(recording, scene.belief(noise_sigma=None))
    rival = np.linalg.norm(blind.rivals[far] - calibration.rivals[far])
    assert rival < 0.6e-3 or np.linalg.norm(blind.rivals[far] - calibration.positions[far]) < 0.6e-3


def amid_four_contacts(level, expected, normals):
    """An estimator of two taxels amid contacts with `normals` (4, 3) to the east, north, west and
    south. Those to the north and south read `level`, where the model expects `expected`, the others
    10 standard deviations; the second taxel reads little, and all counts."""
    sides = np.array([[1.0, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0]])
    read = replace(
        Readings.none(), contact=np.tile(np.arange(4), 2), taxel=np.repeat([0, 1], 4),
        level=np.array([10.0, level, 10.0, level, 1.0, 1.0, 1.0, 1.0]) * 50.0,
        kind=np.full(8, OBSERVED), weight=np.ones(8), precision=np.full(8, 0.25),
    )  # fmt: skip
    residuals = np.zeros(8)
    residuals[[1, 3]] = 0.5 * (expected - level)
    frames = np.tile(np.eye(3), (2, 1, 1))
    return SimpleNamespace(
        live=np.arange(2),
        data=SimpleNamespace(sigma=50.0),
        likelihood=SimpleNamespace(readings=read),
        residuals=lambda: residuals,
        problem=SimpleNamespace(
            contacts=SimpleNamespace(data=SimpleNamespace(points=sides, normals=normals)),
            parametrization=SimpleNamespace(rotations=lambda: frames),
        ),
    )


UP = np.tile([0.0, 0.0, 1.0], (4, 1))


@pytest.mark.parametrize(
    ("level", "expected", "sector"), [(4.9, 4.9, 180.0), (5.1, 5.1, 90.0), (5.1, 0.0, 180.0)]
)
def test_noise_closes_no_open_sector(level, expected, sector):
    estimator = amid_four_contacts(level, expected, UP)
    found = np.degrees(open_sectors(estimator, np.zeros((2, 3))))
    assert np.allclose(found, [sector, 90.0])


@pytest.mark.parametrize(("tilt", "sector"), [(55.0, 90.0), (65.0, 360.0), (180.0, 360.0)])
def test_contacts_on_another_face_close_no_open_sector(tilt, sector):
    """On a link with 1 % noise a taxel was placed on the lower side, 1.3 mm off at 0.18."""
    normals = UP @ exp_so3(np.radians([[tilt, 0.0, 0.0]]))[0]
    found = np.degrees(open_sectors(amid_four_contacts(9.0, 9.0, normals), np.zeros((2, 3))))
    assert np.allclose(found, sector)


@pytest.mark.deep
def test_only_taxels_that_have_moved_are_searched_again(line, monkeypatch):
    """Where the global parameters stay, the rivals of the others do."""
    scene, calibration, far = line
    data = gather(strip_recording(scene, far), scene.belief())
    live = np.flatnonzero(np.isfinite(calibration.positions[:, 0]))
    places, row = calibration.positions[live], int(np.searchsorted(live, far))
    places[row] = calibration.rivals[far]
    charts = charts_at(data.body, places, calibration.poses[live, :3, :3])
    parametrization = SurfaceParametrization(charts, float(np.median(data.radii)) / 2)
    weight, fixed = np.ones(len(data.pressure)), data.parameters.start()
    estimator = JointEstimator(data, live, parametrization, weight, 30, shared=fixed)
    estimator.converge()
    whole, searched, likeliest = find_rivals(estimator), [], rival_optima.likeliest_rivals
    assert whole.log_odds[row] < 0

    def observed(estimator, rows, points):
        searched.append(rows)
        return likeliest(estimator, rows, points)

    monkeypatch.setattr(rival_optima, "likeliest_rivals", observed)
    found = resolve_rivals(estimator)
    assert [len(rows) > 1 for rows in searched] == [True, False]
    np.testing.assert_array_equal(searched[1], [row])
    assert found.log_odds[row] == pytest.approx(-whole.log_odds[row], rel=0.1)
    others = np.arange(len(live)) != row
    np.testing.assert_array_equal(found.log_odds[others], whole.log_odds[others])


def test_a_place_on_another_face_is_not_likelier(noisy, noisy_recording):
    """Silent readings of the contacts there counted against the taxel's own place, though its sheet
    is another: one 0.5 mm from an edge was to be 0.6 mm off by its standard deviation."""
    data = gather(noisy_recording, noisy.belief())
    live = np.arange(len(data.ids))
    charts = charts_at(data.body, noisy.skin.positions)
    parametrization = SurfaceParametrization(charts, float(np.median(data.radii)) / 2)
    estimator = JointEstimator(data, live, parametrization, np.ones(len(data.pressure)), 30)
    rows, z = np.array([40]), estimator.state.z[[40]]
    here = rival_optima.readings_of(estimator, rows, noisy.skin.positions[rows])
    none = here.without(here.kind < 2)
    silent = replace(
        here, kind=np.ones_like(here.kind), level=np.full(len(here.kind), 5 * data.sigma)
    )
    at_rest = rival_optima._costs_at_rest
    assert at_rest(estimator, z[:, 2:], none, silent)[0] < 1e-3
    assert at_rest(estimator, z[:, 2:], none, here)[0] > 100.0
    assert at_rest(estimator, z[:, 2:], here, here)[0] == 0.0
