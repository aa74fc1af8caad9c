"""The state machine: its order, the way through the air, recovery, and giving up."""

from dataclasses import replace
from itertools import groupby

import numpy as np
import pytest
import trimesh

import meshskin as ms
from meshskin.core.errors import ReachError, SimulationError
from meshskin.core.se3 import exp_so3, poses_of_states, transform
from meshskin.exploration import parallels
from meshskin.exploration.left_out import coverage
from meshskin.exploration.path import ROWS, Path, body_twists
from meshskin.geometry.region import Cap
from meshskin.scene.settings import Exploration, Law
from meshskin.simulation import state_machine, transfer
from meshskin.simulation.closed_loop_model import ClosedLoopModel, state_of_pose
from meshskin.simulation.simulate import prepare, run
from meshskin.simulation.simulator import Simulator
from meshskin.simulation.state_machine import PHASES, ExplorationStateMachine
from meshskin.simulation.track import Track

SETTINGS = Exploration(standoff=5e-3, settle=0.3)


@pytest.fixture
def track(prepared, sphere):
    return Track.of(prepared()[1], sphere.body.surface)


@pytest.mark.parametrize("mode", ["arm", "quasi_static"])
def test_two_places_run_through_every_phase_in_order(prepared, track, along, mode):
    simulator, path = prepared(mode)
    places = [track[:400], track[1500:1900]]
    postures = along[[0, 1500]] if mode == "arm" else None
    explorer = ExplorationStateMachine(simulator, places, SETTINGS, postures)
    found = list(explorer.run())
    order = [PHASES[phase] for phase, _ in groupby(found, key=lambda steps: steps.phase)]
    once = ["approach", "touch", "hold", "slide"]
    assert order == [*once, "leave", "next", *once]
    assert explorer.losses == 0
    assert explorer.done == 800

    def force(phase):
        return np.concatenate([s.outputs[:, 6] for s in found if s.phase == phase])

    assert not force(state_machine.NEXT)[20:].any()
    assert force(state_machine.SLIDE) == pytest.approx(3.0, abs=0.05)
    assert not force(state_machine.APPROACH)[:-1].all()
    point = found[-1].outputs[-1, :3]
    assert np.linalg.norm(point - path.points[1899]) < 5e-4
    times = np.concatenate([s.time for s in found])
    np.testing.assert_allclose(np.diff(times), simulator.loop.dt, rtol=1e-6)


def test_contact_that_is_lost_is_sought_again_where_it_was_lost(prepared, sphere, track):
    simulator, _ = prepared("quasi_static")
    explorer = ExplorationStateMachine(simulator, [track[:600]], SETTINGS)
    knocked, after = False, []
    for steps in explorer.run():
        if steps.phase == state_machine.SLIDE and explorer.row > 250 and not knocked:
            simulator.state[2] += 0.01  # thrown 8 mm clear of the indenter
            knocked = True
        elif knocked:
            after.append(steps)
    assert explorer.losses == 1
    order = [PHASES[p] for p, _ in groupby(s.phase for s in after)]
    assert order == ["slide", "approach", "touch", "hold", "slide"]
    assert explorer.done == 600
    assert after[-1].outputs[-1, 6] == pytest.approx(3.0, abs=0.01)


def test_contact_that_cannot_be_kept_is_given_up_by_name(prepared, track):
    simulator, _ = prepared("quasi_static")
    explorer = ExplorationStateMachine(simulator, [track[:3000]], SETTINGS)
    with pytest.raises(SimulationError, match=r"lost 6 times, got row \d+ of place 0"):
        for steps in explorer.run():
            if steps.phase == state_machine.SLIDE:
                simulator.state[2] += 0.01


def test_a_path_to_another_part_of_the_body_must_lift_off(sphere, monkeypatch):
    """The parallels of a ball, unchecked, lead to another ball beside it and back."""
    monkeypatch.setattr(parallels, "_check_convex", lambda *shifts: None)
    balls = [trimesh.creation.icosphere(3, 0.03) for _ in range(2)]
    balls[1].apply_translation((0.1, 0.0, 0.0))
    body = ms.Body.from_mesh(trimesh.util.concatenate(balls))
    skin = ms.Skin.cover(body, spacing=5e-3, count=80)
    scene = sphere.with_(body=body, skin=skin, loop=replace(sphere.loop, mode="quasi_static"))
    path = parallels.parallels(scene, 0.0, scene.loop.dt)
    with pytest.raises(SimulationError, match=r"lost 6 times.*Path\.breaks"):
        ms.simulate(scene, path=path)


