"""Inverse kinematics by Newton's method: along a path of poses, and for a single pose.

Poses are T_w_tip; residuals are the norm of the tip's displacement (m) and rotation vector (rad).

Source: Sugihara, "Solvability-unconcerned inverse kinematics by the Levenberg-Marquardt method"
(IEEE Trans. Robotics 27(5), 2011): damping in proportion to the squared residual.
"""

from __future__ import annotations

import ctypes
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ..core import codegen
from ..core.content_cache import cached_by_content
from ..core.errors import ArmError, ReachError
from ..core.se3 import Array

if TYPE_CHECKING:
    from .arm import Arm

TOLERANCE = 1e-10
"""Largest residual of a solution, m and rad."""
LARGEST_STEP = 0.5
"""Largest step of one joint in one Newton step, rad."""
TRACKING_STEPS = 2
"""Newton steps a sample while a path is followed."""
ROUNDS, SEEDED_ROUNDS = 30, 100
"""Most looks at a pose, from near it and from a seed."""
_WHOLE, _REAL, _ADDRESS = ctypes.c_int64, ctypes.c_double, ctypes.c_void_p


@dataclass(frozen=True)
class Newton:
    """An arm's Newton iterations; targets (k, 12) are rows of `flat`."""

    step: ca.Function
    """(q (n,), target (12,)) -> (q after one step, residual before it)."""
    code: ctypes.CDLL | None = None
    """The step as machine code, with what newton.c adds; None: it is interpreted."""

    def arrive(self, q: Array, targets: Array, rounds: int) -> tuple[Array, Array]:
        """Angles (k, n) and residuals (k,) after at most `rounds` looks at the way from `q` (k, n).

        A residual below TOLERANCE is that of the angles; any other, of those a step before.
        """
        q, targets = np.array(q, order="C"), np.ascontiguousarray(targets)
        residual = np.full(len(q), np.inf)
        if self.code is not None:
            self.code.arrive(
                _WHOLE(len(q)), _address(q), _address(targets), _WHOLE(rounds),
                _REAL(TOLERANCE), _address(residual),
            )  # fmt: skip
            return q, residual
        open_ = np.arange(len(q))
        for _ in range(rounds):
            if not len(open_):
                break
            stepped, error = (o.full().T for o in self.step(q[open_].T, targets[open_].T))
            residual[open_] = error[:, 0]
            unfinished = error[:, 0] >= TOLERANCE
            open_ = open_[unfinished]
            q[open_] = stepped[unfinished]
        return q, residual

    def track(self, q: Array, targets: Array) -> Array:
        """Angles (k, n), a few steps to each target in order from those before it; `q` (n,)."""
        if self.code is not None:
            state, out = np.array(q), np.empty((len(targets), len(q)))
            self.code.track(
                _WHOLE(len(out)), _address(state), _address(np.ascontiguousarray(targets)),
                _WHOLE(TRACKING_STEPS), _address(out),
            )  # fmt: skip
            return out
        start, target = ca.SX.sym("q", len(q)), ca.SX.sym("target", 12)
        after = start
        for _ in range(TRACKING_STEPS):
            after = self.step(after, target)[0]
        follow = ca.Function("follow", [start, target], [after, after])
        followed = follow.mapaccum("track", len(targets))(q, targets.T)
        return np.asarray(followed[0].full().T)


@cached_by_content
def newton(arm: Arm) -> Newton:
    """The Newton iterations of `arm`, compiled where there is a C compiler.

    Levenberg-Marquardt: dq = J^T (J J^T + mu I)^-1 e with mu of the order of |e|^2, so that it is
    cautious far away and converges quadratically.
    """
    q, target = ca.SX.sym("q", len(arm.joint_names)), ca.SX.sym("target", 12)
    pose, jacobian = arm.kinematics(q)
    error = _pose_error(pose, ca.reshape(target[:9], 3, 3), target[9:])
    size = ca.dot(error, error)
    normal = jacobian @ jacobian.T + (0.01 * size + 1e-12) * ca.SX.eye(6)
    change = jacobian.T @ ca.ldl_solve(error, *ca.ldl(normal))
    change *= ca.fmin(1.0, LARGEST_STEP / (ca.norm_inf(change) + 1e-12))
    step = ca.Function("newton", [q, target], [q + change, ca.sqrt(size)], {"cse": True})
    after = Path(__file__).with_name("newton.c").read_text(encoding="utf-8")
    sizes = f"#define JOINTS {q.numel()}\n#define TARGET {target.numel()}"
    text = "\n".join([codegen.INLINE, codegen.c_source(step), sizes, after])
    return Newton(step, codegen.compile_library("inverse kinematics", text))


def inverse_kinematics(arm: Arm, poses: ArrayLike, seed: ArrayLike) -> Array:
    """Joint angles (k, n) along `poses` (k, 4, 4) from `seed` (n,); see `Arm.inverse_kinematics`.

    Tracks the poses one after the other in few steps, then polishes all samples at once.
    """
    targets = flat(shaped("poses", poses, (4, 4), batch=1))
    start = shaped("seed", seed, (len(arm.joint_names),))
    first, _ = arm.newton.arrive(start[None], targets[:1], ROUNDS)
    q, residual = arm.newton.arrive(arm.newton.track(first[0], targets), targets, ROUNDS)
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
    q, residual = arm.newton.arrive(start, np.repeat(target, len(start), axis=0), SEEDED_ROUNDS)
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


def _pose_error(pose: ca.SX, rotation: ca.SX, origin: ca.SX) -> ca.SX:
    """Displacement (6,) in world axes from `pose` to the target: m, then rotation vector."""
    now = pose[:3, :3]
    turn = 0.5 * sum((ca.cross(now[:, k], rotation[:, k]) for k in range(3)), ca.SX(3, 1))
    sine = ca.sqrt(ca.dot(turn, turn) + 1e-40)
    cosine = 0.5 * (ca.dot(now, rotation) - 1.0)
    return ca.vertcat(origin - pose[:3, 3], turn * (ca.atan2(sine, cosine) / sine))


def _address(array: Array) -> ctypes.c_void_p:
    return _ADDRESS(array.ctypes.data)
