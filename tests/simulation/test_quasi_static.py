"""Without an arm the body moves exactly at the law's velocity: one step against closed forms."""

import numpy as np
import pytest

from meshskin.core.se3 import exp_so3, log_so3, poses_of_states, transform
from meshskin.scene.settings import Law
from meshskin.simulation.closed_loop_model import ClosedLoopModel, flat_anchor, state_of_pose
from meshskin.simulation.integrators import step

INDENTER, MODULUS, DT = np.array([0.4, -0.3, 0.7]), 2.6e5, 1e-4
ROTATION = exp_so3([0.6, -0.9, 0.3])


def one_step(arm, body, depth, velocity, omega, track_normal=0.0):
    """Poses before and after a step, and the force, of a sphere pressed down on the indenter."""
    law = Law(gamma=20.0, approach_speed=0.5)
    loop = ClosedLoopModel(arm, np.eye(4), INDENTER, 0.01, MODULUS, law, DT, mode="quasi_static")
    pose = transform(ROTATION, np.add(INDENTER, [0.0, 0.0, 0.11 - depth]))
    hit = body.closest((ROTATION.T @ [0.0, 0.0, -0.11])[None])
    state = [*state_of_pose(pose), *hit.uv[0]]
    reference = [*pose[:3, 3], *ROTATION.T.ravel(), *velocity, *omega]
    parameters = [*loop.parameters.values[:-1], track_normal]
    anchor = flat_anchor(body.surface.patches[hit.face[0]])
    after, output = (x.full().ravel() for x in step(loop)(state, reference, anchor, parameters))
    assert np.linalg.norm(after[3:7]) == pytest.approx(1.0, abs=1e-14)
    return pose, poses_of_states(after[None])[0], output[loop.outputs["force"].start]


@pytest.mark.parametrize("track_normal", [0.0, 1.0])
def test_the_contact_point_moves_with_the_path_and_the_force_part(arm, body, track_normal):
    depth, velocity, omega = 1e-3, np.array([0.02, -0.05, 0.03]), np.array([0.5, -0.3, 0.8])
    before, after, force = one_step(arm, body, depth, velocity, omega, track_normal)
    assert force == pytest.approx(4 / 3 * MODULUS * np.sqrt(depth**3 / 110), rel=1e-4)
    down, lever = np.array([0.0, 0.0, -1.0]), np.array([0.0, 0.0, -0.1])
    moved = velocity + np.cross(omega, lever)
    if not track_normal:  # the law's speed along the normal in place of the path's
        speed = 20.0 * (3.0 - force) / (1.5 * force / depth)
        moved += (speed - moved @ down) * down
    origin = (after - before)[:3, 3] / DT
    np.testing.assert_allclose(origin, moved - np.cross(omega, lever), atol=1e-5)
    turn = log_so3(after[:3, :3] @ ROTATION.T) / DT
    np.testing.assert_allclose(turn, omega, atol=1e-6)


def test_state_and_pose_are_inverse():
    vectors = np.linspace(-2.0, 2.0, 21).reshape(7, 3)
    poses = transform(exp_so3(vectors), 1.0 + vectors)
    np.testing.assert_allclose(poses_of_states(state_of_pose(poses)), poses, atol=1e-14)