def test_a_place_that_the_body_cannot_come_to_is_given_up(prepared, sphere, track):
    """At the second place the indenter would be within the ball."""
    simulator, path = prepared("quasi_static")
    within = track[1000:1200]
    references = within.references.copy()
    references[:, 2] -= 0.05
    places = [track[:300], replace(within, references=references), track[1500:1800]]
    explorer = ExplorationStateMachine(simulator, places, SETTINGS)
    steps = [s for s in explorer.run() if s.phase == state_machine.SLIDE]
    assert [(part.place, part.rows) for part in simulator.given_up] == [(1, slice(0, 200))]
    assert sum(len(s.time) for s in steps) == 600
    assert np.linalg.norm(steps[-1].outputs[-1, :3] - path.points[1799]) < 1e-3


def test_an_arm_that_finds_no_way_to_a_place_goes_on_to_the_next(
    prepared, track, along, monkeypatch
):
    """It has left the first place when it looks for a way to the second, and does not leave it
    again."""
    simulator, path = prepared("arm")
    ways = []

    def joint_path(loop, body, start, goal):
        ways.append(start)
        if len(ways) == 1:
            raise ReachError("no way")
        return found(loop, body, start, goal)

    found = transfer.joint_path
    monkeypatch.setattr(transfer, "joint_path", joint_path)
    places = [track[:300], track[1000:1200], track[1500:1800]]
    explorer = ExplorationStateMachine(simulator, places, SETTINGS, along[[0, 1000, 1500]])
    steps = list(explorer.run())
    order = [PHASES[phase] for phase, _ in groupby(steps, key=lambda step: step.phase)]
    once = ["approach", "touch", "hold", "slide"]
    assert order == [*once, "leave", "next", *once]
    assert [str(part) for part in simulator.given_up] == ["no way"]
    np.testing.assert_array_equal(ways[0], ways[1])
    assert np.linalg.norm(steps[-1].outputs[-1, :3] - path.points[1799]) < 1e-3


class Spoiled:
    """A rollout whose blocks are spoiled by `spoil(states, outputs)` in the second place."""

    def __init__(self, simulator, spoil):
        self.rollout, self.spoil, self.explorer = simulator.rollout, spoil, None
        self.lengths = self.rollout.lengths

    def run(self, *inputs):
        states, outputs = (x.copy() for x in self.rollout.run(*inputs))
        if self.explorer.place == 1 and self.explorer.phase == state_machine.SLIDE:
            self.spoil(states, outputs)
        return states, outputs


def explore_spoiled(simulator, track, along, spoil):
    """Explorer and steps over three places, the second of which is spoiled."""
    places = [track[:300], track[1000:1200], track[1500:1800]]
    postures = along[[0, 1000, 1500]] if simulator.loop.joints else None
    simulator.rollout = spoiled = Spoiled(simulator, spoil)
    spoiled.explorer = ExplorationStateMachine(simulator, places, SETTINGS, postures)
    try:
        return spoiled.explorer, list(spoiled.explorer.run())
    finally:
        simulator.rollout = spoiled.rollout


@pytest.mark.parametrize(
    ("mode", "number", "why"),
    [("arm", np.nan, "diverged"), ("quasi_static", np.nan, "diverged"),
     ("quasi_static", 1e9, "flew off its path")],
)  # fmt: skip
def test_a_contact_that_cannot_be_held_costs_itself_alone(
    prepared, track, along, mode, number, why
):
    def thrown(states, outputs):
        states[-1, 0] = number

    simulator, path = prepared(mode)
    _, found = explore_spoiled(simulator, track, along, thrown)
    (part,) = simulator.given_up
    assert (part.place, part.rows) == (1, slice(0, 200))
    assert why in str(part)
    assert np.abs(np.concatenate([s.q for s in found])).max() < 10.0
    assert sum(len(s.time) for s in found if s.phase == state_machine.SLIDE) == 600
    assert np.linalg.norm(found[-1].outputs[-1, :3] - path.points[1799]) < 1e-3


