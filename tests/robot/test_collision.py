"""Collisions of the arm, against dense samples of its links."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

import meshskin as ms
from meshskin.core.se3 import transform
from meshskin.robot import collision, link_shapes

from ..height_field import height_field

BENT = """<robot name="bent"><link name="base"/>
  <joint name="turn" type="revolute"><parent link="base"/><child link="forearm"/>
    <axis xyz="0 0 1"/><limit lower="-2" upper="2"/></joint>
  <link name="forearm"><collision><origin xyz="0 0 0.15"/>
    <geometry><cylinder radius="0.02" length="0.26"/></geometry></collision></link>
  <joint name="wrist" type="revolute"><parent link="forearm"/><child link="hand"/>
    <origin xyz="0 0 0.3"/><axis xyz="AXIS"/><limit lower="-2.9" upper="2.9"/></joint>
  <link name="hand"/>
  <joint name="flange" type="fixed"><parent link="hand"/><child link="tool"/>
    <origin xyz="0 0 0.02"/></joint><link name="tool"/></robot>"""
AWAY = ms.Indenter(position=(5.0, 5.0, 5.0))


def reasons(body, along, angles, axis="0 1 0"):
    """Why a body `along` the tip's axis, m, collides with a forearm of 0.3 m at wrist angles, and
    what belongs to its mount.
    """
    arm = ms.Arm.from_text(BENT.replace("AXIS", axis), "tool")
    mount = transform(np.eye(3), (0.0, 0.0, along))
    q = np.stack([np.zeros(len(angles)), angles], axis=1)
    allowed = collision.allowed_collisions(arm, body, mount)
    return list(collision.arm_reasons(arm, body, q, arm.pose(q) @ mount, AWAY, allowed)), allowed


def rippled_plate(height):
    """A plate 12 mm wide whose surface rises and falls by `height`, m, every 2.7 mm along x."""
    mesh = height_field(lambda x, y: -height * np.cos(2.0 * np.pi * x / 2.7e-3), 6e-3)
    return ms.Body.from_mesh(trimesh.Trimesh(*mesh), open=True)


def test_ripples_of_a_small_part_of_the_depth_within_the_patch_are_no_hollows():
    """A sphere that touches the bottom of a ripple of 40 um overlaps its sides by 17 um."""

    def reason(height, depth):
        hit = rippled_plate(height).closest([[0.0, 0.0, 0.0]])
        return collision.contact_reasons(
            rippled_plate(height), hit.point, hit.normal, ms.Indenter.sphere(8e-3), depth
        )[0]

    assert reason(40e-6, 1.28e-3) == ""
    assert reason(40e-6, 0.2e-3) == collision.HOLLOW
    assert reason(200e-6, 1.28e-3) == collision.HOLLOW


def test_a_link_that_can_be_clear_of_the_body_is_checked_up_to_the_tip():
    """A sphere of radius 3 cm, 10 cm from the joint, meets the forearm in a folded wrist."""
    reason, allowed = reasons(ms.Body.sphere(0.03), 0.08, [0.0, 1.5, 2.8])
    assert reason == ["", "", collision.ARM_BODY]
    assert allowed.notes == ()
    assert not allowed.near_tip.any()


def test_spheres_that_are_always_in_the_body_are_not_checked():
    """A sleeve about the forearm, which only rolls in it."""
    sleeve = ms.Body.capsule(0.05, 0.2)
    reason, allowed = reasons(sleeve, -0.17, [-2.0, 0.0, 2.0], axis="0 0 1")
    assert reason == [""] * 3
    assert allowed.everywhere.all()
    (note,) = allowed.notes
    assert note.startswith("link forearm: meets the body in every posture")


def test_the_far_part_of_a_link_that_always_meets_the_body_is_checked():
    """A rod through the wrist lies along the forearm, or across it."""
    reason, allowed = reasons(ms.Body.capsule(0.03, 0.4), 0.0, [0.0, 1.5])
    assert reason == [collision.ARM_BODY, ""]
    assert allowed.names == ("forearm",)
    assert not allowed.everywhere.all()


@pytest.mark.parametrize("way", [(0.0, 0.0, 1.0), (0.48, -0.64, 0.6), (-1.0, 0.0, 0.0)])
def test_all_collisions_are_found(sphere, way):
    arm, shape = sphere.arm, collision.arm_capsules(sphere.arm)
    body, size = ms.Body.sphere(0.1), 0.1
    rng = np.random.default_rng(1)
    q = rng.uniform(np.maximum(arm.lower, -3), np.minimum(arm.upper, 3), (2000, len(arm.lower)))
    poses = np.tile(np.eye(4), (len(q), 1, 1))
    poses[:, :3, 3] = rng.uniform([-0.4, -0.4, 0.2], [0.4, 0.4, 1.0], (len(q), 3))
    place = replace(
        sphere.indenter, position=(0.25, 0.1, 0.9), support_height=1.2, support_radius=0.05,
        direction=way,
    )  # fmt: skip
    got = collision.arm_reasons(arm, body, q, poses, place)

    ends, part = shape.at(q), np.linspace(0.0, 1.0, 100)[:, None]
    points = ends[:, :, None, 0] * (1 - part) + ends[:, :, None, 1] * part  # (k, l, p, 3)
    far = (np.linalg.norm(points - poses[:, None, None, :3, 3], axis=-1) - size).min(axis=2)
    top = np.array(place.position)
    below = np.clip((top - points) @ way, 0.0, place.radius + place.support_height)
    aside = points - top + below[..., None] * way
    gap = np.linalg.norm(aside, axis=-1).min(axis=2) - place.column_radius
    support, struck = ((d < shape.radii - 5e-4).any(axis=1) for d in (gap, far))
    apart = [(d > s * shape.radii + 5e-4).all(axis=1) for d, s in ((gap, 1.0), (far, 1.04))]
    assert min(x.sum() for x in (support, struck, *apart)) > 20
    assert (got[struck] == collision.ARM_BODY).all()
    assert (got[support & apart[1]] == collision.ARM_SUPPORT).all()
    assert (got[apart[0] & apart[1]] == "").all()


def test_the_support_is_found_to_meet_the_body_where_dense_samples_do():
    body = ms.Body.torus(0.03, 0.012)
    rng = np.random.default_rng(2)
    hit = body.closest(rng.normal(size=(400, 3)) * (0.03, 0.03, 0.01))
    indenter = ms.Indenter.sphere(4e-3)
    tilted = hit.normal + 0.6 * rng.normal(size=(400, 3))
    axis = tilted / np.linalg.norm(tilted, axis=1)[:, None]
    heights = collision.support_samples(indenter)
    samples = (hit.point[:, None] + heights[:, None] * axis[:, None]).reshape(-1, 3)
    least = collision.PITCH_ERROR * indenter.column_radius
    dense = (body.closest(samples).distance < least).reshape(400, -1).any(axis=1)
    assert 50 < dense.sum() < 350
    found = collision._support_meets(body, hit.point, axis, indenter)
    np.testing.assert_array_equal(found, dense)


def test_capsules_enclose_the_shapes_of_links():
    boxed = """<robot name="r"><link name="base"><collision><origin xyz="0 0 0.2"/>
      <geometry><cylinder radius="0.05" length="0.4"/></geometry></collision></link>
      <joint name="j" type="continuous"><parent link="base"/><child link="arm"/>
      <origin xyz="0 0 0.4"/><axis xyz="0 0 1"/></joint><link name="arm"/>
      <joint name="k" type="fixed"><parent link="arm"/><child link="tool"/>
      <origin xyz="0.3 0 0"/></joint><link name="tool"/></robot>"""
    found = collision.arm_capsules(ms.Arm.from_text(boxed, "tool"))
    assert found.names == ("base", "arm")
    ends = found.at(np.array([[np.pi / 2]]))[0]
    np.testing.assert_allclose(ends[1], [[0, 0, 0.4], [0, 0.3, 0.4]], atol=1e-12)
    assert found.radii[1] == collision.LINK_RADIUS
    assert 0.05 <= found.radii[0] < 0.08
    assert np.abs(ends[0][:, :2]).max() < 1e-9
    low, high = np.sort(ends[0][:, 2])
    assert low - found.radii[0] <= 1e-9
    assert high + found.radii[0] >= 0.4 - 1e-9


def test_the_distance_of_segments_agrees_with_dense_samples():
    rng = np.random.default_rng(3)
    a, b = rng.normal(size=(2, 60, 3))
    c, d = rng.normal(size=(2, 3))
    a[0], b[0] = c + np.eye(3)[0], d + np.eye(3)[0]  # parallel
    b[1] = a[1]  # a point
    part = np.linspace(0.0, 1.0, 101)[:, None]
    dense = np.linalg.norm(
        (a[:, None] * (1 - part) + b[:, None] * part)[:, :, None]
        - (c * (1 - part) + d * part)[None, None],
        axis=-1,
    ).min(axis=(1, 2))
    got = link_shapes.segment_distance(a, b, c, d)
    assert (got <= dense + 1e-12).all()
    np.testing.assert_allclose(got, dense, atol=0.05)
