"""The catalogue of foreign worlds against closed forms, and the study's table at a small size."""

import csv
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
from scipy.integrate import quad

import meshskin as ms
from meshskin.recording.recording import Recording


@pytest.fixture(scope="module")
def study(script):
    return script("foreign_worlds")


@pytest.fixture(scope="module")
def worlds():
    from worlds.catalogue import catalogue

    return catalogue()


@pytest.fixture(scope="module")
def small(worlds):
    """The recording of a world with fewer taxels and contacts."""
    from worlds.world import record

    def make(name, seed=0, **options):
        world = replace(worlds[name], taxels=19, contacts=250, **options)
        return world, record(world, seed)

    return make


def test_every_method_has_its_color(study):
    assert study.METHODS.keys() <= study.theme.METHOD_COLOURS.keys()


@pytest.mark.parametrize("name", ["Hertz", "Winkler", "Bell", "blurred"])
def test_the_pressure_of_a_profile_adds_up_to_the_force(name):
    from worlds import profiles

    profile = (
        profiles.blurred(profiles.Winkler(), 1e-3)
        if name == "blurred"
        else getattr(profiles, name)()
    )
    r = np.linspace(0.0, profiles.REACH, 20001)
    for force in (2.5, 3.0, 3.6):
        p = profile(r, np.array(force))
        assert np.trapezoid(2 * np.pi * r * p, r) == pytest.approx(force, rel=2e-4)
        assert np.all(np.diff(p) <= 1e-9 * p[0])


def test_hertz_by_its_textbook_values():
    """K. L. Johnson: a^3 = 3 F R / (4 E*), p_0^3 = 6 F E*^2 / (pi^3 R^2)."""
    from worlds.profiles import Hertz

    profile, force = Hertz(modulus=1e6, radius=0.02), 5.0
    assert profile(0.0, force) == pytest.approx((6 * force * 1e12 / (np.pi**3 * 4e-4)) ** (1 / 3))
    a = (3 * force * 0.02 / 4e6) ** (1 / 3)
    assert profile(0.999 * a, force) > 0 == profile(1.001 * a, force)
    assert profile(0.6 * a, force) == pytest.approx(0.8 * profile(0.0, force))


def test_springs_press_in_proportion_to_their_depth():
    """The depth under a sphere falls by r^2 / (2 R)."""
    from worlds.profiles import Winkler

    profile = Winkler(stiffness=4e7, radius=0.01)
    drop = profile(0.0, 3.0) - profile(2e-3, 3.0)
    assert drop == pytest.approx(4e7 * 2e-3**2 / 0.02)


@pytest.mark.slow
def test_a_blur_adds_its_variance():
    """Of second moments of the pressure, per axis: that of the cover adds to the foam's."""
    from worlds.profiles import REACH, Winkler, blurred

    r = np.linspace(0.0, REACH, 20001)

    def moment(profile):
        p = profile(r, np.array(3.0))
        return np.trapezoid(r**3 * p, r) / np.trapezoid(r * p, r) / 2

    added = moment(blurred(Winkler(), 1.2e-3)) - moment(Winkler())
    assert added == pytest.approx(1.2e-3**2, rel=1e-3)


def test_a_disc_reads_its_mean():
    """Against adaptive quadrature; the mean depends on the distance alone, whatever the side."""
    from worlds import sphere
    from worlds.profiles import Winkler
    from worlds.world import Radial, disc_means

    profile, at, s = Winkler(), 4.2e-3, sphere.DISC_RADIUS

    def ring(radius):
        angle = np.pi * (np.arange(400) + 0.5) / 400
        r = np.sqrt(at**2 + radius**2 + 2 * at * radius * np.cos(angle))
        return 2 * radius / s**2 * profile(r, np.array(3.0)).mean()

    mean = disc_means(profile).ev(np.log(3.0), at)
    assert mean == pytest.approx(quad(ring, 0, s, epsrel=1e-6)[0], rel=1e-4)
    pole = sphere.RADIUS * np.array([[0.0, 0.0, 1.0]])
    turn = np.linspace(0, 2 * np.pi, 8)
    ring = sphere.on_sphere(at * np.column_stack([np.cos(turn), np.sin(turn)]))
    read = Radial(profile)(sphere.Touch(pole, np.array([3.0])), ring)
    assert np.ptp(read) < 1e-9 * read.mean()


