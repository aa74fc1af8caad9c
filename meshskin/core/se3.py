"""Rotations and rigid transforms: `T_a_b` is the pose of frame b in frame a.

Source: Sola, Deray, Atchuthan, "A micro Lie theory for state estimation in robotics" (2018).
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from .arrays import Array, cross

if TYPE_CHECKING:
    import casadi as ca

TURN_PER_METRE = 10.0
"""Standard deviation of an unknown rotation, rad, per m of that of the translation beside it: the
rotation that moves a point 0.1 m from the origin as far as the translation does."""


def hat(w: ArrayLike) -> Array:
    """Cross-product matrices of vectors `w` (..., 3) -> (..., 3, 3)."""
    w = np.asarray(w, dtype=float)
    m = np.zeros((*w.shape[:-1], 3, 3))
    m[..., 0, 1], m[..., 0, 2], m[..., 1, 2] = -w[..., 2], w[..., 1], -w[..., 0]
    m[..., 1, 0], m[..., 2, 0], m[..., 2, 1] = w[..., 2], -w[..., 1], w[..., 0]
    return m


def exp_so3(w: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of rotation vectors `w` (..., 3), in rad."""
    from scipy.spatial.transform import Rotation

    w = np.asarray(w, dtype=float)
    return np.asarray(Rotation.from_rotvec(w.reshape(-1, 3)).as_matrix()).reshape(*w.shape, 3)


def left_jacobian(w: ArrayLike) -> Array:
    """J (..., 3, 3) with exp(w + dw) = exp(J dw) exp(w) to first order, of `w` (..., 3), rad."""
    w = np.asarray(w, dtype=float)
    angle2 = np.sum(w * w, axis=-1)[..., None, None]
    small = angle2 < 1e-4
    angle = np.sqrt(np.where(small, 1.0, angle2))
    first = np.where(small, 1 / 2 - angle2 / 24, (1 - np.cos(angle)) / angle**2)
    second = np.where(small, 1 / 6 - angle2 / 120, (angle - np.sin(angle)) / angle**3)
    k = hat(w)
    return np.asarray(np.eye(3) + first * k + second * (k @ k))


def quaternion(rotation: ArrayLike) -> Array:
    """Unit quaternions (..., 4), xyzw, w >= 0, of rotation matrices (..., 3, 3)."""
    from scipy.spatial.transform import Rotation

    r = np.asarray(rotation, dtype=float)
    q = Rotation.from_matrix(r.reshape(-1, 3, 3)).as_quat(canonical=True)
    return np.asarray(q).reshape((*r.shape[:-2], 4))


def log_so3(rotation: ArrayLike) -> Array:
    """Rotation vectors (..., 3), in rad, of rotation matrices (..., 3, 3); finite up to pi."""
    q = quaternion(rotation)
    v, w = q[..., :3], q[..., 3:]
    n = np.sqrt(np.sum(v * v, axis=-1, keepdims=True) + 1e-24)
    return np.asarray(2.0 * np.arctan2(n, w) / n * v)


def from_rpy(rpy: ArrayLike) -> Array:
    """Rotation (3, 3) Rz(yaw) Ry(pitch) Rx(roll) of roll, pitch, yaw (3,) as in URDF, rad."""
    from scipy.spatial.transform import Rotation

    return np.asarray(Rotation.from_euler("xyz", rpy).as_matrix())


def to_rpy(rotation: ArrayLike) -> Array:
    """Roll, pitch and yaw (3,) as in URDF, rad, of a rotation (3, 3); yaw is 0 at a pitch of 90
    degrees, where roll and yaw are one."""
    r = np.asarray(rotation, dtype=float)
    level = float(np.hypot(r[0, 0], r[1, 0]))
    pitch = np.arctan2(-r[2, 0], level)
    if level > 1e-9:
        return np.array([np.arctan2(r[2, 1], r[2, 2]), pitch, np.arctan2(r[1, 0], r[0, 0])])
    return np.array([np.arctan2(-r[1, 2], r[1, 1]), pitch, 0.0])


def transform(rotation: ArrayLike, translation: ArrayLike) -> Array:
    """Homogeneous transforms (..., 4, 4) of rotations (..., 3, 3) and translations (..., 3)."""
    r, t = np.asarray(rotation, dtype=float), np.asarray(translation, dtype=float)
    out = np.zeros((*np.broadcast_shapes(r.shape[:-2], t.shape[:-1]), 4, 4))
    out[..., :3, :3], out[..., :3, 3], out[..., 3, 3] = r, t, 1.0
    return out


def inverse(pose: ArrayLike) -> Array:
    """Inverse of rigid transforms (..., 4, 4)."""
    pose = np.asarray(pose, dtype=float)
    rt = np.swapaxes(pose[..., :3, :3], -1, -2)
    return transform(rt, -(rt @ pose[..., :3, 3:])[..., 0])


def perpendicular(vectors: ArrayLike) -> Array:
    """Unit vectors (..., 3) perpendicular to non-zero `vectors` (..., 3).

    Each is the cross product of the coordinate axis that is least aligned with the vector, and the
    vector.
    """
    v = np.asarray(vectors, dtype=float)
    across = cross(np.eye(3)[np.argmin(np.abs(v), axis=-1)], v)
    return np.asarray(across / np.linalg.norm(across, axis=-1, keepdims=True))


