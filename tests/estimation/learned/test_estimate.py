"""The learned response in worlds whose contact is not the believed one.

The worlds are written here with NumPy alone: a cap of a sphere with 37 taxels, pressed along a
spiral; a taxel reads the mean over its disc, by a product rule.
"""

from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest

from meshskin.contact.indenter import Indenter
from meshskin.contact.material import Material
from meshskin.core.errors import CalibrationError
from meshskin.estimation.calibrate import calibrate
from meshskin.estimation.calibration import Calibration
from meshskin.estimation.data.gather import gather
from meshskin.estimation.data.global_parameters import DRIFT_SIZE, DRIFTS
from meshskin.estimation.joint.contacts import LinearizedContacts
from meshskin.estimation.joint.likelihood import Likelihood
from meshskin.estimation.joint.readings import select
from meshskin.estimation.learned import random_effects
from meshskin.estimation.learned.estimate import with_learned_response
from meshskin.estimation.recalibrate.touch_design import next_touches
from meshskin.geometry.body import Body
from meshskin.geometry.region import Cap
from meshskin.recording.recording import CONTACT_SCHEMA, NOMINAL, READING_SCHEMA, Recording
from meshskin.scene.belief import Belief
from meshskin.scene.scene import Scene
from meshskin.simulation.static_contacts import press
from meshskin.skin.skin import Skin

RADIUS, INDENTER, DISC, FORCE, TAXELS = 0.1, 0.01, 2e-3, 3.0, 37
MODULUS = 0.2e6 / (1 - 0.49**2)
A = (3 * FORCE / (1 / RADIUS + 1 / INDENTER) / (4 * MODULUS)) ** (1 / 3)
PEAK = 3 * FORCE / (2 * np.pi * A**2)


def spiral(count, share, turns=None):
    k = np.arange(count) + 0.5
    z = 1 - share * k / count
    angle = 2 * np.pi * turns * np.sqrt(k / count) if turns else np.pi * (1 + 5**0.5) * k
    return RADIUS * np.column_stack(
        [np.sqrt(1 - z**2) * np.cos(angle), np.sqrt(1 - z**2) * np.sin(angle), z]
    )


SHARE = TAXELS * 5e-3**2 * np.sqrt(3) / 2 / (2 * np.pi * RADIUS**2)
TRUTH = spiral(TAXELS, SHARE)


def hertz(r, force):
    scale = (force / FORCE) ** (1 / 3)
    return PEAK * scale * np.sqrt(np.maximum(1 - (r / (A * scale)) ** 2, 0.0))


def bell(r, force):
    """A thick soft cover: no edge, and a peak that grows with the force."""
    width = 2.2e-3 * (force / FORCE) ** 0.3
    return force / (2 * np.pi * width**2) * np.exp(-(r**2) / (2 * width**2))


def world(
    profile=hertz, seed=0, contacts=500, scatter=0.0, force_error=0.0, noise=0.01, read=None,
    stiffness=None,
):  # fmt: skip
    """A recording, and what it was made with; `read` turns pressures (m, n) into readings,
    `stiffness` gives the factor of the force at points (m, 3) with that effect."""
    rng = np.random.default_rng(seed)
    points = spiral(contacts, 1.4 * SHARE, turns=10)
    force = FORCE * (1 + 0.05 * rng.standard_normal(contacts))
    felt = force if stiffness is None else force * stiffness(points)
    node, weight = np.polynomial.legendre.leggauss(10)
    radius = DISC * (node + 1) / 2
    angle = 2 * np.pi * (np.arange(16) + 0.5) / 16
    offset = TRUTH - points[:, None]
    normal = points / RADIUS
    first = np.cross(normal, [1.0, 0.0, 0.0])
    first /= np.linalg.norm(first, axis=1)[:, None]
    x = np.einsum("mni,mi->mn", offset, first)
    y = np.einsum("mni,mi->mn", offset, np.cross(normal, first))
    pressure = np.zeros(x.shape)
    for r, w in zip(radius, weight, strict=True):
        for t in angle:
            distance = np.hypot(x + r * np.cos(t), y + r * np.sin(t))
            pressure += w * r / DISC / 16 * profile(distance, felt[:, None])
    pressure[np.linalg.norm(offset, axis=2) > 0.02] = 0.0
    if read is not None:
        pressure = read(pressure, rng)
    pressure += noise * PEAK * rng.standard_normal(pressure.shape)
    points = points + scatter * rng.standard_normal(points.shape)
    points *= RADIUS / np.linalg.norm(points, axis=1)[:, None]
    force = force * np.exp(force_error * rng.standard_normal(contacts))
    contact, taxel = np.nonzero(pressure > 0.03 * PEAK)
    return points, force, contact, taxel, pressure[contact, taxel]


