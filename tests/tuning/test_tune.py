"""Tuning of a small scene: against a grid, against the simulator, and its errors."""

from dataclasses import replace

import numpy as np
import pytest

import meshskin as ms
from meshskin.core.errors import ConfigError, TuningError, UnknownNameError
from meshskin.simulation.response import force_response
from meshskin.tuning.feasible_sqp import descent_message
from meshskin.tuning.gains import Gains
from meshskin.tuning.limits import MIN_OVERSHOOT, interpolate
from meshskin.tuning.problem import TOLERANCE, termination_message
from meshskin.tuning.result import simulate_manoeuvre
from meshskin.tuning.shooting import SingleShooting
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
    heard = []
    found = ms.tune(
        small,
        demands=DEMANDS,
        distance=DISTANCE,
        bounds=CALM,
        progress=lambda *at: heard.append(at),
    )
    assert heard[0][:2] == ("tune", 0)
    assert heard[-1][1] == heard[-1][2] >= found.iterations
    return found


def gains_of(tuned):
    return Gains.of(tuned.tuned_scene)


def kept(shooting, gains, demands, target):
    """Whether a manoeuvre keeps the demands on the force, and how long it takes: by its numbers."""
    predicted = shooting.predict(gains)
    error = predicted.force / gains.force_reference - 1.0
    sliding = predicted.since > gains.settle
    first = np.interp(gains.settle, predicted.since, error)
    good = error.max() <= demands.overshoot + TOLERANCE
    good &= abs(first) <= demands.settled + TOLERANCE
    good &= np.abs(predicted.force[sliding] / target - 1.0).max() <= demands.force + TOLERANCE
    return bool(good), predicted.duration


def test_the_simulator_confirms_what_was_predicted(small, tuned):
    seen = tuned.confirm()
    assert seen.difference < 0.02
    assert (
        seen.simulated.max()
        <= (1.0 + DEMANDS.overshoot + 2 * TOLERANCE) * tuned.law.force_reference
    )
    assert tuned.trajectories[0].duration == pytest.approx(tuned.value, abs=2e-3)
    assert seen.time[-1] == pytest.approx(tuned.value, abs=3e-3)


def test_the_result_prints_in_a_few_lines(tuned):
    text = str(tuned)
    assert repr(tuned) == text
    assert len(text.splitlines()) <= 12
    assert "array" not in text
    assert f"{tuned.value:.4g} s" in text.splitlines()[0]
    assert f"{tuned.scene.law.gamma:.4g} -> {tuned.law.gamma:.4g}" in text
    assert ", ".join(tuned.binding) in text
    assert f"Search: {tuned.status}" in text


def touched(scene, manoeuvre, rest=0.3):
    """The response of a scene's law over a rest, before the slide."""
    rested = scene.with_(exploration=replace(scene.exploration, settle=rest))
    time, force = simulate_manoeuvre(rested, manoeuvre)
    first = time <= time[np.argmax(force > 0)] + rest - 2 * scene.loop.dt
    return force_response(time[first], force[first], scene.law.force_reference)


@pytest.mark.slow
def test_settling_is_halved_at_equal_overshoot(small):
    """No more overshoot than the scene's own gains have, which is none."""
    tuned = ms.tune(
        small, objective="settling", demands=Demands(overshoot=0.0), distance=DISTANCE, bounds=CALM
    )
    own = touched(small, tuned.manoeuvres[0])
    found = touched(tuned.tuned_scene, tuned.manoeuvres[0])
    assert own.overshoot < 1e-9
    assert found.overshoot <= own.overshoot + 2 * MIN_OVERSHOOT
    assert found.settling <= 0.5 * own.settling
    assert found.settling == pytest.approx(tuned.value, abs=small.loop.dt)
    assert tuned.confirm().difference < 0.02
    assert tuned.law.force_reference == small.law.force_reference
    assert tuned.exploration.speed == small.exploration.speed
    assert {"overshoot", "settled"} <= set(tuned.binding)


@pytest.mark.slow
def test_older_readings_settle_later(small):
    """The delay is in the problem: twice as old, and the least settling time is longer."""
    found = []
    for delay in (4e-3, 8e-3):
        late = small.with_(loop=replace(small.loop, delay=delay))
        tuned = ms.tune(late, objective="settling", distance=DISTANCE, bounds=CALM)
        assert tuned.confirm().difference < 0.02
        assert {"overshoot", "settled"} & set(tuned.binding)
        assert tuned.law.force_reference == small.law.force_reference
        assert tuned.exploration.speed == small.exploration.speed
        found.append((tuned.value, tuned.law.gamma))
    assert found[1][0] > 1.3 * found[0][0]
    assert found[1][1] < 0.7 * found[0][1]


