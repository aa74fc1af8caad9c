"""Contact points without normals, mirrored on a nearly symmetric body: the reading fits alone."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import meshskin as ms
from meshskin.estimation.data.gather import gather
from meshskin.estimation.uncertainty import frame_errors
from meshskin.estimation.uncertainty.frame_errors import nearer_axes, signed_permutations
from meshskin.geometry.region import Cap

CONTACTS = 300


@pytest.fixture(scope="module")
def bumpy(noisy):
    """An ellipsoid with a bump of 1 mm among its taxels."""
    ball = trimesh.creation.icosphere(4)
    bump = np.exp(-np.sum((ball.vertices - [0.3, 0.9, 0.3]) ** 2, axis=1) / 0.1)
    vertices = ball.vertices * [0.05, 0.04, 0.09] * (1 + 0.025 * bump)[:, None]
    body = ms.Body.from_mesh(trimesh.Trimesh(vertices, ball.faces))
    cap = Cap(direction=(0.3, 0.9, 0.3))
    return noisy.with_(
        body=body,
        skin=ms.Skin.cover(body, spacing=8e-3, count=20, seed=1, region=cap, disc_radius=2e-3),
        contact="auto",
        material=ms.Material(young=0.4e6),
        indenter=ms.Indenter.sphere(8e-3),
        loop=replace(noisy.loop, mode="quasi_static"),
    )


def log(scene, signs, moved=0.0):
    """A log without normals whose contact points have other signs, and are `moved` (c, 3), m."""
    rng = np.random.default_rng(1)
    near = scene.skin.positions[rng.integers(len(scene.skin), size=CONTACTS)]
    points = scene.body.closest(near + rng.uniform(-6e-3, 6e-3, (CONTACTS, 3))).point
    made = ms.press(scene, points, force=rng.uniform(2.5, 3.5, CONTACTS), seed=1)
    normals = np.full((CONTACTS, 3), np.nan)
    made = made.with_columns(points=made.points * signs + moved, normals=normals)
    return replace(made, metadata={})


@pytest.mark.deep
@pytest.mark.parametrize(
    ("signs", "level", "words"),
    [((1.0, 1.0, 1.0), "PASS", ""), ((1.0, -1.0, 1.0), "FAIL", "axes as (x, -y, z)")],
)
def test_mirrored_contact_points_are_named_without_normals(bumpy, signs, level, words):
    found = ms.calibrate(log(bumpy, np.array(signs)), bumpy.belief())
    assert found.verdict.level == level
    assert words in " ".join(found.verdict.reasons)


@pytest.fixture(scope="module")
def off_plane(noisy):
    """A ball whose middle is 1.5 mm off the plane of the mirror: 3 mm explain the distances."""
    ball = trimesh.creation.icosphere(4, radius=0.05)
    ball.vertices += [0.0, 1.5e-3, 0.0]
    body = ms.Body.from_mesh(ball)
    skin = ms.Skin.cover(body, spacing=6e-3, count=20, seed=1, region=Cap(direction=(0, 1, 0)))
    return noisy.with_(body=body, skin=skin, loop=replace(noisy.loop, mode="quasi_static"))


def test_mirrored_taxels_are_within_their_standard_deviations(off_plane):
    found = ms.calibrate(log(off_plane, np.array([1.0, -1.0, 1.0])), off_plane.belief())
    error = np.linalg.norm(found.positions - off_plane.skin.positions, axis=1)
    assert found.verdict.level == "FAIL"
    assert np.nanmin(error) > 0.08
    assert np.nanmin(found.position_sigma / error) > 0.5
    assert np.nanmax(found.position_sigma / error) < 2.0


@pytest.mark.parametrize(("sign", "level"), [(1.0, "PASS"), (-1.0, "FAIL")])
@pytest.mark.parametrize(
    "course", [np.linspace(1e-3, 3e-3, CONTACTS), np.repeat([0.5e-3, 4e-3], CONTACTS // 2)]
)
def test_points_that_move_in_the_recording_are_not_mirrored_ones(off_plane, course, sign, level):
    """Drifting by 1 to 3 mm, they are 2.1 mm off the ball, mirrored 1.2 mm, displaced 0.6 mm; with
    a jump from 0.5 to 4 mm 2.9 mm, mirrored 1.9 mm, displaced by one shift 1.8 mm."""
    recording = log(off_plane, np.ones(3))
    data = gather(recording, off_plane.belief())
    moved = np.outer(-course, [0.0, sign > 0, 0.0])
    found = nearer_axes(data, (data.points + moved) * [1.0, sign, 1.0])
    assert found.level == level
    np.testing.assert_array_equal(found.axes, np.diag([1.0, sign, 1.0]))


@pytest.mark.parametrize("jump", [0.0, 1e-3])
def test_a_body_that_moves_in_the_recording_is_named(bumpy, jump):
    """A displacement that all contacts share is none."""
    moved = np.outer(np.repeat([0.3e-3, 0.3e-3 + jump], CONTACTS // 2), [1.0, 0.0, 0.0])
    found = ms.calibrate(log(bumpy, np.ones(3), moved), bumpy.belief())
    reasons = " ".join(found.verdict.reasons)
    assert found.verdict.level != "PASS"
    assert ("moved in the course of the recording, at about 51%" in reasons) == bool(jump)
    assert ("displaced by another 1 mm" in reasons) == bool(jump)


def test_each_order_and_sign_of_the_axes_is_tried_once():
    axes = signed_permutations()
    assert len({tuple(one.ravel()) for one in axes}) == 47
    np.testing.assert_array_equal(np.abs(np.linalg.det(axes)), 1.0)
    assert not (axes == np.eye(3)).all(axis=(1, 2)).any()


def test_a_body_of_another_size_has_not_moved(off_plane):
    """One side is touched after the other; both lie 0.3 mm below the believed surface."""
    body, rng = off_plane.body, np.random.default_rng(0)
    across, side = rng.uniform(-0.5, 0.5, (400, 2)), np.repeat([1.0, -1.0], 200)
    points = body.closest(0.05 * np.column_stack([side, across]) + [0.0, 1.5e-3, 0.0]).point
    middle = np.array([0.0, 1.5e-3, 0.0])
    data = gather(log(off_plane, np.ones(3)), off_plane.belief())
    assert not list(frame_errors._of_moves(data, middle + (1 - 0.3 / 50) * (points - middle)))
    moved = points + np.where(side[:, None] > 0, 0.0, [0.0, 0.0, 1e-3])
    ((_, words),) = frame_errors._of_moves(data, moved)
    assert "at about 50%" in words
    assert "another 1 mm" in words
