"""Requests for an accuracy or a time: predictions from a pilot, and actual runs."""

from dataclasses import replace

import numpy as np
import pytest

import meshskin as ms
from meshskin import cli, pipeline
from meshskin.core.errors import ConfigError, StudyError
from meshskin.geometry.region import Cap
from meshskin.study.sensitivity.first_run import LANES
from meshskin.study.sensitivity.knobs import RATES, Level, worthwhile
from meshskin.study.sensitivity.numerical_error import NumericalReference
from meshskin.study.sensitivity.pilot import (
    contact_levels,
    loop_levels,
    surface_levels,
    tolerance_levels,
    with_long_recording,
)
from meshskin.study.sensitivity.request import Pilot, Request
from meshskin.study.sensitivity.setting import Setting

BASE = Setting(5120, 4, "hertz", 1e-3, "semi_implicit", 4e-3, 100.0)


def pilot(**changes):
    """A pilot of round numbers, on the scene's own lanes."""
    numbers = {
        "base": BASE, "setting": BASE, "steps": 1000, "contacts": 100, "readings": 400,
        "bound_mm": 0.1, "systematic_mm": 0.0, "knobs": (),
        "lane_spacings": tuple(4e-3 * x for x in LANES if x <= 1.0),
        "rates": tuple(100.0 * x for x in RATES), "fixed": 1.0, "each_step": 1e-4,
        "each_contact": 1e-3, "estimating": (0.2, 1e-3), "spent": (3.0, 1.5),
    }  # fmt: skip
    return Pilot(**(numbers | changes))


def test_seconds_add_up():
    prediction = pilot().predict(BASE)
    assert prediction.processor_seconds == pytest.approx(1.5 + 1.0 + 0.1 + 0.1 + 0.2 + 0.4)
    assert prediction.seconds == pytest.approx(3.0 + 2 * 1.8), "the machine ran at half its speed"


def test_errors_fall_with_the_contacts_down_to_the_systematic_error():
    four = replace(BASE, rate=400.0)
    assert pilot().predict(four).error_mm == pytest.approx(0.05)
    assert pilot(systematic_mm=0.3).predict(four).error_mm == pytest.approx(np.hypot(0.05, 0.3))
    half = replace(BASE, lane_spacing=2e-3)
    assert pilot().predict(half).error_mm == pytest.approx(0.1 / np.sqrt(2))


def test_the_cheapest_setting_is_chosen_for_an_accuracy():
    measured = pilot()
    chosen = measured.choose(Request(accuracy_mm=0.05))
    assert all(p.error_mm <= 0.05 for p in chosen)
    kept = [p for p in measured.predictions() if p.error_mm <= 0.045]
    assert chosen[0].processor_seconds == min(p.processor_seconds for p in kept)


def test_the_most_accurate_setting_is_chosen_for_a_time():
    measured = pilot()
    chosen = measured.choose(Request(seconds=8.0))
    fits = [p for p in measured.predictions() if p.seconds <= 8.0]
    assert chosen[0].error_mm == min(p.error_mm for p in fits)
    assert 0 < len(fits) < len(measured.predictions())


def test_runge_kutta_is_chosen_if_the_step_error_is_too_large():
    own = Level({"integrator": "semi_implicit"}, 0.2, along=0.1)
    measured = pilot(knobs=((own, Level({"integrator": "rk4"}, 1e-5, along=0.4)),))
    assert measured.choose(Request(accuracy_mm=0.1))[0].setting.integrator == "rk4"
    assert measured.choose(Request(accuracy_mm=1.0))[0].setting.integrator == "semi_implicit"


