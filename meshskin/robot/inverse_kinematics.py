"""Inverse kinematics by Newton's method: along a path of poses, and for a single pose.

Poses are T_w_tip; a residual is the norm of the tip's displacement (m) and rotation vector (rad).

Source: Sugihara, "Solvability-unconcerned inverse kinematics by the Levenberg-Marquardt method"
(IEEE Trans. Robotics 27(5), 2011): damping proportional to the squared residual. Pinocchio was
weighed: it has the kinematics of one posture a call; here those of many are solved together.
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
from ..core.arrays import Array
from ..core.content_cache import cached_by_content
from ..core.errors import ArmError, ReachError

if TYPE_CHECKING:
    from .arm import Arm

TOLERANCE = 1e-10
"""Largest residual of a solution, m and rad: rounding of poses 1 m away, times 1e5 for Jacobians
that are ill-conditioned."""
LARGEST_STEP = 0.5
"""Largest change of one joint in one Newton step, rad. Chosen."""
TRACKING_STEPS = 2
"""Newton steps per sample while a path is tracked."""
PATH_ITERATIONS, SEED_ITERATIONS = 30, 100
"""Most iterations for a pose, from near it and from a seed."""
SEEDS = 200
"""Random seeds of `solve`: they find all eight postures of the Puma at each of 12 random poses."""
_WHOLE, _REAL, _ADDRESS = ctypes.c_int64, ctypes.c_double, ctypes.c_void_p


@dataclass(frozen=True)
class Newton:
    """The Newton iterations of an arm; targets (k, 12) are as `pose_rows` gives them."""

    step: ca.Function
    """(q (n,), target (12,)) -> (q after one step, residual before it)."""
    code: ctypes.CDLL | None = None
    """The step as machine code, with the loops of newton.c; None: the step is interpreted."""

    def iterate(self, q: Array, targets: Array, iterations: int) -> tuple[Array, Array]:
        """Joint angles (k, n) and residuals (k,) after at most `iterations` from `q` (k, n).

        A residual below TOLERANCE is that of the returned angles; a larger one is that of the
        angles before the last step.
        """
        q, targets = np.array(q, order="C"), np.ascontiguousarray(targets)
        residual = np.full(len(q), np.inf)
        if self.code is not None:
            self.code.iterate(
                _WHOLE(len(q)), _address(q), _address(targets), _WHOLE(iterations),
                _REAL(TOLERANCE), _address(residual),
            )  # fmt: skip
            return q, residual
        active = np.arange(len(q))
        for _ in range(iterations):
            if not len(active):
                break
            stepped, error = (o.full().T for o in self.step(q[active].T, targets[active].T))
            residual[active] = error[:, 0]
            unfinished = error[:, 0] >= TOLERANCE
            active = active[unfinished]
            q[active] = stepped[unfinished]
        return q, residual

    def track(self, q: Array, targets: Array) -> Array:
        """Joint angles (k, n), by a few steps to each target from the angles at the one before,
        beginning with `q` (n,).
        """
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
    """The Newton iterations of `arm`, compiled if there is a C compiler.

    Levenberg-Marquardt: dq = J^T (J J^T + mu I)^-1 e with mu proportional to |e|^2, which damps
    large residuals and converges quadratically.
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

    The poses are tracked one after the other in few steps; then all samples are refined together.
    """
    targets = pose_rows(check_shape("poses", poses, (4, 4), batch=1))
    start = check_shape("seed", seed, (len(arm.joint_names),))
    first, _ = arm.newton.iterate(start[None], targets[:1], PATH_ITERATIONS)
    q, residual = arm.newton.iterate(arm.newton.track(first[0], targets), targets, PATH_ITERATIONS)
    if not np.all(residual < TOLERANCE):
        k = int(np.argmin(residual < TOLERANCE))
        raise ReachError(
            f"{arm.name} cannot reach pose {k} of {len(q)}",
            value=f"residual {residual[k]:.3g} (m, rad)",
            limit=f"{TOLERANCE:g}",
            remedy="move the path nearer, sample it more finely, or start from another seed",
        )
    _check_limits(arm, q)
    return q


def solve(arm: Arm, pose: ArrayLike, seeds: ArrayLike | None = None) -> Array:
    """Joint angles (n,) for one `pose` (4, 4), from `seeds` (k, n) or (n,); see `Arm.solve`."""
    target = pose_rows(check_shape("pose", pose, (4, 4)))
    if seeds is None:
        low = np.where(np.isfinite(arm.lower), arm.lower, -math.pi)
        high = np.where(np.isfinite(arm.upper), arm.upper, math.pi)
        seeds = np.random.default_rng(0).uniform(low, high, (SEEDS, len(low)))
    start = np.atleast_2d(check_shape("seeds", seeds, (len(arm.joint_names),), batch=1))
    q, residual = arm.newton.iterate(start, np.repeat(target, len(start), axis=0), SEED_ITERATIONS)
    reached = residual < TOLERANCE
    if not reached.any():
        raise ReachError(
            f"{arm.name} cannot reach the pose at {target[0, 9:].round(4).tolist()} m",
            value=f"residual {residual.min():.3g} (m, rad)",
            limit=f"{TOLERANCE:g}",
            remedy="move the pose nearer to the arm's base",
        )
    q = unwrapped(arm, q[reached])
    margin = np.minimum(q - arm.lower, arm.upper - q).min(axis=1)
    best = q[np.argmax(margin)]
    _check_limits(arm, best[None])
    return np.asarray(best)


def check_shape(
    name: str, values: ArrayLike, core: tuple[int, ...], batch: int | None = 0
) -> Array:
    """`values` as an array of shape `core`, or also (k, *core) if `batch` is 1.

    With `batch` None any leading axes are accepted. Raises ArmError for another shape or an empty
    array.
    """
    try:
        array = np.asarray(values, dtype=float)
    except (TypeError, ValueError) as error:
        raise ArmError(f"{name} must be numbers: {error}") from error
    lead = array.ndim - len(core)
    most = lead if batch is None else batch
    if not (0 <= lead <= most and array.shape[lead:] == core and array.size > 0):
        axes = ", ".join(map(str, core))
        limits = {0: f"{core}", 1: f"(k, {axes}) or {core}", None: f"(..., {axes})"}
        raise ArmError(f"{name} has the wrong shape", value=array.shape, limit=limits[batch])
    return array


def pose_rows(poses: Array) -> Array:
    """Poses (k, 4, 4) or (4, 4) as rows (k, 12): the rotation column by column, then the origin."""
    t = poses.reshape(-1, 4, 4)
    return np.concatenate([t[:, :3, :3].swapaxes(1, 2).reshape(-1, 9), t[:, :3, 3]], axis=1)


def unwrapped(arm: Arm, q: Array) -> Array:
    """`q` (k, n) with whole turns removed, nearest to the middle of the joints' ranges."""
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
    """Displacement, m, and rotation vector, rad, (6,) in world axes from `pose` to the target."""
    now = pose[:3, :3]
    turn = 0.5 * sum((ca.cross(now[:, k], rotation[:, k]) for k in range(3)), ca.SX(3, 1))
    sine = ca.sqrt(ca.dot(turn, turn) + 1e-40)
    cosine = 0.5 * (ca.dot(now, rotation) - 1.0)
    return ca.vertcat(origin - pose[:3, 3], turn * (ca.atan2(sine, cosine) / sine))


def _address(array: Array) -> ctypes.c_void_p:
    return _ADDRESS(array.ctypes.data)
