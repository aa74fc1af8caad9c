"""What the arm meets, against points that are strewn densely along its links."""

from dataclasses import replace

import numpy as np
import pytest

import meshskin as ms
from meshskin.motion import clear


@pytest.mark.parametrize("way", [(0.0, 0.0, 1.0), (0.48, -0.64, 0.6), (-1.0, 0.0, 0.0)])
def test_nothing_that_meets_is_passed_over(sphere, way):
    arm, shape = sphere.arm, clear.links(sphere.arm)
    body, size = ms.Body.sphere(0.1), 0.1
    rng = np.random.default_rng(1)
    q = rng.uniform(np.maximum(arm.lower, -3), np.minimum(arm.upper, 3), (2000, len(arm.lower)))
    poses = np.tile(np.eye(4), (len(q), 1, 1))
    poses[:, :3, 3] = rng.uniform([-0.4, -0.4, 0.2], [0.4, 0.4, 1.0], (len(q), 3))
    place = replace(
        sphere.indenter, position=(0.25, 0.1, 0.9), support_height=1.2, support_radius=0.05,
        direction=way,
    )  # fmt: skip
    got = clear.arm_reasons(arm, body, q, poses, place)

    ends, part = shape.at(q), np.linspace(0.0, 1.0, 100)[:, None]
    points = ends[:, :, None, 0] * (1 - part) + ends[:, :, None, 1] * part  # (k, l, p, 3)
    outer = np.linalg.norm(points - arm.pose(q)[:, None, None, :3, 3], axis=-1) > clear.WRIST
    far = np.linalg.norm(points - poses[:, None, None, :3, 3], axis=-1) - size
    far = np.where(outer, far, np.inf).min(axis=2)
    top = np.array(place.position)
    below = np.clip((top - points) @ way, 0.0, place.radius + place.support_height)
    aside = points - top + below[..., None] * way
    gap = np.linalg.norm(aside, axis=-1).min(axis=2) - place.column_radius
    support, struck = ((d < shape.radii - 5e-4).any(axis=1) for d in (gap, far))
    apart = [(d > s * shape.radii + 5e-4).all(axis=1) for d, s in ((gap, 1.0), (far, 1.04))]
    assert min(x.sum() for x in (support, struck, *apart)) > 20
    assert (got[struck] == clear.ARM_BODY).all()
    assert (got[support & apart[1]] == clear.ARM_SUPPORT).all()
    assert (got[apart[0] & apart[1]] == "").all()
