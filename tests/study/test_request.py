"""An accuracy or a time asked for: what the pilot's numbers promise, and what the run comes to."""

import numpy as np
import pytest

from meshskin import cli, job
from meshskin.errors import ConfigError, StudyError
from meshskin.study.cost.request import Pilot, Request
from meshskin.study.cost.setting import Setting

BASE = Setting(5120, 4, "hertz", 1e-3, "semi_implicit", 4e-3, 100.0)


def pilot(**changes):
    """A pilot of round numbers, on the scene's own lanes."""
    numbers = {
        "base": BASE, "setting": BASE, "steps": 1000, "contacts": 100, "readings": 400,
        "bound_mm": 0.1, "systematic_mm": 0.0, "numerical_mm": {}, "fixed": 1.0, "each_step": 1e-4,
        "each_contact": 1e-3, "estimating": (0.2, 1e-3), "spent": (3.0, 1.5),
    }  # fmt: skip
    return Pilot(**(numbers | changes))


def test_seconds_add_up():
    promise = pilot().promise(BASE)
    assert promise.processor_seconds == pytest.approx(1.5 + 1.0 + 0.1 + 0.1 + 0.2 + 0.4)
    assert promise.seconds == pytest.approx(3.0 + 2 * 1.8), "the machine ran at half its speed"


def test_errors_go_with_the_contacts_and_stop_at_what_noise_is_not():
    from dataclasses import replace

    four = replace(BASE, rate=400.0)
    assert pilot().promise(four).error_mm == pytest.approx(0.05)
    assert pilot(systematic_mm=0.3).promise(four).error_mm == pytest.approx(np.hypot(0.05, 0.3))
    half = replace(BASE, lane_spacing=2e-3)
    assert pilot().promise(half).error_mm == pytest.approx(0.1 / np.sqrt(2))


def test_an_accuracy_is_kept_by_the_cheapest_setting():
    tried = pilot()
    chosen = tried.choose(Request(accuracy_mm=0.05))
    assert all(p.error_mm <= 0.05 for p in chosen)
    kept = [p for p in tried.promises() if p.error_mm <= 0.045]
    assert chosen[0].processor_seconds == min(p.processor_seconds for p in kept)


def test_a_time_is_used_for_the_most_accurate_setting():
    tried = pilot()
    chosen = tried.choose(Request(seconds=8.0))
    fits = [p for p in tried.promises() if p.seconds <= 8.0]
    assert chosen[0].error_mm == min(p.error_mm for p in fits)
    assert 0 < len(fits) < len(tried.promises())


def test_runge_kutta_is_taken_where_the_step_would_spoil_the_accuracy():
    tried = pilot(numerical_mm={"semi_implicit": 0.2, "rk4": 1e-5})
    assert tried.choose(Request(accuracy_mm=0.1))[0].setting.integrator == "rk4"
    assert tried.choose(Request(accuracy_mm=1.0))[0].setting.integrator == "semi_implicit"


def test_what_cannot_be_kept_names_the_best():
    with pytest.raises(StudyError, match=r"out of reach, got 1e-06 mm, limit: 0\.01"):
        pilot().choose(Request(accuracy_mm=1e-6))
    with pytest.raises(StudyError, match=r"too short, got 0\.1 s, limit: 5\.\d+ s for 0\.2 mm"):
        pilot().choose(Request(seconds=0.1))


@pytest.mark.parametrize("given", [{}, {"accuracy_mm": 0.1, "seconds": 5.0}, {"seconds": -1.0}])
def test_a_request_is_one_positive_number(given):
    with pytest.raises(ConfigError):
        Request(**given)


def test_a_run_keeps_its_promise(tmp_path):
    """The error is within a factor of 1.5 of what was promised, and within what was asked."""
    result = job.run("sphere_noisy", tmp_path, seed=2, request=Request(accuracy_mm=0.05))
    promise = result.metrics["promise"]
    assert promise["asked"] == "0.05 mm"
    assert "frames/s" in promise["setting"]
    came = promise["came_to"]["error_mm"]
    assert came == result.metrics["position_error_mm"]["mean"]
    assert promise["error_mm"] / 1.5 < came < min(1.5 * promise["error_mm"], 0.05)
    assert result.metrics["readings"] < 4000, "fewer than the scene's own 8,000"
    assert 0 < promise["numerical_mm"] < 0.002
    assert result.metrics["seconds"]["pilot"] > 0


def test_out_of_reach_is_one_line(capsys, tmp_path):
    out = ["--out", str(tmp_path), "--quiet"]
    assert cli.main(["run", "sphere_noisy", *out, "--accuracy-mm", "1e-6"]) == 2
    line = capsys.readouterr().err.strip()
    assert line.count("\n") == 0
    assert "mm in" in line
    assert "at best" in line