def test_the_loop_of_the_play_operator():
    """From rest up to p and back: it lags by the half-width, and holds in between."""
    from worlds.electronics import play

    up, down = np.linspace(0, 1, 101), np.linspace(1, 0, 101)
    out = play(np.concatenate([up, down])[:, None], 0.2)[:, 0]
    assert out[100] == pytest.approx(0.8)
    assert out[50] == pytest.approx(0.3)
    assert np.ptp(out[101:141]) < 1e-12
    assert out[-1] == pytest.approx(0.2)
    cycle = np.concatenate([down[1:-1], up, down])
    lag = play(np.concatenate([up, cycle])[:, None], 0.2)[:, 0]
    # area of the closed loop: width of the loop, 2 r, times its height, p - 2 r
    p = np.concatenate([up, cycle])
    assert -np.trapezoid(lag[200:], p[200:]) == pytest.approx(0.4 * 0.6, rel=1e-2)


def test_counts_are_integers_that_saturate(small):
    from worlds.electronics import FULL_SCALE

    world, sample = small("counts")
    counts = sample.recording.pressure
    np.testing.assert_array_equal(counts, np.round(counts))
    assert sample.threshold < counts.min()
    assert counts.max() <= 255
    assert np.ptp(sample.recording.force) == 0.0
    peak = sample.sensors.peak
    full = world.electronics.response(np.array([peak, 1e9 * peak]), peak)
    np.testing.assert_allclose(full / full[0], [1.0, 2.0])
    assert counts.max() == pytest.approx(FULL_SCALE, rel=0.3)


def test_scatter_and_force_errors_have_their_size(worlds):
    from worlds import sphere
    from worlds.world import record

    sample = record(worlds["scatter_03"], 0)
    off = sample.recording.points - sample.touch.points
    assert np.sqrt(np.mean(off**2) * 1.5) == pytest.approx(0.3e-3, rel=0.05)
    radius = np.linalg.norm(sample.recording.points, axis=1)
    np.testing.assert_allclose(radius, sphere.RADIUS, rtol=1e-12)
    sample = record(worlds["force_10"], 0)
    assert np.abs(sample.recording.points - sample.touch.points).max() < 1e-15
    error = np.log(sample.recording.force / sample.touch.force)
    assert np.std(error) == pytest.approx(0.1, rel=0.07)
    assert np.std(np.log(sample.touch.force)) == pytest.approx(0.05, rel=0.07)


def test_drift_and_crosstalk(small):
    world, sample = small("hertz")
    quiet = sample.exact(world)
    world, sample = small("drift")
    rise = (sample.exact(world) - quiet) / sample.sensors.peak
    np.testing.assert_allclose(rise, np.linspace(0, 1, 250)[:, None] * rise[-1], atol=1e-12)
    assert np.std(rise[-1]) == pytest.approx(0.05, rel=0.4)
    world, sample = small("crosstalk")
    leaked = (sample.exact(world) - quiet).sum(axis=1)
    near = np.linalg.norm(sample.positions[:, None] - sample.positions, axis=2)
    neighbours = ((near > 1e-3) & (near < 6e-3)).sum(axis=1)
    assert neighbours.max() == 6
    np.testing.assert_allclose(leaked, 0.05 * quiet @ neighbours, rtol=1e-9, atol=1e-6)


@pytest.mark.parametrize("name", ["hertz", "together", "counts"])
def test_a_seed_gives_the_same_recording(small, name):
    one, again, other = small(name)[1], small(name)[1], small(name, seed=1)[1]
    assert one.recording.readings.equals(again.recording.readings)
    assert one.recording.contacts.equals(again.recording.contacts)
    assert not one.recording.readings.equals(other.recording.readings)
    assert not np.allclose(one.positions, other.positions)


@pytest.mark.deep
def test_the_joint_estimate_is_on_the_bound_where_hertz_holds(worlds):
    """Two seeds of the world that is as believed: no shift from the rules of quadrature."""
    from foreign_worlds import belief
    from worlds.bound import bound
    from worlds.world import record

    body, square, limit = ms.Body.sphere(0.1), [], []
    for seed in range(2):
        sample = record(worlds["hertz"], seed)
        found = ms.calibrate(sample.recording, belief(sample, body))
        square.append(np.mean(np.sum((found.positions - sample.positions) ** 2, axis=1)))
        limit.append(bound(worlds["hertz"], sample) ** 2)
    assert np.sqrt(np.mean(square) / np.mean(limit)) == pytest.approx(1.0, abs=0.1)


def test_the_bound_of_what_is_unknown_is_larger(small, worlds):
    from worlds.bound import bound

    known = bound(*small("hertz"))
    for name in ("force_10", "scatter_03", "scatter_10"):
        assert bound(*small(name)) > known
    assert bound(*small("scatter_10")) > bound(*small("scatter_03"))
    half = replace(worlds["hertz"].electronics, noise=0.005)
    assert bound(*small("hertz", electronics=half)) == pytest.approx(known / 2, rel=0.05)
    assert np.isnan(bound(*small("together")))