def recording(points, force, contact, taxel, pressure):
    time = 0.01 * np.arange(len(points))
    normals = points / RADIUS
    return Recording(
        pa.table([time, *points.T, *normals.T, force], schema=CONTACT_SCHEMA),
        pa.table([time[contact], taxel.astype(np.int32), pressure], schema=READING_SCHEMA),
        {"taxel_ids": list(range(TAXELS)), "disc_radius_m": DISC},
    )


def belief(**changes):
    return Belief(
        body=Body.sphere(radius=RADIUS), indenter=Indenter(INDENTER),
        material=Material(0.2e6, 0.49, None), taxel_ids=np.arange(TAXELS), disc_radius=DISC,
        **changes,
    )  # fmt: skip


def errors(calibration):
    """RMS error and rms stated deviation, m."""
    off = np.linalg.norm(calibration.positions - TRUTH, axis=1)
    assert np.isfinite(off).all()
    stated = np.trace(calibration.covariances[:, :2, :2], axis1=1, axis2=2)
    return np.sqrt(np.mean(off**2)), np.sqrt(np.mean(stated))


@pytest.mark.deep
@pytest.mark.parametrize(
    ("wave", "noise"), [pytest.param(0.05, 0.01, marks=pytest.mark.slow), (0.1, 0.02)]
)
def test_unmeasured_forces_whose_errors_neighbouring_contacts_share(wave, noise):
    felt = FORCE * (1 + wave * np.sin(0.1 * np.arange(500)))[:, None]
    points, _, *readings = world(lambda r, _: hertz(r, felt), noise=noise)
    given = recording(points, np.full(500, FORCE), *readings)
    given = replace(given, metadata={**given.metadata, "force": NOMINAL})
    found = calibrate(given, belief(contact="learned", readings="raw"))
    assert found.verdict.level == "PASS"
    off, stated = errors(found)
    assert 0.8 < stated / off < 1.25
    scatter, _ = found.unknowns["force_scatter"]
    assert 0.9 * wave / 2**0.5 < scatter < 1.4 * wave / 2**0.5  # with what noise has in it


