"""Tilt of the surface displaces contacts; another sheet widens positions along the normal."""

from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

import meshskin as ms
from meshskin.core.se3 import transform
from meshskin.estimation.uncertainty.surface_errors import sheet_covariance, tilts
from meshskin.geometry.region import Cap

UP = np.array([0.0, 0.0, 1.0])


@pytest.mark.parametrize("slope", [0.0, 0.03])
def test_contacts_under_a_tilted_surface_are_displaced_by_the_radius(slope):
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(-5e-3, 5e-3, (300, 2)), np.zeros(300)])
    data = SimpleNamespace(
        ids=np.arange(2),
        taxel=np.repeat([0, 1], 150),
        contact=np.arange(300),
        pressure=rng.uniform(1.0, 2.0, 300),
        belief=SimpleNamespace(indenter=SimpleNamespace(radius=0.01)),
    )
    height = slope * points[:, 0] + rng.normal(0.0, 1e-6, 300)
    found = tilts(data, points, height)
    np.testing.assert_allclose(found, np.tile([0.01 * slope, 0.0, 0.0], (2, 1)), atol=1e-5)


def box(size, top):
    """A box (3,), m, whose upper face is at a height, m."""
    return trimesh.creation.box(size, transform(np.eye(3), (top - size[2] / 2) * UP))


@pytest.fixture(scope="module")
def lid():
    """A box, and in it a smaller one whose upper face is 0.4 mm below the other's."""
    parts = box((0.08, 0.06, 0.02), 0.0), box((0.04, 0.03, 0.01), -0.4e-3)
    return ms.Body.from_mesh(trimesh.util.concatenate(parts))


def test_a_sheet_below_and_a_sheet_above(lid):
    places = np.array([[0.0, 0.0, 0.0], [0.01, 0.01, -0.4e-3], [0.03, 0.02, 0.0], [np.nan] * 3])
    found = np.sqrt(sheet_covariance(lid, places))
    assert found[:, 2, 2] == pytest.approx([0.4e-3, 0.4e-3, 0.0, 0.0], abs=1e-8)
    assert found[:, 3, 3] == pytest.approx(0.0, abs=1e-6)


def test_taxels_of_rigid_modules_are_off_their_sheet(lid):
    """Their height over the surface is not the distance of another sheet."""
    places = np.array([[0.03, 0.02, 0.3e-3], [0.0, 0.0, 0.3e-3], [0.0, 0.01, -0.7e-3]])
    found = np.sqrt(sheet_covariance(lid, places)[:, 2, 2])
    assert found == pytest.approx([0.0, 0.4e-3, 0.4e-3], abs=1e-8)
    body = ms.Body.capsule(radius=0.05, length=0.15)
    for seed in range(3):
        disc = ms.Disc(point=(0.05, 0.0, 0.0), radius=0.045)
        modules = ms.Skin.modules(body, count=3, region=disc, seed=seed).skin
        assert np.abs(body.closest(modules.positions).distance).max() > 0.2e-3
        assert not sheet_covariance(body, modules.positions).any()


def test_the_other_face_of_a_thin_plate_is_no_such_sheet():
    plate = ms.Body.from_mesh(box((0.08, 0.06, 0.6e-3), 0.0))
    assert np.abs(sheet_covariance(plate, np.zeros((1, 3)))).max() < 1e-15


def test_a_thin_plate_in_any_position_gives_no_warning():
    """Cosines of its faces' normals are beyond -1 by rounding."""
    for angle in np.linspace(0.1, 1.5, 12):
        mesh = box((0.08, 0.06, 0.8e-3), 0.0)
        turn = trimesh.transformations.euler_matrix(angle, 2.0 * angle, 3.0 * angle)
        mesh.apply_transform(turn)
        up = turn[:3, :3] @ UP
        top = mesh.vertices @ up
        places = top.max() * up + np.linspace(-0.02, 0.02, 20)[:, None] * turn[:3, 0]
        with np.errstate(invalid="raise"):
            found = sheet_covariance(ms.Body.from_mesh(mesh), places)
        assert np.isfinite(found).all()


def test_it_is_in_the_covariance_of_a_taxel(lid, noisy):
    region = Cap(direction=UP)
    skin = ms.Skin.cover(lid, spacing=5e-3, count=12, region=region)
    scene = noisy.with_(body=lid, skin=skin)
    near = np.repeat(skin.positions, 12, axis=0)
    rng = np.random.default_rng(1)
    places = near + rng.uniform(-4e-3, 4e-3, near.shape) * [1.0, 1.0, 0.0]
    made = ms.press(scene, places, force=rng.uniform(2.5, 3.5, len(places)), seed=1)
    found = ms.calibrate(made, scene.belief())
    over = (np.abs(skin.positions[:, :2]) < [0.019, 0.014]).all(axis=1)
    assert over.sum() > 5
    assert np.sqrt(found.covariances[over, 2, 2]) == pytest.approx(0.4e-3, rel=1e-3)
