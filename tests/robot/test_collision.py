"""What the arm meets, against points that are strewn densely along its links."""

from dataclasses import replace

import numpy as np
import pytest

import meshskin as ms
from meshskin.core.se3 import transform
from meshskin.robot import collision

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


def judged(body, along, angles, axis="0 1 0"):
    """Why a body `along` the tip's axis, m, collides with a forearm of 0.3 m at wrist angles, and
    what counts as its mount.
    """
    arm = ms.Arm.from_text(BENT.replace("AXIS", axis), "tool")
    mount = transform(np.eye(3), (0.0, 0.0, along))
    q = np.stack([np.zeros(len(angles)), angles], axis=1)
    held = collision.allowed_collisions(arm, body, mount)
    return list(collision.arm_reasons(arm, body, q, arm.pose(q) @ mount, AWAY, held)), held


def test_a_link_that_can_be_clear_of_the_body_is_judged_up_to_the_tip():
    """A ball of 3 cm, 10 cm before the joint: folded back it lies on the forearm."""
    why, held = judged(ms.Body.sphere(0.03), 0.08, [0.0, 1.5, 2.8])
    assert why == ["", "", collision.ARM_BODY]
    assert held.notes == ()
    assert not held.near_tip.any()


def test_what_is_always_in_the_body_is_its_mount_however_far_from_the_tip():
    """A sleeve about the forearm that rolls: nothing could be explored were it judged."""
    sleeve = ms.Body.capsule(0.05, 0.2)
    why, held = judged(sleeve, -0.17, [-2.0, 0.0, 2.0], axis="0 0 1")
    assert why == [""] * 3
    assert held.everywhere.all()
    (note,) = held.notes
    assert note.startswith("link forearm: meets the body in every posture")


def test_of_a_link_that_always_meets_the_body_the_rest_is_judged():
    """A rod through the wrist: it lies along the forearm, or across it."""
    why, held = judged(ms.Body.capsule(0.03, 0.4), 0.0, [0.0, 1.5])
    assert why == [collision.ARM_BODY, ""]
    assert held.names == ("forearm",)
    assert not held.everywhere.all()


@pytest.mark.parametrize("way", [(0.0, 0.0, 1.0), (0.48, -0.64, 0.6), (-1.0, 0.0, 0.0)])
def test_nothing_that_meets_is_passed_over(sphere, way):
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
