"""Unknowns of the robot that move contacts: the indenter's offset as a table of sensitivities, what
other measurements have told, and directions that stay undetermined."""

from dataclasses import replace

import numpy as np
import pytest

import meshskin as ms
from meshskin.core import se3
from meshskin.core.errors import ConfigError
from meshskin.estimation.calibrate import Estimation, calibrate
from meshskin.estimation.data.global_parameters import MOTION
from meshskin.estimation.joint.contacts import LinearizedContacts
from meshskin.estimation.learned.estimate import with_learned_response
from meshskin.geometry.region import Cap
from meshskin.scene.contact_motion import ContactMotion

from .test_unknowns import record

OFFSET = np.array([3e-4, -2e-4, 1e-4])
NAMES = tuple(f"probe {axis}" for axis in "xyz")


@pytest.fixture(scope="module")
def turned(world):
    """A recording whose contact points ignore an indenter offset, and its headings."""
    turn = np.random.default_rng(3).uniform(-3, 3, len(world.points))
    headings = se3.exp_so3(turn[:, None] * [0, 0, 1.0])
    centre = world.points + (0.01 - world.a**2 * (10 + 100))[:, None] * world.normals
    believed = world.body.closest(centre - np.einsum("mji,j->mi", headings, OFFSET)).point
    return record(world, points=believed), headings


@pytest.mark.deep
def test_the_indenter_offset_is_a_special_case(world, turned):
    recording, headings = turned
    known = calibrate(
        recording,
        world.belief(0.01, 0.05, unknown=("modulus", "indenter_offset"), headings=headings),
    )
    motion = ContactMotion(NAMES, np.full(3, 5e-3), np.swapaxes(headings, 1, 2))
    found = calibrate(recording, world.belief(0.01, 0.05, contact_motion=motion))
    for axis, name in zip("xyz", NAMES, strict=True):
        value, sigma = found.unknowns[name]
        expected = known.unknowns[f"indenter_offset {axis}"]
        assert value == pytest.approx(expected[0], abs=1e-3 * sigma)
        assert sigma == pytest.approx(expected[1], rel=1e-4)
    np.testing.assert_allclose(found.positions, known.positions, atol=1e-9)
    # along the normals contacts keep their heights, which say nothing of the probe's place here
    tangential = (slice(None), slice(2), slice(2))
    np.testing.assert_allclose(
        found.covariances[tangential], known.covariances[tangential], rtol=1e-3, atol=1e-13
    )
    assert not {label for label in found.unknowns if "contact_motion" in label}


@pytest.mark.deep
def test_a_mean_and_a_root_are_the_same_unknowns(world, turned):
    """Whitened by a full covariance about another mean, with the same prior, it is the same."""
    recording, headings = turned
    plain = ContactMotion(NAMES, np.full(3, 5e-3), np.swapaxes(headings, 1, 2))
    rotation = se3.exp_so3([0.3, -0.5, 0.9])
    about = np.array([2e-3, 1e-3, -3e-3])  # what is lost along the normals is of second order
    turned_root = replace(plain, root=5e-3 * rotation, about=about)
    moved = world.body.closest(
        recording.points
        + (0.01 - world.a**2 * 110)[:, None] * world.body.closest(recording.points).normal
        + plain.slopes @ (5e-3 * rotation @ about)
    ).point
    found = calibrate(
        record(world, points=moved), world.belief(0.01, 0.05, contact_motion=turned_root)
    )
    expected = calibrate(recording, world.belief(0.01, 0.05, contact_motion=plain))
    for name in NAMES:
        value, sigma = expected.unknowns[name]
        assert found.unknowns[name] == pytest.approx((value, sigma), abs=0.02 * sigma)
    np.testing.assert_allclose(found.positions, expected.positions, atol=1e-6)


