"""The tangent plane, spacing, exaggeration, and the thinned mesh of the picture."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from meshskin.geometry.body import Body
from meshskin.report.decimation import decimate
from meshskin.report.plane import LEAST_PITCH, enlargement, pitch, tangent_plane


def test_the_plane_keeps_lengths_in_it_and_is_seen_from_outside(case: SimpleNamespace) -> None:
    skin = case.skin()
    plane = tangent_plane(skin.positions, skin.normals)
    assert np.allclose(plane.axes @ plane.axes.T, np.eye(2))
    assert np.cross(*plane.axes) @ skin.normals.mean(axis=0) > 0.9
    shift = 1e-3 * plane.axes[0] + 2e-3 * plane.axes[1]
    assert np.allclose(plane.project(plane.origin + shift), [1.0, 2.0])


def test_the_plane_without_a_mean_normal_is_the_best_fitting_one() -> None:
    flat = np.random.default_rng(0).normal(size=(30, 3)) * [1.0, 1.0, 0.0]
    flat[4] = np.nan
    plane = tangent_plane(flat, np.zeros_like(flat))
    assert np.allclose(np.abs(np.cross(*plane.axes)), [0, 0, 1])
    assert np.allclose(plane.origin, np.nanmean(flat, axis=0))


def test_covariances_project_as_lengths_do(case: SimpleNamespace) -> None:
    plane = tangent_plane(case.skin().positions, case.skin().normals)
    one = plane.axes.T @ np.diag([4e-6, 1e-6]) @ plane.axes
    both = plane.project_covariance(np.stack([one, np.full((3, 3), np.inf)]))
    assert np.allclose(both[0], np.diag([4.0, 1.0]))
    assert np.isnan(both[1]).all()


def test_the_pitch_is_the_median_distance_of_nearest_neighbours() -> None:
    grid = np.stack(np.meshgrid(np.arange(4.0), np.arange(4.0), [0.0]), axis=-1).reshape(-1, 3)
    grid[3] = np.nan
    assert pitch(5e-3 * grid) == pytest.approx(5e-3)
    assert pitch(np.zeros((1, 3))) == LEAST_PITCH


@pytest.mark.parametrize(
    ("length", "factor"), [(1e-3, 1000.0), (3e-3, 200.0), (0.4, 2.0), (5.0, 1.0), (0.0, 1.0)]
)
def test_exaggeration_is_a_round_factor_and_never_shrinks(length: float, factor: float) -> None:
    assert enlargement([length, np.nan, np.inf], 1.0) == factor


def test_thinning_keeps_the_skin_and_the_shape(case: SimpleNamespace) -> None:
    mesh = Body.sphere(radius=case.RADIUS, faces=20480).mesh
    focus = case.skin().positions
    v, f = decimate(mesh.vertices, mesh.faces, focus, 5000)
    assert 2500 < len(f) <= 5000
    assert f.max() < len(v)
    radius = np.linalg.norm(v, axis=1)
    assert radius.min() > 0.95 * case.RADIUS
    kept = {tuple(p) for p in v}
    fine = mesh.vertices[np.linalg.norm(mesh.vertices - focus[0], axis=1) < 0.02]
    assert all(tuple(p) in kept for p in fine)
    edges = np.sort(f[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    counts = np.unique(edges, axis=0, return_counts=True)[1]
    assert np.all(counts % 2 == 0), "the thinned sphere has a crack"


def test_thinning_under_a_skin_all_around_is_even_and_faces_outwards() -> None:
    mesh = Body.sphere(radius=0.1, faces=20480).mesh
    v, f = decimate(mesh.vertices, mesh.faces, mesh.vertices[::20], 5000)
    assert 1000 < len(f) <= 5000
    a, b, c = (v[f[:, k]] for k in range(3))
    assert np.mean(np.einsum("fi,fi->f", np.cross(b - a, c - a), a) > 0) > 0.99
    assert np.linalg.norm(v[np.unique(f)], axis=1).min() > 0.095


def test_a_small_mesh_is_left_alone() -> None:
    mesh = Body.sphere(radius=0.1, faces=320).mesh
    v, f = decimate(mesh.vertices, mesh.faces, np.zeros((0, 3)))
    assert len(f) == len(mesh.faces)
    assert np.array_equal(v, mesh.vertices)