@pytest.mark.deep
@pytest.mark.parametrize(
    ("name", "truth", "worst"),
    [
        pytest.param("hysteresis", {"hysteresis": (0.5, 0.2)}, 0.05e-3, marks=pytest.mark.deep),
        ("crosstalk", {"crosstalk": 0.05}, 0.04e-3),
        pytest.param("crosstalk_modules", {"crosstalk": 0.05}, 0.04e-3, marks=pytest.mark.deep),
        pytest.param("crosstalk_faint", {"crosstalk": 0.02}, 0.03e-3, marks=pytest.mark.slow),
        pytest.param("matrix", {"crosstalk": 0.03}, 0.03e-3, marks=pytest.mark.slow),
        pytest.param("ghosts", {"crosstalk": 0.03}, 0.03e-3, marks=pytest.mark.slow),
        pytest.param("drift", {"drift": 0.05}, 0.05e-3, marks=pytest.mark.slow),
        pytest.param("creep_30", {"creep": (0.2, 3.0)}, 0.04e-3, marks=pytest.mark.slow),
        pytest.param("creep_stops", {"creep": (0.2, 1.0)}, 0.04e-3, marks=pytest.mark.slow),
        pytest.param(
            "warming", {"gain_drift": 0.1, "offset_drift": 0.03}, 0.05e-3, marks=pytest.mark.slow
        ),
        pytest.param("force_drift", {"force_drift": 0.22}, 0.04e-3, marks=pytest.mark.deep),
        pytest.param("drag_01", {"drag": 0.1e-3}, 0.03e-3, marks=pytest.mark.slow),
        pytest.param("drag_09", {"drag": 0.9e-3}, 0.03e-3, marks=pytest.mark.slow),
        ("force_nominal", {}, 0.05e-3),
        pytest.param("strays", {}, 0.04e-3, marks=pytest.mark.slow),
        ("hertz", {}, 0.04e-3),
    ],
)
def test_what_the_electronics_add_is_named_and_estimated(study, worlds, name, truth, worst):
    """By default, of pressures; `truth`: share and width of the hysteresis, share of crosstalk,
    deviation of the drift relative to the peak reading, drag, m, share and time constant, s, of the
    creep, and drifts of all gains and forces, relative, and of all offsets, in peak readings."""
    from worlds import sphere
    from worlds.world import record

    sample = record(replace(worlds[name], taxels=61, contacts=620), 0)
    found = ms.calibrate(sample.recording, study.belief(sample, ms.Body.sphere(sphere.RADIUS)))
    off = np.linalg.norm(found.positions - sample.positions, axis=1)
    rms = np.sqrt(np.mean(off**2))
    assert rms < worst
    assert 0.7 < np.sqrt(np.mean(found.position_sigma**2)) / rms < 1.4
    if name == "hertz":
        assert found.response is None
        return
    learned = found.response
    estimated = {
        "hysteresis": learned.hysteresis,
        "crosstalk": learned.crosstalk,
        "drift": learned.drift / sample.sensors.peak,
        "drag": found.unknowns.get("drag", (0.0, 0.0))[0],
        "creep": learned.creep,
        "gain_drift": learned.gain_drift,
        "offset_drift": learned.offset_drift / sample.sensors.peak,
        "force_drift": learned.force_drift,
    }
    for key, value in estimated.items():
        expected = truth.get(key, np.zeros(np.shape(value)))
        assert value == pytest.approx(expected, rel=0.3)
    if "drag" in truth:
        return
    words = "hysteresis", "crosstalk", "offsets drift", "creep", "the "
    named = [text for text in learned.describe() if text.startswith(words)]
    assert len(named) == len(truth)


@pytest.mark.deep
def test_taxels_that_are_read_one_after_another(study, worlds):
    """One spiral passes most taxels in one direction: only those in its middle tell how far."""
    from worlds import sphere
    from worlds.world import record

    sample = record(replace(worlds["multiplexed"], taxels=61, contacts=620), 1)
    found = ms.calibrate(sample.recording, study.belief(sample, ms.Body.sphere(sphere.RADIUS)))
    off = np.linalg.norm(found.positions - sample.positions, axis=1)
    assert np.max(off / found.position_sigma) < 4.5
    assert 0.8 < np.sqrt(np.mean(found.position_sigma**2) / np.mean(off**2)) < 1.25
    step = np.linalg.norm(np.diff(sample.touch.points, axis=0), axis=1)
    late = 0.5 * np.median(step) * np.linspace(0.0, 1.0, 61)
    assert found.response.skew == pytest.approx(np.std(late), rel=0.3)


