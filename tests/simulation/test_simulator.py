"""The simulator: runs across faces, strays and comes back, says what went wrong."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import meshskin as ms
from meshskin.core import codegen as module
from meshskin.core.errors import ConfigError, SimulationError
from meshskin.geometry.body import Body
from meshskin.scene.settings import Loop as LoopTable
from meshskin.simulation.closed_loop_model import ClosedLoopModel
from meshskin.simulation.machine_code import machine_code
from meshskin.simulation.simulate import prepare, run
from meshskin.simulation.track import IDENTITY_MAP, Track, face_maps

needs_compiler = pytest.mark.skipif(module.find_compiler() is None, reason="no C compiler here")


def outputs(scene, simulator, path, count=3000):
    found, total = [], 0
    for steps in run(scene, simulator, path):
        found.append(steps.outputs)
        total += len(steps.time)
        if total >= count:
            break
    return np.concatenate(found)[:count]


@pytest.mark.parametrize("mode", ["arm", "quasi_static"])
def test_the_contact_runs_across_faces_without_a_hop(prepared, sphere, mode):
    simulator, path = prepared(mode)
    found = outputs(sphere, simulator, path)
    assert simulator.relocations == 0
    assert len(np.unique(path.faces[:2500])) > 5
    np.testing.assert_allclose(np.linalg.norm(found[:, :3], axis=1), 0.1, atol=1e-7)
    assert found[600:, 6] == pytest.approx(3.0, rel=2e-3)


def test_a_path_that_names_the_wrong_faces_costs_hops_and_nothing_else(prepared, sphere):
    simulator, path = prepared()
    right = outputs(sphere, simulator, path)
    simulator.reset()
    there = sphere.body.closest(path.points + np.array([0.01, 0.0, 0.0])).face
    wrong = outputs(sphere, simulator, replace(path, faces=there))
    assert simulator.relocations > 2
    np.testing.assert_allclose(wrong[:, :8], right[:, :8], atol=2e-5)


@pytest.mark.deep
def test_a_patch_beside_its_face_does_not_hold_the_indenter_off(sphere):
    """A collision mesh, a hull of few points: patches leave the surface beyond their faces, where
    the force fell to 79 % of its reference for a moment."""
    x = np.random.default_rng(1).normal(size=(150, 3))
    x *= [0.05, 0.06, 0.08] / np.linalg.norm(x, axis=1)[:, None]
    body = Body.from_mesh(trimesh.PointCloud(x).convex_hull)
    region = ms.Cap(direction=(1.0, 0.3, 0.05))
    scene = sphere.with_(
        body=body,
        skin=ms.Skin.cover(body, spacing=6e-3, count=16, seed=1, region=region),
        material=ms.Material(young=0.4e6),
        indenter=ms.Indenter.sphere(8e-3),
        loop=replace(sphere.loop, mode="quasi_static"),
        exploration=replace(sphere.exploration, pattern="lanes", lane_spacing=5e-3),
    )
    motion = ms.simulate(scene).motion
    force = motion["force"].to_numpy()[np.array(motion["phase"].to_pylist()) == "slide"]
    assert len(force) > 3000
    assert force.min() > 0.81 * 3.0
    assert force.max() < 1.05 * 3.0


def test_crossings_carry_a_point_of_the_common_edge_exactly():
    surface = Body.ellipsoid((0.1, 0.08, 0.06), faces=1000).surface
    for k, (own, slots) in enumerate(zip(surface.faces[:50], np.eye(3)[[1, 2, 0]], strict=False)):
        edge = int(np.argmax(slots))
        other = surface.neighbours[k, edge]
        weights = np.full(3, 0.5)
        weights[edge] = 0.0
        change = face_maps(surface, np.array([k]), np.array([other])).reshape(3, 2).T
        u, v = change @ [weights[1], weights[2], 1.0]
        corners = surface.vertices[surface.faces[other]]
        here = weights @ surface.vertices[own]
        np.testing.assert_allclose(np.array([1 - u - v, u, v]) @ corners, here, atol=1e-12)
    same = face_maps(surface, np.array([3]), np.array([3]))
    np.testing.assert_allclose(same[0], IDENTITY_MAP, atol=1e-12)


@pytest.fixture(scope="module")
def compiled(sphere):
    """A simulator of the paper's scene in machine code, by mode."""
    made = {}

    def get(mode="arm"):
        if mode not in made:
            scene = sphere.with_(loop=replace(sphere.loop, mode=mode, compile="always"))
            made[mode] = prepare(scene)
        made[mode][0].reset()
        return made[mode]

    return get


