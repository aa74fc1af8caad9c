"""The tuning on a small scene: against a grid, against the simulator, and where it must refuse."""

from dataclasses import replace

import numpy as np
import pytest

import meshskin as ms
from meshskin.errors import ConfigError, TuningError, UnknownNameError
from meshskin.motion.response import force_response
from meshskin.tuning.answer import respond
from meshskin.tuning.gains import Gains
from meshskin.tuning.problem import TOLERANCE, interpolated
from meshskin.tuning.shooting import Shot
from meshskin.tuning.tune import Demands, Scenario, scenarios

DISTANCE = 5e-3
DEMANDS = Demands(overshoot=0.01)
CALM = {"approach_speed": (1e-3, 0.3), "speed": (1e-3, 0.2), "ramp": (0.01, 1.0)}
"""Ranges within which the loop's step resolves every touch."""


@pytest.fixture(scope="module")
def small(sphere):
    """The sphere without an arm, readings 4 ms late: the delay limits gamma."""
    return sphere.with_(loop=replace(sphere.loop, mode="quasi_static", delay=4e-3, compile="never"))


@pytest.fixture(scope="module")
def tuned(small):
    return ms.tune(small, demands=DEMANDS, distance=DISTANCE, bounds=CALM)


def gains_of(tuned):
    return Gains.of(tuned.tuned)


def kept(shot, gains, demands, target):
    """Whether a manoeuvre keeps the demands on the force, and how long it takes: by its numbers."""
    foretold = shot.predict(gains)
    error = foretold.force / gains.force_reference - 1.0
    sliding = foretold.since > gains.settle
    first = np.interp(gains.settle, foretold.since, error)
    good = error.max() <= demands.overshoot + TOLERANCE
    good &= abs(first) <= demands.settled + TOLERANCE
    good &= np.abs(foretold.force[sliding] / target - 1.0).max() <= demands.force + TOLERANCE
    return bool(good), foretold.duration


def test_the_simulator_confirms_what_was_predicted(small, tuned):
    seen = tuned.confirm()
    assert seen.difference < 0.02
    assert (
        seen.simulated.max()
        <= (1.0 + DEMANDS.overshoot + 2 * TOLERANCE) * tuned.law.force_reference
    )
    assert tuned.trajectories[0].duration == pytest.approx(tuned.value, abs=2e-3)
    assert seen.time[-1] == pytest.approx(tuned.value, abs=3e-3)


def test_settling_is_halved_at_equal_overshoot(small, tuned):
    """The same rest and slide by the default law and by the one found."""
    resting = small.exploration.settle
    found = {}
    for name, law in (("default", small.law), ("tuned", tuned.law)):
        time, force = respond(small.with_(law=law), tuned.manoeuvres[0])
        first = time <= time[np.argmax(force > 0)] + resting
        found[name] = force_response(time[first], force[first], law.force_reference)
    assert found["tuned"].overshoot <= found["default"].overshoot + DEMANDS.overshoot + TOLERANCE
    assert found["tuned"].settling <= 0.5 * found["default"].settling + 1e-9  # steps, rounded


def test_no_gains_about_it_are_better(small, tuned):
    """A grid over gamma, approach speed and rest about the solution: nothing feasible is faster."""
    shot = Shot(small, Scenario(), tuned.manoeuvres[0])
    best, better = gains_of(tuned), []
    for gamma in np.linspace(0.7, 1.4, 8):
        for speed in np.linspace(0.7, 1.4, 8):
            for rest in (0.9, 0.95, 1.0):
                tried = replace(
                    best,
                    gamma=gamma * best.gamma,
                    approach_speed=speed * best.approach_speed,
                    settle=rest * best.settle,
                )
                if tried.approach_speed > CALM["approach_speed"][1]:
                    continue
                good, time = kept(shot, tried, DEMANDS, small.law.force_reference)
                if good:
                    better.append(time)
    assert better  # the grid is no empty claim
    assert min(better) > tuned.value * (1.0 - 0.01)


