"""Hard cases of the estimators: a correct estimate with its uncertainty, or a named error."""

import warnings
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest

from meshskin.contact.indenter import Indenter
from meshskin.core.errors import CalibrationError, ContactError, LeftOutWarning, RecordingError
from meshskin.estimation.calibrate import METHODS, calibrate
from meshskin.estimation.data.gather import gather
from meshskin.estimation.joint import joint_estimator, maximum_likelihood
from meshskin.estimation.uncertainty.metrics import nees, position_errors
from meshskin.geometry.body import Body
from meshskin.scene.belief import Belief
from tests.estimation.conftest import World, changed


@pytest.fixture(scope="module")
def world():
    return World(extent=17e-3)


@pytest.fixture(scope="module")
def noisy(world):
    return world.record(0.01, 0.05), world.belief(0.01, 0.05)


@pytest.fixture(scope="module")
def clean(world, noisy):
    return position_errors(calibrate(*noisy), world.skin)


@pytest.fixture(autouse=True)
def no_warnings():
    """No case may warn its way through."""
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("default", LeftOutWarning)  # says what these cases leave out
        yield


@pytest.mark.parametrize(
    ("share", "method"),
    [(1.3, method) for method in METHODS]
    + [
        pytest.param(1.0, method, marks=() if method == "joint" else pytest.mark.slow)
        for method in METHODS
    ],
)
def test_pressures_at_and_above_the_peak(world, noisy, share, method):
    recording, belief = noisy
    top = recording.pressure > 0.98 * recording.pressure.max()
    pressure = np.where(top, share * world.peak_reference, recording.pressure)
    assert 3 <= top.sum() < 60
    found = calibrate(recording.with_columns(pressure=pressure), belief, method=method)
    errors = position_errors(found, world.skin)
    assert np.isfinite(errors).sum() >= 30
    if method == "joint":
        assert errors.mean() < 20e-6
        assert found.observed[:, :2].all()


@pytest.mark.deep
def test_forces_near_zero(world, noisy):
    recording, belief = noisy
    force = recording.force.copy()
    force[::3] = 1e-6  # the gauge slept, the skin did not
    found = calibrate(recording.with_columns(force=force), belief)
    assert position_errors(found, world.skin).mean() < 20e-6
    assert "outlying" in found.fit.words
    with pytest.raises(CalibrationError, match="check the units of pressure, force and modulus"):
        calibrate(recording.with_columns(force=np.full_like(force, 1e-6)), belief)
    with pytest.raises(CalibrationError, match=r"no contact is pressed, got .* at most 0 N"):
        calibrate(recording.with_columns(force=np.zeros_like(force)), belief)


@pytest.mark.parametrize("method", METHODS)
def test_contacts_on_a_line(world, method):
    lane = world.points[np.argmin(np.abs(world.points[:, 1])), 1]
    line = np.abs(world.points[:, 1] - lane) < 1e-4
    other = replace(world)
    for name in ("points", "normals", "force", "a", "peak"):
        setattr(other, name, getattr(world, name)[line])
    with pytest.raises(CalibrationError, match=r"contacts near a line.*not on a line"):
        calibrate(other.record(0.01, 0.05), world.belief(0.01, 0.05), method=method)


def test_a_taxel_touched_once(world, noisy, clean):
    recording, belief = noisy
    keep = recording.reading_taxel != world.ids[18]
    keep[np.flatnonzero(~keep)[0]] = True
    found = calibrate(changed(recording, keep=keep), belief)
    assert found.reasons[18] == "fewer than three readings"
    assert found.touched[18]
    assert not found.observed[18].any()
    errors = np.delete(position_errors(found, world.skin), 18)
    assert errors.mean() < 1.05 * np.delete(clean, 18).mean()


def with_twin(world, recording, factor):
    """The recording with a taxel 999 whose readings are `factor` (k,) times those of the sixth, and
    what is believed of both."""
    twin = recording.readings.filter(pa.array(recording.reading_taxel == world.ids[5]))
    ids = pa.array(np.full(twin.num_rows, 999, dtype=np.int32))
    pressure = pa.array(twin["pressure"].to_numpy() * factor(twin.num_rows))
    twin = twin.set_column(1, "taxel", ids)
    twin = twin.set_column(twin.column_names.index("pressure"), "pressure", pressure)
    both = replace(recording, readings=pa.concat_tables([recording.readings, twin]))
    return both, world.belief(0.01, 0.05, taxel_ids=np.append(world.ids, 999))


@pytest.mark.deep
def test_two_taxels_at_one_place(world, noisy, clean):
    rng = np.random.default_rng(1)
    found = calibrate(*with_twin(world, noisy[0], lambda k: 1 + 1e-7 * rng.normal(size=k)))
    assert np.allclose(found.positions[5], found.positions[-1], atol=1e-8)
    assert found.observed[[5, -1], :5].all()
    errors = np.linalg.norm(found.positions[:-1] - world.truth, axis=1)
    assert errors.mean() < 1.05 * clean.mean()


@pytest.mark.deep
def test_two_taxels_with_equal_readings_have_no_place(world, noisy, clean):
    """One of them is a copy: nothing tells which, nor where it is. The others are as without."""
    found = calibrate(*with_twin(world, noisy[0], np.ones))
    assert np.isnan(found.positions[[5, -1]]).all()
    assert any("equal to those of taxel 999" in reason for reason in found.reasons_left_out)
    errors = np.linalg.norm(found.positions[:-1] - world.truth, axis=1)
    assert np.nanmean(errors) < 1.05 * clean.mean()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("threshold", [0.0, 0.05])
def test_all_readings_zero(world, threshold, method):
    recording = world.record(0.01, threshold)
    silent = recording.with_columns(pressure=np.zeros(len(recording.pressure)))
    with pytest.raises(CalibrationError, match=r"no readings.*at most 0 Pa.*wiring"):
        calibrate(silent, world.belief(0.01, threshold), method=method)