@pytest.mark.deep
def test_no_gains_near_the_solution_are_better(small, tuned):
    """A grid over gamma, approach speed and rest about the solution: nothing feasible is faster."""
    shooting = SingleShooting(small, Scenario(), tuned.manoeuvres[0])
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
                good, time = kept(shooting, tried, DEMANDS, small.law.force_reference)
                if good:
                    better.append(time)
    assert better  # the grid is no empty claim
    assert min(better) > tuned.value * (1.0 - 0.01)


def test_binding_limits_are_named_with_the_right_multiplier(small, tuned):
    """The multiplier of the overshoot is the gain of a wider one."""
    assert "overshoot" in tuned.binding
    assert "settled" in tuned.binding
    wider = replace(DEMANDS, overshoot=DEMANDS.overshoot + 2e-3)
    again = ms.tune(small, demands=wider, distance=DISTANCE, bounds=CALM, start=gains_of(tuned))
    gained = tuned.value - again.value
    assert gained == pytest.approx(2e-3 * tuned.multipliers["overshoot"], rel=0.15)


@pytest.mark.slow
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
    assert exact.trajectories[0].duration <= demands.time * (1.0 + TOLERANCE)
    seen = exact.confirm()
    assert seen.error < 0.5 * tuned.confirm().error
    assert seen.error <= 1.05 * exact.value


def test_messages_of_how_a_search_ended(tuned):
    assert tuned.status == "solved"
    assert tuned.predicted_decrease < 1e-6
    assert tuned.one_sided == {}
    assert termination_message("User_Requested_Stop", True, 25) == (
        "stopped at the best gains that meet the limits: no progress of 0.1 % in 25 iterations"
    )
    assert termination_message("Restoration_Failed", False, 50).endswith(
        "IPOPT returned Restoration_Failed"
    )
    assert "40 steps were made" in descent_message(40)
    assert "no change of the gains by more than 0.01 %" in descent_message(39)


@pytest.mark.slow
def test_the_multiplier_of_time_is_right_for_the_least_force_error(small, tuned):
    """0.3 % of it more or less, searched from the solution, which is at its end, in no tooth."""

    def least(part, start):
        demands = replace(DEMANDS, time=part * 1.1 * tuned.value)
        return ms.tune(
            small, objective="force_error", demands=demands, distance=DISTANCE, bounds=CALM,
            start=start,
        )  # fmt: skip

    found = least(1.0, gains_of(tuned))
    assert "User_Requested" not in found.status
    assert found.predicted_decrease < 1e-3
    for part in (0.997, 1.003):
        gained = found.value - least(part, gains_of(found)).value
        assert gained == pytest.approx((part - 1.0) * found.multipliers["time"], rel=0.15)


@pytest.mark.slow
def test_every_scenario_keeps_the_demands(small):
    over = scenarios(modulus=(0.8, 1.25))
    tuned = ms.tune(small, demands=DEMANDS, over=over, distance=DISTANCE, bounds=CALM)
    assert [t.scenario for t in tuned.trajectories] == list(over)
    for k in range(len(over)):
        seen = tuned.confirm(k)
        assert seen.difference < 0.02
        highest = seen.simulated.max() / tuned.law.force_reference - 1.0
        assert highest <= DEMANDS.overshoot + 2 * TOLERANCE


@pytest.mark.slow
def test_demands_that_cannot_be_met_name_the_limit_to_relax(small, tuned):
    with pytest.raises(TuningError, match="relax the time") as raised:
        ms.tune(small, demands=replace(DEMANDS, time=0.02), distance=DISTANCE, bounds=CALM)
    assert raised.value.limit == "0.02 s"
    best = tuned.value + small.loop.dt  # the rest is rounded up to whole steps
    assert raised.value.value == f"at best time of {best:.4g} s"
    met = ms.tune(small, demands=replace(DEMANDS, time=1.01 * best), distance=DISTANCE, bounds=CALM)
    assert met.value <= 1.01 * best


@pytest.mark.slow
def test_a_rest_too_short_to_settle_in_names_the_overshoot_or_the_settling(small):
    with pytest.raises(TuningError, match=r"relax the (overshoot|settled)"):
        ms.tune(small, demands=DEMANDS, distance=DISTANCE, bounds={"settle": (2e-3, 8e-3)})


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sphere", "capsule"])
def test_with_the_arm_settling_is_halved_at_no_more_overshoot(name):
    """Through RK4, whose steps damp nothing: true of the scene's own step, and of CVODES."""
    scene = ms.Scene.load(name).with_(effects=())
    exact = scene.with_(loop=replace(scene.loop, integrator="rk4"))
    tuned = ms.tune(exact, objective="settling", demands=Demands(overshoot=0.0), distance=DISTANCE)
    assert tuned.confirm().difference < 0.02
    torque = np.abs(tuned.trajectories[0].torque) / scene.arm.effort_limit
    assert torque.max() <= 1.0 + TOLERANCE
    for integrator, spare in (("semi_implicit", 2 * MIN_OVERSHOOT), ("cvodes", 5e-4)):
        loop = replace(scene.loop, integrator=integrator)
        before, after = (
            touched(s.with_(loop=loop), tuned.manoeuvres[0]) for s in (scene, tuned.tuned_scene)
        )
        assert after.settling <= 0.5 * before.settling
        assert after.overshoot <= before.overshoot + spare


