"""An earlier map tested by a few touches."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pytest
from scipy.special import logsumexp
from scipy.stats import multivariate_normal, norm

import meshskin as ms
from meshskin.core.errors import CalibrationError, ConfigError
from meshskin.estimation.recalibrate import errors as errors_module
from meshskin.estimation.recalibrate import evidence, readings
from meshskin.estimation.recalibrate.blocks import all_log_likelihoods
from meshskin.estimation.recalibrate.hypotheses import (
    CONFIRMED,
    DEAD,
    EXCHANGED,
    GAIN,
    MOVED,
    Hypothesis,
    dead,
    dispersed,
    grid,
    log_prior,
    moved,
    regained,
    unchanged,
)
from meshskin.estimation.recalibrate.recalibrate import _rival, _words
from meshskin.estimation.recalibrate.result import updated
from meshskin.estimation.recalibrate.skin_map import skin_map, turns
from meshskin.estimation.recalibrate.touches import Block, Errors, Touches
from meshskin.skin import slots


@pytest.fixture(scope="module")
def setting():
    """A scene of seven modules, and touches planned on its map."""
    scene = ms.Scene.load("sphere_noisy")
    modules = ms.Skin.modules(scene.body, count=7, seed=1)
    scene = scene.with_(skin=modules.skin)
    return scene, ms.next_touches(modules.skin, scene.belief(), 8).points


def turned(skin, module):
    """A module turned by 120 degrees: its slots at the places of others."""
    rows = np.flatnonzero(skin.ids // 12 == module)
    (angle, image), *_ = turns(slots.OFFSETS, np.array(slots.TAXELS)).items()
    assert np.isclose(np.degrees(angle), 120)
    place = dict(zip(skin.ids[rows] % 12, rows, strict=True))
    poses = skin.poses.copy()
    poses[rows] = skin.poses[[place[image[s]] for s in skin.ids[rows] % 12]]
    return replace(skin, poses=poses)


@pytest.mark.deep
def test_a_turned_module_is_found_and_the_others_are_confirmed(setting):
    scene, points = setting
    now = turned(scene.skin, 4)
    heard, recording = [], ms.press(scene.with_(skin=now), points)
    found = ms.recalibrate(
        scene.skin, recording, scene.belief(), progress=lambda *at: heard.append(at)
    )
    assert heard[0] == ("recalibrate", 0, 35)
    assert heard[-1][1] == heard[-1][2] >= 14  # 7 modules from two starts
    (finding,) = found.findings
    assert (finding.unit, finding.number, finding.state) == ("module", 4, "turned")
    assert "120 degrees" in finding.words
    assert all(words in found._repr_html_() for words in ("6 confirmed", "module 4", "120 degrees"))
    assert any("(0, 1 and 4 more)" in line for line in found.lines(2))
    with pytest.raises(ConfigError, match="shown is out of range, got -1, limit: at least 0"):
        found.lines(-1)
    assert finding.false_alarm < 1e-6
    assert (found.unit_states == "confirmed").sum() == 6
    assert np.allclose(found.calibration.positions, now.positions[np.argsort(now.ids)], atol=1e-12)
    compared = ms.compare(scene.skin, ms.Skin(found.calibration.poses, found.calibration.ids))
    assert set(compared.permutation) == {12 * 4 + s for s in slots.TAXELS if s != slots.CENTRE}


@pytest.mark.deep
def test_untouched_modules_and_taxels_are_not_confirmed(setting):
    scene, points = setting
    recording = ms.press(scene, points[:4])
    found = ms.recalibrate(scene.skin, recording, scene.belief())
    gap = np.linalg.norm(scene.skin.positions[:, None] - points[:4], axis=2).min(axis=1)
    far = scene.skin.ids[gap > 8e-3]
    assert set(found.states[np.isin(found.ids, far)]) == {"not touched"}
    modules = set(range(7)) - set((scene.skin.ids[gap <= 8e-3] // 12).tolist())
    assert modules
    assert all(found.unit_states[m] == "not touched" for m in modules)
    assert set(found.next_contacts(4, scene.belief()).unit) <= set(
        found.units[(found.unit_states != "confirmed") | ~found.placed]
    )


@pytest.mark.deep
@pytest.mark.parametrize(
    ("factor", "state"), [(0.0, "dead"), pytest.param(2.0, "gain changed", marks=pytest.mark.slow)]
)
def test_a_single_taxel_that_changed(setting, factor, state):
    scene, points = setting
    best = 13
    own = scene.skin.poses[scene.skin.ids == best][0]
    around = own[:3, 3] + 3e-3 * np.stack([own[:3, 0], -own[:3, 0], own[:3, 1]])
    recording = ms.press(scene, np.concatenate([points, around]))
    pressure = np.where(recording.reading_taxel == best, factor, 1.0) * recording.pressure
    changed = recording.with_columns(pressure=pressure)
    changed = replace(changed, readings=changed.readings.filter(pa.array(pressure > 0)))
    found = ms.recalibrate(scene.skin, changed, scene.belief())
    assert [(f.number, f.state) for f in found.findings] == [(best, state)]
    row = np.flatnonzero(found.ids == best)[0]
    assert found.states[row] == state
    assert state.split()[0] in found.calibration.faults[row]
    if factor:
        assert found.calibration.taxel_unknowns["gain"][row, 0] == pytest.approx(np.log(2), abs=0.3)


def test_the_likelihood_is_that_of_a_normal_distribution(setting):
    """Against scipy, with one silent reading given the others."""
    places = np.tile(1e-8 * np.eye(3), (2, 1, 1))
    state = Hypothesis(CONFIRMED, np.zeros((2, 3)), np.zeros((2, 3)), np.zeros(2), places)
    block = Block(
        state, np.array([0, 0, 1]), np.array([0, 1, 1]), np.array([0.5, 0.2, np.nan]),
        np.array([0.45, 0.22, 0.08]), 100 * np.random.default_rng(0).normal(size=(3, 3)),
        np.full(3, 1e-4), np.array([-0.3, 0.1, 0.1]), np.array([0.4, 0.2, 0.05]),
        np.zeros(3), np.zeros(3),
    )  # fmt: skip
    errors = Errors(0.01, 2e-4, 0.03, common=((0.01, 0.0), (0.0, 0.002)))
    c = block.covariance(errors)
    mean, threshold = block.mean, 0.05
    joint = multivariate_normal(mean[:2], c[:2, :2]).logpdf(block.level[:2])
    gain = c[2, :2] @ np.linalg.inv(c[:2, :2])
    at, sd = mean[2] + gain @ (block.level - mean)[:2], np.sqrt(c[2, 2] - gain @ c[:2, 2])
    far = norm.logcdf(threshold / errors.sigma)
    expected = joint + norm.logcdf((threshold - at) / sd) - 3 * far
    assert block.log_likelihood(errors, threshold) == pytest.approx(expected)


def test_predictions_average_over_the_errors_of_places(setting):
    """Mean and variance against random displacements of the contacts."""
    scene, points = setting
    data = _data(scene, points)
    known = skin_map(scene.skin, scene.belief())
    touches = Touches(data, known)
    rows, tau = known.units[0], 0.4e-3
    errors = Errors(1e-6, tau, 1e-9)
    state = replace(unchanged(known, 0), covariance=np.zeros((len(rows), 3, 3)))
    (block,) = touches.blocks(0, [state], errors)
    variance = np.diag(block.covariance(errors))
    rng, draws = np.random.default_rng(0), []
    for _ in range(400):
        step = tau * rng.standard_normal((2, len(data.points), 1))
        at = data.points + step[0] * data.directions + step[1] * touches.across
        offset = state.points[block.taxel] - at[block.contact]
        draws.append(touches._means(offset, block.contact, 0.0))
    strong = block.mean > 0.1
    assert strong.sum() > 2
    assert np.allclose(np.mean(draws, axis=0)[strong], block.mean[strong], atol=0.01)
    assert np.allclose(np.std(draws, axis=0)[strong], np.sqrt(variance[strong]), rtol=0.15)


def _data(scene, points):
    from meshskin.estimation.data.gather import gather

    return gather(ms.press(scene, points), scene.belief())


@pytest.mark.parametrize("state", [MOVED, GAIN])
def test_what_a_component_leaves_open_is_estimated(state):
    """By the information of prior and readings, where the package takes their covariance."""
    rng = np.random.default_rng(0)
    contact, taxel, mean = np.arange(30) % 7, np.arange(30) % 5, rng.uniform(0.2, 1.0, 30)
    slope = rng.normal(scale=200.0, size=(30, 3)) * [1.0, 1.0, 0.0]
    level, zero = mean + rng.normal(scale=0.1, size=30), np.zeros(30)
    level[25:] = np.nan  # silent
    errors = Errors(0.02, 1e-4, 0.03, common=((0.04, 0.001), (0.001, 0.01)))
    places, up = np.tile(np.diag([1e-8, 1e-8, 0.0]), (5, 1, 1)), np.tile([0.0, 0.0, 1.0], (5, 1))
    still = Hypothesis(state, np.zeros((5, 3)), up, np.zeros(5), places)
    if state == MOVED:
        sigma, by, start = 5e-4, slope[:25, :2], [1e-3, -2e-3]
        component = replace(still, shift=(*start, 0.0), shift_sigma=sigma)
    else:
        sigma, by, start = 0.15, mean[:25, None], [0.5]
        component = replace(still, change=0.5, gain_sigma=sigma)
    columns = contact, taxel, level, mean, slope, zero, 0.3 * mean, mean, zero, zero
    found, covariance = evidence._estimate(Block(component, *columns), errors)
    own = np.linalg.inv(Block(still, *columns).covariance(errors)[:25, :25])
    expected = np.linalg.inv(by.T @ own @ by + np.eye(len(start)) / sigma**2)
    size = len(start)
    np.testing.assert_allclose(covariance[:size, :size], expected, rtol=1e-6)
    change = expected @ by.T @ own @ (level - mean)[:25]
    np.testing.assert_allclose(found[:size] - start, change, rtol=1e-6)


def test_prior_odds_do_not_depend_on_what_is_tried(sphere):
    """Moves and gains are tried only where a unit misfits."""
    known = skin_map(sphere.skin, sphere.belief())
    base, expected, units = unchanged(known, 3), np.ones(1), len(known.units)
    few = [dead(base), replace(base, state=EXCHANGED, value=5.0)]
    every = few + moved(base, sphere.body, grid()) + regained(base, True)
    some = log_prior(few, units, expected, True)
    np.testing.assert_allclose(some, log_prior(every, units, expected, True)[:2])
    total = np.exp(log_prior([few[0], *every[2:], *[few[1]] * (units - 1)], units, expected, True))
    assert total.sum() == pytest.approx(1.0)


def judged(known, unit, state, **change):
    """What is found if a unit is in `state`, and the others as they were."""
    one = np.ones(1, dtype=bool)
    changes = (evidence.Change(state, 9.0, **change),)
    return [
        evidence.Evidence(0.0, state, changes, 9.0, one, one, False) if u == unit
        else evidence.Evidence(0.0, unchanged(known, u), (), 0.0, one, one, True)
        for u in range(len(known.units))
    ]  # fmt: skip


def test_an_exchanged_taxel_has_the_uncertainty_of_the_place(sphere):
    """Of a well known place of the map, at the taxel that was badly known itself."""
    scene, points = single_taxels(sphere, 0, 7)
    belief = scene.belief()
    map_ = ms.calibrate(ms.press(scene, points, seed=1), belief)
    weak, sound = np.flatnonzero(map_.observed[:, 0])[:2]
    covariances = map_.covariances.copy()
    covariances[weak] *= 25.0
    map_ = replace(map_, covariances=covariances)
    known = skin_map(map_, belief)
    unit = [int(rows[0]) for rows in known.units].index(weak)
    state = replace(
        unchanged(known, unit), state=EXCHANGED, value=float(map_.ids[sound]),
        points=known.points[[sound]], normals=known.poses[[sound], :3, 2],
    )  # fmt: skip
    now = updated(known, belief, judged(known, unit, state), (), 9)
    np.testing.assert_allclose(now.covariances[weak], map_.covariances[sound], atol=1e-15)
    np.testing.assert_array_equal(now.observed[weak], map_.observed[sound])


def test_a_changed_gain_has_its_standard_deviation(sphere):
    belief = sphere.belief()
    known = skin_map(sphere.skin, belief)
    state = replace(unchanged(known, 3), state=GAIN)
    found = judged(known, 3, state, log_gain=0.5, log_gain_sigma=0.02)
    gain = updated(known, belief, found, (), 9).taxel_unknowns["gain"]
    np.testing.assert_allclose(gain[3], [0.5, 0.02])
    assert not gain[:3].any()


def test_common_changes_that_nothing_shows_are_zero(setting):
    scene, points = setting
    known = skin_map(scene.skin, scene.belief())
    touches = Touches(_data(scene, points), known)
    errors = replace(errors_module.start(touches), log_modulus=0.2, log_scale=-0.1)
    found = errors_module._fit_common(touches, {}, errors)
    assert np.allclose([found.log_modulus, found.log_scale], 0.0, atol=1e-15)


def test_turns_follow_from_the_symmetry_of_a_layout():
    square = 1e-3 * np.array([[0, 0, 0], [10, 0, 0], [10, 10, 0], [0, 10, 0]], dtype=float)
    every = np.arange(4)
    assert np.allclose(np.degrees(sorted(turns(square, every))), [90, 180, 270])
    assert list(turns(square, every)[round(np.pi / 2, 9)]) == [1, 2, 3, 0]
    assert turns(square * [1, 1.3, 1], every).keys() == {round(np.pi, 9)}
    assert not turns(np.vstack([square, [[2e-3, 5e-3, 0]]]), np.arange(5))


def test_moves_cover_their_disc():
    flat = grid()
    rng = np.random.default_rng(0)
    inside = rng.uniform(-5e-3, 5e-3, (200, 2))
    inside = inside[np.linalg.norm(inside, axis=1) < 5e-3]
    assert np.linalg.norm(inside[:, None] - flat, axis=2).min(axis=1).max() < 0.6e-3


def test_moved_units_stay_on_the_body(setting):
    scene, _ = setting
    state = unchanged(skin_map(scene.skin, scene.belief()), 0)
    for h in moved(state, scene.body, grid()[:5]):
        assert np.abs(scene.body.closest(h.points).distance).max() < 1e-9


def test_what_cannot_be_tested_is_refused(setting):
    scene, points = setting
    recording = ms.press(scene, points)
    with pytest.raises(CalibrationError, match="does not know the scene"):
        ms.recalibrate(scene.skin, recording)
    with pytest.raises(CalibrationError, match="too few readings"):
        ms.recalibrate(scene.skin, ms.press(scene, points[:1]), scene.belief())
    with pytest.raises(CalibrationError, match="false_alarm"):
        ms.recalibrate(scene.skin, recording, scene.belief(), false_alarm=0.0)
    with pytest.raises(CalibrationError, match="whose calibration learned the response"):
        ms.recalibrate(scene.skin, recording, scene.belief(readings="raw"))
    with pytest.raises(CalibrationError, match="must be a Calibration or a Skin"):
        ms.recalibrate("map.txt", recording, scene.belief())
    with pytest.raises(CalibrationError, match="number of touches"):
        ms.next_touches(scene.skin, scene.belief(), 0)
    for units in ([9999], []):
        with pytest.raises(CalibrationError, match="no such module to test"):
            ms.next_touches(scene.skin, scene.belief(), 3, units=units)


@pytest.mark.slow
def test_single_taxels_and_a_calibration_as_the_map(noisy):
    """Two exchanged taxels of twelve."""
    skin = ms.Skin.cover(noisy.body, spacing=5e-3, count=12, seed=1)
    scene = noisy.with_(skin=skin)
    around = 2e-3 * np.concatenate([skin.poses[:, :3, 0], -skin.poses[:, :3, 1]])
    points = np.tile(skin.positions, (2, 1)) + around
    map_ = ms.calibrate(ms.press(scene, points, seed=1), scene.belief())
    a, b = 0, 7
    poses = skin.poses.copy()
    poses[[a, b]] = poses[[b, a]]
    now = scene.with_(skin=replace(skin, poses=poses))
    found = ms.recalibrate(map_, ms.press(now, skin.positions, seed=2))
    assert found.unit == "taxel"
    assert {(f.number, f.state) for f in found.findings} == {(a, "exchanged"), (b, "exchanged")}
    assert np.allclose(found.calibration.positions[[a, b]], map_.positions[[b, a]])
    unknown = np.isnan(map_.positions[:, 0])
    assert set(found.states[unknown]) <= {"not touched"}
    assert (found.states == "confirmed").sum() >= 8


@pytest.mark.slow
def test_false_alarms_are_rarer_than_stated(setting):
    """200 recordings of an unchanged skin, noise unknown, at a stated rate of 10 %: a binomial
    number above 32 would have a chance of 1 %."""
    scene, points = setting
    belief = scene.belief(noise_sigma=None)
    alarms = 0
    for seed in range(200):
        rng = np.random.default_rng(seed)
        poses = scene.skin.poses.copy()
        poses[:, :3, 3] += 0.3e-3 * np.einsum(
            "nij,nj->ni", poses[:, :3, :2], rng.standard_normal((len(poses), 2))
        )
        skin = replace(scene.skin, poses=poses).onto(scene.body)
        recording = ms.press(scene.with_(skin=skin), points, seed=seed)
        alarms += bool(ms.recalibrate(scene.skin, recording, belief, false_alarm=0.1).findings)
    assert alarms <= 32


def single_taxels(sphere, seed, count=12):
    """A scene of single taxels, and three touches about each: readings with 1 % noise."""
    skin = ms.Skin.cover(sphere.body, spacing=6e-3, count=count, seed=1)
    noisy = ms.effects.find("gaussian_noise")(sigma_relative=0.01)
    rng = np.random.default_rng(seed)
    around = rng.normal(scale=3e-3, size=(3 * count, 3))
    return sphere.with_(skin=skin, effects=(noisy,)), np.tile(skin.positions, (3, 1)) + around


def displaced(skin, offset):
    """The skin with its taxels displaced by `offset` (n, 2), m, along their tangents."""
    poses = skin.poses.copy()
    poses[:, :3, 3] += np.einsum("nij,nj->ni", poses[:, :3, :2], offset)
    return replace(skin, poses=poses)


@pytest.mark.deep
def test_a_place_three_sigmas_off_is_no_change(sphere):
    """Its readings are not straight over three standard deviations of its place."""
    scene, points = single_taxels(sphere, 0)
    offset = np.random.default_rng(1).normal(scale=0.1e-3, size=(12, 2))
    offset[4] = 0.9e-3, 0.0
    map_ = displaced(scene.skin, offset).onto(scene.body)
    recording, belief = ms.press(scene, points, seed=1), scene.belief(noise_sigma=None)
    found = ms.recalibrate(map_, recording, belief)
    assert found.findings == ()
    assert found.unit_evidence[4] < 0


@pytest.mark.deep
def test_the_likelihood_of_a_taxel_is_that_over_all_places_that_the_map_allows(sphere):
    """Against random places about a map that is three standard deviations off."""
    scene, points = single_taxels(sphere, 0)
    offset = np.zeros((12, 2))
    offset[4, 0] = 0.9e-3
    known = skin_map(displaced(scene.skin, offset).onto(scene.body), scene.belief())
    touches, errors = Touches(_data(scene, points[:18]), known), Errors(0.01, 1e-6, 1e-3)

    def likelihoods(hypotheses):
        blocks = touches.blocks(4, hypotheses, errors)
        return [block.log_likelihood(errors, touches.threshold) for block in blocks]

    state, rng = unchanged(known, 4), np.random.default_rng(0)
    places = moved(state, scene.body, rng.normal(scale=0.6e-3, size=(3000, 2)))
    weights = np.array([-0.375 * np.sum(np.square(h.shift)) / 0.3e-3**2 for h in places])
    still = [replace(h, covariance=0 * h.covariance, shift_sigma=0.0) for h in places]
    expected = logsumexp(weights + likelihoods(still)) + np.log(4 / len(places))
    parts, shares = dispersed(state, scene.body)
    assert logsumexp(shares + likelihoods(parts)) == pytest.approx(expected, abs=0.7)
    straight = touches.straight(4, state, errors).log_likelihood(errors, touches.threshold)
    assert straight == pytest.approx(expected, abs=0.7)
    assert abs(likelihoods([state])[0] - expected) > 1.0  # over all of them at once


@pytest.mark.deep
@pytest.mark.parametrize("seed", [0, *(pytest.param(k, marks=pytest.mark.slow) for k in (1, 2, 3))])
def test_a_module_is_judged_by_all_places_that_the_map_allows(setting, seed):
    """The readings of taxels at random places of the map's own uncertainty that its straight
    approximation explains worst: their likelihood is the product of those of the taxels."""
    scene, points = setting
    known, errors = skin_map(scene.skin, scene.belief(), 0.3e-3), Errors(0.01, 1e-6, 1e-3)
    touches, rng = Touches(_data(scene, points), known), np.random.default_rng(seed)

    def likelihoods(unit, hypotheses):
        blocks = touches.blocks(unit, hypotheses, errors)
        return np.array([block.log_likelihood(errors, touches.threshold) for block in blocks])

    cases, silent = [], np.full(touches.level.shape, np.nan)
    for unit, rows in enumerate(known.units):
        state = unchanged(known, unit)
        still = replace(state, covariance=0 * state.covariance)
        shifts = rng.normal(scale=0.3e-3, size=(len(rows), 40, 2))
        apart = [moved(still, scene.body, flat) for flat in shifts]
        places = [
            replace(still, points=np.array([h.points[j] for j, h in enumerate(each)]))
            for each in zip(*apart, strict=True)
        ]
        for block in touches.blocks(unit, places, errors):
            drawn = block.mean + errors.sigma * rng.normal(size=len(block.mean))
            touches.level = silent.copy()
            touches.level[block.contact, rows[block.taxel]] = np.where(
                drawn > touches.threshold, drawn, np.nan
            )
            (whole,) = touches.blocks(unit, [state], errors)
            as_expected = replace(whole, level=np.where(whole.read, whole.mean, np.nan))
            over_all_at_once, usual = (
                b.log_likelihood(errors, touches.threshold) for b in (whole, as_expected)
            )
            cases.append((usual - over_all_at_once, over_all_at_once, unit, touches.level))
    _, over_all_at_once, unit, touches.level = max(cases, key=lambda case: case[0])
    state = unchanged(known, unit)
    still = replace(state, covariance=0 * state.covariance)
    (at_rest,) = likelihoods(unit, [still])
    wide = rng.normal(scale=0.6e-3, size=(1000, 2))
    weights = -0.375 * np.sum(np.square(wide), axis=1) / 0.3e-3**2
    weights -= logsumexp(weights)
    expected, shifted = at_rest, moved(still, scene.body, wide)
    for taxel in np.unique(touches.blocks(unit, [state], errors)[0].taxel):
        own = np.arange(len(state.points))[:, None] == taxel
        one = [replace(still, points=np.where(own, h.points, still.points)) for h in shifted]
        expected += logsumexp(weights + likelihoods(unit, one)) - at_rest
    found = evidence.judge(touches, unit, errors, np.log(len(known.units) / 0.01))
    assert found.null == pytest.approx(expected, abs=1.0)
    assert over_all_at_once < expected - 1.0
    assert found.changes == ()


def test_thinned_contacts_keep_all_that_they_have(setting):
    """Fields with a row a contact."""
    scene, points = setting
    data = _data(scene, points)
    m, turns = len(data.points), np.tile(np.eye(3), (len(data.points), 1, 1))
    errors, corrupt = np.arange(3.0 * m).reshape(m, 3), np.array([[0, 1], [2, 0], [m - 1, 3]])
    data = replace(data, headings=turns, contact_errors=errors, corrupt=corrupt)
    assert len({m, len(data.pressure), len(data.ids)}) == 3
    kept = np.arange(m) % 2 == 0
    found = readings._of_contacts(data, kept)
    for name, value in vars(data).items():
        if isinstance(value, np.ndarray) and len(value) == m:
            np.testing.assert_array_equal(getattr(found, name), value[kept], err_msg=name)
    np.testing.assert_array_equal(
        found.points[found.contact], data.points[data.contact][kept[data.contact]]
    )
    assert found.corrupt[:2].tolist() == [[0, 1], [1, 0]]


def test_a_lost_reading_does_not_lose_the_others_of_a_falling_skin(setting):
    scene, points = setting
    recording = ms.press(scene, points[:2])
    pressure = recording.pressure.copy()
    pressure[1] = np.nan
    turned = readings._turned(recording.with_columns(pressure=pressure)).pressure
    assert np.flatnonzero(np.isnan(turned)).tolist() == [1]


@pytest.mark.slow
def test_false_alarms_of_single_taxels_are_rarer_than_stated(sphere):
    """60 recordings with 1 % noise of maps that are as wrong as they say, at a stated rate of 10 %:
    a binomial number above 12 would have a chance of 1 %."""
    alarms = 0
    for seed in range(60):
        scene, points = single_taxels(sphere, seed)
        offset = np.random.default_rng(1000 + seed).normal(scale=0.3e-3, size=(12, 2))
        map_, belief = (
            displaced(scene.skin, offset).onto(scene.body),
            scene.belief(noise_sigma=None),
        )
        recording = ms.press(scene, points[:24], seed=seed)
        alarms += bool(ms.recalibrate(map_, recording, belief, false_alarm=0.1).findings)
    assert alarms <= 12


@pytest.mark.parametrize(
    ("odds", "words"),
    [
        (0.2, "dead: silent where it was pressed; or taxel 31 has another gain, 0.2 times as "
         "probable: touch it again"),
        (0.001, "dead: silent where it was pressed"),
    ],
)  # fmt: skip
def test_a_change_that_is_not_excluded_is_named(odds, words):
    none = np.zeros((3, 3))
    base = Hypothesis(CONFIRMED, none, none, np.zeros(3), np.zeros((3, 3, 3)))
    steps = [replace(base, state=DEAD, taxel=2), replace(base, state=GAIN, taxel=1)]
    blocks = [SimpleNamespace(hypothesis=step) for step in steps]
    tried = SimpleNamespace(blocks=blocks, posterior=np.log([1.0, odds]))
    change = evidence._change(tried, None, 9.0)
    known = SimpleNamespace(ids=np.array([30, 31, 32]), noun="module")
    said = _words(known, change) + _rival(known, np.arange(3), change)
    assert said == words


@pytest.mark.parametrize("state", ["moved", "gain"])
def test_the_likelihoods_of_a_stack_are_those_of_its_blocks(sphere, state):
    """Of blocks of unlike sizes, with errors of all kinds, by their dense covariances."""
    scene, points = single_taxels(sphere, 0)
    touches = Touches(_data(scene, points), skin_map(scene.skin, scene.belief()))
    errors = Errors(0.01, 1e-4, 0.02, 0.05, common=((0.04, 0.01), (0.01, 0.02)))
    base = unchanged(touches.known, 4)
    steps = moved(base, scene.body, grid()) if state == "moved" else regained(base, True)
    blocks = touches.blocks(4, [base, dead(base), *steps], errors)
    blocks = [replace(b, log_gain_sigma=b.bend + 0.1, offset_sigma=b.bend + 0.02) for b in blocks]
    assert len({len(block.mean) for block in blocks}) > (state == "moved")
    expected = [block.log_likelihood(errors, touches.threshold) for block in blocks]
    found = all_log_likelihoods(blocks, errors, touches.threshold)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-9)


def test_levels_beyond_the_patches_are_zero(setting, monkeypatch):
    scene, points = setting
    touches = Touches(_data(scene, points), skin_map(scene.skin, scene.belief()))
    rng = np.random.default_rng(0)
    offset, contact = rng.normal(scale=6e-3, size=(9000, 3)), np.arange(9000) % len(points)
    found = touches._means(offset, contact, 0.0)
    monkeypatch.setattr(touches, "_is_pressed", lambda offset, *_: np.full(len(offset), True))
    np.testing.assert_allclose(found, touches._means(offset, contact, 0.0), atol=1e-15)
    assert 0.2 < np.mean(found > 0) < 0.8
