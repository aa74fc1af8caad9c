"""Single contacts off the believed surface, and readings of a clock that was set back."""

import warnings
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pytest
import trimesh

import meshskin as ms
from meshskin.core.errors import RecordingError
from meshskin.estimation.data.gather import gather
from meshskin.estimation.data.unit_checks import angles, check_clock, off_surface, on_facets

RADIUS = 8e-3
"""Of the indenter, m."""


@pytest.fixture(scope="module")
def contacts():
    """Points (m, 3) on a sphere, and the normals there."""
    direction = np.random.default_rng(0).normal(size=(1000, 3))
    direction /= np.linalg.norm(direction, axis=1)[:, None]
    return ms.Body.sphere(0.1), 0.1 * direction, direction


def leaning(normals, angle):
    """Normals (m, 3) turned by `angle` (m,), rad, about a direction across."""
    across = np.cross(normals, [0.3, -0.5, 0.8])
    across /= np.linalg.norm(across, axis=1)[:, None]
    return np.cos(angle)[:, None] * normals + np.sin(angle)[:, None] * across


def test_contacts_off_the_surface_and_leaning_normals_are_found(contacts):
    body, points, normals = contacts
    rows, angle = np.arange(len(points)), np.zeros(len(points))
    wrong = (rows < 30) | (rows >= 980)
    points = points + np.where(rows < 30, 1e-3, 1e-6)[:, None] * normals
    angle[980:] = np.radians(10.0)
    hit, recorded = body.closest(points), leaning(normals, angle)
    np.testing.assert_allclose(angles(hit, recorded), angle, atol=1e-4)
    np.testing.assert_array_equal(off_surface(hit, recorded, RADIUS), wrong)
    np.testing.assert_array_equal(
        off_surface(hit, np.full_like(normals, np.nan), RADIUS), rows < 30
    )


def test_errors_of_all_contacts_accuse_none(contacts):
    body, points, normals = contacts
    rng = np.random.default_rng(1)
    scattered = body.closest(points + rng.normal(0, 1e-3, (len(points), 1)) * normals)
    noisy = leaning(normals, rng.normal(0, 0.1, len(points)))
    assert not off_surface(scattered, noisy, RADIUS).any()
    many = body.closest(points + np.where(np.arange(len(points)) < 300, 1e-3, 0)[:, None] * normals)
    assert not off_surface(many, normals, RADIUS).any()


def test_strays_are_left_out_and_said(noisy):
    recording = ms.press(noisy, noisy.skin.positions, seed=1)
    points = recording.points.copy()
    points[[3, 40]] += 1e-3 * recording.normals[[3, 40]]
    strayed = recording.with_columns(points=points)
    data = gather(strayed, noisy.belief())
    assert data.strays == 2
    assert len(data.points) == len(recording.points) - 2
    np.testing.assert_array_equal(
        data.recorded, np.setdiff1d(np.arange(len(recording.points)), [3, 40])
    )
    belief = replace(noisy.belief(), noise_sigma=None)
    assert "without 2 contacts off the believed surface" in (ms.calibrate(strayed, belief).factors)


@pytest.mark.parametrize("seed", [1, 2])
def test_contacts_made_on_the_faces_of_a_noisy_mesh_are_on_its_surface(noisy, seed):
    """The smooth surface leaves the faces: 73 and 45 of 1000 contacts on them were left out."""
    ball = trimesh.creation.icosphere(subdivisions=3, radius=0.1)
    ball.vertices += 1e-3 * np.random.default_rng(seed).normal(size=ball.vertices.shape)
    body = ms.Body.from_mesh(ball)
    scene = noisy.with_(body=body, skin=noisy.skin.onto(body))
    made, rows = trimesh.sample.sample_surface(body.mesh, 1000, seed=seed)
    face = body.mesh.face_normals[rows]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # places too hollow for a contact model
        recording = ms.press(scene, made, seed=1)
    off = off_surface(body.closest(made), face, RADIUS)
    assert off.sum() > 5
    assert on_facets(body, made, face, RADIUS).mean() > 0.98
    assert not on_facets(body, made + 0.2e-3 * face, face, RADIUS).any()
    assert not on_facets(body, made, -face, RADIUS).any()
    data = gather(recording.with_columns(points=made, normals=face), scene.belief())
    assert data.strays == (off & ~on_facets(body, made, face, RADIUS)).sum() < 0.1 * off.sum()


def test_a_clock_that_was_set_back_is_refused(noisy):
    """Later readings would belong to earlier contacts. Tables in other orders are taken."""
    recording = ms.press(noisy, noisy.skin.positions, seed=1)
    taxel, time = recording.reading_taxel, recording.readings["time"].to_numpy()
    count, half = len(recording.time), recording.time[len(recording.time) // 2]
    twice = recording.with_columns(points=np.roll(recording.points, count // 2, axis=0))
    for rows in (np.lexsort((time, taxel)), np.random.default_rng(0).permutation(len(time))):
        table = recording.readings.take(pa.array(rows))
        check_clock(replace(recording, readings=table), taxel[rows])
    both = np.append(time, time + recording.time[-1] + recording.frame)
    late = np.append(np.zeros(len(time), dtype=bool), np.ones(len(time), dtype=bool))
    table = pa.concat_tables([recording.readings, twice.readings])
    table = table.set_column(0, "time", pa.array(both))
    check_clock(replace(recording, readings=table), np.tile(taxel, 2))
    table = table.set_column(0, "time", pa.array(both - late * (both[late].min() - half)))
    with pytest.raises(RecordingError, match="clock of the readings was set back"):
        check_clock(replace(recording, readings=table), np.tile(taxel, 2))