@pytest.mark.deep
@pytest.mark.parametrize("measured", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_whole_patches_that_press_harder_than_their_forces_say(measured):
    def harder(pressure, rng):
        return pressure * np.exp(0.08 * rng.standard_normal((len(pressure), 1)))

    points, force, *readings = world(read=harder, seed=4)
    given = recording(points, force if measured else np.full(500, FORCE), *readings)
    if not measured:
        given = replace(given, metadata={**given.metadata, "force": NOMINAL})
    found = calibrate(given, belief(contact="learned", readings="raw"))
    assert found.verdict.level == "PASS"
    off, stated = errors(found)
    assert 0.8 < stated / off < 1.25
    exponent, sigma = found.unknowns["exponents of the radius in force errors"]
    assert sigma < 0.05
    assert -0.43 < exponent < (-0.25 if measured else -0.1)  # amplitudes alone: -1/3
    assert not any("force errors" in words for words in found.undetermined)


@pytest.mark.parametrize("readings", ["pressure", "raw"])
def test_a_recording_without_readings_is_refused(readings):
    points, force, *found = world(contacts=20)
    with pytest.raises(CalibrationError, match="no readings of a pressed contact"):
        calibrate(recording(points, force, *(x[:0] for x in found)), belief(readings=readings))


@pytest.mark.parametrize("readings", ["pressure", "raw"])
def test_a_recording_without_a_force_is_refused(readings):
    points, force, *found = world(contacts=20)
    with pytest.raises(CalibrationError, match="no contact is pressed, got 20 forces of at most 0"):
        calibrate(recording(points, 0 * force, *found), belief(readings=readings))


@pytest.mark.deep
@pytest.mark.parametrize("groups", [(), (range(5, 12), [0, 20])])
def test_every_derivative_of_the_learned_response(groups):
    known = belief(contact="learned", response_groups=groups)
    data = gather(recording(*world(contacts=80)), known)
    data = replace(with_learned_response(data, TRUTH), response_levels=(0.4, 0.3))
    p, more = data.parameters, np.full(DRIFT_SIZE * len(DRIFTS), 0.3)
    p = replace(p, names=(*p.names, *DRIFTS), sigma=np.append(p.sigma, more))
    data, n, m = replace(data, parameters=p), len(TRUTH), len(data.points)
    readings = select(
        data, np.arange(n), TRUTH, TRUTH / RADIUS, 0.0, np.ones(len(data.pressure)), np.ones(n)
    )
    likelihood, rng = Likelihood(data, readings), np.random.default_rng(1)
    s = 0.05 * rng.standard_normal(len(data.parameters.sigma))
    contacts = LinearizedContacts(data, np.zeros_like(s))
    at = [
        TRUTH + 1e-4 * rng.standard_normal(TRUTH.shape),
        0.05 * rng.standard_normal((n, 2)),
        s,
        rng.standard_normal((m, 3)) * [1e-4, 1e-4, 0.05],
    ]

    def predict(points, nuisance, s, errors):
        own = readings.taxel
        return likelihood.predict(
            readings.contact, points[own], nuisance[own], contacts.with_errors(s, errors),
            likelihood.groups(own),
        )  # fmt: skip

    jacobian = predict(*at)[1]
    parts = ((0, 3, 1e-8), (1, 2, 1e-6), (2, len(s), 1e-6), (3, 3, None))
    row = 0
    for part, count, step in parts:
        for k in range(count):
            h = step or (1e-8, 1e-8, 1e-6)[k]
            moved = [[x.copy() for x in at] for _ in range(2)]
            for x, sign in zip(moved, (1, -1), strict=True):
                x[part][..., k] += sign * h
            slope = (predict(*moved[0])[0] - predict(*moved[1])[0]) / (2 * h)
            scale = max(np.abs(slope).max(), 1.0)
            np.testing.assert_allclose(jacobian[row] / scale, slope / scale, atol=2e-6)
            row += 1
    assert row == len(jacobian)


@pytest.mark.slow
def test_where_the_model_holds_the_estimate_is_the_model_s():
    log = recording(*world(hertz))
    model = calibrate(log, belief())
    assert model.response is None
    assert model.verdict.level == "PASS"
    learned = calibrate(log, belief(contact="learned"))
    assert learned.response is not None
    assert errors(learned)[0] < 1.05 * errors(model)[0]
    off = learned.response.profile - hertz_disc(learned.response.distance)
    assert np.abs(off).max() < 0.02 * PEAK


def hertz_disc(distance):
    from meshskin.contact.disc import disc_mean

    return PEAK * disc_mean(distance / A, DISC / A, nodes=32)


@pytest.fixture(scope="module")
def bell_shaped():
    """The calibrations under the believed model, and under the one that the evidence chooses."""
    log = recording(*world(bell))
    return calibrate(log, belief(contact="hertz")), calibrate(log, belief())


def test_a_bell_shaped_profile_is_learned(bell_shaped):
    model, learned = bell_shaped
    assert learned.response is not None
    assert learned.verdict.level == "PASS"
    error, stated = errors(learned)
    assert error < 0.75 * errors(model)[0]
    assert 0.75 < stated / error < 1.3


@pytest.mark.deep
def test_noise_does_not_fall_before_its_share_in_the_residuals_is_known(monkeypatch):
    """Two or three readings of a contact fit its three errors however small the noise is: on a limb
    the noise fell to its least value and stayed there."""
    step, seen = random_effects.RandomEffects.step, []

    def watched(effects, settled):
        seen.append((effects.deviations.noise, effects.leverages.any()))
        return step(effects, settled)

    monkeypatch.setattr(random_effects.RandomEffects, "step", watched)
    calibrate(recording(*world(hertz, contacts=250)), belief(contact="learned"))
    noise, known = map(np.array, zip(*seen, strict=True))
    first = np.flatnonzero(known)[0]
    assert first >= 2
    assert np.all(np.diff(noise[:first]) >= 0)
    assert noise[-1] < noise[0]


@pytest.mark.deep
def test_noise_that_grows_with_the_reading_comes_to_rest():
    """Its constant part and the other one grew in turn."""

    def read(pressure, rng):
        return pressure * (1 + 0.05 * rng.standard_normal(pressure.shape))

    found = calibrate(recording(*world(hertz, read=read)), belief(contact="learned"))
    assert len(found.iterates) < 40
    assert found.response.noise_relative == pytest.approx(0.05, rel=0.1)
    assert found.response.noise == pytest.approx(0.01 * PEAK, rel=0.2)
    assert found.verdict.level == "PASS"


@pytest.mark.deep
@pytest.mark.parametrize("seed", [pytest.param(2, marks=pytest.mark.slow), 3])
def test_gains_that_rise_and_fall_during_the_recording(seed):
    """By one period of a sine, from 0.9 to 1.1."""

    def read(pressure, rng):
        phase = np.linspace(0.0, 2 * np.pi, len(pressure))[:, None]
        return pressure * (1 + 0.1 * np.sin(phase))

    found = calibrate(recording(*world(seed=seed, read=read)), belief(contact="learned"))
    rms, stated = errors(found)
    assert found.response.gain_drift == pytest.approx(0.22, rel=0.2)
    assert found.response.force_drift < 0.03
    assert 0.8 < stated / rms < 1.25


@pytest.mark.deep
def test_scatter_of_the_contact_points_is_found():
    log = recording(*world(hertz, scatter=0.3e-3))
    learned = calibrate(log, belief())
    error, stated = errors(learned)
    assert learned.unknowns["contact_scatter"][0] == pytest.approx(0.3e-3, rel=0.1)
    assert error < 0.5 * errors(calibrate(log, belief(contact="hertz")))[0]
    assert 0.75 < stated / error < 1.4


@pytest.mark.slow
def test_displacements_alike_in_neighbouring_contacts_widen_the_uncertainty():
    points, *rest = world(hertz, contacts=1500)
    rng, off = np.random.default_rng(5), np.zeros((len(points), 3))
    for k in range(1, len(points)):
        off[k] = 0.9 * off[k - 1] + 0.15e-3 * np.sqrt(1 - 0.9**2) * rng.standard_normal(3)
    moved = points + off
    moved *= RADIUS / np.linalg.norm(moved, axis=1)[:, None]
    found = calibrate(recording(moved, *rest), belief())
    error, stated = errors(found)
    assert found.response.contact_correlation > 0.4
    assert 1 / 1.5 < stated / error < 2.5
    assert found.verdict.level == "DOUBT"
    assert any("alike" in words for words in found.verdict.reasons)


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "contacts"), [(0, 500), (1, 700)])
def test_force_errors_are_found(seed, contacts):
    """Seed 1: at the mode over these errors, the likelihood has the slope of a lag."""
    log = recording(*world(hertz, seed, contacts, force_error=0.1))
    learned = calibrate(log, belief())
    error, stated = errors(learned)
    # what remains of ln F when the measured force is known: 5 % of variation, 10 % of error
    assert learned.unknowns["force_scatter"][0] == pytest.approx(0.05 / np.sqrt(1.25), rel=0.2)
    assert 0.75 < stated / error < 1.35


