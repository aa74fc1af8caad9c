"""How deep the indenter is in the body, from where the body is alone."""

from __future__ import annotations

import numpy as np

from ..core.se3 import Array, poses_of_states
from ..geometry.body import Body
from ..geometry.surface.closest_point import Closest
from .closed_loop_model import ClosedLoopModel


def poses(loop: ClosedLoopModel, q: Array) -> Array:
    """T_w_b (k, 4, 4) in configurations (k, n): joint angles, or position and quaternion."""
    return np.asarray(loop.arm.pose(q) @ loop.mount) if loop.joints else poses_of_states(q)


def centres(loop: ClosedLoopModel, poses: Array) -> Array:
    """The indenter's centre (k, 3), body frame, at T_w_b (k, 4, 4)."""
    way = loop.indenter_position - poses[:, :3, 3]
    return np.asarray(np.einsum("kji,kj->ki", poses[:, :3, :3], way))


def under(loop: ClosedLoopModel, body: Body, poses: Array) -> tuple[Closest, Array]:
    """The body's points next to the indenter at T_w_b (k, 4, 4), and how deep it is in (k,), m.

    An open surface has no inside to be in: far from it, signs mean nothing.
    """
    hit = body.closest(centres(loop, poses))
    far = hit.distance if body.mesh.is_watertight else np.abs(hit.distance)
    return hit, loop.indenter_radius - far
