"""The closed loop's step against closed forms: Hertz, the paper's steady error, free flight."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from meshskin.core.se3 import exp_so3, hat, transform
from meshskin.scene.settings import Law
from meshskin.simulation.closed_loop_dynamics import ClosedLoopDynamics
from meshskin.simulation.closed_loop_model import ClosedLoopModel, flat_anchor
from meshskin.simulation.integrators import step
from meshskin.simulation.rollout import StepBlock

E_STAR = 0.2e6 / (1 - 0.49**2)
PLACE = np.array([0.424, -0.424, 0.7])
MOUNT = transform(exp_so3([np.pi, 0, 0]), [0, 0, 0.12])


def pressed(arm, body, law, depth, dt=1e-3, length=50):
    """A loop at rest and a block of steps, the sphere pressed straight down to `depth`."""
    loop = ClosedLoopModel(arm, MOUNT, PLACE, 0.01, E_STAR, law, dt)
    pose = transform(np.eye(3), PLACE + np.array([0, 0, 0.11 - depth]))
    q = arm.solve(pose @ np.linalg.inv(MOUNT))
    block = StepBlock(loop, length)
    hit = body.closest(np.array([[0, 0, -0.11]]))
    block.anchors[:] = flat_anchor(body.surface.patches[hit.face[0]])
    block.state[:] = [*q, *np.zeros(6), *hit.uv[0]]
    block.references[:, :12] = [*pose[:3, 3], *pose[:3, :3].T.ravel()]
    return loop, block


def column(loop, block, name):
    return block.outputs[:, loop.outputs[name]]


def test_force_is_hertz_at_the_depth_of_the_pose(arm, body):
    loop, block = pressed(arm, body, Law(), 1.5e-3)
    block.run()
    radius = 1 / (1 / 0.1 + 1 / 0.01)
    expected = 4 / 3 * E_STAR * np.sqrt(radius) * 1.5e-3**1.5
    assert column(loop, block, "depth")[0, 0] == pytest.approx(1.5e-3, abs=1e-9)
    # the patch lies within some nm of the sphere, of 1.5 mm depth
    assert column(loop, block, "force")[0, 0] == pytest.approx(expected, rel=1e-5)
    np.testing.assert_allclose(column(loop, block, "point")[0], [0, 0, -0.1], atol=1e-8)
    np.testing.assert_allclose(column(loop, block, "normal")[0], [0, 0, -1], atol=1e-6)


def settled(arm, body, law, dt=1e-3):
    loop, block = pressed(arm, body, law, 1.5e-3, dt)
    for _ in range(round(5 / dt / 50)):
        block.run()
        block.state[:] = block.states[-1]
    return loop, block


def test_the_compensated_law_reaches_its_reference(arm, body):
    loop, block = settled(arm, body, Law())
    assert column(loop, block, "force")[-1, 0] == pytest.approx(3.0, abs=1e-6)


@pytest.mark.deep
def test_the_printed_law_leaves_its_steady_error(arm, body):
    """e / F = k_t n^T J L^-1 J^T n / gamma, with k_t the tangent stiffness at the settled depth."""
    law = Law(torque="paper", shape="identity", gain=1000.0, gamma=20.0)
    loop, block = settled(arm, body, law, dt=2e-4)
    force, depth = (column(loop, block, name)[-1, 0] for name in ("force", "depth"))
    q = block.state[:6]
    tip = arm.pose(q)
    lever = (tip @ MOUNT)[:3, 3] + (tip @ MOUNT)[:3, :3] @ [0, 0, -0.1] - tip[:3, 3]
    jacobian = arm.jacobian(q)
    row = jacobian[2] + np.cross(lever, [0, 0, 1]) @ jacobian[3:]
    stiffness = 1.5 * force / depth
    expected = stiffness * row @ row / 1000.0 / 20.0
    assert (3.0 - force) / force == pytest.approx(expected, rel=2e-3)
    assert force < 2.95


def test_in_the_air_the_body_comes_down_at_the_approach_speed(arm, body):
    loop, block = pressed(arm, body, Law(approach_speed=0.02), -4e-3)
    block.run()
    assert np.all(column(loop, block, "force") == 0)
    speed = np.diff(column(loop, block, "depth")[:, 0]) / loop.dt
    assert speed[-1] == pytest.approx(0.02, rel=2e-3)


def test_one_step_has_no_branch_and_is_finite_at_first_touch(arm, body):
    loop, block = pressed(arm, body, Law(), 0.0)
    block.run()
    assert np.isfinite(block.states).all()
    one = step(loop)
    x, r, a, p = (ca.MX.sym(n, one.size1_in(k)) for k, n in enumerate("xrap"))
    slope = ca.Function("slope", [x, r, a, p], [ca.jacobian(one(x, r, a, p)[0], x)])
    here = (block.states[0], block.references[0], block.anchors[0], block.parameters[0])
    assert np.isfinite(slope(*here).full()).all()


def wanted_twists(arm, loop, block):
    """Twists (6,) of the sphere's center and of the contact point, by the law's joint velocities.

    From rest the compensated law accelerates by rate times the velocities that it asks for.
    """
    block.run()
    qdot = block.states[0, 6:12] / (loop.dt * loop.law.rate)
    tip = arm.pose(block.state[:6])
    center = (tip @ MOUNT)[:3, 3]
    found = []
    for point in (center, np.add(center, [0.0, 0.0, -0.1])):
        jacobian = arm.jacobian(block.state[:6])
        jacobian[:3] -= hat(point - tip[:3, 3]) @ jacobian[3:]
        found.append(jacobian @ qdot)
    return found


@pytest.mark.parametrize("surface", ["sphere", "exact"])
def test_the_force_part_moves_the_sphere_along_the_normal(arm, body, surface):
    """At gamma (f_ref - F) / slope towards the indenter, and its center not to the side."""
    loop, block = pressed(arm, body, Law(surface=surface, approach_speed=0.5), 1e-3)
    center, _ = wanted_twists(arm, loop, block)
    force = column(loop, block, "force")[0, 0]
    speed = loop.law.gamma * (3.0 - force) / (1.5 * force / 1e-3)
    np.testing.assert_allclose(center[:3], [0.0, 0.0, -speed], atol=2e-5 * speed)


def test_the_path_part_moves_the_contact_point_with_the_references_twist(arm, body):
    """Its rotation to 1 %, which is lost by damping; its position to 1e-6; nothing along n."""
    depth = 3.0 ** (2 / 3) / (4 / 3 * E_STAR * np.sqrt(1 / 110)) ** (2 / 3)
    loop, block = pressed(arm, body, Law(), depth)  # at the reference force: no force part
    velocity, omega = np.array([0.01, -0.02, 0.03]), np.array([0.2, -0.1, 0.3])
    block.references[:, 12:] = [*velocity, *omega]
    _, contact = wanted_twists(arm, loop, block)
    moved = velocity + np.cross(omega, [0.0, 0.0, -0.1])
    np.testing.assert_allclose(contact[:2], moved[:2], atol=1e-5)
    assert abs(contact[2]) < 1e-5
    np.testing.assert_allclose(contact[3:], omega, atol=0.01 * np.linalg.norm(omega))


def test_the_payload_is_the_body_as_a_solid(sphere):
    """At the tip: m I of a solid sphere, 2/5 m r^2, and its center at the mount."""
    mount = transform(exp_so3([0.3, -0.2, 0.5]), [0.02, -0.03, 0.15])
    scene = sphere.with_(payload=2.0, mount=mount)
    heavy, q = ClosedLoopModel.of(scene).arm, np.array([0.2, -0.4, 0.3, 0.1, 0.5, -0.2])
    variable = ca.SX.sym("q", 6)
    mass, bare = (
        ca.Function("m", [variable], [a.dynamics().mass_matrix(variable)])(q).full()
        for a in (heavy, scene.arm)
    )
    tip = scene.arm.pose(q)
    jacobian = scene.arm.jacobian(q)
    jacobian[:3] -= hat((tip @ mount)[:3, 3] - tip[:3, 3]) @ jacobian[3:]
    solid = np.diag([2.0] * 3 + [0.4 * 2.0 * 0.1**2] * 3)
    np.testing.assert_allclose(mass - bare, jacobian.T @ solid @ jacobian, rtol=5e-3, atol=1e-5)


def terms(arm, body, law, depth):
    """(force, stiffness, unlimited) of the dynamics at rest at a depth, with qdot = 0."""
    loop, block = pressed(arm, body, law, depth)
    dynamics = ClosedLoopDynamics(loop, newton=4)
    _, q, qdot, contact_state = state = dynamics.state()
    now = dynamics.at(q, qdot, contact_state)
    function = ca.Function(
        "terms", [state[0], *dynamics.inputs], [now.force, now.stiffness, now.unlimited]
    )
    inputs = block.state, block.references[0], block.anchors[0]

    def at(lift):
        """With the indenter raised by `lift`, m: deeper by as much at the same posture."""
        raised = replace(loop, indenter_position=np.add(PLACE, [0.0, 0.0, lift]))
        there = ClosedLoopDynamics(raised, newton=4)
        here = there.at(q, qdot, contact_state)
        made = ca.Function("force", [state[0], *there.inputs], [here.force])
        return made(*inputs, block.parameters[0]).full().ravel()

    values = [part.full().ravel() for part in function(*inputs, block.parameters[0])]
    return values, (at(1e-7) - at(-1e-7)) / 2e-7


@pytest.mark.deep
@pytest.mark.parametrize(
    "law", [Law(), Law(torque="paper", shape="identity", gain=50.0), Law(torque="off")], ids=str
)
def test_the_stiffness_is_minus_the_derivative_of_the_force_by_the_depth(arm, body, law):
    (_, stiffness, unlimited), derivative = terms(arm, body, law, 1e-3)
    np.testing.assert_allclose(-derivative, stiffness, rtol=1e-4, atol=1e-3 * abs(stiffness).max())
    assert (unlimited == (law.torque != "off")).all()


@pytest.mark.deep
def test_at_its_torque_limit_a_joint_has_the_stiffness_of_the_contact_alone(arm, body):
    weak = replace(arm, effort_limit=np.full(6, 1e-6))
    (_, stiffness, unlimited), derivative = terms(weak, body, Law(), 1e-3)
    np.testing.assert_allclose(-derivative, stiffness, rtol=1e-4, atol=1e-3 * abs(stiffness).max())
    assert not unlimited.any()


@pytest.mark.parametrize("shape", ["inertia", "identity"])
def test_the_linearly_implicit_step_solves_its_equation(arm, body, shape):
    """(M + h L + h^2 a b^T) dv = h (f - h a (b . qdot)) at a speed into the contact."""
    loop, block = pressed(arm, body, Law(shape=shape, gain=5.0), 1e-3, 5e-3)
    loop = replace(loop, integrator="linearly_implicit")
    dynamics = ClosedLoopDynamics(loop)
    state, q, qdot, contact_state = dynamics.state()
    now = dynamics.at(q, qdot, contact_state)
    parts = [now.mass, now.force, now.stiffness, now.depth_gradient, now.unlimited]
    inputs = (block.state, block.references[0], block.anchors[0], block.parameters[0])
    block.state[6:12] = speed = 1e-2 * np.array([1.0, -2.0, 3.0, -1.0, 2.0, 0.5])
    found = ca.Function("parts", [state, *dynamics.inputs], parts)(*inputs)
    mass, force, a, b, unlimited = (np.squeeze(part.full()) for part in found)
    assert unlimited.all()
    gain = loop.law.rate * mass if shape == "inertia" else 5.0 * np.eye(6)
    h = loop.dt
    left = mass + h * gain + h**2 * np.outer(a, b)
    expected = np.linalg.solve(left, h * (force - h * a * (b @ speed)))
    after = step(loop)(*inputs)[0].full().ravel()
    np.testing.assert_allclose(after[6:12] - speed, expected, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(after[:6] - block.state[:6], h * after[6:12], atol=1e-14)