@pytest.mark.slow
def test_over_all_corners_the_simulator_confirms_force_and_limits():
    """E*, curvature and friction of the joints at once, nine scenarios in one program."""
    scene = ms.Scene.load("sphere").with_(effects=())
    over = scenarios(modulus=(0.8, 1.2), curvature=(0.8, 1.25), friction=(0.0, 0.01))
    demands = Demands(overshoot=0.1, settled=0.05, force=0.1)
    tuned = ms.tune(scene, demands=demands, over=over, distance=DISTANCE)
    limit, reference = scene.arm.effort_limit, tuned.law.force_reference
    assert len(tuned.trajectories) == 9
    for k, predicted in enumerate(tuned.trajectories):
        seen = tuned.confirm(k)
        assert seen.scenario == over[k]
        assert seen.difference < 0.02
        assert seen.simulated.max() / reference - 1.0 <= demands.overshoot + 2 * TOLERANCE
        sliding = predicted.since[: len(seen.time)] > tuned.exploration.settle
        error = np.abs(seen.simulated[sliding] / scene.law.force_reference - 1.0)
        assert error.max() <= demands.force + 2 * TOLERANCE
        assert (np.abs(predicted.torque) <= (1.0 + 2 * TOLERANCE) * limit).all()
        assert predicted.duration <= tuned.value + scene.loop.dt
    alone = ms.tune(scene, demands=demands, distance=DISTANCE)
    assert alone.value <= tuned.value * (1.0 + TOLERANCE)  # serving all scenarios has a cost


@pytest.mark.slow
@pytest.mark.parametrize(
    ("limits", "what"),
    [
        ({"torque": 0.5}, "torque of"),
        ({"velocity": 0.05}, "speed of"),
        ({"position": None}, "position of"),
    ],
)
def test_each_limit_of_the_joints_binds_and_is_named_where_it_cannot_be_kept(limits, what):
    """Tightened until it costs time; tightened beyond what any gains keep."""
    scene = ms.Scene.load("sphere").with_(effects=())
    free = ms.tune(scene, distance=DISTANCE)
    (name, share), q = next(iter(limits.items())), free.trajectories[0].q
    arm = scene.arm
    spare = float(np.minimum(q - arm.lower, arm.upper - q).min())
    if share is not None:
        tight = ms.tune(scene, demands=Demands(**{name: share}), distance=DISTANCE)
        assert tight.value > free.value * 1.01
        assert any(one.startswith(what) for one in tight.binding)
        assert tight.confirm().difference < 0.02
    never = {"torque": 0.1, "velocity": 1e-4, "position": spare + 0.1}[name]
    with pytest.raises(TuningError, match=f"relax the .*{what}"):
        ms.tune(scene, demands=Demands(**{name: never}), distance=DISTANCE)


@pytest.mark.slow
def test_one_sided_multipliers_are_right():
    """The largest speed of the ellipsoid's arm, re-solved with 0.5 % more and less of it."""
    scene = ms.Scene.load("ellipsoid")
    tuned = ms.tune(scene)
    ((name, (wide, tight)),) = ((k, v) for k, v in tuned.one_sided.items() if "speed of" in k)
    assert f"{name} (one-sided)" in str(tuned)
    assert tight > 1.2 * wide
    for part, multiplier in ((1.005, wide), (0.995, tight)):
        again = ms.tune(scene, demands=Demands(velocity=part), start=gains_of(tuned))
        gained = (tuned.value - again.value) / (part - 1.0)
        assert gained == pytest.approx(multiplier, rel=0.15)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["ellipsoid", "torus"])
def test_on_other_bodies_the_simulator_confirms_every_objective(name):
    scene = ms.Scene.load(name)
    fastest = ms.tune(scene)
    within = Demands(time=1.2 * fastest.value)
    exact = ms.tune(scene, objective="force_error", demands=within, start=gains_of(fastest))
    settled = ms.tune(scene, objective="settling")
    for tuned in (fastest, exact, settled):
        assert tuned.confirm().difference < 0.02
        assert tuned.binding
    assert exact.value < fastest.confirm().error
    assert settled.value < 0.5 * touched(scene, settled.manoeuvres[0]).settling


def test_invalid_arguments_are_named(small):
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
    at = float(interpolate(ca.DM(values), ca.DM(times), 0.634, 0.1))
    assert at == pytest.approx(1.0 + 2.0 * 0.634 - 3.0 * 0.634**2)
