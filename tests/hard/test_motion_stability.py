"""The closed loop where it is hard: stiff and soft, fast, at edges and limits, against CVODES."""

import re
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from meshskin import Body, Law, Material
from meshskin.errors import ReachError, SimulationError
from meshskin.motion import stability
from meshskin.motion.arm import Arm
from meshskin.motion.loop import Loop
from meshskin.motion.machine import Machine
from meshskin.motion.phases import SLIDE
from meshskin.motion.track import STAY, Track
from meshskin.se3 import hat
from meshskin.simulation import prepare, run

NU = 0.49
RADIUS = 1 / 110  # relative, of the sphere and the indenter
CURVATURE = np.array([10.0, 10.0])  # of the sphere
INTEGRATORS = ("semi_implicit", "linearly_implicit", "rk4")


@pytest.fixture(scope="module")
def base(sphere):
    """Machine and path of the paper's scene."""
    return prepare(sphere.with_(loop=replace(sphere.loop, compile="never")))


@pytest.fixture(scope="module")
def place(base, sphere):
    """A machine of the paper's scene before its touch, with another contact, law and integrator."""
    base, path = base
    arm, tip = base.loop.arm, np.linalg.inv(sphere.mount_pose)
    home = base.state[:6].copy()

    def at(*, young=2e5, speed=0.0, gap=0.0, law=None, body=None, **loop):
        made = replace(
            base.loop,
            effective_modulus=young / (1 - NU**2),
            law=law or replace(sphere.law, approach_speed=max(speed, 1e-3)),
            **loop,
        )
        pose = path.poses[0].copy()
        pose[2, 3] = made.indenter_position[2] + 0.11 + gap
        q = arm.inverse_kinematics((pose @ tip)[None], home)[0]
        lever = pose[:3, 3] - arm.pose(q)[:3, 3]
        jacobian = arm.jacobian(q)
        jacobian[:3] -= hat(lever) @ jacobian[3:]
        machine = Machine(body or sphere.body, made, q, path.points[0])
        machine.state[6:12] = np.linalg.solve(jacobian, [0, 0, -speed, 0, 0, 0])
        stiffness = 4 / 3 * made.effective_modulus * np.sqrt(RADIUS)
        row = path.references[:1].copy()
        row[0, 2] = pose[2, 3] - gap - (3.0 / stiffness) ** (2 / 3)
        row[0, 12:] = 0.0
        return machine, Track(row, np.array([machine.face]), STAY[None]).hold(0, 32)

    return at


def forces(machine, track, steps):
    found, done = [], 0
    while done < steps:
        out = machine.advance(track, 0).outputs
        assert np.isfinite(out).all()
        found.append(out[:, 6])
        done += len(out)
    return np.concatenate(found)[:steps]


def longest(place, young, speed, integrator):
    machine, track = place(young=young, speed=speed, integrator=integrator)
    q, loop = machine.state[:6], machine.loop
    accurate = stability.touch_limit(loop, stability.inertia(loop, q), CURVATURE, speed)
    most = min(accurate, stability.LONGEST)
    return stability.stable_limit(machine, q, track.references[0], most)


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize(
    ("young", "speed"),
    [
        *((1e4, 0.5), (2e5, 0.5), (2e5, 0.05), (1e7, 0.5), (1e7, 0.05)),
        *((1e9, 0.5), (1e9, 0.05), (1e9, 1e-3), (2e11, 0.5), (2e11, 0.05), (2e11, 1e-3)),
    ],
)
def test_at_the_longest_step_the_touch_keeps_its_stated_error(place, young, speed, integrator):
    dt = longest(place, young, speed, integrator)
    assert 1e-5 <= dt <= 1e-2
    found = {}
    for name in (integrator, "cvodes"):
        machine, track = place(
            young=young, speed=speed, gap=2.5 * speed * dt, integrator=name, dt=dt
        )
        found[name] = forces(machine, track, 60)
    peak = max(found["cvodes"].max(), 3.0)
    assert found["cvodes"].max() > 0
    assert np.abs(found[integrator] - found["cvodes"]).max() <= stability.ERROR * peak


@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("shape", ["inertia", "identity"])
def test_a_step_too_long_is_refused_and_the_step_named_works(sphere, integrator, shape):
    def scene(dt):
        law = Law(shape=shape, gain=1000.0, approach_speed=0.05)
        loop = replace(sphere.loop, dt=dt, integrator=integrator, compile="never")
        return sphere.with_(material=Material(young=1e8), law=law, loop=loop)

    with pytest.raises(SimulationError, match=r"too long to .*loop\.dt_ms = 10,") as caught:
        prepare(scene(0.01))
    named = float(re.search(r"set loop.dt_ms = ([\d.e-]+)", str(caught.value))[1])
    assert 1e-2 < named < 10
    machine, path = prepare(scene(named * 1e-3))
    track = Track.of(path, sphere.body.surface).hold(0, 256)
    found = forces(machine, track, round(1000 / named))
    assert found.max() > 0
    assert abs(found[-1] - 3.0) < 0.05