@pytest.mark.deep
@pytest.mark.parametrize(
    ("name", "seed"),
    [(name, seed) for name in ("scan_places", "scan_drawn") for seed in range(3)],
)
def test_a_scan_in_any_order_is_in_the_standard_deviations(study, worlds, name, seed):
    """A mean lag of the readings shows; that of each taxel hardly does, nor does the order of the
    channels: 0.34 to 0.38 of the error was stated, with PASS, and is 0.79 to 1.01."""
    from worlds import sphere
    from worlds.world import record

    sample = record(replace(worlds[name], taxels=61, contacts=620), seed)
    found = ms.calibrate(sample.recording, study.belief(sample, ms.Body.sphere(sphere.RADIUS)))
    off = np.linalg.norm(found.positions - sample.positions, axis=1)
    assert 0.7 < np.sqrt(np.mean(found.position_sigma**2) / np.mean(off**2)) < 1.25
    assert found.verdict.level == "DOUBT"
    assert "ahead of the contacts" in found.verdict.reasons[0]


@pytest.mark.deep
def test_a_misfit_that_displaces_taxels_is_in_the_standard_deviations(study, worlds):
    """Of ovals on a sphere, as by an ellipsoidal tip, for which other parameters stand in: 0.63 of
    the error was stated, and 0.37 with such a tip on thin foam, with taxels 7 sigma off."""
    from worlds import sphere
    from worlds.world import record

    sample = record(replace(worlds["oblong_13"], taxels=61, contacts=620), 1)
    found = ms.calibrate(sample.recording, study.belief(sample, ms.Body.sphere(sphere.RADIUS)))
    off = np.linalg.norm(found.positions - sample.positions, axis=1)
    assert np.sqrt(np.mean(found.position_sigma**2) / np.mean(off**2)) > 0.8
    assert (off < 5 * found.position_sigma).all()
    assert found.verdict.level != "PASS"


@pytest.mark.deep
@pytest.mark.parametrize("seed", [0, pytest.param(1, marks=pytest.mark.slow)])
def test_a_scan_too_short_to_be_estimated_is_in_the_standard_deviations(study, worlds, seed):
    """Of 0.1 of a frame; without it 0.2 to 0.3 of the error is stated."""
    from worlds import sphere
    from worlds.world import record

    body = ms.Body.sphere(sphere.RADIUS)
    sample = record(replace(worlds["hertz"], skew=0.1, taxels=61, contacts=620), seed)
    belief = replace(study.belief(sample, body), contact="hertz")
    found = ms.calibrate(sample.recording, belief)
    off = np.linalg.norm(found.positions - sample.positions, axis=1)
    assert 0.67 < np.sqrt(np.mean(found.position_sigma**2) / np.mean(off**2)) < 1.5
    assert any("one after another" in words for words in found.factors)
    sound = record(replace(worlds["hertz"], taxels=61, contacts=620), seed)
    found = ms.calibrate(sound.recording, belief)
    off = np.linalg.norm(found.positions - sound.positions, axis=1)
    assert 0.8 < np.sqrt(np.mean(found.position_sigma**2) / np.mean(off**2)) < 1.25
    assert not any("one after another" in words for words in found.factors)


@pytest.mark.deep
def test_a_scan_too_short_to_be_estimated_moves_the_taxels_under_a_learned_response(study, worlds):
    """Of 0.06 of a frame on a spiral: 0.066 mm rms if they stay where they are."""
    from worlds import sphere
    from worlds.world import record

    sample = record(replace(worlds["hertz"], skew=0.06, taxels=61, contacts=620), 1)
    belief = replace(study.belief(sample, ms.Body.sphere(sphere.RADIUS)), contact="learned")
    found = ms.calibrate(sample.recording, belief)
    off = np.linalg.norm(found.positions - sample.positions, axis=1)
    assert np.sqrt(np.mean(off**2)) < 0.04e-3
    assert 0.8 < np.sqrt(np.mean(found.position_sigma**2) / np.mean(off**2)) < 1.25


@pytest.mark.deep
@pytest.mark.parametrize(
    "name",
    [
        "oblong_13",
        *(
            pytest.param(name, marks=pytest.mark.slow)
            for name in (
                *("pair", "oblong_13_turns", "oblong_20", "oblong_20_turns"),
                *("wander", "skewed"),
            )
        ),
    ],
)
def test_a_world_outside_the_family_is_named_or_its_errors_stated(study, worlds, name):
    from worlds import sphere
    from worlds.world import record

    sample = record(replace(worlds[name], taxels=61, contacts=650), 1)
    found = ms.calibrate(sample.recording, study.belief(sample, ms.Body.sphere(sphere.RADIUS)))
    off = np.linalg.norm(found.positions - sample.positions, axis=1)
    stated = np.sqrt(np.mean(found.position_sigma**2))
    assert found.verdict.level != "PASS" or np.sqrt(np.mean(off**2)) < 1.5 * stated
    if not name.endswith("turns"):  # where the directions average out to scatter, PASS is right
        assert found.verdict.level != "PASS"
    if name == "oblong_13":  # lags of each taxel would stand in for the shape of the patches
        assert np.sqrt(np.mean(off**2)) < 0.5e-3


