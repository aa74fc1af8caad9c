"""Indenters that are carried to a body at rest: the list of contacts, its recording, the map."""

from dataclasses import replace

import numpy as np
import pyarrow.csv
import pytest

import meshskin as ms
from meshskin.core.errors import ConfigError, ReachError, UnknownNameError
from meshskin.core.se3 import exp_so3, transform
from meshskin.effects.gravity_error import GravityError
from meshskin.effects.indenter_offset import IndenterOffset
from meshskin.estimation.uncertainty import metrics
from meshskin.exploration.contact_plan import CONTACTS
from meshskin.exploration.plan import explore, plan_exploration
from meshskin.pipeline import run
from meshskin.robot import collision
from meshskin.simulation.simulate import prepare

BASE = transform(exp_so3([0.0, 0.0, 0.4]), [-0.5, 0.0, -1.2])


def carried(scene, by):
    """The scene with a body at rest; the arm that carries the indenter stands below it."""
    return scene.with_(
        indenter=replace(scene.indenter, carried_by=by),
        loop=replace(scene.loop, mode="quasi_static"),
        arm=scene.arm.with_base(BASE),
    )


@pytest.fixture(scope="module", params=["hand", "arm"])
def scene(request, noisy):
    return carried(noisy, request.param)


@pytest.fixture(scope="module")
def plan(scene):
    return plan_exploration(scene)


def columns(table, *names):
    return np.stack([table.column(name).to_numpy() for name in names], axis=1)


def test_the_list_says_where_the_indenter_is_pressed_on_a_sphere(scene, plan):
    table = plan.contacts
    point, normal = columns(table, "px", "py", "pz"), columns(table, "nx", "ny", "nz")
    np.testing.assert_allclose(point, 0.1 * normal, atol=1e-4)  # a mesh of a sphere
    centre = columns(table, "x", "y", "z")
    height = 0.1 + scene.indenter.radius - scene.patch.depth
    np.testing.assert_allclose(centre, height * normal, atol=1e-4)
    w, x, y, z = columns(table, "qw", "qx", "qy", "qz").T
    axis = np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x**2 + y**2)], axis=1)
    np.testing.assert_allclose(axis, -normal, atol=1e-9)
    assert table.column("force").to_pylist() == [scene.law.force_reference] * len(point)


@pytest.mark.deep
def test_every_pose_of_the_list_has_its_force_whatever_the_curvature():
    body = ms.Body.ellipsoid((0.09, 0.045, 0.045))
    scene = ms.Scene(
        body=body,
        skin=ms.Skin.cover(body, spacing=8e-3),
        indenter=ms.Indenter(carried_by="hand"),
        loop=ms.Loop(mode="quasi_static"),
        contact="elliptic",
    )
    table = plan_exploration(scene).contacts
    point, normal = columns(table, "px", "py", "pz"), columns(table, "nx", "ny", "nz")
    height = np.einsum("ki,ki->k", columns(table, "x", "y", "z") - point, normal)
    curvature = body.closest(point).curvature
    assert np.ptp(curvature) > 10.0
    force = scene.model.force(
        depth=scene.indenter.radius - height,
        curvature=curvature,
        indenter_radius=scene.indenter.radius,
        effective_modulus=scene.material.effective_modulus,
    )
    np.testing.assert_allclose(force, table.column("force").to_numpy(), rtol=1e-6)


@pytest.mark.deep
def test_contacts_are_a_spacing_apart_and_cover_all_taxels(scene, plan):
    points = plan.path.points
    gap = np.linalg.norm(points[:, None] - points, axis=2) + np.diag(np.full(len(points), np.inf))
    assert np.median(gap.min(axis=1)) == pytest.approx(scene.exploration.lane_spacing, rel=0.2)
    assert plan.unreachable == {}
    way = np.linalg.norm(np.diff(points, axis=0), axis=1)
    assert np.median(way) < 1.5 * scene.exploration.lane_spacing
    wide = plan_exploration(
        scene.with_(exploration=replace(scene.exploration, lane_spacing=5.5e-3))
    )
    assert "have too few contacts near them at a spacing of 5.5 mm" in wide.notes[-1]
    eight = replace(scene.exploration, contacts=float(CONTACTS))
    assert plan_exploration(scene.with_(exploration=eight)).unreachable == {}
    asked = replace(scene.exploration, contacts=10.0)
    fewer = plan_exploration(scene.with_(exploration=asked))
    near = np.linalg.norm(fewer.path.points[:, None] - scene.skin.positions, axis=2)
    assert (near < scene.rig.sensing_radius).sum(axis=0).mean() == pytest.approx(10.0, rel=0.25)


