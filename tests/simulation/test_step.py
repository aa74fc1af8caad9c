"""The closed loop's step against closed forms: Hertz, the paper's steady error, free flight."""

import casadi as ca
import numpy as np
import pytest

from meshskin.core.se3 import exp_so3, transform
from meshskin.scene.settings import Law
from meshskin.simulation.closed_loop_model import ClosedLoopModel, flat_anchor
from meshskin.simulation.step import StepBlock, step

E_STAR = 0.2e6 / (1 - 0.49**2)
PLACE = np.array([0.424, -0.424, 0.7])
MOUNT = transform(exp_so3([np.pi, 0, 0]), [0, 0, 0.12])


def pressed(arm, body, law, depth, dt=1e-3):
    """A loop at rest, the sphere pressed straight down on the indenter to `depth`."""
    loop = ClosedLoopModel(arm, MOUNT, PLACE, 0.01, E_STAR, law, dt)
    pose = transform(np.eye(3), PLACE + np.array([0, 0, 0.11 - depth]))
    q = arm.solve(pose @ np.linalg.inv(MOUNT))
    blocks = StepBlock(loop, 50)
    hit = body.closest(np.array([[0, 0, -0.11]]))
    blocks.anchors[:] = flat_anchor(body.surface.patches[hit.face[0]])
    blocks.state[:] = [*q, *np.zeros(6), *hit.uv[0]]
    blocks.references[:, :12] = [*pose[:3, 3], *pose[:3, :3].T.ravel()]
    return loop, blocks


def column(loop, blocks, name):
    return blocks.outputs[:, loop.outputs[name]]


def test_force_is_hertz_at_the_depth_of_the_pose(arm, body):
    loop, blocks = pressed(arm, body, Law(), 1.5e-3)
    blocks.run()
    radius = 1 / (1 / 0.1 + 1 / 0.01)
    expected = 4 / 3 * E_STAR * np.sqrt(radius) * 1.5e-3**1.5
    assert column(loop, blocks, "depth")[0, 0] == pytest.approx(1.5e-3, abs=1e-9)
    # the patch lies within some nm of the sphere, of 1.5 mm depth
    assert column(loop, blocks, "force")[0, 0] == pytest.approx(expected, rel=1e-5)
    np.testing.assert_allclose(column(loop, blocks, "point")[0], [0, 0, -0.1], atol=1e-8)
    np.testing.assert_allclose(column(loop, blocks, "normal")[0], [0, 0, -1], atol=1e-6)


def settled(arm, body, law, dt=1e-3):
    loop, blocks = pressed(arm, body, law, 1.5e-3, dt)
    for _ in range(round(5 / dt / 50)):
        blocks.run()
        blocks.state[:] = blocks.states[-1]
    return loop, blocks


def test_the_compensated_law_reaches_its_reference(arm, body):
    loop, blocks = settled(arm, body, Law())
    assert column(loop, blocks, "force")[-1, 0] == pytest.approx(3.0, abs=1e-6)


def test_the_printed_law_leaves_its_steady_error(arm, body):
    """e / F = k_t n^T J L^-1 J^T n / gamma, with k_t the tangent stiffness at the settled depth."""
    law = Law(torque="paper", shape="identity", gain=1000.0, gamma=20.0)
    loop, blocks = settled(arm, body, law, dt=2e-4)
    force, depth = (column(loop, blocks, name)[-1, 0] for name in ("force", "depth"))
    q = blocks.state[:6]
    tip = arm.pose(q)
    lever = (tip @ MOUNT)[:3, 3] + (tip @ MOUNT)[:3, :3] @ [0, 0, -0.1] - tip[:3, 3]
    jacobian = arm.jacobian(q)
    row = jacobian[2] + np.cross(lever, [0, 0, 1]) @ jacobian[3:]
    stiffness = 1.5 * force / depth
    expected = stiffness * row @ row / 1000.0 / 20.0
    assert (3.0 - force) / force == pytest.approx(expected, rel=2e-3)
    assert force < 2.95


def test_in_the_air_the_body_comes_down_at_the_approach_speed(arm, body):
    loop, blocks = pressed(arm, body, Law(approach_speed=0.02), -4e-3)
    blocks.run()
    assert np.all(column(loop, blocks, "force") == 0)
    speed = np.diff(column(loop, blocks, "depth")[:, 0]) / loop.dt
    assert speed[-1] == pytest.approx(0.02, rel=2e-3)


def test_one_step_has_no_branch_and_is_finite_at_first_touch(arm, body):
    loop, blocks = pressed(arm, body, Law(), 0.0)
    blocks.run()
    assert np.isfinite(blocks.states).all()
    one = step(loop)
    x, r, a, p = (ca.MX.sym(n, one.size1_in(k)) for k, n in enumerate("xrap"))
    slope = ca.Function("slope", [x, r, a, p], [ca.jacobian(one(x, r, a, p)[0], x)])
    here = (blocks.states[0], blocks.references[0], blocks.anchors[0], blocks.parameters)
    assert np.isfinite(slope(*here).full()).all()
