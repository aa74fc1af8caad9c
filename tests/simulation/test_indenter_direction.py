"""Indenters that do not point straight up, and arms that do not stand at the world's origin."""

import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np
import pytest

import meshskin as ms
from meshskin.core import codegen
from meshskin.core.errors import ConfigError, ReachError
from meshskin.core.se3 import exp_so3, transform
from meshskin.estimation.uncertainty import metrics
from meshskin.exploration.plan import plan_exploration
from meshskin.geometry.region import Cap
from meshskin.robot import dynamics
from meshskin.robot.arm import Arm
from meshskin.scene.file import read_tables
from meshskin.simulation.closed_loop_model import ClosedLoopModel
from meshskin.simulation.contact_samplers import closed_loop_sampler, static_sampler
from meshskin.simulation.machine_code import MachineCode
from meshskin.simulation.simulate import prepare, run
from meshskin.simulation.stability import inertia
from meshskin.simulation.state_machine import SLIDE
from meshskin.tuning.manoeuvre import plan_manoeuvre

WALL = ms.Indenter(position=(-0.6, -0.15, 0.5), direction=(1.0, 0.0, 0.0))
SLANT = ms.Indenter(position=(-0.5, 0.3, 0.6), direction=(0.6, -0.2, 0.7))


def column(recording, name):
    return recording.motion.column(name).to_numpy()


def phases(recording):
    return np.asarray(recording.motion.column("phase").to_pylist())


def joints(recording, kind):
    return np.stack([column(recording, f"{kind}{k + 1}") for k in range(6)], axis=1)


def faced(recording):
    """The recorded normals in the world (m, 3)."""
    return np.einsum("kij,kj->ki", recording.headings, recording.normals)


@pytest.fixture(scope="module")
def walled(noisy):
    """The paper's scene, its indenter on a wall."""
    return noisy.with_(indenter=WALL)


@pytest.fixture(scope="module")
def ellipsoid():
    """A small skin on the ellipsoid over a slanted indenter."""
    whole = ms.Scene.load("ellipsoid")
    skin = ms.Skin.cover(whole.body, count=19, spacing=5e-3, region=Cap((0.0, -1.0, 0.0)))
    return whole.with_(skin=skin, indenter=SLANT)


@pytest.mark.slow
def test_a_wall_calibrates_as_well_as_a_table(walled, noisy, noisy_recording):
    recording = ms.simulate(walled, seed=1)
    force = column(recording, "force")[phases(recording) == "slide"]
    assert np.abs(force / 3.0 - 1.0).max() < 0.01
    np.testing.assert_allclose(faced(recording) @ WALL.axis, -1.0, atol=1e-5)
    errors = [
        metrics.position_errors(ms.calibrate(r, noisy.belief()), noisy.skin)
        for r in (recording, noisy_recording)
    ]
    assert np.isfinite(errors).all()
    assert errors[0].mean() < 1.1 * errors[1].mean()


@pytest.mark.slow
def test_what_is_turned_as_a_whole_does_the_same(sphere, monkeypatch):
    """Arm, indenter and gravity by one rotation: the same angles, torques, forces, readings."""
    sphere = sphere.with_(exploration=replace(sphere.exploration, lane_spacing=0.012))
    recording = ms.simulate(sphere, seed=1)
    place = replace(sphere.indenter, direction=(0.48, -0.64, 0.6))
    turn, shift = place.rotation, np.array([0.2, -0.5, 0.3])
    base = transform(turn, shift)
    there = tuple((turn @ place.position + shift).tolist())
    monkeypatch.setattr(dynamics, "GRAVITY", turn @ dynamics.GRAVITY)
    moved = sphere.with_(indenter=replace(place, position=there), arm=sphere.arm.with_base(base))
    found = ms.simulate(moved, seed=1)
    assert found.metadata["force_error"] == pytest.approx(recording.metadata["force_error"])
    felt = [
        inertia(ClosedLoopModel.of(scene), joints(recording, "q")[0]) for scene in (sphere, moved)
    ]
    assert felt[1] == pytest.approx(felt[0])
    for kind, within in (("q", 1e-10), ("tau", 1e-6)):
        np.testing.assert_allclose(joints(found, kind), joints(recording, kind), atol=within)
    np.testing.assert_allclose(column(found, "force"), column(recording, "force"), atol=1e-9)
    np.testing.assert_allclose(found.points, recording.points, atol=1e-10)
    np.testing.assert_allclose(found.headings, turn @ recording.headings, atol=1e-9)
    assert found.readings.column("taxel").equals(recording.readings.column("taxel"))
    np.testing.assert_allclose(found.pressure, recording.pressure, atol=1e-8 * sphere.patch.peak)