def test_a_loop_that_no_step_can_save_is_named(place, monkeypatch):
    machine, track = place(integrator="rk4")
    monkeypatch.setattr(stability, "spectral_radius", lambda *_: 2.0)
    with pytest.raises(SimulationError, match=r"unstable at every step, got law.gamma = 50"):
        stability.stable_limit(machine, machine.state[:6], track.references[0], 1e-3)


def test_convergence_orders(place):
    """Error of the state after 16 ms in contact against CVODES, over the step: slopes 1, 1, 4."""
    law = Law(approach_speed=1.0, force_reference=3.0)  # no limit is met: the field is smooth

    def end(integrator, dt):
        machine, track = place(gap=-1.8e-3, law=law, integrator=integrator, dt=dt)
        machine.state[11] = 0.3  # spin, and the path's pull against it
        for _ in range(round(0.016 / dt / 4)):
            forces(machine, track[:4], 4)
        return machine.state[:12].copy()

    exact = end("cvodes", 4e-3)
    for integrator, order, steps in (
        ("semi_implicit", 1, (1e-3, 5e-4, 2.5e-4)),
        ("linearly_implicit", 1, (1e-3, 5e-4, 2.5e-4)),
        ("rk4", 4, (2e-3, 1e-3, 5e-4)),
    ):
        errors = [np.linalg.norm(end(integrator, dt) - exact) for dt in steps]
        slope = np.polyfit(np.log(steps), np.log(errors), 1)[0]
        assert slope == pytest.approx(order, abs=0.25), integrator


LEVER = """<robot name="lever"><link name="root"/>
  <joint name="hinge" type="revolute"><parent link="root"/><child link="bar"/>
    <origin xyz="0 0 1"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="1000" velocity="10"/></joint>
  <link name="bar"><inertial><mass value="2"/><origin xyz="0.4 0 0"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="flange" type="fixed"><parent link="bar"/><child link="tool0"/>
    <origin xyz="0.5 0 0"/></joint><link name="tool0"/></robot>"""


def test_energy_does_not_drift_over_10000_contact_periods(sphere):
    """A lever that lies on the indenter by its weight, without control: the contact is a spring."""
    arm, modulus = Arm.from_text(LEVER), 1e7
    stiffness = 4 / 3 * modulus * np.sqrt(RADIUS)
    inertia, weight = 0.01 + 2 * 0.4**2, 2 * 9.80665 * 0.4
    depth = (weight / 0.5 / stiffness) ** (2 / 3)
    omega = np.sqrt(1.5 * stiffness * np.sqrt(depth) * 0.5**2 / inertia)
    dt = 2 * np.pi / omega / 64
    loop = Loop(
        arm, np.eye(4), np.array([0.5, 0.0, 0.89 + depth]), 0.01, modulus, Law(torque="off"), dt
    )
    machine = Machine(sphere.body, loop, np.array([-depth]), np.array([0.0, 0.0, -0.1]))
    track = Track(np.zeros((1, 18)), np.array([machine.face]), STAY[None]).hold(0, 256)
    means, values = [], np.array(loop.parameters.values)
    while machine.steps < 10_000 * 64:
        states, outputs = machine.stretch.run(machine.state, track, values, False)
        machine.state[:] = states[-1]
        machine.steps += len(outputs)
        angle, speed = states[:-1, 0], states[:-1, 1]
        pressed = np.maximum(outputs[:, 7], 0.0)
        energy = 0.5 * inertia * speed**2 - weight * np.sin(angle)
        means.append(np.mean(energy + 0.4 * stiffness * pressed**2.5))
    rest = -weight * np.sin(0.0) + 0.4 * stiffness * depth**2.5
    assert machine.steps >= 640_000
    swing = np.mean(means[:25]) - rest
    assert swing > 0
    assert abs(np.mean(means[-25:]) - np.mean(means[:25])) < 1e-4 * swing


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_contact_that_is_lost_comes_back(place, integrator):
    """Thrown off the indenter at 0.3 m/s: touches again and holds, as CVODES has it."""
    found = {}
    for name in (integrator, "cvodes"):
        machine, track = place(
            young=1e7, gap=-1e-4, speed=-0.3, law=Law(approach_speed=0.1), dt=3e-4, integrator=name
        )
        found[name] = forces(machine, track, 600)
    mine, exact = found[integrator], found["cvodes"]
    assert (exact == 0).any()
    assert exact[0] > 0
    assert mine[-1] == pytest.approx(3.0, rel=0.1)
    assert np.abs(mine - exact).max() < stability.ERROR * max(exact.max(), 3.0)


@pytest.mark.parametrize("integrator", [*INTEGRATORS, "cvodes"])
def test_touch_without_penetration_and_depth_zero_are_finite(place, integrator):
    machine, track = place(gap=0.0, integrator=integrator)
    found = forces(machine, track, 64)
    assert found[0] == pytest.approx(0.0, abs=1e-3)
    assert found[-1] > 0