def orthonormal_basis(normals: ArrayLike, tangents: ArrayLike | None = None) -> Array:
    """Rotations (..., 3, 3) with the columns t1, t2 = n x t1, n, of unit normals n (..., 3).

    t1 is `tangents` (..., 3), unit vectors perpendicular to the normals, or the tangent of Duff et
    al., which varies smoothly within each of the half-spaces z >= 0 and z < 0.

    Source: Duff et al., "Building an Orthonormal Basis, Revisited", JCGT 6 (2017).
    """
    n = np.asarray(normals, dtype=float)
    if tangents is not None:
        t1 = np.asarray(tangents, dtype=float)
        return np.stack([t1, cross(n, t1), n], axis=-1)
    x, y, z = np.moveaxis(n, -1, 0)
    sign = np.where(z >= 0, 1.0, -1.0)
    a = -1.0 / (sign + z)
    b = x * y * a
    t1 = np.stack([1.0 + sign * x * x * a, sign * b, -sign * x], axis=-1)
    t2 = np.stack([b, sign + y * y * a, -y], axis=-1)
    return np.stack([t1, t2, n], axis=-1)


def shortest_rotation(source: ArrayLike, target: ArrayLike) -> Array:
    """Rotations (..., 3, 3) by the smallest angle that take unit vectors `source` to `target`.

    Both are (..., 3). For antiparallel vectors the axis is not determined: it is then the
    coordinate axis least aligned with `source`, projected onto the plane perpendicular to it.
    """
    s, t = np.broadcast_arrays(np.asarray(source, dtype=float), np.asarray(target, dtype=float))
    across, cosine = cross(s, t), np.einsum("...i,...i->...", s, t)
    k = hat(across)
    near = cosine > -0.999
    rotation = np.eye(3) + k + k @ k / np.where(near, 1.0 + cosine, 1.0)[..., None, None]
    if near.all():
        return np.asarray(rotation)
    # 1 + cosine has lost its digits: the angle from the sine, the axis where the sine is not zero
    far = ~near & np.isfinite(cosine)
    sine = np.linalg.norm(across[far], axis=-1)
    straight = cross(s[far], perpendicular(s[far]))
    axis = np.where(sine[:, None] > 1e-12, across[far] / np.maximum(sine, 1e-12)[:, None], straight)
    rotation[far] = exp_so3(np.arctan2(sine, cosine[far])[:, None] * axis)
    return np.asarray(rotation)


def transform_points(pose: ArrayLike, points: ArrayLike) -> Array:
    """Points (..., 3) transformed by one rigid transform (4, 4)."""
    pose = np.asarray(pose, dtype=float)
    return np.asarray(points @ pose[:3, :3].T + pose[:3, 3])


def is_rigid(pose: ArrayLike) -> bool:
    """Whether `pose` is a finite (4, 4) rigid transform without reflection, within 1e-6."""
    try:
        given = np.asarray(pose, dtype=float)
    except (TypeError, ValueError):
        return False
    if given.shape != (4, 4) or not np.isfinite(given).all():
        return False
    rotation = given[:3, :3]
    rows = np.abs(given[3] - [0.0, 0.0, 0.0, 1.0]).max()
    return bool(
        np.abs(rotation @ rotation.T - np.eye(3)).max() < 1e-6
        and rows < 1e-6
        and np.linalg.det(rotation) > 0
    )


def interpolate(start: ArrayLike, goal: ArrayLike, fraction: ArrayLike) -> Array:
    """Poses (k, 4, 4) at fractions (k,) between two poses (4, 4).

    The origin moves on a straight line, the rotation about a fixed axis, both at constant speed.
    """
    a, b = np.asarray(start, dtype=float), np.asarray(goal, dtype=float)
    s = np.asarray(fraction, dtype=float)[:, None]
    rotation = exp_so3(s * log_so3(b[:3, :3] @ a[:3, :3].T)) @ a[:3, :3]
    return transform(rotation, a[:3, 3] + s * (b[:3, 3] - a[:3, 3]))


def align(source: ArrayLike, target: ArrayLike) -> Array:
    """The rigid transform (4, 4) of points `source` (n, 3) to `target` (n, 3) by least squares.

    Source: Umeyama, IEEE PAMI 13 (1991), without the scale.
    """
    a, b = np.asarray(source, dtype=float), np.asarray(target, dtype=float)
    ca, cb = a.mean(axis=0), b.mean(axis=0)
    u, _, vt = np.linalg.svd((b - cb).T @ (a - ca))
    d = np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))])
    r = u @ d @ vt
    return transform(r, cb - r @ ca)


def casadi_rotation(q: ca.SX) -> ca.SX:
    """Rotation matrix (3, 3) of a CasADi unit quaternion (4,), xyzw."""
    import casadi as ca

    v, w = q[:3], q[3]
    k = ca.skew(v)
    return ca.SX.eye(3) + 2 * w * k + 2 * ca.mtimes(k, k)


def cayley(a: ArrayLike) -> Array:
    """Rotation matrices (..., 3, 3) of increments `a` (..., 3), as edge_assembly.cayley."""
    a = np.asarray(a, dtype=float)
    k = hat(a)
    scale = 1.0 / (1.0 + np.sum(a * a, axis=-1)[..., None, None] / 4.0)
    return np.eye(3) + scale * (k + k @ k / 2.0)


def poses_of_states(states: Array) -> Array:
    """T_w_b (k, 4, 4) of states (k, 7 or more): position, m, and unit quaternion wxyz."""
    from scipy.spatial.transform import Rotation

    rotation = Rotation.from_quat(states[:, [4, 5, 6, 3]]).as_matrix()
    return transform(rotation, states[:, :3])