@pytest.mark.deep
def test_forces_recorded_as_constant_are_mended():
    body, rng = Body.ellipsoid((0.07, 0.05, 0.04)), np.random.default_rng(4)
    side = rng.normal(size=3)
    cap = Cap(direction=tuple(side / np.linalg.norm(side)))
    skin = Skin.cover(body, spacing=5e-3, count=40, seed=4, region=cap, disc_radius=2e-3)
    scene = Scene.load("sphere_noisy").with_(
        body=body, skin=skin, contact="auto", material=Material(0.3e6), indenter=Indenter(8e-3)
    )
    near = skin.positions[rng.integers(40, size=300)]
    points = body.closest(near + rng.uniform(-6e-3, 6e-3, (300, 3))).point
    made = press(scene, points, force=rng.uniform(2.0, 4.0, 300), seed=4)
    log = replace(made.with_columns(force=np.full(300, 3.0)), metadata={})
    found = calibrate(log, scene.belief(contact="auto"))
    error = np.linalg.norm(found.positions - skin.positions, axis=1)
    assert found.unknowns["force_scatter"][0] == pytest.approx(0.2, rel=0.15)
    assert np.sqrt(np.mean(error**2)) < 0.05e-3
    assert (error < 5 * found.position_sigma).all()
    assert "the force is constant" in found.verdict.reasons[0]