@pytest.mark.deep
def test_all_readings_saturated(world, noisy):
    recording, _ = noisy
    level = 0.06 * world.peak_reference
    full = recording.with_columns(pressure=np.minimum(recording.pressure, level))
    found = calibrate(full, world.belief(0.01, 0.05, saturation=level))
    errors = position_errors(found, world.skin)
    assert errors.mean() < 0.12e-3  # where a taxel begins and ends to answer is what is left
    assert nees(found, world.skin).mean() < 4.0
    assert found.fit.good is None


@pytest.mark.slow
def test_the_end_of_the_range_of_all_taxels_is_found(world, noisy):
    level = 0.06 * world.peak_reference
    full = noisy[0].with_columns(pressure=np.minimum(noisy[0].pressure, level))
    found = calibrate(full, world.belief(0.01, 0.05, saturation=level))
    blind = calibrate(full, world.belief(0.01, 0.05))
    np.testing.assert_allclose(blind.positions, found.positions, atol=1e-7)


@pytest.mark.parametrize(
    ("factor", "words"),
    [(1e-3, "look like kPa taken for Pa"), (1e-6, "look like MPa"), (1e3, "cannot be in Pa")],
)
@pytest.mark.parametrize("noise", [0.01, None])
def test_pressures_in_other_units(world, factor, words, noise):
    recording = world.record(0.01, 0.0)
    wrong = recording.with_columns(pressure=factor * recording.pressure)
    with pytest.raises(CalibrationError, match=words):
        calibrate(wrong, world.belief(noise, 0.0))


@pytest.mark.parametrize(("factor", "unit"), [(1e-3, "kN"), (1e3, "mN"), (1e6, "uN")])
def test_forces_in_other_units(noisy, factor, unit):
    recording, belief = noisy
    with pytest.raises(CalibrationError, match=f"cannot be in N.*look like {unit} taken for N"):
        calibrate(recording.with_columns(force=factor * recording.force), belief)


def test_forces_too_large_for_the_contact_model_and_lengths_in_mm(noisy):
    recording, belief = noisy
    with pytest.raises(ContactError, match="too wide"):
        calibrate(recording.with_columns(force=50 * recording.force), belief)
    mm = recording.with_columns(points=1e3 * recording.points)
    with pytest.raises(CalibrationError, match=r"not on the believed body.*times 0.001"):
        calibrate(mm, belief)


@pytest.mark.parametrize("method", METHODS)
def test_nan_in_a_recording(noisy, method):
    recording, belief = noisy
    pressure = recording.pressure.copy()
    pressure[[3, 7]] = np.nan, np.inf  # single numbers are left out
    found = calibrate(recording.with_columns(pressure=pressure), belief, method=method)
    assert np.isfinite(found.positions).all(axis=1).sum() > 0.9 * len(found.ids)
    pressure[3::40] = np.nan
    with pytest.raises(RecordingError, match=r"row 3 of readings, .* in all; drop those rows"):
        calibrate(recording.with_columns(pressure=pressure), belief, method=method)


@pytest.mark.deep
def test_a_belief_without_a_reference_force_takes_the_recordings(world, noisy, clean):
    recording, belief = noisy
    silent = Belief(
        body=Body.sphere(0.1),
        indenter=Indenter.sphere(belief.indenter.radius),
        material=belief.material,
        taxel_ids=belief.taxel_ids,
        noise_sigma=belief.noise_sigma,
        threshold=belief.threshold,
    )
    found = calibrate(recording, silent)
    told = calibrate(recording, replace(silent, force_reference=3.0))
    assert np.allclose(found.positions, told.positions, atol=1e-9)
    assert np.allclose(position_errors(found, world.skin), clean, atol=1e-7)  # facets' error
    assert found.belief.force_reference == pytest.approx(3.0, rel=0.01)


@pytest.mark.deep
def test_an_iteration_limit_of_one(world, noisy):
    far = gather(noisy[0], world.belief(0.01, 0.05, young=2.5 * world.young))
    with pytest.raises(CalibrationError, match=r"did not converge.*raise the iteration limit"):
        maximum_likelihood.optimum(far, iterations=1).result()
    with pytest.raises(CalibrationError, match=r"calibrate\(iterations=\.\.\.\)"):
        calibrate(noisy[0], far.belief, iterations=1)
    assert maximum_likelihood.optimum(far).result().modulus == pytest.approx(
        world.modulus, rel=0.01
    )


@pytest.mark.deep
def test_ipopt_in_restoration_failure(world, noisy, monkeypatch):
    data = gather(noisy[0], world.belief(0.01, 0.05, young=2.5 * world.young))
    whole = joint_estimator.minimize
    monkeypatch.setattr(
        joint_estimator, "minimize", lambda *a: (whole(*a)[0], "Restoration_Failed")
    )
    found = maximum_likelihood.optimum(data).result()  # at the optimum, whatever the status says
    assert found.modulus == pytest.approx(world.modulus, rel=0.01)
    monkeypatch.setattr(
        joint_estimator, "minimize", lambda problem, state, *a: (state, "Restoration_Failed")
    )
    with pytest.raises(CalibrationError, match=r"did not converge.*Restoration_Failed.*check the"):
        maximum_likelihood.optimum(data).result()


@pytest.mark.deep
def test_a_modulus_far_off(world, noisy, clean):
    for factor in (0.6, 5.0):
        found = calibrate(noisy[0], world.belief(0.01, 0.05, young=factor * world.young))
        assert found.modulus == pytest.approx(world.modulus, rel=0.01)
        assert position_errors(found, world.skin).mean() < 1.2 * clean.mean()