@pytest.mark.deep
@pytest.mark.parametrize("seed", [1, 2])
def test_creep_with_two_time_constants_counts_in_the_errors(study, worlds, seed):
    """With one constant 0.79 of the error was stated, with a NEES of 3.3 and PASS."""
    from worlds import sphere
    from worlds.world import record

    sample = record(worlds["creep_twice"], seed)
    believed = study.belief(sample, ms.Body.sphere(sphere.RADIUS), readings="raw")
    found = ms.calibrate(sample.recording, believed)
    off = found.positions - sample.positions
    rms = np.sqrt(np.mean(np.sum(off**2, axis=1)))
    assert 0.85 < np.sqrt(np.mean(found.position_sigma**2)) / rms < 1.25
    assert "lags of the readings" in str(found.verdict)


@pytest.mark.deep
@pytest.mark.parametrize(
    ("share", "seed"), [pytest.param(0.1, 1, marks=pytest.mark.slow), (-0.06, 2)]
)
def test_single_pairs_that_crosstalk_displace_no_taxel_beyond_its_error(study, worlds, share, seed):
    """With a common share of those that read, and none where it was negative, the three taxels were
    9 to 10 and 7 to 8 standard deviations off, with PASS."""
    from worlds import sphere
    from worlds.world import record

    sample = record(replace(worlds["hertz"], taxels=61, contacts=650), seed)
    recording = sample.recording
    near = np.linalg.norm(sample.positions[:, None] - sample.positions, axis=2)
    pressed = np.zeros((len(recording.points), len(near)))
    at = recording.reading_contact, recording.reading_taxel
    pressed[at] = recording.pressure
    read = pressed.copy()
    for taxel in (5, 20, 40):
        read[:, taxel] += share * pressed[:, np.argsort(near[taxel])[1]]
    readings, values = recording.readings, np.maximum(read[at], recording.pressure.min())
    column = readings.column_names.index("pressure")
    readings = readings.set_column(column, readings.schema.field(column), pa.array(values))
    leaking = Recording(recording.contacts, readings, recording.metadata)
    believed = study.belief(sample, ms.Body.sphere(sphere.RADIUS), contact="learned")
    found = ms.calibrate(leaking, believed)
    off = np.einsum("nji,nj->ni", found.poses[:, :3, :3], found.positions - sample.positions)
    square = np.linalg.solve(found.covariances[:, :2, :2], off[:, :2, None])[:, :, 0]
    assert np.sqrt(np.sum(off[:, :2] * square, axis=1)).max() < 4.5
    assert np.median(found.position_sigma) < 0.03e-3


def test_the_layer_on_a_prism_bears_the_force():
    """On a face the overlap is the cap of a ball, pi d^2 (3 R - d) / 3; on an edge, half of it and
    less than that of the other face."""
    from worlds import edge, sphere

    force = np.array([2.0, 4.0])
    world, none = edge.Edge(), np.zeros(2)
    depth = sphere.INDENTER_RADIUS - world._indenter(none, none, force)[:, 0] + edge.APOTHEM
    cap = np.pi * depth**2 * (3 * sphere.INDENTER_RADIUS - depth) / 3
    assert edge.STIFFNESS * cap == pytest.approx(force, rel=0.01)
    over = world._indenter(np.array([world.width / 2]), none[:1], force[:1])[0]
    corner, normal = world.at(np.array(world.width / 2 - 1e-9), np.zeros(()))
    deeper = sphere.INDENTER_RADIUS - (over - corner) @ normal
    assert depth[0] < deeper < np.sqrt(2) * depth[0]


@pytest.mark.slow
def test_sigma_holds_beside_an_edge(study, tmp_path):
    """Without deviations of the readings over edges 0.12 of the errors were stated."""
    asked = ["--worlds", "edge", "--seeds", "1", "--out", str(tmp_path)]
    row = study.main([*asked, "--methods", "joint", "learned"])["edge"]
    for method in ("joint", "learned"):
        assert row[f"{method}_lost"] < 5
        assert 0.5 < row[f"{method}_sigma_mm"] / row[f"{method}_mm"] < 2.0
    assert row["joint_mm"] < row["centroid_mm"]


