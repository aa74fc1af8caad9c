"""The compliance law: against automatic differentiation, closed forms and limits."""

import casadi as ca
import numpy as np
import pytest

from meshskin.core.errors import ConfigError, UnknownNameError
from meshskin.core.se3 import exp_so3
from meshskin.geometry.body import Body
from meshskin.geometry.surface.patch import casadi_foot
from meshskin.scene.settings import Law
from meshskin.simulation.law import (
    damped_inverse,
    force_rows,
    force_speed,
    path_twist,
    slope_depth,
    touch_speed,
)


def zeta(delta, d, n):
    """The matrix zeta (3, 3) of eq. 10; delta, d in m, n (3,) the outward body normal."""
    nn = n @ n.T
    return -(delta * ca.sqrt(delta) / d) * (ca.DM.eye(3) - nn) + 1.5 * ca.sqrt(delta) * nn


def general_zeta(delta, n, shape):
    """The matrix Z (3, 6) of the module's docstring; on a sphere Z (v, omega) is zeta v_b."""
    turn = delta * ca.sqrt(delta)
    return ca.horzcat(1.5 * ca.sqrt(delta) * n @ n.T - turn * shape, -turn * ca.skew(n))


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
    slope = 1.5 * stiffness * np.sqrt(slope_depth(delta, 2e-3))
    got = float(force_speed(law, slope, delta, force))
    np.testing.assert_allclose(got * n, expected, rtol=1e-12)


def test_force_speed_before_touch_is_the_approach_speed():
    law = Law(approach_speed=0.05)
    slope = 1.5 * 3.1e4 * np.sqrt(slope_depth(-1e-3, 2e-3))
    assert float(force_speed(law, float(slope), -1e-3, 0.0)) == 0.05


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


def contact_force(body, face, uv, centre, twist, stiffness):
    """f_c in the world, normal and depth, for a small twist (v at the centre, omega)."""
    turn = ca.SX.eye(3) + ca.skew(twist[3:])
    # the body moves: in its own frame the indenter's centre moves the other way
    seen = turn.T @ (ca.DM(centre) - twist[:3] - ca.DM(centre)) + ca.DM(centre)
    patch = ca.DM(body.surface.patches[face])
    _, _, point, normal, _ = casadi_foot(patch, *uv, seen, 3)
    depth = 0.01 - ca.dot(normal, seen - point)
    return -stiffness * depth * ca.sqrt(depth) * (turn @ normal), normal, depth


@pytest.mark.parametrize("shape", ["sphere", "ellipsoid", "torus"])
def test_the_general_zeta_is_minus_the_derivative_of_the_contact_force(shape):
    """By automatic differentiation of the contact under the whole twist, on any surface."""
    body = {
        "sphere": lambda: Body.sphere(0.1),
        "ellipsoid": lambda: Body.ellipsoid((0.1, 0.07, 0.05)),
        "torus": lambda: Body.torus(0.1, 0.04),
    }[shape]()
    rng = np.random.default_rng(8)
    faces = rng.integers(len(body.mesh.faces), size=5)
    hit = body.surface.at(faces, np.full((5, 2), 0.3))
    for k in range(5):
        centre = hit.point[k] + 0.0085 * hit.normal[k]
        twist = ca.SX.sym("twist", 6)
        force, normal, depth = contact_force(body, faces[k], hit.uv[k], centre, twist, 3.1e4)
        turned = ca.jacobian(normal, twist[:3])  # dn by the centre's way: minus dn/dc
        values = ca.Function("v", [twist], [ca.jacobian(force, twist), normal, depth, -turned])
        by_ad, n, delta, dn = values(np.zeros(6))
        by_formula = -3.1e4 * np.array(general_zeta(delta, n, dn))
        np.testing.assert_allclose(by_formula, by_ad, rtol=1e-6, atol=1e-5)
        bends = np.sort(np.linalg.eigvalsh(0.5 * np.array(dn + dn.T)))
        expected = hit.curvature[k] / (1 + 0.0085 * hit.curvature[k])
        np.testing.assert_allclose(np.sort([*expected, 0.0]), bends, rtol=1e-4, atol=1e-6)


