"""Inverse kinematics by Newton's method: along a path of poses, and for a single pose.

Poses are T_w_tip; residuals are the norm of the tip's displacement (m) and rotation vector (rad).

Source: Sugihara, "Solvability-unconcerned inverse kinematics by the Levenberg-Marquardt method"
(IEEE Trans. Robotics 27(5), 2011): damping in proportion to the squared residual.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import casadi as cs
import numpy as np
from numpy.typing import ArrayLike

from ..errors import ArmError, ReachError
from ..se3 import Array

if TYPE_CHECKING:
    from .arm import Arm

TOLERANCE = 1e-10  # largest residual of a solution, m and rad
LARGEST_STEP = 0.5  # rad, of one joint in one Newton step
TRACKING_STEPS = 2  # Newton steps per sample while following a path


@dataclass(frozen=True)
class Newton:
    """An arm's Newton iterations; targets (12,) are rows of `flat`."""

    step: cs.Function
    """(q (n,), target (12,)) -> (q after one step, residual before it)."""
    follow: cs.Function
    """(q (n,) of the sample before, target (12,)) -> (q, q), the form that `mapaccum` takes."""


def newton(arm: Arm) -> Newton:
    """The Newton iterations of `arm`.

    Levenberg-Marquardt: dq = J^T (J J^T + mu I)^-1 e with mu of the order of |e|^2, so that it is
    cautious far away and converges quadratically.
    """
    q, target = cs.SX.sym("q", len(arm.joint_names)), cs.SX.sym("target", 12)
    pose, jacobian = arm.kinematics(q)
    error = _pose_error(pose, cs.reshape(target[:9], 3, 3), target[9:])
    size = cs.dot(error, error)
    normal = jacobian @ jacobian.T + (0.01 * size + 1e-12) * cs.SX.eye(6)
    change = jacobian.T @ cs.ldl_solve(error, *cs.ldl(normal))
    change *= cs.fmin(1.0, LARGEST_STEP / (cs.norm_inf(change) + 1e-12))
    step = cs.Function("newton", [q, target], [q + change, cs.sqrt(size)], {"cse": True})
    following = q
    for _ in range(TRACKING_STEPS):
        following = step(following, target)[0]
    return Newton(step, cs.Function("follow", [q, target], [following, following]))


def inverse_kinematics(arm: Arm, poses: ArrayLike, seed: ArrayLike) -> Array:
    """Joint angles (k, n) along `poses` (k, 4, 4) from `seed` (n,); see `Arm.inverse_kinematics`.

    Tracks the poses one after the other in few steps, then polishes all samples at once.
    """
    targets = flat(shaped("poses", poses, (4, 4), batch=1))
    start = shaped("seed", seed, (len(arm.joint_names),))
    first, _ = _converge(arm, start[None], targets[:1])
    track = arm.newton.follow.mapaccum("track", len(targets))
    q, residual = _converge(arm, track(first.T, targets.T)[0].full().T, targets)
    if not np.all(residual < TOLERANCE):
        k = int(np.argmin(residual < TOLERANCE))
        raise ReachError(
            f"{arm.name} cannot reach pose {k} of {len(q)}",
            value=f"residual {residual[k]:.3g} (m, rad)",
            limit=f"{TOLERANCE:g}",
            remedy="move the path nearer, sample it finer, or start from another seed",
        )
    _check_limits(arm, q)
    return q


def solve(arm: Arm, pose: ArrayLike, seeds: ArrayLike | None = None) -> Array:
    """Joint angles (n,) for one `pose` (4, 4), from `seeds` (k, n) or (n,); see `Arm.solve`."""
    target = flat(shaped("pose", pose, (4, 4)))
    if seeds is None:
        low = np.where(np.isfinite(arm.lower), arm.lower, -math.pi)
        high = np.where(np.isfinite(arm.upper), arm.upper, math.pi)
        seeds = np.random.default_rng(0).uniform(low, high, (200, len(low)))
    start = np.atleast_2d(shaped("seeds", seeds, (len(arm.joint_names),), batch=1))
    q, residual = _converge(arm, start, np.repeat(target, len(start), axis=0), rounds=100)
    reached = residual < TOLERANCE
    if not reached.any():
        raise ReachError(
            f"{arm.name} cannot reach the pose at {target[0, 9:].round(4).tolist()} m",
            value=f"residual {residual.min():.3g} (m, rad)",
            limit=f"{TOLERANCE:g}",
            remedy="move the pose nearer to the arm's base",
        )
    q = unwound(arm, q[reached])
    margin = np.minimum(q - arm.lower, arm.upper - q).min(axis=1)
    best = q[np.argmax(margin)]
    _check_limits(arm, best[None])
    return np.asarray(best)