def potential(arm, q):
    """Potential energy (k,), J, of an arm's links by the masses of its URDF, at angles (k, 6)."""
    robot, energy = ET.fromstring(arm.urdf), np.zeros(len(q))
    for link in robot.iter("link"):
        mass = link.find("inertial/mass")
        if mass is None or link.get("name") == robot.find("link").get("name"):
            continue  # the root does not move
        middle = [float(x) for x in link.find("inertial/origin").get("xyz").split()]
        part = Arm.from_text(arm.urdf, tip=link.get("name")).with_base(arm.base)
        pose = part.pose(q[:, : len(part.joint_names)])
        energy += 9.80665 * float(mass.get("value")) * (pose[:, 2, :3] @ middle + pose[:, 2, 3])
    return energy


@pytest.mark.parametrize(
    "case", ["table", "wall", pytest.param("wall and a tilted base", marks=pytest.mark.slow)]
)
def test_at_rest_the_torques_carry_the_weight_and_the_contact(sphere, case):
    """Gravity is the world's: torques against differences of the potential energy."""
    scene = sphere if case == "table" else sphere.with_(indenter=WALL)
    if case.endswith("base"):
        base = transform(exp_so3([-0.3, 0.2, 0.0]), [0.0, 0.0, 0.1])
        scene = scene.with_(arm=scene.arm.with_base(base))
    scene = scene.with_(loop=replace(scene.loop, compile="never"))
    simulator, path = prepare(scene)
    for steps in run(scene, simulator, path):
        if steps.phase == SLIDE:  # before it the touch is at rest
            break
        last = steps
    loop, q = simulator.loop, last.q[-1]
    rows = {name: last.outputs[-1, rows] for name, rows in loop.outputs.items()}
    assert rows["force"][0] == pytest.approx(3.0, rel=1e-3)

    def energy(q):
        body = loop.arm.pose(q) @ loop.mount
        contact = body[:, :3, :3] @ rows["point"] + body[:, :3, 3]
        return potential(loop.arm, q) - rows["force"] * (contact @ scene.indenter.axis)

    step = 1e-4 * np.eye(6)
    wanted = (energy(q + step) - energy(q - step)) / 2e-4
    assert np.abs(wanted).max() > 5.0
    np.testing.assert_allclose(rows["torque"], wanted, atol=0.02)


@pytest.mark.deep
@pytest.mark.parametrize("mode", [pytest.param("arm", marks=pytest.mark.slow), "quasi_static"])
def test_a_slanted_indenter_is_explored_by_lanes(ellipsoid, mode):
    scene = ellipsoid.with_(loop=replace(ellipsoid.loop, mode=mode))
    plan = plan_exploration(scene)
    assert plan.unreachable == {}
    centre = np.einsum("kij,kj->ki", plan.path.poses[:, :3, :3], plan.path.points)
    centre = centre + plan.path.poses[:, :3, 3]
    depth = (centre - SLANT.position) @ SLANT.axis
    np.testing.assert_allclose(depth, SLANT.radius - scene.patch.depth, atol=2e-4)
    recording = ms.simulate(scene, seed=1, path=plan.path)
    sliding = column(recording, "force")[phases(recording) == "slide"]
    assert np.abs(np.median(sliding) / 3.0 - 1.0) < 0.01
    np.testing.assert_allclose(faced(recording) @ SLANT.axis, -1.0, atol=1e-3)
    found = ms.calibrate(recording, scene.belief())
    assert metrics.position_errors(found, scene.skin).max() < 1e-4


def test_between_places_the_body_is_lifted_the_way_the_indenter_points(sphere):
    parts = [
        ms.Skin.cover(sphere.body, count=4, spacing=5e-3, region=Cap(way))
        for way in ((0.5, 0.0, -1.0), (-0.5, 0.0, -1.0))
    ]
    poses = np.concatenate([part.poses for part in parts])
    scene = sphere.with_(
        skin=ms.Skin(poses, np.arange(len(poses))),
        indenter=SLANT,
        loop=replace(sphere.loop, mode="quasi_static"),
        exploration=replace(sphere.exploration, pattern="lanes"),
    )
    recording = ms.simulate(scene, seed=1)
    place = np.stack([column(recording, name) for name in "xyz"], axis=1)
    leaving = place[phases(recording) == "leave"]
    way = leaving[-1] - leaving[0]
    assert way @ SLANT.axis == pytest.approx(np.linalg.norm(way), rel=1e-9)
    assert way @ SLANT.axis > scene.exploration.standoff - 1e-4
    assert set(recording.reading_taxel) == set(scene.skin.ids)