@pytest.mark.deep
def test_ovals_do_not_pass_for_lags_of_single_taxels():
    """A skin on an ellipsoid whose patches are 3 % longer than wide, which spirals cross."""
    body, count = Body.ellipsoid((0.08, 0.08, 0.1)), 500
    skin = Skin.cover(
        body, spacing=5e-3, count=45, seed=1, region=Cap((1.0, 0.0, 0.0)), disc_radius=2e-3
    )
    scene = Scene.load("sphere_noisy").with_(body=body, skin=skin, contact="elliptic")
    radius = 22e-3 * np.sqrt((np.arange(count) + 0.5) / count)
    angle = 2 * np.pi * radius / np.sqrt(np.pi * 22e-3**2 / count)
    flat = np.column_stack([np.full(count, 0.08), radius * np.cos(angle), radius * np.sin(angle)])
    made = press(scene, body.closest(flat).point, force=np.full(count, 3.0), seed=1)
    found = calibrate(made, scene.belief(readings="raw", contact="auto"))
    error = np.linalg.norm(found.positions - skin.positions, axis=1)
    assert np.sqrt(np.nanmean(error**2)) < 0.03e-3
    assert str(found.verdict.level) == "PASS"


@pytest.mark.deep
@pytest.mark.parametrize("unit", [1.0, 1e-3])
def test_corrupt_and_stuck_taxels_of_a_learned_response_are_named(unit):
    """unit: of the readings, Pa; another than 1 Pa is believed to be raw."""
    points, force, contact, taxel, pressure = world(contacts=300)
    pressure[np.flatnonzero(taxel == 3)[0]] = 1e99
    kept, every = taxel != 7, np.arange(0, 300, 3)  # in more, the level would be that at rest
    contact = np.concatenate([contact[kept], every])
    taxel = np.concatenate([taxel[kept], np.full(100, 7)])
    pressure = np.concatenate([pressure[kept], np.full(100, 0.4 * PEAK)])
    order = np.argsort(contact, kind="stable")
    given = recording(points, force, contact[order], taxel[order], unit * pressure[order])
    found = calibrate(
        given, belief(contact="learned", readings="pressure" if unit == 1.0 else "raw")
    )
    assert found.faults[3] == "1 corrupt, stuck or negative readings left out"
    level = f"{0.4 * PEAK / 1e3:.3g}"
    words = f"{level} kPa" if unit == 1.0 else f"a level of {level}"
    assert found.faults[7] == f"stuck at {words}"
    assert np.isnan(found.positions[7]).all()


