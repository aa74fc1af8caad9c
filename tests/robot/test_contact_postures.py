"""All postures that hold a skin on the indenter."""

import numpy as np

from meshskin.robot import contact_postures


def test_the_skin_lies_on_the_indenter_in_every_posture(sphere):
    q = sphere.postures
    pose = sphere.body_pose(q)
    centre = np.einsum(
        "kji,kj->ki", pose[:, :3, :3], np.array(sphere.indenter.position) - pose[:, :3, 3]
    )
    hit = sphere.body.closest(centre)
    gap = sphere.indenter.radius - sphere.patch.depth
    np.testing.assert_allclose(hit.distance, gap, atol=1e-6)
    down = np.einsum("kij,kj->ki", pose[:, :3, :3], hit.normal)
    np.testing.assert_allclose(down, [[0.0, 0.0, -1.0]] * len(q), atol=1e-4)
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
    from meshskin.scene.settings import Loop

    assert len(sphere.with_(loop=Loop(mode="quasi_static")).postures) == 0


def test_places_are_spread():
    line = np.column_stack([np.arange(11.0), np.zeros(11), np.zeros(11)])
    assert contact_postures.spread(line, 3).tolist() == [0, 10, 5]
    assert contact_postures.spread(line[:1], 3).tolist() == [0]
    assert contact_postures.spread(np.zeros((4, 3)), 3).tolist() == [0]