def test_what_binds_is_named_and_its_price_is_right(small, tuned):
    """The multiplier of the overshoot is the gain of a wider one."""
    assert "overshoot" in tuned.binding
    assert "settled" in tuned.binding
    wider = replace(DEMANDS, overshoot=DEMANDS.overshoot + 2e-3)
    again = ms.tune(small, demands=wider, distance=DISTANCE, bounds=CALM, start=gains_of(tuned))
    gained = tuned.value - again.value
    assert gained == pytest.approx(2e-3 * tuned.multipliers["overshoot"], rel=0.15)


def test_least_force_error_costs_time(small, tuned):
    """A tenth more time than the least: less than half its force error, and no later than asked."""
    demands = replace(DEMANDS, time=1.1 * tuned.value)
    exact = ms.tune(
        small,
        objective="force_error",
        demands=demands,
        distance=DISTANCE,
        bounds=CALM,
        start=gains_of(tuned),
    )
    assert exact.trajectories[0].duration <= demands.time + small.loop.dt
    seen = exact.confirm()
    assert seen.error < 0.5 * tuned.confirm().error
    assert seen.error <= 1.05 * exact.value


def test_every_scenario_keeps_the_demands(small):
    over = scenarios(modulus=(0.8, 1.25))
    tuned = ms.tune(small, demands=DEMANDS, over=over, distance=DISTANCE, bounds=CALM)
    assert [t.scenario for t in tuned.trajectories] == list(over)
    for k in range(len(over)):
        seen = tuned.confirm(k)
        assert seen.difference < 0.02
        highest = seen.simulated.max() / tuned.law.force_reference - 1.0
        assert highest <= DEMANDS.overshoot + 2 * TOLERANCE


def test_what_cannot_be_met_says_what_to_relax(small):
    with pytest.raises(TuningError, match="relax the time") as raised:
        ms.tune(small, demands=replace(DEMANDS, time=0.02), distance=DISTANCE, bounds=CALM)
    assert raised.value.limit == "0.02 s"


@pytest.mark.slow
def test_a_rest_too_short_to_settle_in_names_the_overshoot_or_the_settling(small):
    with pytest.raises(TuningError, match=r"relax the (overshoot|settled)"):
        ms.tune(small, demands=DEMANDS, distance=DISTANCE, bounds={"settle": (2e-3, 8e-3)})


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sphere", "capsule"])
def test_with_the_arm_settling_is_halved_within_the_torque_limits(name):
    scene = ms.Scene.load(name).with_(effects=())
    demands = Demands(overshoot=0.005)
    tuned = ms.tune(scene, demands=demands, bounds={"settle": (5e-3, 0.026)})
    seen = tuned.confirm()
    assert seen.difference < 0.02
    limit = scene.arm.effort_limit
    assert (np.abs(tuned.trajectories[0].torque) <= (1.0 + TOLERANCE) * limit).all()
    assert any(name.startswith("torque of") for name in tuned.binding)
    found = []
    for law in (scene.law, tuned.law):
        time, force = respond(scene.with_(law=law), tuned.manoeuvres[0])
        first = time <= time[np.argmax(force > 0)] + scene.exploration.settle
        found.append(force_response(time[first], force[first], law.force_reference))
    assert found[1].settling <= 0.5 * found[0].settling + 1e-9  # steps, rounded
    assert found[1].overshoot <= found[0].overshoot + demands.overshoot + TOLERANCE


def test_arguments_that_cannot_be_are_named(small):
    with pytest.raises(UnknownNameError, match="did you mean force_error"):
        ms.tune(small, objective="force_eror")
    with pytest.raises(ConfigError, match="gama"):
        ms.tune(small, bounds={"gama": (1.0, 2.0)})
    with pytest.raises(ConfigError, match="overshoot"):
        Demands(overshoot=-1.0)


def test_interpolation_is_exact_for_quadratics():
    import casadi as ca

    times = np.arange(20) * 0.1
    values = 1.0 + 2.0 * times - 3.0 * times**2
    at = float(interpolated(ca.DM(values), ca.DM(times), 0.634, 0.1))
    assert at == pytest.approx(1.0 + 2.0 * 0.634 - 3.0 * 0.634**2)
