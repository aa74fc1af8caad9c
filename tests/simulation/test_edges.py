"""Explorations at the edges of bodies, segments that are given up, and bodies moved by hand."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from meshskin import Body, Material, Skin
from meshskin.core.errors import EdgeError, PlaceError, SimulationError
from meshskin.core.se3 import exp_so3, transform
from meshskin.exploration.plan import plan_exploration
from meshskin.robot import collision
from meshskin.scene.settings import Exploration
from meshskin.simulation.closed_loop_model import ClosedLoopModel, state_of_pose
from meshskin.simulation.simulate import prepare, simulate
from meshskin.simulation.simulator import Simulator
from meshskin.simulation.state_machine import LEAVE, SLIDE, ExplorationStateMachine
from meshskin.simulation.track import Track


@pytest.fixture(scope="module")
def box_scene(sphere):
    """Taxels over an edge of a box, moved by hand."""
    mesh = trimesh.creation.box((0.16, 0.12, 0.1)).subdivide().subdivide().subdivide()
    body = Body(name="box", mesh=mesh)
    y, x = np.meshgrid(0.057 - 6e-3 * np.arange(4), np.arange(-0.015, 0.016, 6e-3), indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), np.full(x.size, -0.05)], axis=1)
    poses = transform(np.tile(np.diag([1.0, -1.0, -1.0]), (len(points), 1, 1)), points)
    skin = Skin(poses, np.arange(len(points)), 2e-3)
    return sphere.with_(
        body=body, skin=skin, material=Material(young=4e5), contact="elliptic",
        loop=replace(sphere.loop, mode="quasi_static"),
        exploration=replace(sphere.exploration, pattern="lanes", lane_spacing=5e-3),
    )  # fmt: skip


@pytest.mark.deep
def test_taxels_at_an_edge_are_named_and_the_others_explored(box_scene):
    found = plan_exploration(box_scene)
    row = len(box_scene.skin) // 4
    # the first row is 3 mm from the edge, the patch is 3.5 mm long to either side
    assert all(found.unreachable[k] == collision.EDGE for k in range(row))
    assert set(found.unreachable) <= set(range(2 * row))
    normals = box_scene.body.closest(found.path.points).normal
    np.testing.assert_allclose(normals, np.tile([0.0, 0.0, -1.0], (len(normals), 1)), atol=1e-9)
    recording = simulate(box_scene)
    assert np.abs(recording.force[-50:] - 3.0).max() < 0.1


@pytest.fixture
def floating(sphere):
    """A sphere moved by hand, 2 mm deep on its indenter."""
    loop = ClosedLoopModel(
        arm=sphere.arm, mount=np.eye(4), indenter_position=np.zeros(3), indenter_radius=0.01,
        effective_modulus=2.6e5, law=sphere.law, dt=1e-3, mode="quasi_static",
    )  # fmt: skip
    pose = transform(np.eye(3), [0.0, 0.0, 0.108])
    return Simulator(sphere.body, loop, state_of_pose(pose), np.array([0.0, 0.0, -0.1])), pose


def test_a_body_is_lifted_off_by_hand_and_its_force_falls_to_nothing(floating):
    simulator, pose = floating
    heights = np.linspace(0.0, 5e-3, 40)
    poses = np.tile(pose, (40, 1, 1))
    poses[:, 2, 3] += heights
    steps = simulator.move(state_of_pose(poses), LEAVE)
    force, depth = steps.outputs[:, 6], steps.outputs[:, 7]
    np.testing.assert_allclose(depth, 2e-3 - heights, atol=1e-7)
    expected = 4 / 3 * 2.6e5 * np.sqrt(1 / 110) * np.maximum(depth, 0.0) ** 1.5
    np.testing.assert_allclose(force, expected, atol=1e-3)
    np.testing.assert_allclose(simulator.state[:7], state_of_pose(poses[-1]), atol=1e-12)


def test_a_way_that_meets_the_indenter_again_is_refused(floating):
    simulator, pose = floating
    poses = np.tile(pose, (30, 1, 1))
    poses[:, 2, 3] += 5e-3 * np.sin(np.linspace(0.0, np.pi, 30))
    assert not simulator.is_clear(poses)
    with pytest.raises(SimulationError, match=r"meets the indenter in the air, got 2 mm deep"):
        simulator.move(state_of_pose(poses), LEAVE)
    high = transform(exp_so3([[0.3, 0.0, 0.0]]), [[0.0, 0.0, 0.2]])
    assert simulator.is_clear(high)


@pytest.mark.slow
def test_a_part_given_up_is_no_end_and_all_of_it_is(sphere, monkeypatch):
    scene = sphere.with_(
        loop=replace(sphere.loop, mode="quasi_static"),
        exploration=replace(sphere.exploration, lane_spacing=0.012),
    )
    simulator, path = prepare(scene)
    track = Track.of(path, scene.body.surface)
    half = len(track) // 2
    advance, calls = Simulator.advance, {"slides": 0, "fail": range(10**6)}

    def failing(self, track, phase, **more):
        calls["slides"] += phase == SLIDE
        if phase == SLIDE and calls["slides"] in calls["fail"]:
            raise EdgeError("the contact ran over an edge of the body")
        return advance(self, track, phase, **more)

    def explore(tracks):
        simulator.reset()
        explorer = ExplorationStateMachine(
            simulator, tracks, Exploration(standoff=5e-3, settle=0.3)
        )
        steps = [s for s in explorer.run() if s.phase == SLIDE]
        assert all("ran over an edge" in str(part) for part in simulator.given_up)
        return len(simulator.given_up), sum(len(s.time) for s in steps)

    monkeypatch.setattr(Simulator, "advance", failing)
    with pytest.raises(PlaceError, match="edge"):
        explore([track[:half], track[half:]])
    calls.update(slides=0, fail=(3, 5))
    assert explore([track[:half], track[half:]]) == (2, len(track) - 2 * 200)
    calls.update(slides=0)
    assert explore([track]) == (2, len(track) - 2 * 200)
    calls.update(slides=0, fail=range(1, 10**6))
    with pytest.raises(PlaceError, match="edge"):
        explore([track])


def moved_path(path, offset):
    """The same path of a body that lies at `offset` (3,), m, in its frame."""
    poses = path.poses @ transform(np.eye(3), -offset)
    twists = path.twists.copy()
    twists[:, :3] += np.cross(path.twists[:, 3:], poses[:, :3, 3] - path.poses[:, :3, 3])
    return replace(path, points=path.points + offset, poses=poses, twists=twists)


@pytest.mark.deep
def test_a_body_far_from_its_origin_turns_about_its_middle(sphere):
    """From one face of a box to the next, the origin moves along a circle, not the body."""
    box = trimesh.creation.box((0.05, 0.04, 0.03))
    scene = sphere.with_(
        body=Body.from_mesh(box),
        skin=Skin.cover(Body.from_mesh(box), spacing=12e-3, seed=1),
        loop=replace(sphere.loop, mode="quasi_static"),
        exploration=replace(sphere.exploration, pattern="lanes", lane_spacing=8e-3),
    )
    path = plan_exploration(scene).path

    def duration(offset):
        away = transform(np.eye(3), offset)
        body, skin = Body.from_mesh(box.copy().apply_transform(away)), scene.skin.moved(away)
        there = scene.with_(body=body, skin=skin)
        return simulate(there, seed=1, path=moved_path(path, offset)).time[-1]

    far, near = duration(np.array([0.0, 2.0, 0.0])), duration(np.zeros(3))
    assert far == pytest.approx(near, rel=0.1)