def test_an_estimate_that_does_not_converge_is_refused(monkeypatch):
    monkeypatch.setattr(random_effects, "MAX_ITERATIONS", 1)
    with pytest.raises(CalibrationError, match="did not converge, got steps still decrease"):
        calibrate(recording(*world(bell, contacts=100)), belief(contact="learned"))


@pytest.mark.slow
def test_compression_is_told_from_the_profile_where_forces_vary():
    def saturate(pressure, rng):
        return pressure / (1 + pressure / PEAK)

    learned = calibrate(recording(*world(hertz, read=saturate)), belief(contact="learned"))
    value, sigma = learned.unknowns["compression"]
    assert abs(value - 1.0) < 4 * sigma
    assert sigma < 0.3
    level, reading = learned.response.level[1:], learned.response.reading[1:]
    by_compression = reading**2 * (1 / reading - 1 / level) / value  # |d reading / d value|
    np.testing.assert_allclose(learned.response.reading_sigma[1:], by_compression * sigma)
    assert 0.75 < np.divide(*errors(learned)[::-1]) < 1.35


@pytest.mark.deep
def test_the_noise_on_a_smooth_body_is_no_error_over_edges():
    """A sphere departs from its quadrics, by nearly as much in all contacts."""
    found = calibrate(recording(*world(hertz, noise=0.02)), belief(contact="learned"))
    assert found.response.edge_error == 1.0
    assert found.response.noise == pytest.approx(0.02 * PEAK, rel=0.1)


def counts(seed=0, scatter=0.3e-3):
    """8-bit counts of unequal taxels that saturate, forces only nominal, contacts that scatter."""

    def read(pressure, rng):
        gain = np.exp(0.1 * rng.standard_normal(TAXELS))
        return pressure / (1 + pressure / PEAK) * gain

    points, _, contact, taxel, level = world(hertz, seed, scatter=scatter, read=read)
    level = np.clip(np.round(level / PEAK * 400), 0, 255)
    return points, np.full(len(points), FORCE), contact, taxel, level


@pytest.mark.slow
def test_raw_counts_need_no_unit():
    log = counts()
    found = calibrate(recording(*log), belief(readings="raw"))
    error, stated = errors(found)
    assert error < 0.15e-3
    assert 0.7 < stated / error < 1.4
    assert "exponents of the radius is not determined" in found.undetermined  # one force


@pytest.mark.deep
def test_next_contacts_of_a_loaded_calibration_take_the_belief_in_counts():
    own = belief(readings="raw", force_reference=FORCE, threshold=8.0, noise_sigma=3.0)
    found = calibrate(recording(*counts(scatter=0.0)), own)
    loaded = replace(found, belief=None)
    again, expected = loaded.next_contacts(2, own), found.next_contacts(2)
    np.testing.assert_allclose(again.worst, expected.worst, rtol=1e-9)
    again, expected = next_touches(loaded, own, 2), next_touches(found, None, 2)
    np.testing.assert_allclose(again.confusion, expected.confusion, rtol=1e-9)
    assert again.confusion.min() < 0.1
    with pytest.raises(CalibrationError, match="no touch tells a changed map"):
        next_touches(loaded, replace(own, noise_sigma=1e5), 2)


@pytest.mark.slow
def test_counts_that_fall_with_pressure():
    points, force, contact, taxel, level = counts(scatter=0.0)
    every = np.zeros((len(points), TAXELS))
    every[contact, taxel] = level
    rest = 200.0 + np.arange(TAXELS)
    row, column = np.indices(every.shape).reshape(2, -1)
    rising = calibrate(
        recording(points, force, row, column, (rest + every)[row, column]), belief(readings="raw")
    )
    falling = calibrate(
        recording(points, force, row, column, (rest - every)[row, column]), belief(readings="raw")
    )
    np.testing.assert_allclose(falling.positions, rising.positions, atol=1e-7)
    assert errors(rising)[0] < 0.1e-3