def test_what_cannot_be_told_apart_is_named(world, turned):
    """An unknown of the robot that moves contacts as the probe's x does, twice as far."""
    recording, headings = turned
    slopes = np.swapaxes(headings, 1, 2)
    doubled = np.concatenate([slopes, 2 * slopes[:, :, :1]], axis=2)
    motion = ContactMotion((*NAMES, "mast x"), np.full(4, 5e-3), doubled)
    found = calibrate(recording, world.belief(0.01, 0.05, contact_motion=motion))
    assert found.undetermined == ("cannot be told apart: probe x +1, mast x -0.5",)
    value = found.unknowns["probe x"][0] + 2 * found.unknowns["mast x"][0]
    assert value == pytest.approx(OFFSET[0], abs=2e-5)
    assert found.unknowns["mast x"][1] == pytest.approx(5e-3 / np.sqrt(5), rel=0.01)


@pytest.mark.parametrize(("name", "changes"), [("joint_offset a", False), ("body_offset z", True)])
def test_patches_of_a_learned_response_keep_their_sizes_where_joints_move_them(name, changes):
    """About the long axis of an ellipsoid, along which its curvature varies: by how much sizes vary
    with that is not known, and would tell the turn of all contacts."""
    body = ms.Body.ellipsoid((0.045, 0.02, 0.06))
    skin = ms.Skin.cover(body, spacing=6e-3, count=20, seed=2, region=Cap((1.0, 0.8, 0.2)))
    scene = ms.Scene.load("sphere").with_(body=body, skin=skin)
    log = ms.press(scene, skin.positions, seed=1)
    slopes = np.cross([0.0, 0.0, 1.0], log.points)[:, :, None]
    motion = ContactMotion((name,), np.array([0.1]), slopes)
    data = Estimation(log, replace(scene.belief(), contact_motion=motion)).data
    data = with_learned_response(data, skin.positions)
    at, start = data.parameters.columns[MOTION], data.parameters.start()
    contacts, there = LinearizedContacts(data, start), start.copy()
    there[at] += 0.3  # of 0.1 rad
    before, after = contacts.at(start), contacts.at(there)
    assert np.linalg.norm(after.points - before.points, axis=1).min() > 3e-4
    assert np.array_equal(before.patches.first, after.patches.first) != changes
    assert bool(before.shape[0][:, at].any()) == bool(before.log_peak[:, at].any()) == changes


def test_tables_of_another_shape_are_refused(world, turned):
    recording, headings = turned
    motion = ContactMotion(NAMES, np.full(3, 5e-3), np.swapaxes(headings, 1, 2))
    some = motion.take(np.arange(len(headings)) < 3)
    with pytest.raises(ConfigError, match="slopes of each contact of the recording, got 3 co"):
        calibrate(recording, world.belief(0.01, 0.05, contact_motion=some))
    with pytest.raises(ConfigError, match="limit: K = 2"):
        ContactMotion(("a", "b"), np.ones(2), motion.slopes)
    with pytest.raises(ConfigError, match="finite"):
        ContactMotion(NAMES, np.ones(3), motion.slopes * np.nan)


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"mean": np.zeros(2)}, r"mean .* got shape \(2,\), limit: shape \(3,\)"),
        ({"mean": [0.0, np.nan, 0.0]}, "mean of a contact motion must be finite"),
        ({"root": np.eye(2)}, r"root .* got shape \(2, 2\)"),
        ({"root": np.eye(3)[:, :2], "about": np.zeros(3)}, r"about .* limit: shape \(2,\)"),
        ({"held": np.zeros((2, 1))}, "held of a contact motion must fit its unknowns"),
        ({"sigma": ["a", 1, 1]}, "sigma of a contact motion must be numbers"),
    ],
)
def test_arguments_that_do_not_fit_are_refused(wrong, message):
    given = {"sigma": np.ones(3), "slopes": np.zeros((4, 3, 3)), **wrong}
    with pytest.raises(ConfigError, match=message):
        ContactMotion(NAMES, **given)
