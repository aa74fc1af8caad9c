"""A declared body offset by the distances of the contact points from the surface."""

from dataclasses import replace

import numpy as np
import pytest

import meshskin as ms
from meshskin.core import se3
from meshskin.estimation.data.registration import registered, slopes

SHIFT, TURN = np.array([1e-3, -2e-3, 2e-3]), np.array([0.01, 0.02, -0.01])


@pytest.fixture(scope="module")
def scene():
    return ms.Scene.load("ellipsoid")


def points(scene):
    rng = np.random.default_rng(0)
    return scene.body.closest(rng.normal(scale=0.1, size=(400, 3))).point


def test_the_offset_is_found_where_contacts_surround_the_body(scene):
    belief = scene.belief(unknown=("modulus", "body_offset"))
    at = points(scene)
    found, moved = registered(belief, (at - SHIFT) @ se3.exp_so3(TURN))
    np.testing.assert_allclose(moved, at, atol=2e-5)
    np.testing.assert_allclose(found.contact_motion.mean, [*SHIFT, *TURN], atol=2e-4)
    assert found.unknown == ("modulus",)
    motion = found.contact_motion
    assert motion.root.shape == (6, 6)
    assert np.sqrt(np.diag(motion.covariance(np.eye(6))))[:3].max() < 2e-5
    centres = moved + 0.01 * scene.body.closest(moved).normal
    np.testing.assert_allclose(motion.slopes, slopes(centres, motion.mean), atol=1e-9)


def test_slopes_are_those_of_the_moved_points():
    at, offset, step = np.random.default_rng(0).normal(size=(5, 3)), np.array([*SHIFT, *TURN]), 1e-6

    def moved(offset):
        return at @ se3.exp_so3(offset[3:]).T + offset[:3]

    for k, change in enumerate(step * np.eye(6)):
        numeric = (moved(offset + change) - moved(offset - change)) / (2 * step)
        np.testing.assert_allclose(slopes(moved(offset), offset)[:, :, k], numeric, atol=1e-9)


def test_what_slides_along_the_body_is_held_at_its_prior():
    belief = ms.Scene.load("sphere_noisy").belief(unknown=("body_offset",))
    at = points(ms.Scene.load("sphere_noisy"))
    found, moved = registered(belief, at + np.array([0.0, 0.0, 1e-3]))
    motion = found.contact_motion
    np.testing.assert_allclose(motion.mean[:3], [0.0, 0.0, -1e-3], atol=1e-5)
    assert motion.size == 3
    np.testing.assert_allclose(np.diag(motion.held @ motion.held.T)[3:], 0.05**2, rtol=0.01)
    assert np.abs(belief.body.closest(moved).distance).max() < 1e-5


def test_points_that_do_not_touch_do_not_tell(scene):
    belief = scene.belief(unknown=("modulus", "body_offset"))
    at, touching = points(scene), np.arange(400) < 150
    wrong = (at - SHIFT) @ se3.exp_so3(TURN)
    wrong[~touching] += [0.0, 0.0, 0.03]
    _, moved = registered(belief, wrong, touching)
    np.testing.assert_allclose(moved[touching], at[touching], atol=5e-5)
    assert registered(belief, wrong, touching & False)[0] is belief


def test_points_on_the_surface_do_not_tell(scene):
    belief = scene.belief(unknown=("body_offset",))
    assert registered(belief, points(scene))[0] is belief
    assert registered(scene.belief(), points(scene) + SHIFT)[0].contact_motion is None


def test_a_log_that_is_off_calibrates_where_it_is(noisy):
    """On a sphere the centre is determined, the rotation is not: positions relative to it are."""
    log = ms.press(noisy, noisy.skin.positions, seed=0)
    body = ms.Body.sphere(0.1)
    belief = noisy.belief(body=body, unknown=("modulus", "body_offset"))
    wrong = replace(log.with_columns(points=log.points + SHIFT), metadata={})
    found = ms.calibrate(wrong, belief)
    for axis, value in zip("xyz", SHIFT, strict=True):
        stated = found.unknowns[f"body_offset {axis}"]
        assert abs(stated[0] + value) < 0.01e-3
    assert found.observed[:, :2].all()
    error = np.linalg.norm(found.positions - noisy.skin.positions, axis=1)
    assert np.median(error) < 0.1e-3  # in the orientation of the log
    assert found.undetermined == tuple(
        f"body_offset rotation {axis} is not determined" for axis in "xyz"
    )
    turned = 0.1 * 0.05  # m, along each of two tangents, by the prior of the ball's rotation
    assert np.median(found.position_sigma) == pytest.approx(2**0.5 * turned, rel=0.05)