def test_on_the_sphere_the_general_law_is_the_papers():
    """Z (v, omega) = zeta v_b for the twist of a body that turns about its centre."""
    rng = np.random.default_rng(9)
    n = rng.normal(size=3)
    n /= np.linalg.norm(n)
    delta, d = 1.5e-3, 0.1085
    shape = (np.eye(3) - np.outer(n, n)) / d
    general = np.array(general_zeta(delta, ca.DM(n), ca.DM(shape)))
    paper = np.array(zeta(delta, d, ca.DM(n)))
    v, omega = rng.normal(size=3), rng.normal(size=3)
    at_indenter = v + np.cross(omega, d * n)
    np.testing.assert_allclose(general @ [*at_indenter, *omega], paper @ v, atol=1e-12)
    jacobian = rng.normal(size=(6, 6))  # at the body's centre
    moved = jacobian.copy()
    moved[:3] -= d * np.array(ca.DM(ca.skew(ca.DM(n)))) @ jacobian[3:]
    rows = np.array(force_rows(ca.DM(moved), ca.DM(n), ca.DM(shape), d))
    inverse = np.linalg.pinv(paper @ jacobian[:3])
    along = 1.5 * np.sqrt(delta)
    np.testing.assert_allclose(np.linalg.pinv(rows) @ n / along, inverse @ n, rtol=1e-8)


def test_without_contact_the_speed_grows_with_the_gap():
    """gamma (f_ref / slope + gap), at most the approach speed in either direction."""
    law, slope = Law(gamma=20.0, force_reference=3.0, approach_speed=0.1), 1e4
    for gap in (0.0, 1e-3, 3e-3):
        wanted = 20.0 * (3.0 / slope + gap)
        assert float(force_speed(law, slope, -gap, 0.0)) == pytest.approx(wanted)
    assert float(force_speed(law, slope, -1.0, 0.0)) == 0.1
    assert float(force_speed(law, slope, 1e-3, 1e9)) == -0.1
    assert float(force_speed(law, slope, 1e-3, 3.0)) == 0.0


def test_the_touch_speed_is_the_force_speed_at_the_reference_slope():
    """Hertz: f_ref = K d^(3/2), slope 3/2 K d^(1/2) at the depth of `slope_depth`."""
    law, depth = Law(gamma=20.0, approach_speed=1.0), 8e-4
    stiffness = law.force_reference / depth**1.5
    slope = 1.5 * stiffness * np.sqrt(float(slope_depth(0.0, depth)))
    expected = float(force_speed(law, slope, 0.0, 0.0))
    assert touch_speed(law, depth) == pytest.approx(expected, rel=1e-9)
    assert touch_speed(Law(gamma=20.0, approach_speed=1e-3), depth) == 1e-3


def twist(pose_error, reference_twist, ahead=0.0, track_normal=0.0):
    """`path_twist` of a body at the origin whose reference differs by (rotation vector, shift)."""
    reference = [*pose_error[3:], *exp_so3(pose_error[:3]).T.ravel(), *reference_twist]
    found = path_twist(
        ca.DM(reference), 7.0, ca.DM.zeros(3), ca.DM.eye(3), ca.DM([0.0, 0.0, -0.1]),
        ca.DM([0.0, 0.0, -1.0]), track_normal, ahead,
    )  # fmt: skip
    return np.concatenate([np.array(part).ravel() for part in found])


def test_the_path_twist_follows_the_reference_to_first_order():
    """omega = omega_ref + k log(R_ref R^T), v = v_ref + k (x_ref - x) + omega x lever."""
    rotation, shift = np.array([2e-4, -1e-4, 3e-4]), np.array([1e-3, 2e-3, -5e-4])
    velocity, omega = np.array([0.02, -0.01, 0.03]), np.array([0.1, 0.2, -0.3])
    found = twist([*rotation, *shift], [*velocity, *omega], track_normal=1.0)
    spin = omega + 7.0 * rotation
    moved = velocity + 7.0 * shift + np.cross(spin, [0.0, 0.0, -0.1])
    np.testing.assert_allclose(found, [*spin, *moved], atol=1e-9)
    held = twist([*rotation, *shift], [*velocity, *omega])
    np.testing.assert_allclose(held, [*spin, *moved[:2], 0.0], atol=1e-9)
    # `ahead` seconds later the reference has moved on by its own twist
    later = twist([*rotation, *shift], [*velocity, *omega], ahead=0.01, track_normal=1.0)
    now = [*(rotation + 0.01 * omega), *(shift + 0.01 * velocity)]
    np.testing.assert_allclose(later, twist(now, [*velocity, *omega], 0.0, 1.0), atol=2e-5)


def test_a_damped_row_loses_the_square_of_its_damping():
    """One row j: |j| x / (j^2 + damping^2)."""
    found = damped_inverse(ca.DM([[2.0, 0.0]]), ca.DM([0.5]), ca.DM([3.0]))
    np.testing.assert_allclose(np.array(found).ravel(), [2.0 * 3.0 / 4.25, 0.0])
