"""Single touches: the body set down on chosen contact points, one after the other."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..core.se3 import Array, inverse
from ..geometry.geodesics import rotate_about, transport_along
from ..robot import posture
from ..robot.contact_rig import ContactRig
from .path import Path
from .plan import usable_nodes


def tour(points: Array) -> NDArray[np.intp]:
    """An order (k,) of points (k, 3) in which each next one is the nearest left."""
    order = [0]
    left = np.ones(len(points), dtype=bool)
    left[0] = False
    while left.any():
        far = np.linalg.norm(points - points[order[-1]], axis=1)
        order.append(int(np.argmin(np.where(left, far, np.inf))))
        left[order[-1]] = False
    return np.array(order, dtype=np.intp)


def visits(setup: ContactRig, points: Array, dwell: int, dt: float) -> tuple[list[Path], Array]:
    """A path of `dwell` steps of `dt` s at rest on each of the points (k, 3) that can be touched,
    in their order, and why each (k,) that cannot be is left out ("" where it is not).

    Postures stay as near to the one before as the joints' limits let them.
    """
    hit = setup.body.closest(points)
    why = setup.fits(hit.point, hit.normal)
    fits = np.flatnonzero(why == "")
    if not len(fits):
        return [], why
    tangents = np.concatenate([transport_along(normal[None]) for normal in hit.normal[fits]])
    normals, tips = hit.normal[fits], setup.tips(hit.point[fits], hit.normal[fits])
    if setup.arm is None:
        poses, held = setup.poses(tips, normals, tangents), [None] * len(fits)
    else:
        assert setup.mount is not None
        spins = 2 * np.pi * np.arange(posture.SPINS) / posture.SPINS
        headings = rotate_about(normals[:, None], tangents[:, None], spins)
        every = setup.poses(tips[:, None], normals[:, None], headings)
        found = posture.nodes(setup.arm, every @ inverse(setup.mount), stretch=1)
        usable, why[fits] = usable_nodes(setup, found, every)
        here = why[fits] == ""
        spin, joints = posture.nearest(found, usable, np.flatnonzero(here))
        poses, held = every[np.flatnonzero(here), spin], list(joints[:, None])
        fits = fits[here]
    paths = [
        Path(
            dt=dt,
            points=np.repeat(hit.point[k : k + 1], dwell, axis=0),
            normals=np.repeat(hit.normal[k : k + 1], dwell, axis=0),
            poses=np.repeat(pose[None], dwell, axis=0),
            twists=np.zeros((dwell, 6)),
            faces=np.repeat(hit.face[k], dwell),
            postures=q,
        )
        for k, pose, q in zip(fits, poses, held, strict=True)
    ]
    return paths, why
