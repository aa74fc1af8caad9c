"""Charts: third-order contact with the surface, continuous frames."""

import numpy as np
import pytest
import trimesh

import meshskin as ms
from meshskin.core.se3 import transform
from meshskin.estimation import chart
from meshskin.geometry.primitives import Ellipsoid, Sphere, Torus


@pytest.fixture
def directions():
    d = np.random.default_rng(1).normal(size=(50, 3))
    return d / np.linalg.norm(d, axis=1)[:, None]


@pytest.mark.parametrize("body", [Sphere(0.1), Ellipsoid((0.1, 0.08, 0.12)), Torus(0.1, 0.03)])
def test_chart_leaves_the_surface_with_the_third_power(body, directions):
    charts = chart.charts_at(body, 0.11 * directions)
    curvature = np.sort(np.linalg.eigvalsh(charts.shape))[:, ::-1]
    assert np.allclose(curvature, body.closest(charts.points).curvature, rtol=2e-4, atol=2e-3)
    y = np.random.default_rng(2).normal(size=(50, 2))
    y *= 1e-3 / np.linalg.norm(y, axis=1)[:, None]
    gap = [np.abs(body.closest(charts.at(h * y)).distance).max() for h in (1.0, 0.5)]
    flat = 0.5 * 1e-6 * np.abs(curvature).max()
    assert gap[0] < 0.1 * flat
    assert gap[0] > 6 * gap[1]


def test_frames_are_frames_and_continue(directions):
    rotation = chart.frames(directions)
    assert np.allclose(rotation @ np.swapaxes(rotation, 1, 2), np.eye(3), atol=1e-12)
    assert np.allclose(np.linalg.det(rotation), 1)
    assert np.allclose(rotation[:, :, 2], directions)
    near = directions + 1e-4 * np.roll(directions, 1, axis=1)
    near /= np.linalg.norm(near, axis=1)[:, None]
    assert np.abs(chart.align_normals(rotation, near) - rotation).max() < 3e-4


@pytest.mark.parametrize("gap", [0.4e-3, 1.2e-3, 3e-3])
def test_what_a_sheet_covers_moves_up_to_it(gap):
    """A plate over a larger one, as the cover of a link: past its rim the lower one is bare."""
    size = (0.04, 0.03, 0.2e-3), (0.1, 0.1, 0.01)
    tops = 0.0, -gap
    parts = [
        trimesh.creation.box(s, transform(np.eye(3), (0, 0, top - s[2] / 2)))
        for s, top in zip(size, tops, strict=True)
    ]
    body = ms.Body.from_mesh(trimesh.util.concatenate(parts))
    below = np.array([[0.0, 0.0, -gap], [0.019, 0.01, -gap], [0.021, 0.0, -gap]])
    charts = chart.charts_at(body, below)
    assert charts.points == pytest.approx(below, abs=1e-9)
    moved = chart.relinearized(body, charts, np.zeros((3, 2)))
    assert moved.points[:, :2] == pytest.approx(below[:, :2], abs=1e-9)
    assert moved.points[:, 2] == pytest.approx([0.0, 0.0, -gap], abs=1e-9)
    assert moved.normals == pytest.approx(np.tile([0.0, 0.0, 1.0], (3, 1)), abs=1e-9)
