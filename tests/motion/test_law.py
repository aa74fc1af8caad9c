"""The compliance law: zeta against automatic differentiation, its normal inverse, its limits."""

import casadi as ca
import numpy as np
import pytest

from meshskin.errors import ConfigError, UnknownNameError
from meshskin.motion.law import Law, damped_inverse, force_speed, zeta


def test_zeta_is_minus_the_derivative_of_the_contact_force():
    """d f_c / dt = -K_c zeta v for the paper's sphere: derived by automatic differentiation."""
    centre, indenter = ca.SX.sym("x_b", 3), ca.SX.sym("x_e", 3)
    r_b, r_e, stiffness = 0.1, 0.01, 3.1e4
    d = ca.norm_2(indenter - centre)
    n, delta = (indenter - centre) / d, r_b + r_e - d
    force = -stiffness * delta**1.5 * n
    exact = ca.jacobian(force, centre)
    check = ca.Function("check", [centre, indenter], [exact, -stiffness * zeta(delta, d, n)])
    rng = np.random.default_rng(5)
    for _ in range(20):
        direction = rng.normal(size=3)
        direction *= (0.11 - rng.uniform(1e-4, 4e-3)) / np.linalg.norm(direction)
        by_ad, by_formula = check(np.zeros(3), direction)
        np.testing.assert_allclose(by_formula, by_ad, rtol=1e-10, atol=1e-7)


def test_force_speed_is_the_inverse_of_zeta_along_the_normal():
    law = Law(gamma=7.0, approach_speed=1.0)
    stiffness, delta, d = 3.1e4, 1.7e-3, 0.1083
    n = np.array([0.0, 0.6, 0.8])
    force = stiffness * delta**1.5
    error = (law.force_reference - force) * n
    expected = (
        law.gamma / stiffness * np.linalg.solve(np.array(ca.DM(zeta(delta, d, ca.DM(n)))), error)
    )
    got = float(force_speed(law, stiffness, delta, force, 2e-3))
    np.testing.assert_allclose(got * n, expected, rtol=1e-12)


def test_force_speed_before_touch_is_the_approach_speed():
    law = Law(approach_speed=0.05)
    assert float(force_speed(law, 3.1e4, -1e-3, 0.0, 2e-3)) == 0.05


def test_damped_inverse_is_the_pseudo_inverse_without_damping_and_finite_when_singular():
    rng = np.random.default_rng(6)
    jacobian, twist = rng.normal(size=(3, 6)), rng.normal(size=3)
    got = np.array(damped_inverse(ca.DM(jacobian), ca.DM.zeros(3), ca.DM(twist))).ravel()
    np.testing.assert_allclose(got, np.linalg.pinv(jacobian) @ twist, rtol=1e-10)
    jacobian[2] = jacobian[1]
    got = np.array(damped_inverse(ca.DM(jacobian), 0.01 * ca.DM.ones(3), ca.DM(twist)))
    assert np.isfinite(got).all()


def test_wrong_gains_are_named():
    with pytest.raises(ConfigError, match=r"law.gamma .* got -1 1/s, limit: above 0 1/s"):
        Law(gamma=-1)
    with pytest.raises(UnknownNameError, match="did you mean paper"):
        Law(torque="papper")