def test_a_loop_that_diverges_nearly_everywhere_is_no_success(prepared, track, monkeypatch):
    simulator, _ = prepared("quasi_static")
    places = [track[:600], track[600:1200], track[1200:1800]]
    rollout, slides = simulator.rollout.run, 0

    def diverge(*args):
        nonlocal slides
        states, outputs = rollout(*args)
        slides += explorer.phase == state_machine.SLIDE
        if explorer.phase == state_machine.SLIDE and slides > 1:
            states[-1, 0] = np.nan
        return states, outputs

    explorer = ExplorationStateMachine(simulator, places, SETTINGS, None)
    monkeypatch.setattr(simulator.rollout, "run", diverge)
    with pytest.raises(SimulationError, match="diverged"):
        list(explorer.run())


def test_steps_over_a_patch_that_folds_are_taken_again_from_the_mesh(prepared, track, along):
    """Beyond its face a patch may fold: its normal is no unit vector there, and the step is far
    off. Where it folds under every step, the place is given up."""

    def beyond(first):
        def folded(states, outputs):
            outputs[first:, 3:6] *= 50.0
            states[first + 1 :, :3] += 1e9

        return folded

    simulator, path = prepared("quasi_static")
    _, found = explore_spoiled(simulator, track, along, beyond(20))
    assert not simulator.given_up
    slides = [s for s in found if s.phase == state_machine.SLIDE]
    assert sum(len(s.time) for s in slides) == 800
    outputs = np.concatenate([s.outputs for s in slides])
    np.testing.assert_allclose(np.linalg.norm(outputs[:, 3:6], axis=1), 1.0, atol=1e-9)
    assert outputs[:, 6] == pytest.approx(3.0, abs=0.05)
    assert np.linalg.norm(outputs[-1, :3] - path.points[1799]) < 1e-3
    simulator.reset()
    explore_spoiled(simulator, track, along, beyond(0))
    (part,) = simulator.given_up
    assert (part.place, part.error.what) == (1, "the surface under the contact folds")


@pytest.mark.deep
def test_steps_that_lead_off_the_surface_have_the_contact_of_the_mesh(prepared, track, along):
    """On a ridge a step of the foot point may lead off the surface from the mesh's own, too."""

    def beside(states, outputs):
        outputs[:, 6] *= 50.0
        states[1:, -2:] = -0.2

    simulator, path = prepared("quasi_static")
    _, found = explore_spoiled(simulator, track, along, beside)
    assert not simulator.given_up
    outputs = np.concatenate([s.outputs for s in found if s.phase == state_machine.SLIDE])
    assert len(outputs) == 800
    assert outputs[:, 6] == pytest.approx(3.0, abs=0.05)
    assert np.linalg.norm(outputs[-1, :3] - path.points[1799]) < 1e-3


def corner(sphere):
    """A floor, 40 mm wide, with a wall 15 mm high at x = 0, and a scene over it."""
    x, z = np.array([[-10, 40, 40, 0, 0, -10], [-8, -8, 0, 0, 15, 15]]) * 1e-3
    points = np.concatenate([np.column_stack([x, np.full(6, y), z]) for y in (-0.02, 0.02)])
    cap = np.array([[0, 1, 3], [1, 2, 3], [0, 3, 5], [3, 4, 5]])
    sides = [[k, k + 6, (k + 1) % 6, (k + 1) % 6, k + 6, (k + 1) % 6 + 6] for k in range(6)]
    faces = np.concatenate([cap, cap[:, ::-1] + 6, np.reshape(sides, (-1, 3))])
    body = ms.Body.from_mesh(trimesh.Trimesh(points, faces).subdivide().subdivide())
    return sphere.with_(
        body=body, skin=ms.Skin.cover(body, spacing=8e-3, count=4, seed=1),
        loop=replace(sphere.loop, mode="quasi_static"), indenter=ms.Indenter.sphere(4e-3),
        contact="elliptic", material=ms.Material(young=1e6),
    )  # fmt: skip


