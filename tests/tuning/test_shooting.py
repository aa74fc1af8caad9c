"""Single shooting against the simulator, and their derivatives against finite differences."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from meshskin.core.errors import ConfigError
from meshskin.tuning.gains import NAMES, Gains
from meshskin.tuning.manoeuvre import plan_manoeuvre
from meshskin.tuning.result import simulate_manoeuvre
from meshskin.tuning.scenarios import Scenario, scenario_scene, scenarios
from meshskin.tuning.shooting import SingleShooting

BOTTOM = np.array([0.0, 0.0, -0.1])
AHEAD = np.array([1.0, 0.0, 0.0])
QUICK = {"settle": 0.05, "speed": 0.1, "ramp": 0.03, "approach_ramp": 0.02}


def shooting_of(scene, scenario=None, distance=0.005):
    """The shooting of a scenario of a scene, as in `tune`."""
    scenario = scenario or Scenario()
    varied = scenario_scene(scene, scenario, BOTTOM)
    made = plan_manoeuvre(varied, BOTTOM / scenario.curvature, AHEAD, distance)
    return SingleShooting(varied, scenario, made)


def quick(scene, mode="arm", delay=0.0):
    return scene.with_(
        loop=replace(scene.loop, mode=mode, delay=delay, compile="never"),
        exploration=replace(scene.exploration, **QUICK),
    )


@pytest.mark.parametrize(
    ("mode", "delay", "scenario"),
    [
        ("quasi_static", 0.0, Scenario()),
        ("quasi_static", 3e-3, Scenario(modulus=1.5, curvature=0.8)),
        ("arm", 2e-3, Scenario(modulus=0.7, curvature=1.25, friction=0.01)),
    ],
)
def test_the_predicted_force_is_the_simulated_one(sphere, mode, delay, scenario):
    """The same manoeuvre on the mesh's own faces, through the state machine: to 0.2 %."""
    one = shooting_of(quick(sphere, mode, delay), scenario)
    predicted = one.predict(Gains.of(one.scene))
    time, force = simulate_manoeuvre(one.scene, one.manoeuvre)
    count = min(len(force), len(predicted.force))
    assert abs(len(force) - len(predicted.force)) <= 2
    difference = np.abs(force[:count] - predicted.force[:count]).max()
    assert force.max() > 2.0
    assert difference < 2e-3 * sphere.law.force_reference
    assert predicted.duration == pytest.approx(time[-1], abs=2 * sphere.loop.dt)


@pytest.mark.parametrize("mode", ["quasi_static", pytest.param("arm", marks=pytest.mark.slow)])
def test_derivatives_by_the_gains_are_those_of_differences(sphere, mode):
    one = shooting_of(quick(sphere, mode, 2e-3))
    x = ca.MX.sym("x", len(NAMES))
    rows = one.roll(ca.exp(x), 200)[:3, :]
    both = ca.Function("both", [x], [rows, ca.jacobian(ca.vec(rows), x)])
    # an approach at less than the law's own speed, so that no clip of it is at its corner
    here = np.log(np.array(replace(Gains.of(one.scene), approach_speed=0.06).values))
    value, slope = (part.full() for part in both(here))
    assert value[0].max() > 1.0
    for k in range(len(NAMES)):
        step = 1e-6 * np.eye(len(NAMES))[k]
        ends = [both(here + sign * step)[0].full().ravel(order="F") for sign in (1, -1)]
        difference = (ends[0] - ends[1]) / 2e-6
        size = np.abs(difference).max() + 1e-2  # N and s; differences are good to some 1e-7
        np.testing.assert_allclose(slope[:, k], difference, atol=2e-4 * size)


def test_a_scenario_changes_the_scene_and_not_what_the_law_assumes(sphere):
    varied = scenario_scene(sphere, Scenario(1.5, 2.0, 0.01), BOTTOM)
    assert varied.material.effective_modulus == pytest.approx(
        1.5 * sphere.material.effective_modulus
    )
    assert varied.law.effective_modulus == sphere.material.effective_modulus
    hit = varied.body.closest(BOTTOM[None] / 2.0)
    np.testing.assert_allclose(hit.curvature, 20.0, rtol=1e-3)
    before, after = (s.mount_pose @ [*p, 1.0] for s, p in ((sphere, BOTTOM), (varied, BOTTOM / 2)))
    np.testing.assert_allclose(after, before, atol=1e-12)
    np.testing.assert_allclose(varied.arm.friction, 0.01 * sphere.arm.effort_limit)
    assert scenario_scene(sphere, Scenario(), BOTTOM) is sphere
    weak = replace(sphere.arm, effort_limit=np.full(6, np.inf))
    with pytest.raises(ConfigError, match="torque limits"):
        scenario_scene(sphere.with_(arm=weak), Scenario(friction=0.1), BOTTOM)


def test_ranges_make_their_corners_once():
    assert scenarios() == (Scenario(),)
    made = scenarios(modulus=(0.8, 1.2), friction=(0.0, 0.01))
    assert made[0] == Scenario()
    assert len(made) == 5
    assert Scenario(1.2, 1.0, 0.01) in made
    assert made[-1].name == "E* x 1.2, friction 1 %"
    assert made[0].name == "nominal"
