"""The skinned surface: an exact offset where a ball touches the body once, a bridge elsewhere."""

import numpy as np
import pytest
import trimesh

import meshskin as ms
from meshskin.core.errors import MeshError
from meshskin.geometry.surface.closing import surface_nets
from meshskin.robot import collision

THICKNESS, FEATURE = 2e-3, 6e-3


@pytest.fixture(scope="module")
def plate():
    """A box with a pit of 4 mm width and depth in its upper face, and a named patch."""
    x = np.array([-20.0, -2.0, 2.0, 20.0])
    bottom = trimesh.creation.box(bounds=[[-20, -20, -10], [20, 20, -4]])
    parts = [bottom]
    for i in range(3):
        for j in range(3):
            if (i, j) != (1, 1):
                bounds = [[x[i], x[j], -4.0], [x[i + 1], x[j + 1], 0.0]]
                parts.append(trimesh.creation.box(bounds=bounds))
    whole = trimesh.util.concatenate(parts)
    return ms.Body("plate", trimesh.Trimesh(1e-3 * whole.vertices, whole.faces, process=False))


def test_a_level_set_becomes_a_closed_mesh_of_the_right_volume():
    grid = np.stack(np.meshgrid(*(np.arange(n) for n in (30, 34, 38)), indexing="ij"), axis=-1)
    vertices, faces = surface_nets(np.linalg.norm(grid - (14.3, 16.1, 18.2), axis=-1) - 10.2)
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.volume == pytest.approx(4.0 / 3.0 * np.pi * 10.2**3, rel=0.02)
    np.testing.assert_allclose(mesh.center_mass, (14.3, 16.1, 18.2), atol=0.02)


@pytest.mark.slow
def test_the_skin_of_a_smooth_body_is_its_offset_surface():
    skinned = ms.Body.sphere(0.02).skinned(THICKNESS, FEATURE, resolution=1e-3)
    radius = np.linalg.norm(skinned.mesh.vertices, axis=1)
    np.testing.assert_allclose(radius, 0.022, atol=1e-7)
    np.testing.assert_allclose(
        skinned.closest(np.array([[0.03, 0.0, 0.0], [0.0, 0.02, 0.0]])).distance,
        (8e-3, -2e-3),
        atol=2e-6,
    )
    assert "bridges 0 %" in skinned.repairs[-1]


@pytest.mark.deep
def test_a_ball_of_the_feature_size_fits_everywhere_and_sinks_into_a_pit_as_it_must(plate):
    skinned = plate.skinned(THICKNESS, FEATURE, resolution=0.7e-3)
    hit = skinned.closest(skinned.mesh.triangles_center)
    centres = hit.point + 0.98 * FEATURE * hit.normal
    clear = skinned.closest(centres).distance
    assert np.quantile(clear, 0.01) > 0.95 * FEATURE
    # over the middle of the pit the ball rests on four corners of the skin's upper side
    rim = np.sqrt((THICKNESS + FEATURE) ** 2 - 2.0 * 2e-3**2)
    x = np.linspace(-2e-3, 2e-3, 41)
    ways = np.stack(np.meshgrid(x, x), axis=-1).reshape(-1, 2)
    above = np.column_stack([ways, np.full(len(ways), 0.05)])
    top = skinned.project(above, np.repeat([[0.0, 0.0, -1.0]], len(above), axis=0)).point[:, 2]
    edge = np.sqrt((THICKNESS + FEATURE) ** 2 - 2e-3**2) - FEATURE
    middle = top[len(top) // 2]
    assert rim - FEATURE - 0.1e-3 < middle < edge + 0.1e-3
    far = skinned.project([[0.012, 0.012, 0.05]], [[0.0, 0.0, -1.0]]).point[0, 2]
    assert far == pytest.approx(THICKNESS, abs=2e-6)
    assert "at most" in skinned.repairs[-1]


@pytest.mark.slow
def test_the_indenter_fits_on_the_skin_over_a_pit_and_beside_its_edges(plate):
    indenter, depth = ms.Indenter.sphere(4e-3), 0.2e-3
    skinned = plate.skinned(THICKNESS, 8e-3, resolution=0.7e-3)

    def reasons(body, height):
        hit = body.closest([[0.0, 0.0, height], [2.3e-3, 0.0, height]])
        found = collision.contact_reasons(body, hit.point, hit.normal, indenter, depth)
        near = collision.edge_points(body, 0.2e-3)
        edge = np.linalg.norm(hit.point[:, None] - near, axis=2).min(axis=1, initial=1.0)
        return list(found), edge > 0.5e-3

    bare, clear = reasons(plate, -4e-3)
    assert bare[0] == collision.HOLLOW
    bare, clear = reasons(plate, 0.0)
    assert not clear[1]
    over, clear = reasons(skinned, THICKNESS)
    assert over == ["", ""]
    assert clear.all()


def test_patches_keep_their_names():
    mesh = ms.Body.sphere(0.02).mesh
    upper = np.flatnonzero(mesh.triangles_center[:, 2] > 0.0)
    body = ms.Body("ball", mesh, patches={"upper": upper})
    skinned = body.skinned(THICKNESS, FEATURE, resolution=1.5e-3)
    middle = skinned.mesh.triangles_center[:, 2]
    share = np.isin(np.arange(len(middle)), skinned.patches["upper"])
    assert share[middle > 2e-3].all()
    assert not share[middle < -2e-3].any()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"thickness": 0.0}, "thickness"),
        ({"thickness": 1e-3, "resolution": 5e-3}, "too coarse"),
        ({"thickness": 1e-3, "resolution": 2e-5}, "too large"),
    ],
)
def test_a_skin_that_cannot_be_meshed_is_refused(given, message):
    with pytest.raises(MeshError, match=message):
        ms.Body.sphere(0.05).skinned(**given)
