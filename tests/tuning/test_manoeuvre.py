"""The manoeuvre against closed forms: great circles, poses that face the indenter."""

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest

from meshskin.core.errors import TuningError
from meshskin.geometry.body import Body
from meshskin.tuning.manoeuvre import (
    fit_patch,
    plan_manoeuvre,
    slide_distance,
    slide_path,
    slide_start,
)

BOTTOM = np.array([0.0, 0.0, -0.1])


@pytest.fixture(scope="module")
def free(sphere):
    return sphere.with_(loop=replace(sphere.loop, mode="quasi_static"))


def test_a_geodesic_of_the_sphere_is_a_great_circle():
    s, points, frames = slide_path(Body.sphere(0.1), BOTTOM, np.array([1.0, 1.0, 0.5]), 0.05)
    angle = s / 0.1
    ahead = np.array([np.sqrt(0.5), np.sqrt(0.5), 0.0])
    expected = 0.1 * (np.outer(np.sin(angle), ahead) - np.outer(np.cos(angle), [0, 0, 1]))
    np.testing.assert_allclose(points, expected, atol=1e-6)
    np.testing.assert_allclose(frames[:, :, 2], expected / 0.1, atol=1e-5)
    with pytest.raises(TuningError, match="normal to the surface"):
        slide_path(Body.sphere(0.1), BOTTOM, BOTTOM, 0.05)


def test_a_place_off_the_body_is_refused_with_the_nearest_point(free):
    start = slide_start(free, 1.015 * BOTTOM, [1.0, 0.0, 0.0])[0]
    np.testing.assert_allclose(start, BOTTOM, atol=1e-6)
    with pytest.raises(TuningError, match=r"place is not on the body, got 50 mm off .*-0\.1\)"):
        slide_start(free, 1.5 * BOTTOM, [1.0, 0.0, 0.0])


def test_the_patch_stands_for_the_surface_about_the_slide():
    for body, place, ahead in (
        (Body.sphere(0.1), BOTTOM, [1.0, 0.0, 0.0]),
        (Body.capsule(0.05, 0.2), [0.05, 0.0, 0.0], [0.0, 1.0, 1.0]),
    ):
        _, points, frames = slide_path(body, np.array(place), np.array(ahead), 0.02)
        assert fit_patch(body, points, frames)[2] < 2e-7  # of a depth of some mm


def test_a_surface_with_an_edge_is_refused(free):
    rod = free.with_(body=Body.cylinder(0.05, 0.1))
    with pytest.raises(TuningError, match="not a smooth patch"):
        plan_manoeuvre(rod, np.array([0.05, 0.0, 0.045]), np.array([0.0, 0.0, 1.0]), 0.02)


def test_the_body_faces_the_indenter_all_the_way(sphere):
    """Contact point over the indenter at the reference depth, its normal down, by the arm too."""
    made = plan_manoeuvre(sphere, BOTTOM, np.array([1.0, 0.0, 0.0]), 0.02)
    path = made.path(sphere.body, sphere.exploration, 1e-3)
    end = [0.1 * np.sin(0.2), 0.0, -0.1 * np.cos(0.2)]
    np.testing.assert_allclose(path.points[[0, -1]], [BOTTOM, end], atol=1e-6)
    normals = np.einsum("kij,kj->ki", path.poses[:, :3, :3], path.normals)
    np.testing.assert_allclose(normals, np.tile([0.0, 0.0, -1.0], (len(normals), 1)), atol=1e-5)
    touching = np.einsum("kij,kj->ki", path.poses[:, :3, :3], path.points) + path.poses[:, :3, 3]
    gap = sphere.indenter.radius - sphere.patch.depth
    over = np.add(sphere.indenter.position, [0.0, 0.0, gap])
    np.testing.assert_allclose(touching, np.tile(over, (len(touching), 1)), atol=1e-6)
    held = sphere.arm.pose(made.posture) @ sphere.mount_pose
    np.testing.assert_allclose(held, path.poses[0], atol=1e-6)
    above = sphere.arm.pose(made.start) @ sphere.mount_pose
    lifted = sphere.exploration.standoff + sphere.patch.depth
    np.testing.assert_allclose(above[:3, 3] - held[:3, 3], [0.0, 0.0, lifted], atol=1e-8)


def test_the_reference_of_the_step_is_the_path_of_the_simulator(free):
    made = plan_manoeuvre(free, BOTTOM, np.array([1.0, 0.0, 0.0]), 0.02)
    speed, ramp, dt = free.exploration.speed, free.exploration.ramp, 1e-3
    path = made.path(free.body, free.exploration, dt)
    for k in (0, 40, 200, len(path.points) - 30):
        now, half, then = (
            slide_distance(ca.DM((k + part) * dt), speed, ramp, 0.02) for part in (0.0, 0.5, 1.0)
        )
        row = made.reference(now, half, (then - now) / dt)
        np.testing.assert_allclose(np.array(row).ravel(), path.references[k], atol=2e-5)


def test_the_slide_goes_its_distance_with_ramps():
    t = np.linspace(-0.1, 1.0, 2001)
    s = np.array(slide_distance(ca.DM(t), 0.05, 0.1, 0.02)).ravel()
    assert s[0] == 0.0
    assert s[-1] == pytest.approx(0.02)
    rate = np.diff(s) / np.diff(t)
    assert rate.max() == pytest.approx(0.05)
    assert (rate >= -1e-12).all()
    assert np.ptp(np.flatnonzero(rate > 1e-9)) * (t[1] - t[0]) == pytest.approx(0.5, abs=2e-3)