def test_a_singular_posture_stays_finite_and_holds_the_force(sphere, base):
    """The Puma's wrist straight: two axes in line."""
    machine, _ = base
    arm, law = machine.loop.arm, Law(approach_speed=0.05)
    q = np.array([0.0, 0.9, -2.6, 0.0, 0.0, 0.0])
    assert np.linalg.cond(arm.jacobian(q)) > 1e6
    pose = arm.pose(q) @ sphere.mount_pose
    down = pose[:3, :3].T @ [0, 0, -1.0]
    foot = pose[:3, 3] + pose[:3, :3] @ (0.1 * down)
    loop = replace(machine.loop, law=law, indenter_position=foot - np.array([0, 0, 0.012]), dt=1e-3)
    there = Machine(sphere.body, loop, q, 0.1 * down)
    row = np.concatenate([pose[:3, 3], pose[:3, :3].T.ravel(), np.zeros(6)])
    track = Track(row[None], np.array([there.face]), STAY[None]).hold(0, 32)
    found = forces(there, track, 1500)
    assert found[-1] == pytest.approx(3.0, abs=0.05)


def test_a_joint_limit_is_named_with_time_and_posture(place):
    machine, track = place(gap=1e-3)
    machine.state[11] = 60.0  # the last joint spins, as fast as nothing brakes
    free = replace(machine.loop, law=Law(torque="off"))
    spun = Machine(machine.body, free, machine.state[:6], machine.body.mesh.vertices[0])
    spun.state[:] = machine.state
    with pytest.raises(ReachError, match=r"joint6 left its range at t = 0\.\d+ s, q = .*rad"):
        forces(spun, track, 2000)


def test_an_edge_of_the_body_is_named(place):
    """A cube slides over its indenter until the edge."""
    box = Body(name="box", mesh=trimesh.creation.box((0.2, 0.2, 0.2)).subdivide().subdivide())
    machine, track = place(body=box, law=Law(approach_speed=0.05))
    moving = track.references.copy()
    moving[:, 12] = 0.4
    time = 0.0
    with pytest.raises(SimulationError, match=r"over an edge of the body at t = .*round the edge"):
        while time < 0.5:
            moving[:, 0] = track.references[:, 0] + 0.4 * (time + 1e-3 * np.arange(len(track)))
            steps = machine.advance(replace(track, references=moving), 2)
            time += 1e-3 * len(steps.time)


def test_numbers_of_the_stated_limits(place):
    """Touch times by the formula, for the paper's sphere."""
    machine, _ = place(speed=0.1)
    slow = stability.touch_limit(machine.loop, 5.0, CURVATURE, 0.1)
    wanted = (3.0 / (4 / 3 * 2e5 / (1 - NU**2) * np.sqrt(RADIUS))) ** (2 / 3)
    assert slow == pytest.approx(0.2 * wanted / 0.1)


def slid(scene, count, **loop):
    """Forces (count,) from the first step of sliding on."""
    machine, path = prepare(scene.with_(loop=replace(scene.loop, compile="never", **loop)))
    found = []
    for steps in run(scene, machine, path):
        if steps.phase == SLIDE:
            found.extend(steps.outputs[:, 6])
        if len(found) >= count:
            return np.array(found[:count])
    raise AssertionError("the path is too short")


def test_sliding_at_half_a_metre_a_second_keeps_to_the_reference(sphere):
    fast = sphere.with_(
        exploration=replace(
            sphere.exploration, speed=0.5, turn_rate=6.0, lane_spacing=0.02, settle=0.1
        )
    )
    exact = slid(fast, 6000, integrator="rk4", dt=2.5e-4)[::4]  # of a path sampled finer, too
    assert np.abs(exact - 3.0).max() > 0.01  # it is disturbed
    for integrator, error in (("semi_implicit", 0.02), ("linearly_implicit", 0.02), ("rk4", 0.01)):
        assert np.abs(slid(fast, 1500, integrator=integrator) - exact).max() < error, integrator
    without = slid(fast, 1500, mode="quasi_static")
    fine = slid(fast, 15000, mode="quasi_static", dt=1e-4)[::10]
    assert np.abs(without - fine).max() < 0.02


@pytest.mark.parametrize("young", [1e4, 2e5, 1e9])
def test_the_quasi_static_touch_keeps_its_stated_error(sphere, young):
    """Without an arm the depth falls at the law's own speed: against steps a tenth as long."""
    law = replace(sphere.law, approach_speed=0.05 if young < 1e8 else 1e-3)
    scene = sphere.with_(
        material=Material(young=young),
        law=law if young > 1e4 else replace(law, force_reference=0.02),
        exploration=replace(sphere.exploration, lane_spacing=0.02, standoff=1e-4),
    )
    touch = {}
    for dt in (1e-3, 1e-4):
        loop = replace(scene.loop, mode="quasi_static", dt=dt, compile="never")
        machine, path = prepare(scene.with_(loop=loop))
        found = forces(machine, Track.of(path, sphere.body.surface).hold(0, 256), round(0.3 / dt))
        touch[dt] = found[:: round(1e-3 / dt)]
    reference = scene.law.force_reference
    assert touch[1e-4][-1] == pytest.approx(reference, rel=0.02)
    assert np.abs(touch[1e-3] - touch[1e-4]).max() <= stability.ERROR * reference
