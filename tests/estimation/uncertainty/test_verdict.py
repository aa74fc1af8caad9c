"""Wrong logs are named: each has a verdict of DOUBT or FAIL with its cause, or is refused."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pytest
import trimesh

import meshskin as ms
from meshskin.cli.calibrate import assess, summary
from meshskin.core.errors import CalibrationError
from meshskin.estimation.calibrate import METHODS, calibrate
from meshskin.estimation.calibration import Calibration
from meshskin.estimation.data.gather import gather
from meshskin.estimation.uncertainty import verdict
from meshskin.estimation.uncertainty.frame_errors import least_turn
from meshskin.estimation.uncertainty.weighted_means import surrounded
from meshskin.geometry.region import Cap
from meshskin.recording.recording import UNCOMPARED, Recording

CONTACTS = 500


def lanes(scene, seed, back=-1):
    """Points (m, 3), m, near the taxels, in the order of lanes 2 mm apart, back and forth; back=1:
    all in one direction."""
    rng, skin = np.random.default_rng(seed), scene.skin
    k = rng.integers(len(skin), size=CONTACTS)
    points = skin.positions[k] + rng.uniform(-5e-3, 5e-3, (CONTACTS, 3))
    points = scene.body.closest(points).point
    lane = np.floor(points[:, 0] / 2e-3).astype(int)
    return points[np.lexsort((points[:, 1] * np.where(lane % 2, 1, back), lane))]


def log(scene, seed=0):
    """A log as of a robot: noise, forces from 2.5 to 3.5 N, no metadata."""
    force = np.random.default_rng(seed + 1).uniform(2.5, 3.5, CONTACTS)
    made = ms.press(scene, lanes(scene, seed), force=force, seed=seed)
    return Recording(made.contacts, made.readings, {})


def changed(recording, points=None, force=None, **readings):
    """The recording with other contact points, forces or columns of the readings."""
    columns = {"points": points, "force": force}
    recording = recording.with_columns(**{k: v for k, v in columns.items() if v is not None})
    table = recording.readings
    for name, values in readings.items():
        index = table.column_names.index(name)
        table = table.set_column(index, name, pa.array(values))
    return replace(recording, readings=table)


def late(recording, frames):
    """The recording with its readings `frames` contacts too late."""
    row = recording.reading_contact + frames
    table = recording.readings.filter(pa.array(row < len(recording.time)))
    return changed(
        Recording(recording.contacts, table, {}), time=recording.time[row[row < CONTACTS]]
    )


def outward(recording, distance):
    return changed(recording, recording.points + distance * recording.normals)


def aside(recording, distance):
    return changed(recording, recording.points + distance * np.array([1.0, 0.0, 0.0]))


def some_negative(values):
    return np.where(np.arange(len(values)) % 10 == 0, -values, values)


LOGS = {
    "pressures times 3": (lambda r: changed(r, pressure=3 * r.pressure), "does not fit"),
    "pressures times 2": (lambda r: changed(r, pressure=2 * r.pressure), "does not fit"),
    "constant force": (lambda r: changed(r, force=np.full(CONTACTS, 3.0)), "force is constant"),
    "some forces negative": (lambda r: changed(r, force=some_negative(r.force)), "not positive"),
    "6 mm out": (lambda r: outward(r, 6e-3), "6 mm above the believed surface"),
    "15 mm out": (lambda r: outward(r, 15e-3), "15 mm above the believed surface"),
    "15 mm aside": (lambda r: aside(r, 15e-3), "contact points lie"),
    "indenter 1 mm off": (lambda r: aside(r, 1e-3), "moved by (-1,"),
    "y mirrored": (
        lambda r: changed(r, r.points * [1.0, -1.0, 1.0]),
        "recorded normals turn -1 times",
    ),
    "equal pressures": (
        lambda r: changed(r, pressure=np.full(len(r.pressure), 2e4)),
        "all pressures are equal",
    ),
    "some pressures negative": (
        lambda r: changed(r, pressure=some_negative(r.pressure)),
        "pressure is negative",
    ),
    "1 frame late": (lambda r: late(r, 1), "1 frame too late"),
    "a quarter frame late": (
        lambda r: changed(r, time=r.readings.column("time").to_numpy() + 0.25 * r.frame),
        "synchronize the clocks",
    ),
}


@pytest.fixture(scope="module")
def recorded(noisy):
    return log(noisy)


def beliefs(scene):
    return {"known": scene.belief(), "unknown": replace(scene.belief(), noise_sigma=None)}


def error_and_sigma(scene, found):
    """RMS error and median standard deviation, mm."""
    error = np.linalg.norm(found.positions - scene.skin.positions, axis=1)
    return 1e3 * np.sqrt(np.nanmean(error**2)), 1e3 * np.nanmedian(found.position_sigma)


@pytest.mark.parametrize("measured", [True, False])
def test_the_scale_of_forces_that_a_learned_response_has_is_no_remedy(measured):
    recording = SimpleNamespace(
        force=np.ones(20), metadata={}, force_measured=measured, reading_contact=np.arange(20)
    )
    found = SimpleNamespace(fit=SimpleNamespace(good=False), response="learned")
    ((level, words),) = verdict.forces(recording, found)
    assert level == "DOUBT"
    assert "record the measured force" in words
    assert ("force_scale" in words) == measured


FIRST = ("pressures times 3", "indenter 1 mm off", "1 frame late")
"""Logs of the default run; the others are tried with -m deep."""


@pytest.mark.parametrize(
    ("name", "noise"),
    [
        *(
            pytest.param(name, "known", marks=() if name in FIRST else pytest.mark.deep)
            for name in LOGS
        ),
        *(pytest.param(name, "unknown", marks=pytest.mark.deep) for name in LOGS),
    ],
)
def test_wrong_logs_are_named(noisy, recorded, name, noise):
    wrong, words = LOGS[name]
    found = ms.calibrate(wrong(recorded), beliefs(noisy)[noise])
    assert found.verdict.level in ("DOUBT", "FAIL")
    assert any(words in reason for reason in found.verdict.reasons)
    error, sigma = error_and_sigma(noisy, found)
    if found.fit.good is False and "late" in name:
        assert error < 3 * sigma  # the misfit widens sigma
        assert any("by the misfit" in factor for factor in found.factors)


def test_negative_readings_of_frames_without_force_do_not_hide_corrupt_ones(noisy, recorded):
    lifted = np.arange(CONTACTS) % 5 == 0
    there = lifted[recorded.reading_contact]
    pressure = np.where(there, -1.0, recorded.pressure)
    corrupt = np.flatnonzero(~there)[::150]
    pressure[corrupt] = 1e99
    wrong = changed(recorded, force=np.where(lifted, 0.0, recorded.force), pressure=pressure)
    found = [words for _, words in verdict.pressures(wrong, gather(wrong, noisy.belief()))]
    assert found[0].startswith(f"the pressure is negative in {there.sum()} of")
    assert found[1].startswith(f"{len(corrupt)} of {len(pressure)} readings are corrupt")


@pytest.mark.deep
@pytest.mark.parametrize("factor", [0.5, 3.0])
def test_no_taxel_is_confidently_wrong_where_the_model_does_not_fit(noisy, recorded, factor):
    found = ms.calibrate(changed(recorded, pressure=factor * recorded.pressure), noisy.belief())
    assert found.verdict.level == "FAIL"
    error = np.linalg.norm(found.positions - noisy.skin.positions, axis=1)
    assert np.nanmax(error) > 0.3e-3
    assert not np.any((error > 0.3e-3) & (error > 5 * found.position_sigma))


@pytest.mark.parametrize("noise", ["known", pytest.param("unknown", marks=pytest.mark.deep)])
def test_a_sound_log_passes(noisy, recorded, noise, tmp_path):
    found = ms.calibrate(recorded, beliefs(noisy)[noise])
    assert found.verdict.level == "PASS"
    assert found.verdict.reasons == ()
    found.save(tmp_path / "c")
    assert Calibration.load(tmp_path / "c").verdict == found.verdict


@pytest.mark.parametrize("method", [m for m in METHODS if m != "joint"])
def test_methods_without_a_test_of_fit_say_so(noisy, recorded, method):
    found = ms.calibrate(recorded, noisy.belief(), method=method)
    assert found.verdict.level == "DOUBT"
    assert f"the method {method} has no test of fit" in found.verdict.reasons[0]


@pytest.mark.parametrize("factor", [pytest.param(0.9, marks=pytest.mark.slow), 1.1])
def test_the_deviation_of_the_modulus_holds_for_a_wrong_indenter_radius(noisy, recorded, factor):
    """E* is proportional to the radius of the paired spheres; no reading shows the difference."""
    belief = replace(noisy.belief(), indenter=ms.Indenter.sphere(factor * 0.01))
    found, true = ms.calibrate(recorded, belief), noisy.material.effective_modulus
    paired = (1 / 0.1 + 1 / 0.01) / (1 / 0.1 + 1 / (factor * 0.01))
    assert found.modulus / true == pytest.approx(paired, rel=0.01)
    assert abs(found.modulus - true) < 4 * found.modulus_sigma
    share = 0.03 / (1 + factor * 0.01 / 0.1)  # d ln E* / d ln R
    statistical = found.unknowns["modulus"][1]
    assert found.modulus_sigma / found.modulus == pytest.approx(
        np.hypot(share, statistical), rel=1e-3
    )
    assert any("indenter radius" in words for words in found.factors)


@pytest.mark.parametrize("change", [{"force": 0.0}, {"force": -1.0}, {"pressure": -1.0}])
def test_logs_without_a_press_or_a_reading_are_refused(noisy, recorded, change):
    (name, factor), = change.items()  # fmt: skip
    wrong = changed(recorded, **{name: factor * getattr(recorded, name)})
    with pytest.raises(CalibrationError, match=r"no contact is pressed|no readings"):
        ms.calibrate(wrong, noisy.belief())


@pytest.mark.deep
@pytest.mark.parametrize(
    ("factor", "level"),
    [
        (5, "DOUBT"),
        *(
            pytest.param(*k, marks=pytest.mark.deep)
            for k in ((2, "PASS"), (12, "FAIL"), (30, "FAIL"))
        ),
    ],
)
def test_the_nominal_modulus_is_compared(noisy, recorded, factor, level):
    """The estimate is right; the nominal value, or the scale of the log, is not."""
    belief = noisy.belief()
    material = replace(belief.material, young=factor * belief.material.young)
    found = ms.calibrate(recorded, replace(belief, material=material))
    assert found.verdict.level == level
    assert level == "PASS" or "times the nominal" in found.verdict.reasons[0]


@pytest.mark.deep
@pytest.mark.parametrize("noise", ["known", pytest.param("unknown", marks=pytest.mark.slow)])
def test_a_body_one_percent_too_large_is_named(noisy, recorded, noise):
    belief = replace(beliefs(noisy)[noise], body=ms.Body.sphere(0.101))
    found = ms.calibrate(recorded, belief)
    assert any("1 mm below the believed surface" in r for r in found.verdict.reasons)


@pytest.mark.deep
def test_the_verdict_is_the_first_of_what_is_saved_and_printed(
    noisy, recorded, tmp_path, no_figures
):
    found = ms.calibrate(outward(recorded, 6e-3), noisy.belief())
    assert str(found.verdict).startswith("verdict: FAIL\n  - contact points lie")
    found.save(tmp_path / "c")
    assert Calibration.load(tmp_path / "c").verdict == found.verdict
    metrics = assess(found, recorded)
    assert next(iter(metrics)) == "verdict"
    assert metrics["verdict"]["level"] == "FAIL"
    assert summary(found, metrics, tmp_path).startswith("verdict: FAIL")
    found.report(tmp_path / "r.html")
    assert "FAIL: do not use this calibration." in (tmp_path / "r.html").read_text()


@pytest.mark.deep
@pytest.mark.parametrize(
    ("back", "level"), [pytest.param(-1, "PASS", marks=pytest.mark.deep), (1, "DOUBT")]
)
def test_clocks_that_were_not_compared_are_named_where_strokes_have_one_direction(
    noisy, back, level
):
    made = ms.press(noisy, lanes(noisy, 0, back), force=3.0, seed=0)
    made = Recording(made.contacts, made.readings, {"clock": UNCOMPARED, **made.metadata})
    found = ms.calibrate(made, noisy.belief())
    assert found.verdict.level == level
    assert all("clock of the skin was not compared" in words for words in found.verdict.reasons)
    sigma = np.where(np.arange(len(found.ids)) % 5 < 3, np.inf, found.position_sigma)
    few = SimpleNamespace(position_sigma=sigma)  # the others are not determined
    named = list(verdict.clocks(made, gather(made, noisy.belief()), few))
    assert bool(named) == (level == "DOUBT")
    metadata = {key: made.metadata[key] for key in made.metadata if key != "clock"}
    assert not list(verdict.clocks(Recording(made.contacts, made.readings, metadata), None, found))


@pytest.mark.slow
@pytest.mark.parametrize("noise", ["known", "unknown"])
def test_sound_logs_pass(noisy, noise):
    levels = [ms.calibrate(log(noisy, k), beliefs(noisy)[noise]).verdict.level for k in range(20)]
    assert levels.count("PASS") >= 19
    assert "FAIL" not in levels


@pytest.mark.deep
@pytest.mark.parametrize("lean", [pytest.param(0.0, marks=pytest.mark.slow), 0.2])
def test_recorded_normals_that_scatter_or_lean_alike_accuse_nothing(noisy, recorded, lean):
    rng = np.random.default_rng(1)
    normals = recorded.normals + rng.normal(0, 0.1, (CONTACTS, 3)) + lean * np.array([0, 1, 0])
    found = ms.calibrate(recorded.with_columns(normals=normals), noisy.belief())
    assert found.verdict.level == "PASS"


@pytest.mark.deep
def test_single_normals_that_lean_back_accuse_no_axes(noisy, recorded):
    """4 % of the contacts, as over an edge: the regression through all normals has a quarter of the
    turn, that through the others the whole."""
    normals = recorded.normals.copy()
    normals[np.argsort(recorded.points[:, 1])[-CONTACTS // 25 :]] = [0.0, -1.0, 0.1]
    found = ms.calibrate(recorded.with_columns(normals=normals), noisy.belief())
    assert found.verdict.level == "PASS", found.verdict.reasons


@pytest.mark.deep
def test_taxels_where_contacts_end_are_not_surrounded(world):
    """Contacts over the half x > 0 only: the weighted mean of a taxel at its edge is displaced."""
    whole = world.record(0.01, 0.05)
    inside = whole.points[:, 0] > 0
    kept = pa.array(np.isin(whole.readings[0].to_numpy(), whole.time[inside]))
    half = Recording(
        whole.contacts.filter(pa.array(inside)), whole.readings.filter(kept), whole.metadata
    )
    belief = world.belief(0.01, 0.05)
    inner = np.linalg.norm(world.truth[:, :2], axis=1) < 13e-3
    assert surrounded(gather(whole, belief), world.truth[inner]).all()
    found, x = surrounded(gather(half, belief), world.truth[inner]), world.truth[inner, 0]
    assert not found[x < 3e-3].any()
    assert found[x > 6e-3].all()
    assert calibrate(half, belief).verdict.level == "PASS"


@pytest.mark.deep
@pytest.mark.parametrize(
    ("offset", "words"),
    [pytest.param(1.0, "1 N too large", marks=pytest.mark.slow), (-1.0, "0.98 N too small")],
)
def test_an_offset_of_the_forces_is_named(noisy, recorded, offset, words):
    wrong = changed(recorded, force=recorded.force + offset)
    found = ms.calibrate(wrong, noisy.belief(contact="auto"))
    assert found.verdict.level == "DOUBT"
    assert any(f"forces seem to be {words}" in text for text in found.verdict.reasons)


@pytest.mark.deep
@pytest.mark.parametrize(
    ("factor", "level"),
    [*(pytest.param(k, "PASS", marks=pytest.mark.deep) for k in (1.0, 2.0)), (4.0, "DOUBT")],
)
def test_an_overstated_noise_is_named(noisy, recorded, factor, level):
    belief = noisy.belief()
    found = ms.calibrate(recorded, replace(belief, noise_sigma=factor * belief.noise_sigma))
    assert found.verdict.level == level
    assert any("times the stated noise" in text for text in found.verdict.reasons) == (factor > 3)


@pytest.mark.parametrize(
    ("bump", "sigma", "threshold", "named"),
    [(0.2, 0.01, 0.05, True), (0.2, 0.1, 0.05, False), (0.2, 0.01, 0.3, False)],
)
def test_a_profile_that_rises_beyond_its_band_is_a_doubt(bump, sigma, threshold, named):
    r = np.linspace(0.0, 5e-3, 60)
    profile = np.exp(-((r / 2e-3) ** 2)) + bump * np.exp(-(((r - 4e-3) / 5e-4) ** 2))
    response = SimpleNamespace(
        distance=r, profile=profile, profile_sigma=np.full(60, sigma), unit=1.0, taxels=()
    )
    data = SimpleNamespace(threshold=threshold)
    both = SimpleNamespace(each=(response,), unit=1.0)
    found = list(verdict.profile(data, SimpleNamespace(response=both)))
    assert [level for level, _ in found] == ["DOUBT"] * named
    assert all("to 4 mm" in words for _, words in found)


def bumpy_handle():
    """A capsule of long triangles with a bump: its curvature changes from face to face."""
    mesh = trimesh.creation.capsule(height=0.1, radius=0.03, count=[24, 24])
    places = mesh.vertices - mesh.vertices.mean(axis=0)
    height = 4e-3 * np.exp(-((places - [0.03, 0.0, 0.05]) ** 2).sum(axis=1) / (2 * 8e-3**2))
    places[:, 0] += height
    body = ms.Body.from_mesh(trimesh.Trimesh(places, mesh.faces))
    skin = ms.Skin.cover(body, spacing=5e-3, count=60, region=Cap(direction=(1.0, 0.0, 0.2)))
    return ms.Scene(body=body, skin=skin, indenter=ms.Indenter.sphere(0.01))


@pytest.mark.deep
@pytest.mark.parametrize(
    "scene", [lambda: ms.Scene.load("sphere"), pytest.param(bumpy_handle, marks=pytest.mark.slow)]
)
def test_errors_of_computing_are_no_doubt(scene):
    """Without noise what is left is of the integration, which contacts near one another share."""
    scene = scene()
    found = ms.calibrate(ms.simulate(scene), scene.belief())
    assert found.verdict.level == "PASS", found.verdict.reasons


@pytest.mark.parametrize("share", [0.02, 0.06])
def test_a_mirrored_axis_shows_on_a_patch_that_hardly_turns(share):
    """Of the contacts on a nearly flat patch few turn, and these are as mirrored as the others."""
    rng = np.random.default_rng(1)
    tilt = rng.normal(0, 0.02, (2000, 2))
    tilt[: int(share * len(tilt))] += rng.uniform(-0.4, 0.4, (int(share * len(tilt)), 2))
    surface = np.column_stack([tilt, np.ones(len(tilt))])
    surface /= np.linalg.norm(surface, axis=1)[:, None]
    recorded = surface * [-1, 1, 1] + rng.normal(0, 2e-3, surface.shape)
    turn, axis = least_turn(surface, recorded)
    assert turn == pytest.approx(-1.0, abs=0.1)
    assert abs(axis[0]) > 0.99
    assert least_turn(surface, surface + rng.normal(0, 2e-3, surface.shape))[0] > 0.9


@pytest.mark.deep
def test_contacts_at_the_edge_of_a_plate_accuse_no_frame(noisy):
    body = ms.Body.from_mesh(trimesh.creation.box((0.08, 0.06, 0.02)))
    region = Cap(direction=(0.0, 0.0, 1.0))
    scene = noisy.with_(body=body, skin=ms.Skin.cover(body, spacing=5e-3, count=20, region=region))
    near = np.repeat(scene.skin.positions, 25, axis=0)
    rng = np.random.default_rng(1)
    flat = near + rng.uniform(-4e-3, 4e-3, near.shape) * [1.0, 1.0, 0.0]
    beside = np.repeat([[0.04, 0.0, 0.0099]], 20, axis=0)  # 0.1 mm below the edge
    places = np.concatenate([flat, beside])
    made = ms.press(scene, places, force=rng.uniform(2.5, 3.5, len(places)), seed=1)
    normals = np.repeat([[0.0, 0.0, 1.0]], len(made.points), axis=0)
    made = replace(made.with_columns(normals=normals), metadata={})
    assert ms.calibrate(made, scene.belief()).verdict.level == "PASS"
