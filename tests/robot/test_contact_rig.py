"""Postures that press a skin on the indenter, and the edges of bodies."""

import numpy as np
import trimesh

from meshskin import Body
from meshskin.robot import collision
from meshskin.robot.contact_rig import farthest_points
from meshskin.scene.settings import Loop


def test_every_posture_presses_the_skin_on_the_indenter(sphere):
    q = sphere.postures
    pose = sphere.body_pose(q)
    centre = np.einsum(
        "kji,kj->ki", pose[:, :3, :3], np.array(sphere.indenter.position) - pose[:, :3, 3]
    )
    hit = sphere.body.closest(centre)
    gap = sphere.indenter.radius - sphere.patch.depth
    np.testing.assert_allclose(hit.distance, gap, atol=1e-6)
    normal = np.einsum("kij,kj->ki", pose[:, :3, :3], hit.normal)
    np.testing.assert_allclose(normal, [[0.0, 0.0, -1.0]] * len(q), atol=1e-4)
    near = np.linalg.norm(hit.point[:, None] - sphere.skin.positions, axis=2).min(axis=1)
    assert near.max() < 1e-5
    assert np.all((q > sphere.arm.lower) & (q < sphere.arm.upper))


def test_the_arm_has_several_postures_at_all_spins(sphere):
    q = sphere.postures
    pose = sphere.body_pose(q)
    heading = np.arctan2(pose[:, 1, 0], pose[:, 0, 0])
    assert np.histogram(heading, 12, (-np.pi, np.pi))[0].min() > 0
    assert len(np.unique(np.sign(q[:, 4]))) == 2  # the wrist both ways


def test_without_an_arm_there_is_no_posture(sphere):
    assert len(sphere.with_(loop=Loop(mode="quasi_static")).postures) == 0


def test_farthest_points_are_spread():
    line = np.column_stack([np.arange(11.0), np.zeros(11), np.zeros(11)])
    assert farthest_points(line, 3).tolist() == [0, 10, 5]
    assert farthest_points(line[:1], 3).tolist() == [0]
    assert farthest_points(np.zeros((4, 3)), 3).tolist() == [0]


def test_the_edges_of_a_cylinder_are_its_rims_and_a_capsule_has_none():
    points = collision.edge_points(Body.cylinder(0.05, 0.2), 1e-3)
    np.testing.assert_allclose(np.hypot(*points[:, :2].T), 0.05, atol=1e-4)
    np.testing.assert_allclose(np.abs(points[:, 2]), 0.1, atol=1e-9)
    apart = np.sort(np.arctan2(points[:, 1], points[:, 0]))
    assert np.diff(apart).max() * 0.05 < 1.5e-3
    assert len(collision.edge_points(Body.capsule(0.05, 0.2), 1e-3)) == 0


def test_a_border_is_an_edge():
    plate = trimesh.creation.box((0.2, 0.2, 0.01))
    top = plate.submesh([np.flatnonzero(plate.face_normals[:, 2] > 0.5)], append=True)
    points = collision.edge_points(Body(name="plate", mesh=top.subdivide().subdivide()), 2e-3)
    np.testing.assert_allclose(np.abs(points[:, :2]).max(axis=1), 0.1, atol=1e-12)
