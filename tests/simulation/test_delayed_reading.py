"""Old readings and joint friction in the closed loop, against shift registers and closed forms."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from scipy.optimize import brentq

from meshskin.core.errors import ConfigError, SimulationError
from meshskin.robot.arm import Arm
from meshskin.scene.settings import INTEGRATORS, Law
from meshskin.simulation.integrators import step
from meshskin.simulation.rollout import StepBlock
from meshskin.simulation.simulate import prepare

from .test_step import column, pressed

LAW = Law(gamma=20.0)


def blocks_of(loop, like):
    """Blocks of another loop at the state of `like`, whose readings have all come."""
    made = StepBlock(loop, like.length)
    made.anchors[:], made.references[:] = like.anchors, like.references
    made.state[:12], made.state[-2:] = like.state[:12], like.state[-2:]
    return made


@pytest.mark.parametrize("integrator", INTEGRATORS[:3])
def test_the_memory_is_a_shift_register_of_the_contact(arm, body, integrator):
    loop, like = pressed(arm, body, LAW, 1.5e-3, length=20)
    old = replace(loop, delay=3, integrator=integrator)
    blocks = blocks_of(old, like)
    blocks.run()
    seen = np.hstack([column(old, blocks, "depth"), column(old, blocks, "force")])
    kept = blocks.states[:, 12:-2].reshape(-1, 3, 2)
    for age in range(3):  # the last of the memory is the reading of the step itself
        np.testing.assert_array_equal(kept[age:, 2 - age], seen[: len(seen) - age])


def test_the_law_uses_the_delayed_measurement(arm, body):
    """The step's torque is that of the moment of the measurement."""
    loop, like = pressed(arm, body, LAW, 1.5e-3, length=20)
    now, late = step(loop), step(replace(loop, delay=1))
    still = (like.references[0], like.anchors[0], like.parameters[0])
    output = now(like.state, *still)[1].full().ravel()
    rows = loop.outputs
    reading = [output[rows["depth"].start], output[rows["force"].start]]
    state = np.concatenate([like.state[:12], reading, like.state[-2:]])
    np.testing.assert_allclose(late(state, *still)[1].full().ravel(), output, rtol=1e-12)
    state[13] -= (
        1.0  # it measures 1 N less: it asks for more by gamma / slope, and compensates 1 N less
    )
    less = late(state, *still)[1].full().ravel()
    assert np.abs(less[rows["torque"]] - output[rows["torque"]]).max() > 0.1
    np.testing.assert_array_equal(less[: rows["torque"].start], output[: rows["torque"].start])


def test_friction_takes_from_the_acceleration_what_it_should(arm, body):
    """M qdd changes by -damping qdot - friction sign(qdot), far from rest."""
    rough = replace(arm, damping=np.full(6, 0.5), friction=np.arange(1.0, 7.0))
    loop, like = pressed(arm, body, LAW, 1.5e-3, length=20)
    speed = 0.2 * np.array([1, -1, 1, 1, -1, 1])
    like.state[6:12] = speed
    still = (like.state, like.references[0], like.anchors[0], like.parameters[0])
    smooth = step(loop)(*still)[0].full().ravel()
    dragged = step(replace(loop, arm=rough))(*still)[0].full().ravel()
    q = ca.SX.sym("q", 6)
    mass = ca.Function("m", [q], [arm.dynamics().mass_matrix(q)])(like.state[:6]).full()
    lost = mass @ (smooth - dragged)[6:12] / loop.dt
    np.testing.assert_allclose(lost, 0.5 * speed + np.arange(1.0, 7.0) * np.sign(speed), rtol=1e-9)


def test_friction_comes_from_the_urdf(arm):
    assert not arm.damping.any()
    assert not arm.friction.any()
    text = arm.urdf.replace(
        '<axis xyz="0 0 1"/>', '<axis xyz="0 0 1"/><dynamics damping="0.2" friction="1.5"/>'
    )
    rough = Arm.from_text(text)
    np.testing.assert_array_equal(rough.damping, np.full(6, 0.2))
    np.testing.assert_array_equal(rough.friction, np.full(6, 1.5))


def test_a_law_that_assumes_another_modulus_asks_for_another_speed(arm, body):
    """Without an arm, at the same depth: speed = gamma (f_ref - F) / slope, slope ~ E*."""
    loop, like = pressed(arm, body, LAW, 1.0e-3, length=20)
    free = replace(loop, mode="quasi_static")
    assuming = replace(LAW, effective_modulus=2.0 * loop.effective_modulus)
    state = np.concatenate([like.references[0, :3], [1.0, 0, 0, 0], like.state[-2:]])
    rest = (like.references[0], like.anchors[0], like.parameters[0])
    moves = [
        step(replace(free, law=law))(state, *rest)[0].full().ravel()[:3] - state[:3]
        for law in (LAW, assuming)
    ]
    assert np.linalg.norm(moves[0]) > 1e-6
    np.testing.assert_allclose(moves[0], 2.0 * moves[1], rtol=1e-9, atol=1e-15)


def test_a_delay_is_a_whole_number_of_steps(sphere):
    assert replace(sphere.loop, delay=5e-3).delay_steps == 5
    words = r"whole number of steps, got 1.6 ms, .*loop\.delay_ms = 2"
    with pytest.raises(ConfigError, match=words):
        replace(sphere.loop, delay=1.6e-3)


@pytest.mark.deep
@pytest.mark.parametrize("delay", [5e-3, 1e-2])
def test_a_delay_limits_gamma_and_says_so(sphere, delay):
    """The force error obeys s (s + L) + L gamma exp(-s T) = 0: its critical gamma, to 20 %."""
    rate = sphere.law.rate
    omega = brentq(lambda w: np.arctan(w / rate) + w * delay - np.pi / 2, 1.0, 1e4)
    critical = omega * np.hypot(omega, rate) / rate
    late = sphere.with_(loop=replace(sphere.loop, delay=delay))
    simulator, _ = prepare(late.with_(law=replace(sphere.law, gamma=0.8 * critical)))
    state, _ = simulator.rest_state(simulator.state[:6])
    np.testing.assert_array_equal(state[13:-2:2], 0.0)  # still in the air: the force is zero
    assert (state[12:-2:2] < 0).all()
    with pytest.raises(SimulationError, match=r"lower law\.gamma"):
        prepare(late.with_(law=replace(sphere.law, gamma=1.2 * critical)))