def test_every_knob_is_changed_if_that_is_worthwhile():
    """Levels add their parts in squares, and their seconds with lanes, readings, or once."""
    knobs = (
        (Level({"dt": 1e-3}, along=0.1), Level({"dt": 2e-3}, 0.03, along=0.05)),
        (Level({"tolerance": 1e-8}, reading=0.4), Level({"tolerance": 1.0}, 0, 0.04, reading=0.1)),
        (Level({"faces": 5120}, 0.01), Level({"faces": 20480}, once=0.4)),
    )
    measured = pilot(knobs=knobs)
    cheap = measured.choose(Request(accuracy_mm=1.0))[0]
    assert (cheap.setting.dt, cheap.setting.tolerance, cheap.setting.faces) == (2e-3, 1.0, 5120)
    assert cheap.numerical_mm == pytest.approx(np.hypot(0.03, 0.01))
    assert cheap.error_mm > 0.04
    fine = measured.choose(Request(accuracy_mm=0.03))[0]
    assert (fine.setting.dt, fine.setting.tolerance) == (1e-3, 1e-8)
    half = replace(BASE, lane_spacing=2e-3)
    plain = measured.predict(half).processor_seconds
    turned = measured.predict(half, [level[1] for level in knobs]).processor_seconds
    assert turned - plain == pytest.approx(2 * -0.05 + 2 * -0.3 + 0.4)


def test_a_level_with_a_larger_error_must_save_time():
    own = Level({"dt": 1e-3}, 0.01, along=1.0)
    chance, spared = (replace(own, numerical_mm=0.02, along=x) for x in (0.9, 0.5))
    better = replace(own, numerical_mm=0.001, along=4.0)
    assert worthwhile((own, chance, spared, better)) == (own, spared, better)


@pytest.mark.slow
def test_levels_are_measured_on_the_reference_path():
    """Twice the step moves the taxels further, Runge-Kutta hardly; what cannot run is left out."""
    whole = ms.Scene.load("sphere_noisy")
    region = Cap(direction=(0.0, 0.0, -1.0))
    skin = ms.Skin.cover(whole.body, spacing=6e-3, count=30, region=region)
    scene = whole.with_(skin=skin)
    fine = scene.with_(loop=replace(scene.loop, dt=5e-4, integrator="rk4"))
    reference = NumericalReference(fine, 1e-10, "auto")
    found = {(x.changes["dt"], x.changes["integrator"]): x.numerical_mm
             for x in loop_levels(reference, scene, (1, 2, 5))}  # fmt: skip
    assert next(iter(found)) == (1e-3, "semi_implicit")
    own, twice = found[1e-3, "semi_implicit"], found[2e-3, "semi_implicit"]
    assert twice / own == pytest.approx(2.0, rel=0.15)
    assert found[1e-3, "rk4"] < 0.1 * own
    assert (5e-3, "semi_implicit") not in found
    names = [level.changes["contact"] for level in contact_levels(reference, scene)]
    assert names == ["hertz", "elliptic"]
    (surface,) = surface_levels(reference, scene, 0.01)
    assert surface.changes == {"faces": 5120, "degree": 4}
    assert surface.numerical_mm < 1e-5
    tight, _, loose = tolerance_levels(ms.simulate(scene), scene.belief())
    assert tight.error_mm == 0.0 < loose.error_mm < 0.005


@pytest.mark.slow
def test_finer_faces_are_measured_if_the_own_surface_is_too_coarse():
    scene = ms.Scene.load("sphere_noisy")
    scene = scene.with_(body=ms.Body.sphere(0.1, 320), loop=replace(scene.loop, integrator="rk4"))
    reference = NumericalReference(scene, 1e-10, "auto")
    own, _, finer = surface_levels(reference, scene, 1e-5)
    assert finer.changes["faces"] == 4 * own.changes["faces"]
    assert finer.numerical_mm < 0.1 * own.numerical_mm
    assert finer.once > 0


def test_a_request_out_of_reach_names_the_best_setting():
    with pytest.raises(StudyError, match=r"out of reach, got 1e-06 mm, limit: 0\.01"):
        pilot().choose(Request(accuracy_mm=1e-6))
    with pytest.raises(StudyError, match=r"too short, got 0\.1 s, limit: 5\.\d+ s for 0\.2 mm"):
        pilot().choose(Request(seconds=0.1))