def shaped(name: str, values: ArrayLike, core: tuple[int, ...], batch: int | None = 0) -> Array:
    """`values` as an array of shape `core`, or (k, *core) too where `batch` is 1.

    None for `batch`: any leading axes. Raises ArmError, naming the shape; an empty array is wrong.
    """
    try:
        array = np.asarray(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise ArmError(f"{name} is no array of numbers: {error}") from error
    lead = array.ndim - len(core)
    most = lead if batch is None else batch
    if not (0 <= lead <= most and array.shape[lead:] == core and array.size > 0):
        axes = ", ".join(map(str, core))
        limits = {0: f"{core}", 1: f"(k, {axes}) or {core}", None: f"(..., {axes})"}
        raise ArmError(f"{name} of wrong shape", value=array.shape, limit=limits[batch])
    return array


def flat(poses: Array) -> Array:
    """Poses (k, 4, 4) or (4, 4) as rows (k, 12): the rotation column by column, then the origin."""
    t = poses.reshape(-1, 4, 4)
    return np.concatenate([t[:, :3, :3].swapaxes(1, 2).reshape(-1, 9), t[:, :3, 3]], axis=1)


def unwound(arm: Arm, q: Array) -> Array:
    """`q` (k, n) with whole turns removed, nearest the middle of the range."""
    with np.errstate(invalid="ignore"):
        middle = np.where(np.isfinite(arm.lower), 0.5 * (arm.lower + arm.upper), 0.0)
    turns = np.round((q - middle) / (2.0 * math.pi))
    return np.asarray(q - 2.0 * math.pi * turns)


def _check_limits(arm: Arm, q: Array) -> None:
    """Raise ReachError for the first sample of `q` (k, n) outside the joint limits."""
    outside = (q < arm.lower - 1e-9) | (q > arm.upper + 1e-9)
    if outside.any():
        k, j = np.argwhere(outside)[0]
        raise ReachError(
            f"pose {k} of {len(q)} takes {arm.joint_names[j]} of {arm.name} past its limit",
            value=f"{q[k, j]:.4f} rad",
            limit=f"[{arm.lower[j]:.4f}, {arm.upper[j]:.4f}] rad",
            remedy="move the poses, or start from another configuration",
        )


def _converge(arm: Arm, q: Array, targets: Array, rounds: int = 30) -> tuple[Array, Array]:
    """Newton from all `q` (k, n) at once to `targets` (k, 12): angles, residuals (k,)."""
    q, residual, open_ = q.copy(), np.full(len(q), np.inf), np.arange(len(q))
    for _ in range(rounds):
        stepped, error = (o.full().T for o in arm.newton.step(q[open_].T, targets[open_].T))
        residual[open_] = error[:, 0]
        unfinished = error[:, 0] >= TOLERANCE
        open_ = open_[unfinished]
        if not len(open_):
            break
        q[open_] = stepped[unfinished]
    return q, residual


def _pose_error(pose: cs.SX, rotation: cs.SX, origin: cs.SX) -> cs.SX:
    """Displacement (6,) in world axes from `pose` to the target: m, then rotation vector."""
    now = pose[:3, :3]
    turn = 0.5 * sum((cs.cross(now[:, k], rotation[:, k]) for k in range(3)), cs.SX(3, 1))
    sine = cs.sqrt(cs.dot(turn, turn) + 1e-40)
    cosine = 0.5 * (cs.dot(now, rotation) - 1.0)
    return cs.vertcat(origin - pose[:3, 3], turn * (cs.atan2(sine, cosine) / sine))