@pytest.mark.deep
def test_single_touches_and_presses_are_made_from_the_side(ellipsoid):
    points = ellipsoid.skin.positions[::6]
    for sampler in (static_sampler, closed_loop_sampler):
        recording, why = sampler(ellipsoid, 0)(points)
        assert set(why) == {""}
        assert len(recording.time) == len(points)
        np.testing.assert_allclose(faced(recording) @ SLANT.axis, -1.0, atol=1e-4)
        np.testing.assert_allclose(recording.force, 3.0, rtol=0.01)


def test_the_manoeuvre_of_the_tuning_comes_from_the_side(walled):
    made = plan_manoeuvre(walled, np.array([0.0, 0.0, -0.1]), np.array([1.0, 0.0, 0.0]), 0.02)
    path = made.path(walled.body, walled.exploration, 1e-3)
    normals = np.einsum("kij,kj->ki", path.poses[:, :3, :3], path.normals)
    np.testing.assert_allclose(normals, np.tile([-1.0, 0.0, 0.0], (len(normals), 1)), atol=1e-5)
    starts = [walled.arm.pose(q) @ walled.mount_pose for q in (made.posture, made.start)]
    lifted = walled.exploration.standoff + walled.patch.depth
    np.testing.assert_allclose((starts[1] - starts[0])[:3, 3], [lifted, 0.0, 0.0], atol=1e-8)


@pytest.mark.skipif(codegen.find_compiler() is None, reason="no C compiler here")
def test_compiled_steps_equal_interpreted_ones(walled):
    found = []
    for choice in ("never", "always"):
        scene = walled.with_(loop=replace(walled.loop, compile=choice))
        simulator, path = prepare(scene)
        assert isinstance(simulator.rollout, MachineCode) == (choice == "always")
        rows = []
        for steps in run(scene, simulator, path):
            rows.append(np.hstack([steps.q, steps.outputs]))
            if sum(map(len, rows)) > 1000:
                break
        found.append(np.concatenate(rows)[:1000])
    np.testing.assert_allclose(found[1], found[0], rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    "integrator",
    ["linearly_implicit", *(pytest.param(k, marks=pytest.mark.slow) for k in ("rk4", "cvodes"))],
)
def test_every_integrator_holds_the_force_on_a_wall(walled, integrator):
    scene = walled.with_(loop=replace(walled.loop, integrator=integrator))
    simulator, path = prepare(scene)
    total, force = 0, simulator.loop.outputs["force"].start
    for steps in run(scene, simulator, path):
        total += len(steps.time)
        if total > 800:
            break
    assert steps.outputs[-1, force] == pytest.approx(3.0, rel=0.01)


def test_a_scene_file_says_direction_and_base():
    data, folder = read_tables("sphere")
    data["indenter"] |= {"direction": [1, 0, 0], "position_m": [-0.6, -0.15, 0.5]}
    data["arm"] |= {"base_mm": [0, 0, 100], "base_angles_deg": [0, 0, 90]}
    scene = ms.Scene.from_tables(data, folder)
    assert scene.indenter.direction == (1, 0, 0)
    turned = [[0, -1, 0, 0], [1, 0, 0, 0], [0, 0, 1, 0.1], [0, 0, 0, 1]]
    np.testing.assert_allclose(scene.arm.base, turned, atol=1e-15)
    assert np.array_equal(ClosedLoopModel.of(scene).arm.base, scene.arm.base)
    data["arm"]["base_mm"] = [0, 0]
    with pytest.raises(ConfigError, match=r"base must be a tuple of 3 numbers, got \(0.0, 0.0\)"):
        ms.Scene.from_tables(data, folder)


def test_a_wall_out_of_reach_is_named(sphere):
    behind = sphere.with_(indenter=replace(sphere.indenter, direction=(1.0, 0.0, 0.0)))
    words = r"explored: joint limit.* \(0.424, -0.424, 0.7\) m; move .* \(indenter.carried_by\)"
    with pytest.raises(ReachError, match=words):
        ms.simulate(behind)
