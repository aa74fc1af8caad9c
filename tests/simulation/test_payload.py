"""The body's mass at the arm's tip against pinocchio."""

import subprocess
import sys
from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
import trimesh

import meshskin as ms
from meshskin.core.se3 import exp_so3, transform
from meshskin.geometry.region import Cap
from meshskin.robot.dynamics import GRAVITY
from meshskin.simulation import closed_loop_model
from meshskin.simulation.closed_loop_model import ClosedLoopModel


def test_the_mass_of_an_eccentric_body_is_mounted_with_its_pose():
    """Mass matrix and gravity torque of the arm with pinocchio's inertia of the body at the mount,
    for a body whose centre of mass is off its origin and a mount that turns it.
    """
    pin = pytest.importorskip("pinocchio")
    ball = ms.Body.sphere(0.05)
    mesh = ball.mesh.copy()
    mesh.apply_translation([0.03, -0.02, 0.04])
    body = ms.Body(name="eccentric", mesh=mesh)
    mount = transform(exp_so3(np.array([0.7, -0.4, 1.1])), [0.02, 0.01, 0.1])
    skin = ms.Skin.cover(body, spacing=6e-3, count=5, region=Cap((0.0, 0.0, -1.0)))
    scene = ms.Scene(body=body, skin=skin, mount=mount, payload=1.7)
    loaded, bare = ClosedLoopModel.of(scene).arm, scene.arm

    model = pin.buildModelFromXML(bare.urdf)
    model.armature, model.gravity.linear = bare.reflected_inertia, GRAVITY
    density = scene.payload / mesh.volume
    inertia = pin.Inertia(scene.payload, mesh.center_mass, density * mesh.moment_inertia)
    frame = model.frames[model.getFrameId(bare.tip)]
    placement = frame.placement * pin.SE3(mount)
    model.appendBodyToJoint(frame.parentJoint, inertia, placement)
    data = model.createData()

    q = np.array([0.4, 0.7, -2.1, 0.9, 0.6, 1.3])
    symbols = ca.SX.sym("q", 6), ca.SX.sym("qd", 6)
    dynamics = loaded.dynamics()
    f = ca.Function("f", list(symbols), [dynamics.mass_matrix(symbols[0]), dynamics.bias(*symbols)])
    mass, bias = (x.full() for x in f(q, 0.5 * q))
    expected = np.triu(pin.crba(model, data, q))
    np.testing.assert_allclose(mass, expected + np.triu(expected, 1).T, atol=1e-10)
    np.testing.assert_allclose(bias[:, 0], pin.nonLinearEffects(model, data, q, 0.5 * q), atol=1e-9)


@pytest.mark.parametrize("inverted", [False, True])
def test_an_open_body_weighs_as_its_convex_hull_and_a_quasi_static_loop_asks_no_mass(inverted):
    """A dome without its base, and the same inside out: neither encloses a volume."""
    mesh = ms.Body.sphere(0.05).mesh.copy()
    mesh.update_faces(mesh.triangles_center[:, 2] < 0.0)
    if inverted:
        mesh.invert()
    body = ms.Body(name="dome", mesh=mesh)
    skin = ms.Skin.cover(body, spacing=6e-3, count=5, region=Cap((0.0, 0.0, -1.0)))
    scene = ms.Scene(body=body, skin=skin, payload=1.7)
    hull = scene.with_(body=ms.Body(name="hull", mesh=mesh.convex_hull))
    assert ClosedLoopModel.of(scene).arm.urdf == ClosedLoopModel.of(hull).arm.urdf
    still = scene.with_(loop=replace(scene.loop, mode="quasi_static"))
    assert ClosedLoopModel.of(still).arm is scene.arm


def test_moments_of_a_solid_are_those_of_trimesh():
    """Of a cone, whose corners are not about its centre."""
    cone = trimesh.creation.cone(0.05, 0.2, sections=16)
    cone.apply_translation([0.1, -0.2, 0.3])
    volume, centre, square = closed_loop_model._moments(np.asarray(cone.triangles))
    assert volume == pytest.approx(cone.volume)
    np.testing.assert_allclose(centre, cone.center_mass)
    inertia = np.trace(square) * np.eye(3) - square
    np.testing.assert_allclose(inertia, cone.moment_inertia, atol=1e-12)


@pytest.mark.deep
def test_the_loop_of_a_primitive_is_made_without_trimesh():
    """Its import takes 0.6 s."""
    code = """
import sys, meshskin as ms
from meshskin.simulation import closed_loop_model
from meshskin.simulation.closed_loop_model import ClosedLoopModel
scene = ms.Scene.load("sphere")
assert ClosedLoopModel.of(scene).arm is not scene.arm
assert "trimesh" not in sys.modules
"""
    subprocess.run([sys.executable, "-c", code], check=True)