@needs_compiler
@pytest.mark.parametrize("mode", ["arm", "quasi_static"])
def test_compiled_and_interpreted_agree_to_the_last_digits(prepared, compiled, sphere, mode):
    simulator, path = prepared(mode)
    fast, _ = compiled(mode)
    one, other = (outputs(sphere, m, path, 1000) for m in (simulator, fast))
    # fused multiply-add rounds once where the interpreter rounds twice
    assert (np.abs(one - other) <= 5e-12 * np.abs(one).max(axis=0)).all()


@needs_compiler
def test_machine_code_ends_where_the_interpreter_does(prepared, compiled, sphere):
    """At the touch, where the foot leaves its face, and where a number is not finite."""
    simulator, path = prepared()
    fast, _ = compiled()
    track = Track.of(path, sphere.body.surface)
    first, ends = int(track.faces[0]), []
    for one in (simulator, fast):
        steps = one.advance(track.hold(0, 32), 0, until_touch=True)
        while not steps.outputs[-1, 6] > 0:
            steps = one.advance(track.hold(0, 32), 0, until_touch=True)
        touch, row = one.steps, 0
        while one.relocations == 0:
            rows = slice(row, row + 256)
            stay = np.tile(IDENTITY_MAP, (256, 1))
            part = replace(track[rows], faces=np.full(256, first), maps=stay)
            row += len(one.advance(part, 2).time)
        ends.append((touch, one.steps, *one.state))
    assert ends[0][1] - ends[0][0] > 100
    np.testing.assert_allclose(*ends, rtol=1e-6, atol=1e-8)
    fast.state[3] = np.nan
    with pytest.raises(SimulationError, match="a number is not finite"):
        fast.advance(track.hold(0, 32), 0)


@needs_compiler
def test_auto_takes_what_an_earlier_run_built(sphere, tmp_path, monkeypatch):
    monkeypatch.setenv("MESHSKIN_CACHE", str(tmp_path))
    loop = ClosedLoopModel.of(sphere.with_(loop=replace(sphere.loop, mode="quasi_static")))
    patches = sphere.body.surface.patches

    def get(compile_, steps=0.0):
        return machine_code(loop, patches, compile_, steps)

    assert get("auto") is None
    assert get("auto", steps=1e6) is not None
    assert get("auto") is not None
    assert get("never", steps=1e6) is None


def test_torques_stay_within_the_arms_limits_and_are_counted(prepared, sphere):
    simulator, path = prepared()
    outputs(sphere, simulator, path, 1000)
    assert not simulator.saturated.any()
    effort = simulator.loop.arm.effort_limit.copy()
    effort[1] = 15.0  # not enough to carry the arm
    arm = replace(sphere.arm, effort_limit=effort)
    weak, path = prepare(sphere.with_(arm=arm, loop=replace(sphere.loop, compile="never")))
    steps = weak.advance(Track.of(path, sphere.body.surface).hold(0, 32), 0)
    torque = steps.outputs[:, weak.loop.outputs["torque"]]
    assert np.abs(torque[:, 1]).max() == 15.0
    assert weak.saturated[1] == np.count_nonzero(np.abs(torque[:, 1]) == 15.0) > 10
    assert not np.delete(weak.saturated, 1).any()


def test_a_number_that_is_not_finite_never_leaves_the_loop(prepared, sphere):
    simulator, path = prepared()
    simulator.state[3] = np.nan
    with pytest.raises(SimulationError, match=r"diverged .* at t = 0.0000 s, q = .*nan"):
        simulator.advance(Track.of(path, sphere.body.surface).hold(0, 32), 0)


def test_wrong_choices_of_the_loop_are_named(prepared):
    with pytest.raises(ConfigError, match=r"unknown integrator 'rk5'; did you mean rk4"):
        LoopTable(integrator="rk5")
    with pytest.raises(ConfigError, match=r"unknown choice of loop.compile 'alway'"):
        LoopTable(compile="alway")
    with pytest.raises(ConfigError, match=r"unknown mode .* 'static'"):
        replace(prepared()[0].loop, mode="static")
    assert ClosedLoopModel.__dataclass_fields__["integrator"].default == LoopTable().integrator
