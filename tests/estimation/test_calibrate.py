"""`calibrate` with every method, and the calibration as a file."""

import functools
import json
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import meshskin as ms
from meshskin.core.errors import (
    CalibrationError,
    ConfigError,
    ContactError,
    RecordingError,
    UnknownNameError,
)
from meshskin.estimation.calibrate import METHODS, UNTOUCHED, Estimation, calibrate
from meshskin.estimation.calibration import Calibration
from meshskin.estimation.joint import maximum_likelihood
from meshskin.estimation.uncertainty.metrics import position_errors


@pytest.fixture(scope="module")
def noisy(world):
    return world.record(0.01, 0.05), world.belief(0.01, 0.05)


@pytest.fixture(scope="module")
def alone(noisy):
    """The calibration by a method, computed once."""
    return functools.cache(lambda method: calibrate(*noisy, method=method))


def mean_error(world, calibration):
    return np.nanmean(position_errors(calibration, world.skin))


# three circles of two neighbours' shared contacts meet at a shallow angle: the quadrature's error
# of 1e-6 of the peak pressure, some 10 nm of distance, is enlarged a hundredfold; the centroid has
# no model: lanes that are 3.5 mm apart shift it by some 1/200 of that; eq. 15 takes discs for
# points; co-activation knows who answers together, not how strongly: a tenth of the pitch
EXACT = {"posegraph_paper": 5e-6, "centroid": 2e-5, "eq15": 3e-3, "coactivation": 5e-4}


@pytest.mark.parametrize("method", sorted(METHODS.keys() - {"eq15"}))
def test_every_method_on_ideal_data(world, method):
    found = calibrate(world.record(), world.belief(), method=method)
    assert found.method == method
    assert mean_error(world, found) < EXACT.get(method, 1e-6)
    assert found.observed[:, :5].all()
    assert not found.observed[:, 5].any()
    assert np.isinf(found.covariances[:, 5, 5]).all()
    tilt = 10 * EXACT.get(method, 1e-7) / 0.1  # the largest error is some times the mean
    assert np.allclose(found.poses[:, :3, 2], world.truth / 0.1, atol=tilt)
    assert found.anchor
    assert found.factors
    assert found.provenance["method"] == method


@pytest.mark.deep
def test_methods_rank_as_they_should(world, alone):
    ranked = ("joint", "trilateration", "posegraph", "posegraph_isotropic", "three_circles")
    error = {method: mean_error(world, alone(method)) for method in ranked}
    assert error["joint"] <= 1.1 * error["trilateration"]
    assert error["joint"] < 0.8 * error["posegraph"] < 0.8 * error["posegraph_isotropic"]
    assert error["joint"] < error["three_circles"] / 5


def test_save_and_load(world, alone, tmp_path):
    found = alone("joint")
    found.save(tmp_path / "calibration")
    again = Calibration.load(tmp_path / "calibration")
    for name in ("ids", "poses", "covariances", "observed", "touched", "readings", "iterates"):
        assert np.array_equal(getattr(again, name), getattr(found, name)), name
    for name in ("method", "anchor", "factors", "modulus", "modulus_sigma", "seconds"):
        assert getattr(again, name) == getattr(found, name), name
    assert again.provenance["versions"] == found.provenance["versions"]
    rows = (tmp_path / "calibration.csv").read_text().splitlines()
    assert len(rows) == 1 + len(world.ids)
    first = rows[1].split(",")
    assert int(first[0]) == world.ids[0]
    assert [float(x) for x in first[1:4]] == pytest.approx(1e3 * found.positions[0], abs=1e-6)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["calibration.csv", "calibration.parquet"]


def test_files_that_hold_no_calibration(tmp_path):
    with pytest.raises(CalibrationError, match="no calibration at"):
        Calibration.load(tmp_path / "none")
    (tmp_path / "torn.parquet").write_bytes(b"PAR1 and no more")
    with pytest.raises(CalibrationError, match="cannot be read"):
        Calibration.load(tmp_path / "torn")
    pq.write_table(pa.table({"a": [1]}), tmp_path / "other.parquet")
    with pytest.raises(CalibrationError, match="holds no calibration"):
        Calibration.load(tmp_path / "other")


@pytest.mark.parametrize(
    "change", [{"method": None}, {"verdict": {"level": "PASS"}}, {"fit": {"chi": 1.0}}, {"new": 1}]
)
def test_a_file_of_another_version_is_refused(noisy, tmp_path, change):
    calibrate(*noisy, method="centroid").save(tmp_path / "c")
    table = pq.read_table(tmp_path / "c.parquet")
    (key,) = (k for k in table.schema.metadata if b"meshskin" in k)
    header = json.loads(table.schema.metadata[key]) | change
    if "method" in change:
        del header["method"]
    table = table.replace_schema_metadata({key: json.dumps(header).encode()})
    pq.write_table(table, tmp_path / "c.parquet")
    with pytest.raises(CalibrationError, match=r"another version of meshskin.*; calibrate again"):
        Calibration.load(tmp_path / "c")