@pytest.mark.parametrize("given", [{}, {"accuracy_mm": 0.1, "seconds": 5.0}, {"seconds": -1.0}])
def test_a_request_is_one_positive_number(given):
    with pytest.raises(ConfigError):
        Request(**given)


@pytest.mark.slow
def test_a_run_agrees_with_its_prediction(tmp_path):
    """The error is within a factor of 1.5 of the prediction, and within the request."""
    result = pipeline.run("sphere_noisy", tmp_path, seed=2, request=Request(accuracy_mm=0.05))
    prediction = result.metrics["promise"]
    assert prediction["asked"] == "0.05 mm"
    assert "frames/s" in prediction["setting"]
    came = prediction["came_to"]["error_mm"]
    assert came == result.metrics["position_error_mm"]["mean"]
    assert prediction["error_mm"] / 1.5 < came < min(1.5 * prediction["error_mm"], 0.05)
    assert result.metrics["readings"] < 4000, "fewer than the scene's own 8,000"
    assert 0 < prediction["numerical_mm"] < 0.002
    assert np.hypot(prediction["error_mm"], prediction["numerical_mm"]) < 0.05
    assert result.metrics["seconds"]["pilot"] > 0


@pytest.mark.slow
def test_an_accuracy_out_of_reach_is_one_error_line(capsys, tmp_path):
    out = ["--out", str(tmp_path), "--quiet"]
    assert cli.main(["run", "sphere_noisy", *out, "--accuracy-mm", "1e-6"]) == 2
    line = capsys.readouterr().err.strip()
    assert line.count("\n") == 0
    assert "mm in" in line
    assert "at best" in line


def test_the_seconds_of_a_reading_are_those_of_a_long_recording(recording):
    """Caches hold the pilot's readings, and no longer the run's; what is paid once stays."""
    readings = len(recording.pressure)
    resting = Level({"tolerance": 1e-8}, reading=0.3), Level({"tolerance": 0.01}, reading=0.1)
    measured = pilot(readings=readings, estimating=(0.1, 1e-6), fixed=200.0, knobs=(resting,))
    lengths = []

    def whole(data):
        lengths.append(len(data.pressure))
        return 0.1 + 1e-6 * readings + 3e-6 * (len(data.pressure) - readings)

    def joint(data, rest):
        more = len(data.pressure) / readings - 1
        return 0.3 + 0.04 * more if rest < 1e-3 else 0.1 + 0.03 * more

    wanted = Request(seconds=1e4)
    best = measured.choose(wanted)[0].setting
    many = measured.setting.lane_spacing / best.lane_spacing * best.rate / measured.setting.rate
    longer = with_long_recording(measured, recording, wanted, whole, joint)
    assert lengths == [round(many) * readings]
    once, each = longer.estimating
    assert each == pytest.approx(3e-6)
    assert once == pytest.approx(max(0.1 - 2e-6 * readings, 0.0))
    tight, loose = longer.knobs[0]
    assert (tight.once, tight.reading) == pytest.approx((0.26, 0.04))
    assert (loose.once, loose.reading) == pytest.approx((0.07, 0.03))
    unreachable = Request(accuracy_mm=1e-9)
    assert with_long_recording(measured, recording, unreachable, whole, joint) is measured


@pytest.mark.slow
def test_a_method_that_finds_nothing_does_not_end_a_pilot(tmp_path, monkeypatch):
    """Taxels too far apart for displacements: a run leaves the pose graphs out, and so must it."""
    sparse = tmp_path / "sparse.toml"
    monkeypatch.setattr(pipeline, "_write_report", lambda *_: None)  # tests/cli draws one
    sparse.write_text('extends = "sphere_noisy"\n[skin]\nspacing_mm = 20\ncount = 3\n')
    result = pipeline.run(sparse, tmp_path / "out", seed=2, request=Request(accuracy_mm=0.1))
    assert "two taxels" in result.metrics["posegraph"]["why"]
    assert result.metrics["position_error_mm"]["mean"] < 0.1