@pytest.mark.deep
def test_the_table(study, tmp_path, capsys):
    asked = ["--worlds", "scatter_03", "counts", "--seeds", "1", "--out", str(tmp_path)]
    found = study.main([*asked, "--methods", "three_circles", "hertz"])
    rows = list(csv.DictReader((tmp_path / "foreign_worlds.csv").open()))
    assert [row["world"] for row in rows] == ["scatter_03", "counts"]
    assert float(rows[0]["hertz_mm"]) == found["scatter_03"]["hertz_mm"]
    assert (tmp_path / "foreign_worlds.png").stat().st_size > 10_000
    out = capsys.readouterr().out
    # Hertz' contact takes the contact points as exact
    ratio = found["scatter_03"]["hertz_mm"] / found["scatter_03"]["centroid_mm"]
    assert ratio > 1.05
    assert f"scatter_03: joint, Hertz {ratio:.1f} times the centroid" in out
    assert "counts: joint, Hertz refused: the pressures cannot be in Pa" in out
    assert found["scatter_03"]["bound_mm"] < 0.5 * found["scatter_03"]["centroid_mm"]


def _indented(**options):
    """A layer that is flat against the indenter, and what presses it."""
    hyperelastic = pytest.importorskip("worlds.hyperelastic", exc_type=ImportError)
    return hyperelastic.Layer(body_radius=100.0, poisson=0.3, **options), hyperelastic.indentation


@pytest.mark.slow
def test_a_thick_layer_is_a_half_space():
    """Hertz at small depth, corrected for the bonded base to second order in sqrt(R d) / h.

    Source: E. K. Dimitriadis and others, Biophysical J. 82 (2002).
    """
    depth = np.array([2e-5, 4e-5])
    layer, indentation = _indented(thickness=0.02, width=0.04, cell=1e-4, fine=1.2e-3)
    force, _ = indentation(layer, depth)
    nu, radius = 0.3, layer.indenter_radius
    modulus = layer.young / (1 - nu**2)
    hertz = 4 / 3 * modulus * np.sqrt(radius) * depth**1.5
    alpha = -(1.2876 - 1.4678 * nu + 1.3442 * nu**2) / (1 - nu)
    chi = np.sqrt(radius * depth) / layer.thickness
    expected = hertz * (1 - 2 * alpha / np.pi * chi + 4 * (alpha / np.pi) ** 2 * chi**2)
    np.testing.assert_allclose(force, expected, rtol=0.012)


@pytest.mark.parametrize("bonded", [True, False])
def test_a_thin_layer_is_a_foundation_of_springs(bonded):
    """F = pi R k d^2. Bonded: k = M / h, M the modulus without lateral strain. Sliding: the sheet
    around the patch holds it as that around a hot spot, s_r + s_t = -nu p, so that k =
    E / (1 - nu^2) / h.
    """
    layer, indentation = _indented(
        thickness=2e-4, width=0.012, cell=1e-4, fine=5e-3, indenter_radius=1.0,
        bonded=bonded, penalty=1000.0,
    )  # fmt: skip
    nu, depth = 0.3, 3e-6
    force, found = indentation(layer, np.array([depth / 2, depth]))
    lateral = (1 - nu) / ((1 + nu) * (1 - 2 * nu)) if bonded else 1 / (1 - nu**2)
    stiffness = lateral * layer.young / layer.thickness
    assert force[1] == pytest.approx(np.pi * 1.0 * stiffness * depth**2, rel=0.03)
    arc, pressure = found[1]
    middle = pressure[arc < 1e-3].mean() / (stiffness * depth)  # means of r^2: a third
    assert middle == pytest.approx(1 - 1e-6 / 3 / (2 * 1.0 * depth), rel=0.02)


def test_the_tangent_is_the_derivative_of_the_stress():
    """At large strains, by central differences."""
    hyperelastic = pytest.importorskip("worlds.hyperelastic", exc_type=ImportError)
    rng = np.random.default_rng(0)
    gradient = rng.uniform(-0.25, 0.25, (3, 4, 5))
    _, moduli = hyperelastic.neo_hookean(gradient, 2.0, 3.0)
    for k in range(5):
        step = 1e-6 * np.eye(5)[k]
        high, low = (hyperelastic.neo_hookean(gradient + s * step, 2.0, 3.0)[0] for s in (1, -1))
        np.testing.assert_allclose(moduli[..., k], (high - low) / 2e-6, atol=1e-7)
    ball = hyperelastic.Ball(1.0, 1.5, 7.0)
    x = rng.uniform(0.0, 0.8, (3, 4, 2))
    for k in range(2):
        step = 1e-6 * np.eye(2)[k]
        high, low = (ball.force(x + s * step)[0] for s in (1, -1))
        np.testing.assert_allclose(ball.force(x)[1][..., k], (high - low) / 2e-6, atol=1e-6)