def floor_track(scene, x, rows=200):
    """A track over the floor, 20 mm long in y, at `x`, m."""
    y = np.linspace(-0.01, 0.01, rows)
    hit = scene.body.closest(np.column_stack([np.full(rows, x), y, np.zeros(rows)]))
    np.testing.assert_allclose(hit.normal[:, 2], 1.0)
    poses = scene.rig.contact_poses(hit.point, hit.normal, np.tile([0.0, 1.0, 0.0], (rows, 1)))
    twists = body_twists(poses, scene.loop.dt)
    path = Path(scene.loop.dt, hit.point, hit.normal, poses, twists, hit.face)
    return path, Track.of(path, scene.body.surface)


def test_an_approach_beside_a_wall_goes_to_the_floor(sphere):
    """The wall is 0.5 mm from the indenter, nearer than the floor where the approach begins."""
    scene = corner(sphere)
    path, track = floor_track(scene, 4.5e-3)
    simulator, _ = prepare(scene, path)
    explorer = ExplorationStateMachine(simulator, [track, track], SETTINGS)
    steps = list(explorer.run())
    assert not simulator.given_up
    assert explorer.losses == 0
    outputs = np.concatenate([s.outputs for s in steps])
    np.testing.assert_allclose(outputs[outputs[:, 6] > 0.0, 5], 1.0, atol=1e-6)


def test_a_body_that_cannot_be_lifted_off_goes_back_the_way_it_came(
    prepared, track, along, monkeypatch
):
    simulator, path = prepared("quasi_static")
    clear, ways = Simulator.is_clear, []

    def held(self, poses, leaving=False):
        if not leaving:
            return clear(self, poses)
        ways.append(poses)
        return np.abs(poses[0, :3, :3] - path.poses[0, :3, :3]).max() < 1e-2

    monkeypatch.setattr(Simulator, "is_clear", held)
    explorer = ExplorationStateMachine(simulator, [track[:900], track[1500:1800]], SETTINGS)
    steps = list(explorer.run())
    assert not simulator.given_up
    assert sum(len(s.time) for s in steps if s.phase == state_machine.SLIDE) == 1200
    assert len([s for s in steps if s.phase == state_machine.LEAVE]) == 2
    # the way off the contact is tested as finely as the body is moved
    gaps = np.linalg.norm(np.diff(ways[0][:, :3, 3], axis=0), axis=1)
    assert gaps.max() < 0.5 * np.pi * transfer.AIR_SPEED * simulator.loop.dt * 1.01


def test_parts_that_are_given_up_and_their_taxels_are_said(prepared, sphere):
    path = prepared("quasi_static")[1]
    rows = slice(9000, 12000)
    parts = [
        replace(path, **{name: getattr(path, name)[part] for name in ROWS}, breaks=())
        for part in (slice(0, rows.start), rows, slice(rows.stop, None))
    ]
    within = parts[1].poses.copy()
    within[:, 2, 3] -= 0.05
    parts[1] = replace(parts[1], poses=within)
    scene = sphere.with_(loop=replace(sphere.loop, mode="quasi_static"))
    with (
        pytest.warns(UserWarning, match="1 part of the path was given up: the body meets"),
        pytest.warns(ms.LeftOutWarning, match=r"not covered \(\d+: given up: the body meets"),
    ):
        recording = ms.simulate(scene, seed=1, path=Path.concatenate(parts))
    lost = [int(taxel) for taxel in recording.metadata["unreachable"]]
    counts = coverage(len(scene.skin), recording.metadata["unreachable"])
    assert counts == {"planned": len(scene.skin), "reached": len(scene.skin) - len(lost),
                      "given_up": len(lost)}  # fmt: skip

    def nearest(points, taxels):
        at = scene.skin.positions[np.isin(scene.skin.ids, taxels)]
        return np.linalg.norm(at[:, None] - points, axis=2).min(axis=1)

    assert 3 < len(lost) < 0.3 * len(scene.skin)
    radius = scene.rig.sensing_radius
    assert nearest(path.points[rows], lost).max() < radius
    kept = [int(k) for k in scene.skin.ids if k not in lost]
    rest = np.delete(path.points, rows, axis=0)[::10]
    assert nearest(rest, kept).max() < radius