@pytest.mark.parametrize("method", METHODS)
def test_untouched_taxels_are_undetermined(world, method, tmp_path):
    recording, belief = world.record(), world.belief()
    keep = ~np.isin(recording.reading_taxel, world.ids[[4, 9]])
    cut = replace(recording, readings=recording.readings.filter(pa.array(keep)))
    found = calibrate(cut, belief, method=method)
    lost = np.isin(world.ids, world.ids[[4, 9]])
    assert np.array_equal(found.touched, ~lost)
    assert (found.reasons[lost] == UNTOUCHED).all()
    assert np.isnan(found.poses[lost, :3]).all()
    assert not found.observed[lost].any()
    assert np.isinf(np.diagonal(found.covariances[lost], axis1=1, axis2=2)).all()
    assert mean_error(world, found) < EXACT.get(method, 1e-6)
    found.save(tmp_path / "c")
    assert np.array_equal(Calibration.load(tmp_path / "c").poses, found.poses, equal_nan=True)
    assert f"{world.ids[4]},,,,,,,,0,never touched" in (tmp_path / "c.csv").read_text()


def changed(recording, table, name, value):
    """The recording with the first entry of a column set to `value`."""
    rows = getattr(recording, table)
    column = rows.column(name).to_numpy().copy()
    column[0] = value
    index = rows.column_names.index(name)
    return replace(recording, **{table: rows.set_column(index, name, pa.array(column))})


@pytest.mark.parametrize(
    ("table", "name", "value", "words"),
    [
        ("contacts", "force", np.inf, "force is not finite"),
        ("contacts", "py", np.nan, "contact point is not finite"),
    ],
)
def test_values_that_are_not_finite(world, table, name, value, words):
    bad = changed(world.record(), table, name, value)
    with pytest.raises(RecordingError, match=words):
        calibrate(bad, world.belief())


def test_many_pressures_that_are_not_finite(world):
    recording = world.record()
    pressure = recording.pressure.copy()
    pressure[::20] = np.nan
    with pytest.raises(RecordingError, match=r"pressure is not finite.*row 0 of readings"):
        calibrate(recording.with_columns(pressure=pressure), world.belief())


def test_other_bad_input_is_named(world):
    recording, belief = world.record(), world.belief()
    with pytest.raises(UnknownNameError, match="did you mean joint"):
        calibrate(recording, belief, method="joynt")
    with pytest.raises(CalibrationError, match=r"ids 7, limit.*use the skin that was recorded"):
        calibrate(changed(recording, "readings", "taxel", 7), belief)
    with pytest.raises(CalibrationError, match=r"no belief, got World; .*scene\.belief"):
        calibrate(recording, world)
    empty = replace(recording, readings=recording.readings.slice(0, 0))
    with pytest.raises(CalibrationError, match=r"no readings.*0 readings"):
        calibrate(empty, belief)
    with pytest.raises(CalibrationError, match="no readings"):
        calibrate(recording, world.belief(threshold=10.0))
    with pytest.raises(ContactError, match="a/R"):
        calibrate(recording, world.belief(young=0.02e6))
    with pytest.raises(UnknownNameError, match="contact model"):
        calibrate(recording, world.belief(contact="winkler"))


def test_approach_without_force_is_left_out(world):
    recording = world.record()
    untouched = changed(recording, "contacts", "force", 0.0)
    heard = recording.reading_contact != 0
    found = calibrate(untouched, world.belief())
    assert found.readings.sum() == heard.sum()
    assert mean_error(world, found) < 1e-6


@pytest.mark.deep
def test_a_loose_tolerance_stays_within_what_it_says(noisy):
    """sqrt(2 tolerance) standard deviations from the optimum, at most, and no further for less."""
    recording, belief = noisy
    tight = calibrate(recording, belief, tolerance=1e-12)
    off = []
    for tolerance in (1e-1, 1e-2, 1e-8):
        loose = calibrate(recording, belief, tolerance=tolerance)
        away = np.linalg.norm(loose.positions - tight.positions, axis=1) / tight.position_sigma
        off.append(np.nanmax(away))
        assert off[-1] < 2 * np.sqrt(2 * tolerance)
    assert off[0] > 100 * off[2]


def test_a_limit_of_iterations_must_be_a_positive_integer(noisy):
    for iterations in (0, -1, 1.5, True):
        with pytest.raises(ConfigError, match="limit of iterations"):
            calibrate(*noisy, iterations=iterations)


def test_a_limit_of_iterations_reaches_the_optimizer(noisy, monkeypatch):
    seen, optimum = [], maximum_likelihood.optimum

    def observed(data, start, iterations, *others):
        seen.append(iterations)
        return optimum(data, start, iterations, *others)

    monkeypatch.setattr(maximum_likelihood, "optimum", observed)
    calibrate(*noisy, iterations=7)
    assert seen == [7]