@pytest.mark.slow
def test_finite_elements_converge_at_large_depth():
    """A third of the layer is displaced; half the cells change the force by less than 1 %."""
    hyperelastic = pytest.importorskip("worlds.hyperelastic", exc_type=ImportError)
    depths, found = np.arange(1, 11) * 1e-4, []
    for cell in (5e-4, 2.5e-4):
        layer = hyperelastic.Layer(thickness=3e-3, cell=cell)
        force, pressures = hyperelastic.indentation(layer, depths)
        arc, p = pressures[-1]
        around = np.trapezoid(2 * np.pi * arc * p, arc)
        # the normals of the indenter are tilted by up to 30 degrees: 5 % on average
        assert 1.0 < around / force[-1] < 1.08
        found.append(force[-1])
    assert found[0] == pytest.approx(found[1], rel=0.01)


def test_pins_are_springs_in_parallel():
    """At rest, by bisection for the depth at which springs under a sphere carry the force."""
    pins = pytest.importorskip("worlds.pins", exc_type=ImportError)
    from worlds import sphere

    positions = sphere.taxels(37, 0)
    whole = sphere.spiral(200, positions, 0)
    touch = sphere.Touch(whole.points[:40:8], whole.force[:40:8])
    world = pins.Pins()
    found = world(touch, positions) * np.pi * sphere.DISC_RADIUS**2
    gap = np.maximum(sphere.distances(touch, positions) - sphere.DISC_RADIUS, 0.0) ** 2 / 2
    gap *= 1 / sphere.INDENTER_RADIUS + 1 / sphere.RADIUS
    for row, force in enumerate(touch.force):
        low, high = 0.0, 0.02
        for _ in range(60):
            depth = (low + high) / 2
            if world.stiffness * np.maximum(depth - gap[row], 0.0).sum() > force:
                high = depth
            else:
                low = depth
        expected = world.stiffness * np.maximum(depth - gap[row], 0.0)
        np.testing.assert_allclose(found[row], expected, atol=0.02 * force)


@pytest.mark.deep
def test_a_hydroelastic_body_is_springs_under_a_sphere():
    """E over the radius is the stiffness k; F = pi R k d^2 but for the second order in the depth d
    over the radius of the indenter, and for facets."""
    hydroelastic = pytest.importorskip("worlds.hydroelastic", exc_type=ImportError)
    from worlds import sphere
    from worlds.profiles import Winkler
    from worlds.world import Radial

    positions = sphere.taxels(7, 0)
    whole = sphere.spiral(40, positions, 0)
    touch = sphere.Touch(whole.points[::14], whole.force[::14])
    world = hydroelastic.Hydroelastic(resolution=6e-3)
    expected = Radial(Winkler())(touch, positions)
    assert np.abs(world(touch, positions) - expected).max() < 0.05 * expected.max()
    for point, normal, force in zip(touch.points, touch.normals, touch.force, strict=True):
        found, depth = world.pressed(point, normal, force, hydroelastic.DEPTH)
        mesh, field = (f() for f in (found.contact_surface().tri_mesh_W,
                                     found.contact_surface().tri_e_MN))  # fmt: skip
        faces = np.array([[face.vertex(k) for k in range(3)] for face in mesh.triangles()])
        p = np.array([field.EvaluateAtVertex(k) for k in range(mesh.num_vertices())])
        area = [mesh.area(k) * mesh.face_normal(k) @ normal for k in range(len(faces))]
        assert abs(p[faces].mean(axis=1) @ area) == pytest.approx(force, rel=2e-4)
        springs = np.sqrt(force / (np.pi * Winkler().radius * Winkler().stiffness))
        assert depth == pytest.approx(springs, rel=0.1)
    soft = hydroelastic.Hydroelastic(resolution=6e-3, indenter_modulus=0.35e6)
    # both are as stiff: together half as stiff
    halved = Radial(Winkler(Winkler().stiffness / 2))(touch, positions)
    assert np.abs(soft(touch, positions) - halved).max() < 0.08 * halved.max()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["hydroelastic", "hydroelastic_soft", "hydroelastic_counts"])
def test_hydroelastic_contact_is_learned(study, name):
    """A rigid and a compliant indenter; the counts have only nominal forces."""
    pytest.importorskip("worlds.hydroelastic", exc_type=ImportError)
    from worlds import catalogue, sphere
    from worlds.world import record

    sample = record(replace(catalogue.world(name), taxels=61, contacts=620), 3)
    readings = "raw" if name.endswith("counts") else "pressure"
    body = ms.Body.sphere(sphere.RADIUS)
    found = ms.calibrate(sample.recording, study.belief(sample, body, readings=readings))
    off = np.linalg.norm(found.positions - sample.positions, axis=1)
    rms, centroid = np.sqrt(np.mean(off**2)), study.centroid(sample, body).positions
    assert rms < 0.8 * np.sqrt(np.mean(np.sum((centroid - sample.positions) ** 2, axis=1)))
    assert 0.8 < np.sqrt(np.mean(found.position_sigma**2)) / rms < 1.25
    assert np.max(off / found.position_sigma) < 5
    assert found.verdict.level == ("DOUBT" if readings == "raw" else "PASS")