def test_a_ring_turns_about_the_indenter_clear_of_it(arm):
    """From the outer to the inner equator of a torus, whose other side is 80 mm away from there."""
    body = ms.Body.torus(0.08, 0.02, faces=2000)
    loop = ClosedLoopModel(
        arm=arm, mount=np.eye(4), indenter_position=np.zeros(3), indenter_radius=0.01,
        effective_modulus=2.6e5, law=Law(), dt=1e-3, mode="quasi_static",
    )  # fmt: skip
    turn = exp_so3([0.0, 0.5 * np.pi, 0.0])  # the ring's x axis points down

    def touching(x, normal):
        pose = transform(exp_so3([0.0, 0.5 * np.pi * (1 - normal), 0.0]) @ turn, np.zeros(3))
        pose[:3, 3] = -pose[:3, :3] @ [x + normal * 0.0099, 0.0, 0.0]
        return pose

    low, goal = touching(0.1, 1.0), touching(0.06, -1.0)
    goal[2, 3] += SETTINGS.standoff
    simulator = Simulator(body, loop, state_of_pose(low), np.array([0.1, 0.0, 0.0]))
    assert transfer.penetration(loop, body, low[None])[1][0] == pytest.approx(1e-4, abs=1e-5)
    explorer = ExplorationStateMachine(simulator, [], SETTINGS)
    for steps in explorer._float(goal):
        assert not steps.outputs[20:, 6].any()
    np.testing.assert_allclose(poses_of_states(simulator.state[None])[0], goal, atol=1e-9)


def test_an_indenter_that_is_not_there_is_named(prepared, track):
    simulator, _ = prepared("quasi_static")
    simulator.state[2] += 1.0
    with pytest.raises(SimulationError, match=r"did not touch the indenter, got .* s of approach"):
        list(ExplorationStateMachine(simulator, [track], SETTINGS).run())


@pytest.mark.deep
@pytest.mark.parametrize("surface", ["sphere", "exact"])
def test_either_surface_of_the_law_holds_the_force_on_an_ellipsoid(sphere, surface):
    body = ms.Body.ellipsoid((0.11, 0.1, 0.08))
    scene = sphere.with_(
        body=body,
        skin=ms.Skin.cover(body, count=20, spacing=5e-3, region=Cap(direction=(0, 0, -1.0))),
        law=replace(sphere.law, surface=surface),
        arm=replace(sphere.arm, lower=np.full(6, -9.0), upper=np.full(6, 9.0)),
        loop=replace(sphere.loop, compile="never"),
    )
    simulator, path = prepare(scene)
    force = np.concatenate(
        [s.outputs[:, 6] for s in run(scene, simulator, path) if s.phase == state_machine.SLIDE]
    )
    assert force == pytest.approx(3.0, abs=0.03)


def test_the_approach_gains_its_speed_evenly(prepared, sphere, track):
    """Without an arm the body moves as it is asked to: v t / ramp, then v; the touch is later."""
    heights, touched = {}, {}
    for ramp in (0.0, 0.04):
        simulator, _ = prepared("quasi_static")
        settings = replace(SETTINGS, approach_ramp=ramp)
        explorer = ExplorationStateMachine(simulator, [track[:50]], settings)
        found = [steps for steps in explorer.run() if steps.phase == state_machine.APPROACH]
        heights[ramp] = np.concatenate([steps.q[:, 2] for steps in found])
        touched[ramp] = len(heights[ramp])
    dt, speed = simulator.loop.dt, sphere.law.approach_speed
    fall = -np.diff(heights[0.04])
    part = np.minimum((np.arange(len(fall)) + 1) * dt / 0.04, 1.0)
    np.testing.assert_allclose(fall, part * speed * dt, rtol=1e-6)
    assert touched[0.04] - touched[0.0] == pytest.approx(0.5 * 0.04 / dt, abs=2)