def test_the_arm_holds_the_indenter_at_each_contact(scene, plan):
    if scene.indenter.carried_by == "hand":
        assert plan.path.postures is None
        return
    arm, q = scene.arm, columns(plan.contacts, *(f"q{k}" for k in range(1, 7)))
    pose = arm.pose(q)
    height = scene.indenter.support_height + scene.indenter.radius
    centre = pose[:, :3, 3] + height * pose[:, :3, 2]
    np.testing.assert_allclose(centre, columns(plan.contacts, "x", "y", "z"), atol=1e-9)
    np.testing.assert_allclose(pose[:, :3, 2], -plan.path.normals, atol=1e-9)
    assert (q > arm.lower).all()
    assert (q < arm.upper).all()
    ends = collision.arm_capsules(arm).at(q)  # an independent check of the clearance
    part = np.linspace(0.0, 1.0, 20)[:, None, None, None]
    along = ends[None, :, :, 0] * (1.0 - part) + ends[None, :, :, 1] * part
    gap = np.linalg.norm(along, axis=-1) - 0.1 - collision.arm_capsules(arm).radii
    assert gap.min() > -1e-3


def test_an_arm_that_does_not_reach_is_named(noisy):
    scene = carried(noisy, "arm")
    far = scene.with_(arm=scene.arm.with_base(transform(np.eye(3), [3.0, 0.0, 0.0])))
    with pytest.raises(ReachError, match="no contact can be made on the skin: out of the arm's"):
        plan_exploration(far)


def test_the_recording_has_the_contacts_of_the_list_and_the_map_is_at_the_bound(scene, plan):
    recording = ms.simulate(scene, seed=1)
    np.testing.assert_allclose(recording.points, plan.path.points, atol=1e-9)
    np.testing.assert_allclose(recording.headings, plan.path.poses[:, :3, :3], atol=1e-9)
    belief = scene.belief()
    calibration = ms.calibrate(recording, belief)
    assert np.isfinite(calibration.positions).all()
    error = metrics.position_errors(calibration, scene.skin)
    bound = metrics.bound_mm(recording, belief, scene.skin)["rms"]
    assert 0.8 < 1e3 * np.sqrt(np.mean(error**2)) / bound < 1.2
    assert calibration.verdict.level == "PASS"


@pytest.mark.deep
def test_an_offset_of_the_tool_is_estimated_with_the_taxels(noisy):
    """It is constant in the indenter's frame, which a recording's orientations are given in."""
    scene = carried(noisy, "arm")
    offset = (2e-4, -1e-4, 0.0)
    world = scene.with_(effects=(*scene.effects, IndenterOffset(offset=offset)))
    belief = scene.belief(unknown=("modulus", "indenter_offset"))
    calibration = ms.calibrate(ms.simulate(world, seed=1), belief)
    for axis, recorded in zip("xy", offset, strict=False):  # the estimate is true minus recorded
        value, sigma = calibration.unknowns[f"indenter_offset {axis}"]
        assert abs(value + recorded) < 3.0 * sigma < 0.5 * abs(recorded)


@pytest.mark.deep
def test_the_list_is_written_as_csv_and_a_plan_that_moves_the_body_has_none(
    tmp_path, scene, plan, noisy
):
    plan.save_contacts(tmp_path / "contacts.csv")
    assert (
        pyarrow.csv.read_csv(tmp_path / "contacts.csv").column_names == plan.contacts.column_names
    )
    sliding = explore(noisy.body, noisy.skin, mode="quasi_static")
    with pytest.raises(ConfigError, match='plan with Indenter\\(carried_by="hand"\\)'):
        sliding.save_contacts(tmp_path / "none.csv")
    listed = explore(
        noisy.body,
        noisy.skin,
        indenter=ms.Indenter(carried_by="hand"),
        exploration=ms.Exploration(),
        mode="quasi_static",
    )
    assert "contacts to press, 3.5 mm apart, 0 taxels left out" in repr(listed)


def test_what_needs_a_moving_body_is_refused(noisy):
    with pytest.raises(UnknownNameError, match="carrier of the indenter"):
        ms.Indenter(carried_by="foot")
    with pytest.raises(ConfigError, match=r"carried by hand needs a body at rest.*quasi_static"):
        noisy.with_(indenter=ms.Indenter(carried_by="hand"))
    with pytest.raises(ConfigError, match="contact by contact, without a closed loop"):
        prepare(carried(noisy, "hand"))
    with pytest.raises(ConfigError, match="gravity_error needs the vertical"):
        ms.simulate(carried(noisy, "hand").with_(effects=(GravityError(),)))


@pytest.mark.slow
def test_a_scene_file_with_a_carried_indenter_is_run(tmp_path):
    file = tmp_path / "hand.toml"
    file.write_text(
        'extends = "sphere_noisy"\n[skin]\ncount = 14\n[indenter]\ncarried_by = "hand"\n'
        '[loop]\nmode = "quasi_static"\n',
        encoding="utf-8",
    )
    result = run(file, tmp_path / "out", seed=1)
    assert result.recording.motion is None
    assert result.metrics["steps_per_second"] is None
    listed = pyarrow.csv.read_csv(tmp_path / "out" / "contacts.csv")
    assert listed.num_rows == result.metrics["contacts"]
    assert result.metrics["position_error_mm"]["mean"] < 0.1
