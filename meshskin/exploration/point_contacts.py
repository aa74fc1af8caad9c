"""Single contacts: the body set down on chosen contact points, one after the other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import Array
from ..geometry.geodesics import rotate_about, transport_along
from ..robot import posture
from ..robot.contact_rig import ContactRig
from .lane_plan import reachable_nodes
from .path import Path


def nearest_neighbour_order(points: Array) -> NDArray[np.intp]:
    """The order (k,) of points (k, 3), from the first, in which each next one is the nearest."""
    order = [0]
    remaining = np.ones(len(points), dtype=bool)
    remaining[0] = False
    while remaining.any():
        distance = np.linalg.norm(points - points[order[-1]], axis=1)
        order.append(int(np.argmin(np.where(remaining, distance, np.inf))))
        remaining[order[-1]] = False
    return np.array(order, dtype=np.intp)


def point_contacts(
    rig: ContactRig, points: Array, steps: int, dt: float
) -> tuple[list[Path], Array]:
    """A path at rest on each of the points (k, 3) that can be touched, in their order.

    Each path has `steps` rows of `dt` s. The second result is the reason (k,) why a point cannot be
    touched, "" where it can. Each posture is near the one before and far from the joint limits.
    """
    hit = rig.body.closest(points)
    reason = rig.contact_reasons(hit.point, hit.normal)
    rows = np.flatnonzero(reason == "")
    if not len(rows):
        return [], reason
    tangents = np.concatenate([transport_along(normal[None]) for normal in hit.normal[rows]])
    if rig.arm is None:
        poses = rig.contact_poses(hit.point[rows], hit.normal[rows], tangents)
        postures = [None] * len(rows)
    else:
        nodes, usable, reason[rows] = reachable_nodes(
            rig, hit.point[rows], hit.normal[rows], tangents, anchor_spacing=1
        )
        found = np.flatnonzero(reason[rows] == "")
        spin, joints = posture.nearest_postures(nodes, usable, found)
        rows, normals = rows[found], hit.normal[rows[found]]
        headings = rotate_about(normals, tangents[found], spin)
        poses = rig.contact_poses(hit.point[rows], normals, headings)
        postures = list(joints[:, None])
    paths = [
        Path(
            dt=dt,
            points=np.repeat(hit.point[k : k + 1], steps, axis=0),
            normals=np.repeat(hit.normal[k : k + 1], steps, axis=0),
            poses=np.repeat(pose[None], steps, axis=0),
            twists=np.zeros((steps, 6)),
            faces=np.repeat(hit.face[k], steps),
            postures=q,
        )
        for k, pose, q in zip(rows, poses, postures, strict=True)
    ]
    return paths, reason