def test_a_tolerance_must_be_positive(noisy):
    for tolerance in (0.0, -1e-8, np.nan):
        with pytest.raises(ConfigError, match="tolerance of a calibration"):
            calibrate(*noisy, tolerance=tolerance)


def test_limits_of_the_joint_estimate_are_refused_where_they_have_no_effect(noisy, sphere):
    recording, belief = noisy
    with pytest.raises(ConfigError, match=r"for the joint estimate .*got the method centroid"):
        calibrate(recording, belief, method="centroid", iterations=7)
    with pytest.raises(ConfigError, match="got the method joint with a learned response"):
        learned = sphere.belief(contact="learned")
        calibrate(ms.press(sphere, sphere.skin.positions[:20]), learned, tolerance=1e-3)


@pytest.mark.deep
def test_methods_share_what_they_have_in_common(noisy, alone):
    """Each result of an `Estimation` is that of `calibrate`, in any order."""
    estimation = Estimation(*noisy)
    for method in ("posegraph_paper", "joint", "posegraph", "trilateration", "three_circles"):
        together = estimation.calibrate(method)
        assert np.array_equal(alone(method).poses, together.poses, equal_nan=True)
        assert np.array_equal(alone(method).covariances, together.covariances)


def test_parameters_in_natural_units(world, noisy):
    recording, _ = noisy
    belief = world.belief(0.01, 0.05, unknown=("modulus", "force_scale", "force_offset"))
    found = calibrate(recording, belief)
    modulus, scale, offset = (
        found.parameter_values[name] for name in ("modulus", "force_scale", "force_offset")
    )
    assert modulus == (found.modulus, pytest.approx(found.modulus_sigma), "Pa")
    value, sigma = found.unknowns["force_scale"]
    assert scale == (pytest.approx(np.exp(value)), pytest.approx(np.exp(value) * sigma), "")
    assert offset == (*found.unknowns["force_offset"], "N")
    unknowns = {
        "joint_offset j1": (0.01, 1e-3),
        "clock_offset": (0.037, 2e-4),
        "modulus": (0.0, 0.1),
    }
    words = replace(
        found, unknowns=unknowns | {"indenter_position x": (-2e-3, 1e-4)}
    ).parameter_words()
    assert words["joint_offset j1"] == "0.573 +- 0.057 degrees"
    assert words["clock_offset"] == "37 +- 0.2 ms"
    assert words["indenter_position x"] == "-2 +- 0.1 mm"
    assert words["modulus"].endswith("kPa")
    unknowns = {"modulus": (0.0, 0.1), "profile 3": (0.2, 0.01)}
    words = replace(found, unknowns=unknowns, modulus=None).parameter_words()
    assert words == {"patch stiffness": "1 +- 0.1", "profile 3": "0.2 +- 0.01"}


def test_invalid_reports(world, noisy, tmp_path):
    found = calibrate(*noisy)
    with pytest.raises(ConfigError, match=r"a report is an HTML page, got .*r\.pdf"):
        found.report(tmp_path / "r.pdf")
    with pytest.raises(ConfigError, match="the truth of a report must be a Skin"):
        found.report(tmp_path / "r.html", truth=world.body)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["anchor", "factors"])
def test_a_calibration_by_hand_says_what_it_rests_on(name):
    n = 2
    given = {
        "ids": np.arange(n), "poses": np.tile(np.eye(4), (n, 1, 1)),
        "covariances": np.zeros((n, 6, 6)), "observed": np.ones((n, 6), dtype=bool),
        "touched": np.ones(n, dtype=bool), "readings": np.ones(n, dtype=int), "method": "hand",
        "anchor": "a ruler", "factors": ("ruler",), "chi2": np.full(n, np.nan),
        "reasons": np.full(n, ""),
    }  # fmt: skip
    assert getattr(Calibration(**given), name) == given[name]
    with pytest.raises(TypeError, match=name):
        Calibration(**{key: value for key, value in given.items() if key != name})


@pytest.mark.parametrize("undeclared", [False, True])
def test_gains_that_only_the_readings_ask_for_contradict_the_contact_model(undeclared):
    """Where contacts are sparse, their scatter hides what else the model lacks: on an egg with 15
    readings of a taxel and gains 20 % apart its errors were 2.5 times the learned response's."""
    fit = SimpleNamespace(good=True, of_computing=lambda pressure: False)
    found = SimpleNamespace(fit=fit, undeclared_gains=undeclared, departures={})
    data = SimpleNamespace(edges=0, points=np.zeros((9, 3)), pressure=np.ones(9))
    assert Estimation._contradicted(SimpleNamespace(data=data), found) is undeclared
