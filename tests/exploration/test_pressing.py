"""Lighter contacts where the scene's force is refused."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import meshskin as ms
from meshskin.core.errors import ConfigError, ContactError
from meshskin.exploration import lane_plan
from meshskin.exploration.left_out import still_left_out
from meshskin.exploration.path import Path, Plan
from meshskin.exploration.plan import plan_exploration
from meshskin.exploration.pressing import grown_runs, lighter_helps
from meshskin.pipeline import _force
from meshskin.robot import collision

from ..height_field import height_field


def dented_plate():
    """A plate with a dent 6 mm deep, of curvature -60 1/m at its middle."""
    mesh = height_field(lambda x, y: -6e-3 * np.exp(-(x**2 + y**2) / (2 * 10e-3**2)), 30e-3)
    return ms.Body.from_mesh(trimesh.Trimesh(*mesh), open=True)


@pytest.fixture(scope="module")
def dented():
    """A scene in which 3 N are too wide for a contact model in the dent, and 0.75 N are not."""
    body = dented_plate()
    x, y = (v.ravel() for v in np.meshgrid(*[np.linspace(-15e-3, 15e-3, 7)] * 2))
    hit = body.closest(np.column_stack([x, y, np.full(len(x), 1e-3)]))
    poses = np.tile(np.eye(4), (len(x), 1, 1))
    poses[:, :3, 3] = hit.point
    base = ms.Scene.load("sphere_noisy")
    return base.with_(
        body=body,
        skin=ms.Skin(poses, np.arange(len(x))).onto(body),
        contact="auto",
        material=ms.Material(young=0.4e6),
        indenter=ms.Indenter.sphere(8e-3),
        loop=replace(base.loop, mode="quasi_static"),
        exploration=replace(base.exploration, pattern="lanes", lane_spacing=2.5e-3),
    )


def middle(scene):
    """The taxel at the bottom of the dent."""
    return int(np.argmin(np.linalg.norm(scene.skin.positions[:, :2], axis=1)))


def test_a_hollow_too_wide_for_the_force_is_pressed_lighter(dented):
    bottom = middle(dented)
    curvature = dented.body.closest(dented.skin.positions[bottom : bottom + 1]).curvature
    assert "too wide" in dented.invalid_reasons(curvature)[0]
    plan = plan_exploration(dented)
    assert plan.unreachable == {}
    assert set(plan.path.forces) <= {3.0, 1.5, 0.75}
    assert plan.path.forces.min() < 3.0
    assert "N, where 3 N are refused" in " ".join(plan.notes)
    for segment in plan.segments:  # each contact is in the range of the models at its own force
        light = dented.with_(
            contact=dented.model.name,
            law=replace(dented.law, force_reference=float(segment.forces[0])),
        )
        hit = dented.body.closest(segment.points[::50])
        assert np.mean(light.invalid_reasons(hit.curvature) == "") > 0.95


@pytest.mark.deep
def test_a_skin_all_of_which_is_too_soft_is_pressed_lighter(noisy):
    """Under 3 N the patch is wider than a contact model allows at every taxel (a/R = 0.61)."""
    soft = noisy.with_(
        material=ms.Material(young=0.06e6),
        contact="auto",
        skin=ms.Skin(noisy.skin.poses[:20], np.arange(20), noisy.skin.disc_radius),
        loop=replace(noisy.loop, mode="quasi_static"),
        exploration=replace(noisy.exploration, pattern="lanes", lane_spacing=3e-3),
    )
    with pytest.raises(ContactError, match="too wide"):
        ms.press(soft, soft.skin.positions)
    recording = ms.simulate(soft, seed=1)
    assert np.median(recording.force) == pytest.approx(1.5, abs=0.05)
    found = ms.calibrate(recording, soft.belief())
    error = np.linalg.norm(found.positions - soft.skin.positions, axis=1)
    assert np.isfinite(error).sum() >= 10
    assert np.nanmax(error / found.position_sigma) < 5.0
    with pytest.raises(ContactError, match="too wide"):  # under a quarter, too
        plan_exploration(soft.with_(material=ms.Material(young=0.01e6)))


def test_joined_paths_press_each_segment_with_its_own_force(dented):
    light, full = plan_exploration(dented).path.segments[:2]
    whole = Path.concatenate(
        [replace(light, forces=np.array([0.75])), replace(full, forces=None)], 3.0
    )
    np.testing.assert_array_equal(whole.forces, [0.75, 3.0])
    with pytest.raises(ConfigError, match="1 of 2 with forces = None"):
        Path.concatenate([light, replace(full, forces=None)])


@pytest.mark.slow
def test_lighter_contacts_are_simulated_and_calibrated(dented):
    recording = ms.simulate(dented, seed=1)
    assert {0.75, 1.5, 3.0} & set(np.round(recording.force, 2)) > {3.0}
    reference = np.asarray(recording.motion.column("reference"))
    sliding = np.asarray(recording.motion.column("phase").to_pylist()) == "slide"
    force = np.asarray(recording.motion.column("force"))[sliding]
    assert np.median(np.abs(force / reference[sliding] - 1.0)) < 0.01
    found = ms.calibrate(recording, dented.belief())
    error = np.linalg.norm(found.positions - dented.skin.positions, axis=1)
    assert found.verdict.level == "PASS"
    assert 1e3 * error.max() < 0.1
    sigma = np.sqrt(np.trace(found.covariances[:, :3, :3], axis1=1, axis2=2))
    assert (error < 5 * sigma + 5e-6).all()


def test_a_carried_indenter_is_pressed_lighter_too(dented):
    scene = dented.with_(indenter=replace(dented.indenter, carried_by="hand"))
    plan = plan_exploration(scene)
    assert middle(scene) not in plan.unreachable
    table = plan.contacts.to_pydict()
    np.testing.assert_array_equal(table["force"], plan.path.forces)
    assert min(table["force"]) < 3.0 == max(table["force"])
    recording = ms.simulate(scene, path=plan.path)
    np.testing.assert_allclose(recording.force, plan.path.forces)
    response = _force(recording, scene)  # each contact against its own force
    assert (response.reference, response.lighter) == (3.0, tuple(sorted({*table["force"]} - {3.0})))
    assert (response.settling, response.overshoot, response.disturbance) == (0.0, 0.0, 0.0)


@pytest.mark.deep
def test_what_a_force_serves_too_little_is_left_to_the_next_one(dented, monkeypatch):
    """Half the force reaches points, none of the taxels is served thereby: a quarter tries them."""
    calls = []

    def half_serves_none(skin, radius, segments, blocked, before):
        calls.append(radius)
        return (
            before if len(calls) == 1 else still_left_out(skin, radius, segments, blocked, before)
        )

    monkeypatch.setattr(lane_plan, "still_left_out", half_serves_none)
    plan = plan_exploration(dented)
    assert len(calls) == 2
    assert plan.unreachable == {}
    assert set(plan.path.forces) == {3.0, 0.75}


@pytest.mark.deep
def test_what_keeps_lighter_contacts_from_a_taxel_is_named(dented):
    """An arm that meets the support in the dent: no force is light enough."""
    plan = plan_exploration(dented.with_(loop=replace(dented.loop, mode="arm")))
    assert len(plan.unreachable) > 10
    assert not lighter_helps(list(plan.unreachable.values())).any()
    assert "collision: the arm meets the indenter's support" in plan.unreachable.values()


def test_forces_of_a_part_of_a_path(dented):
    path = plan_exploration(dented).path
    assert [float(s.forces[0]) for s in path.segments] == path.forces.tolist()
    table = Plan(path, 2.5e-3).to_arrow().to_pydict()
    np.testing.assert_array_equal(np.unique(table["force"]), np.unique(path.forces))
    assert table["force"][path.breaks[0]] == path.forces[1]
    cut = path.truncated(path.breaks[0] + 1)
    np.testing.assert_array_equal(cut.forces, path.forces[:2])


def test_a_skin_that_the_force_reaches_has_one_force():
    base = ms.Scene.load("sphere")
    scene = base.with_(
        loop=replace(base.loop, mode="quasi_static"),
        exploration=replace(base.exploration, pattern="lanes"),
    )
    plan = plan_exploration(scene)
    assert plan.path.forces is None
    assert not any("refused" in note for note in plan.notes)


def test_runs_grow_over_free_neighbours_only():
    new = np.array([0, 0, 0, 1, 0, 0, 0, 0, 0, 1], dtype=bool)
    free = np.array([1, 1, 1, 1, 0, 0, 1, 0, 0, 1], dtype=bool)
    assert grown_runs(new, free, 3) == [slice(1, 4)]
    assert grown_runs(np.zeros(4, dtype=bool), np.ones(4, dtype=bool), 3) == []


def test_reasons_that_a_lighter_contact_may_not_have():
    reasons = [collision.EDGE, collision.HOLLOW, "elliptic contact does not hold: too wide"]
    assert lighter_helps(reasons).all()
    assert not lighter_helps([collision.SUPPORT, collision.ENCLOSED, ""]).any()
