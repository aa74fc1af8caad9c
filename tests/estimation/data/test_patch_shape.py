"""The curvature over a patch: that of the point where the body is smooth, else the patch's."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import meshskin as ms
from meshskin.estimation.data.patch_shape import in_hollows, over_patches, without_hollows

RADIUS = 0.01


def belief(body):
    return ms.Belief(
        body=body,
        indenter=ms.Indenter.sphere(RADIUS),
        material=ms.Material(young=3e5),
        taxel_ids=np.arange(1),
    )


def shaped(body, points, force=3.0):
    return over_patches(belief(body), body.closest(points), np.full(len(points), force))


def tube(sides):
    """A cylinder of 4 cm with so many flat faces, along z."""
    return trimesh.creation.cylinder(radius=0.04, height=0.2, sections=sides)


def test_of_a_smooth_body_it_is_that_of_the_point():
    """Within a hundredth: the square of the patch's radius over the body's."""
    body = ms.Body.torus(0.1, 0.04)
    rng = np.random.default_rng(0)
    hit = body.closest(body.mesh.vertices[rng.choice(len(body.mesh.vertices), 200)])
    found = over_patches(belief(body), hit, np.full(200, 3.0))
    np.testing.assert_allclose(found.curvature, hit.curvature, atol=0.02 * 25)
    assert np.abs(np.einsum("mc,mc->m", found.direction, hit.direction)).min() > 0.999
    np.testing.assert_array_equal(found.point, hit.point)


def test_beside_an_edge_it_is_between_the_flat_face_and_the_edge():
    """On a face of a box, 1 mm from its edge, the point's curvature is 0 and the patch's is not."""
    body = ms.Body.from_mesh(trimesh.creation.box((0.1, 0.1, 0.1)))
    beside, far = [0.049, 0.0, 0.05], [0.0, 0.0, 0.05]
    assert np.abs(body.closest([beside]).curvature).max() < 1e-6
    near, away = shaped(body, [beside, far]).curvature
    assert near[0] > 30.0
    assert abs(near[1]) < 0.05 * near[0]
    assert np.abs(away).max() < 1e-6


@pytest.mark.parametrize("where", [0.0, 0.25, 0.5])
def test_of_facets_narrower_than_the_patch_it_is_that_of_the_round_body(where):
    """A cylinder of 60 flat strips, 4.2 mm wide, wherever on them the contact is."""
    mesh = tube(60)
    seams = mesh.face_adjacency_edges[mesh.face_adjacency_angles > 0.05]
    body = replace(ms.Body.from_mesh(mesh), seams=seams)  # the strips stay flat
    angle = 2 * np.pi * (3 + where) / 60
    point = 0.04 * np.array([[np.cos(angle), np.sin(angle), 0.03]])
    assert np.abs(body.closest(point).curvature).max() < 1e-6
    found = shaped(body, point)
    np.testing.assert_allclose(found.curvature[0], [25.0, 0.0], atol=6.0)
    assert abs(found.direction[0, 2]) < 0.1  # 6 degrees


def test_contacts_without_force_stay_as_they_are():
    body = ms.Body.sphere(0.1)
    hit = body.closest(body.mesh.vertices[:3])
    assert over_patches(belief(body), hit, np.zeros(3)) is hit


def test_tight_hollows_get_a_curvature_that_the_indenter_fits():
    """As the creases of a coarse mesh have; most contacts in such are a body it does not fit."""
    body = ms.Body.torus(0.1, 0.04)
    hit = body.closest(body.mesh.vertices[:500])
    assert without_hollows(hit, RADIUS) is hit
    assert not in_hollows(hit, RADIUS).any()
    tight = hit.curvature.copy()
    some = len(tight) // 5
    tight[:some, 1] = -8548.0
    few = without_hollows(replace(hit, curvature=tight), RADIUS)
    np.testing.assert_allclose(few.curvature[:some, 1], -0.9 / RADIUS)
    np.testing.assert_array_equal(few.curvature[some:], hit.curvature[some:])
    np.testing.assert_array_equal(in_hollows(few, RADIUS), np.arange(len(tight)) < some)
    tight[: 3 * some, 1] = -8548.0
    many = replace(hit, curvature=tight)
    assert without_hollows(many, RADIUS) is many