def test_transducers_by_their_textbook_values():
    """A barometer's pressure adds up to the force; the stress of the columns does, by quadrature;
    a magnet moves by Boussinesq's displacements, and its field is that of a dipole."""
    from worlds import transducers

    sensor = transducers.Barometer()
    total = quad(lambda r: 2 * np.pi * r * sensor(r, 3.0), 0, np.inf, epsrel=1e-9)[0]
    assert total == pytest.approx(3.0)
    sensor = transducers.Capacitor()

    def stress(r):
        s = 1 / (1 + sensor(r, 3.0) / sensor.shear)
        return 2 * np.pi * r * sensor.shear * (1 / s**2 - s)

    assert quad(stress, 0, 0.02, limit=200)[0] == pytest.approx(3.0, rel=1e-6)
    sensor, r = transducers.Magnet(), 1.5e-3

    def moved(z):
        length, factor = np.hypot(r, z), 3.0 / (4 * np.pi * sensor.shear)
        return factor * np.array([r * z / length**3, -(z**2) / length**3 - 1 / length])

    def field(at):
        away = np.linalg.norm(at)
        return (3 * at[1] * at / away**2 - np.array([0.0, 1.0])) / away**3

    rest = np.array([0.0, sensor.height])
    now = rest + moved(sensor.depth) - moved(sensor.depth + sensor.height)
    change = np.linalg.norm(field(now) - field(rest)) / np.linalg.norm(field(rest))
    assert sensor(r, 3.0) == pytest.approx(sensor.shear * change)


def test_boundary_elements_of_a_smooth_skin_are_hertz():
    half_space = pytest.importorskip("worlds.half_space", exc_type=ImportError)
    from worlds import profiles, sphere
    from worlds.world import Radial

    positions = sphere.taxels(7, 0)
    touch = sphere.Touch(positions[:3], np.array([2.5, 3.0, 3.5]))
    exact = Radial(profiles.Hertz())(touch, positions)
    smooth = half_space.Wrinkled(rms=0.0)(touch, positions)
    assert np.abs(smooth - exact).max() < 0.012 * exact.max()
    rough = half_space.Wrinkled()(touch, positions)
    assert np.abs(rough - exact).max() > 0.03 * exact.max()
    height = half_space.Wrinkled().heights
    assert np.std(height) == pytest.approx(1e-4)


@pytest.mark.deep
def test_a_skin_that_yields_holds_the_force_under_its_limit():
    half_space = pytest.importorskip("worlds.half_space", exc_type=ImportError)
    from worlds.profiles import Hertz

    peak = Hertz()(0.0, 3.0)
    profile, r = half_space.yielding(0.7 * peak), np.linspace(0, 7.9e-3, 2001)
    for force in (2.6, 3.4):
        p = profile(r, np.array(force))
        assert np.trapezoid(2 * np.pi * r * p, r) == pytest.approx(force, rel=5e-3)
        assert p.max() == pytest.approx(0.7 * peak, rel=1e-2)
        assert p[r < 2e-3].min() == pytest.approx(p.max(), rel=1e-2)


@pytest.mark.slow
def test_the_optimum_is_reached_along_a_valley_of_compression_and_profile(script):
    from meshskin.core.progress import Stage
    from meshskin.estimation.data.gather import gather
    from meshskin.estimation.learned.estimate import with_learned_response
    from meshskin.estimation.learned.start import begin
    from meshskin.estimation.trilateration import trilaterate

    log, believed, _ = script("speed/joint").world(300)
    data = gather(log, replace(believed, contact="learned"))
    start, live = trilaterate.least_squares(data), np.arange(300)

    def optimum(s):
        effects = begin(with_learned_response(data, start.points), live, start, Stage())
        effects.move(replace(effects.unknowns, s=np.asarray(s)))
        assert effects.converge()
        return effects

    # a point of the valley at a compression of 0.24, on 10,000 taxels
    far = optimum([0.029, 0.155, -0.015, 0.072, 0.24, 0.017, 0.008, 0.004, 0.067, 0.03, 0.089,
                   0.051, -0.005, -0.032, -0.069, -0.141, -0.03, -0.034, 0.007])  # fmt: skip
    near = optimum(np.zeros(19))
    sigma = np.sqrt(np.diag(near.system().shared_covariance))
    assert (np.abs(far.unknowns.s - near.unknowns.s)[:5] < 0.3 * sigma[:5]).all()
    assert far.cost() < near.cost() + 1