@pytest.mark.slow
def test_few_contacts_leave_the_model():
    """20 contacts over the skin: the default is the model's estimate, or as good."""
    square = {"hertz": [], "auto": []}
    for seed in range(6):
        log = recording(*world(hertz, seed, contacts=20))
        for name, found in square.items():
            off = calibrate(log, belief(contact=name)).positions - TRUTH
            found.append(np.nansum(off**2))
    assert np.sum(square["auto"]) < 1.1**2 * np.sum(square["hertz"])


@pytest.mark.deep
def test_few_readings_of_each_taxel_are_named():
    found = calibrate(recording(*world(hertz, contacts=60)), belief(contact="learned"))
    assert np.median(found.readings) < 10
    assert any("readings per taxel, 10 needed" in words for words in found.verdict.reasons)
    assert found.verdict.level != "PASS"


def test_a_response_is_saved_with_its_calibration(bell_shaped, tmp_path):
    found = bell_shaped[1]
    found.save(tmp_path / "calibration")
    again = Calibration.load(tmp_path / "calibration")
    assert again.response.noise == found.response.noise
    np.testing.assert_array_equal(again.response.profile, found.response.profile)
    assert again.unknowns == found.unknowns


@pytest.mark.deep
def test_contact_errors_that_vary_slowly_are_no_scatter():
    """A kinematic error: neighbouring contacts are off alike, whatever the path's order."""
    points, force, contact, taxel, level = world(hertz)
    wave = 2 * np.pi * points[:, 0] / 0.012
    points = points + 0.3e-3 * np.stack([np.cos(wave), np.sin(wave), 0 * wave], axis=1)
    points *= RADIUS / np.linalg.norm(points, axis=1)[:, None]
    found = calibrate(recording(points, force, contact, taxel, level), belief(contact="learned"))
    assert found.response.contact_correlation > 0.5
    assert found.verdict.level == "DOUBT"
    assert any("not scatter" in words for words in found.verdict.reasons)


@pytest.mark.deep
@pytest.mark.parametrize("uneven", [True, pytest.param(False, marks=pytest.mark.deep)])
def test_a_skin_of_uneven_stiffness_is_named(uneven):
    """Forces that scatter by as much from contact to contact are no unevenness."""
    rng = np.random.default_rng(5)
    waves, phases = rng.normal(size=(3, 100)) / 3e-3, rng.uniform(0, 2 * np.pi, 100)

    def stiffness(points):
        field = np.cos(points @ waves + phases).sum(axis=1)
        return np.exp(0.015 * (field if uneven else rng.permutation(field)))

    found = calibrate(recording(*world(stiffness=stiffness)), belief(contact="learned"))
    named = [reason for reason in found.verdict.reasons if "errors of forces are alike" in reason]
    assert len(named) == uneven
    assert (found.response.alike_contacts > 1.0) == uneven


@pytest.mark.slow
def test_silences_that_are_left_out_do_not_inform(monkeypatch):
    """A threshold of six times the noise: some silent taxels at the rim of a patch inform."""
    log, counts = recording(*world(hertz, noise=0.005)), []
    leave_out = "_leave_out_certain_silences"
    original = getattr(random_effects.RandomEffects, leave_out)

    def counted(effects):
        counts.append(len(effects.mu))
        original(effects)
        counts.append(len(effects.mu))

    believed = belief(contact="learned", threshold=0.03 * PEAK)
    monkeypatch.setattr(random_effects.RandomEffects, leave_out, counted)
    found = calibrate(log, believed)
    monkeypatch.setattr(random_effects.RandomEffects, leave_out, lambda effects: None)
    every = calibrate(log, believed)
    assert counts[1] < 0.97 * counts[0]
    moved = np.linalg.norm(found.positions - every.positions, axis=1) / every.position_sigma
    assert np.sqrt(np.mean(moved**2)) < 2 * random_effects.MOVE_TOLERANCE  # that of both estimates
