"""One manoeuvre: approach from the standoff, touch, settle, slide along a geodesic of the surface.

The contact point follows a geodesic; the body turns so that the normal there always faces the
indenter and the slide keeps its direction in the world. Everything that depends on the arc length s
is a polynomial in s: the optimization differentiates what the simulator follows. The surface about
the slide is one quintic patch fitted to the body's surface; `misfit` is its largest distance from
it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ..core.arguments import check_vector
from ..core.arrays import Array
from ..core.errors import ReachError, TuningError
from ..core.se3 import inverse, orthonormal_basis, transform
from ..exploration.chains import lengths_along
from ..exploration.path import Path, body_twists
from ..geometry.body import Body
from ..geometry.geodesics import geodesic
from ..geometry.surface import patch as patches
from ..scene.scene import Scene
from ..scene.settings import Exploration
from ..simulation.closed_loop_model import flat_anchor

DEGREE = 9
"""Degree of the polynomials in the arc length: their error is far below MAX_MISFIT on the shipped
bodies for slides of 20 mm (tests/tuning/test_manoeuvre.py compares them with closed forms)."""
GEODESIC_STEP = 2.5e-4
"""Step of the geodesic, m."""
PATCH_MARGIN = 1e-3
"""Half width of the patch about the slide, m: beyond the path errors of the simulated slide."""
MAX_MISFIT = 0.01
"""Largest distance of the patch from the surface, relative to the reference depth: 1.5 % of the
force."""
MAX_OFF = 2e-3
"""Largest distance of a given place from the body's surface, m: the radius of a taxel."""
HEADINGS = 8
"""Directions of the slide about the indenter's that are tried for the arm."""


@dataclass(frozen=True, eq=False)
class Manoeuvre:
    """A slide of `distance` over a body, with the body's pose along it."""

    distance: float
    """m."""
    heading: float
    """Direction of the slide in the indenter's frame, rad about its z axis."""
    coefficients: Array
    """Polynomials (DEGREE + 1, 15) in s / distance: contact point (3, body frame), position (3) and
    rotation (9, by columns) of the body in the world frame."""
    anchor: Array
    """The patch about the slide, as the step function takes it (69,)."""
    foot: Array
    """(u, v) of the first contact on the patch."""
    misfit: float
    """Largest distance of the patch from the body's surface, m."""
    posture: Array | None
    """Joint angles (n,) at the first pose; None without an arm."""
    start: Array
    """Joint angles, or T_w_b (4, 4) without an arm, at the standoff over it."""

    def pose(self, s: Any) -> tuple[Any, Any, Any]:
        """Position (3,) and rotation (9,) of the body and their derivatives (12,) by s; CasADi."""
        x = s / self.distance
        powers = [1.0]
        for _ in range(DEGREE):
            powers.append(powers[-1] * x)
        value = ca.vertcat(*powers).T @ ca.DM(self.coefficients[:, 3:])
        slopes = [k * powers[k - 1] / self.distance for k in range(1, DEGREE + 1)]
        slope = ca.vertcat(*slopes).T @ ca.DM(self.coefficients[1:, 3:])
        return value[:3].T, value[3:].T, slope.T

    def reference(self, s: Any, s_half: Any, speed: Any) -> Any:
        """The step's reference (18,): pose at s, twist at s_half for a speed (m/s)."""
        position, rotation, _ = self.pose(s)
        _, half_rotation, slope = self.pose(s_half)
        turn = ca.reshape(slope[3:], 3, 3) @ ca.reshape(half_rotation, 3, 3).T
        omega = 0.5 * ca.vertcat(
            turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]
        )
        return ca.vertcat(position, rotation, slope[:3] * speed, omega * speed)

    def path(self, body: Body, exploration: Exploration, dt: float) -> Path:
        """The slide as the simulator follows it, at the exploration's speed and ramp."""
        speed, ramp = exploration.speed, exploration.ramp
        total = self.distance / speed + ramp
        t = np.append(np.arange(0.0, total, dt), total)
        s = slide_distance(ca.DM(t), speed, ramp, self.distance).full().ravel()
        rows = np.vander(s / self.distance, DEGREE + 1, increasing=True) @ self.coefficients
        rotation = rows[:, 6:].reshape(-1, 3, 3).swapaxes(1, 2)
        poses = transform(rotation, rows[:, 3:6])
        hit = body.closest(rows[:, :3])
        postures = None if self.posture is None else self.posture[None]
        twists = body_twists(poses, dt)
        return Path(dt, hit.point, hit.normal, poses, twists, hit.face, postures=postures)


def slide_distance(t: Any, speed: Any, ramp: Any, distance: Any) -> Any:
    """Distance (m) after t (s) of a slide at `speed` with half-cosine ramps; CasADi."""
    total = distance / speed + ramp
    t = ca.fmin(ca.fmax(t, 0.0), total)

    def ramp_up(x: Any) -> Any:
        x = ca.fmin(x, ramp)
        return 0.5 * (x - ramp / np.pi * ca.sin(np.pi * x / ramp))

    middle = ca.fmin(ca.fmax(t - ramp, 0.0), total - 2.0 * ramp)
    return speed * (ramp_up(t) + middle + 0.5 * ramp - ramp_up(total - t))


def slide_start(
    scene: Scene, place: ArrayLike | None, direction: ArrayLike | None
) -> tuple[Array, Array]:
    """Start (3,), m, and direction (3,) of the slide, body frame; by default the surface point
    nearest to the skin's centre and its first principal direction.

    Raises TuningError for a place farther than MAX_OFF from the surface.
    """
    wanted = scene.skin.positions.mean(axis=0) if place is None else check_vector("place", place)
    hit = scene.body.closest(wanted[None])
    if place is not None and (off := abs(float(hit.distance[0]))) > MAX_OFF:
        near = ", ".join(f"{x:.4g}" for x in hit.point[0])
        raise TuningError(
            "place is not on the body",
            value=f"{1e3 * off:.3g} mm off its surface",
            limit=f"{1e3 * MAX_OFF:g} mm",
            remedy=f"give metres in the body frame; the nearest point is ({near})",
        )
    ahead = hit.direction[0] if direction is None else check_vector("direction", direction)
    return hit.point[0], ahead


def plan_manoeuvre(
    scene: Scene, place: Array, direction: Array, distance: float, heading: float | None = None
) -> Manoeuvre:
    """The slide from `place` (3,) on the scene's body along `direction` (3,), body frame.

    heading: of the slide, rad about the indenter; None: the one farthest from the joints' limits.
    Raises ReachError where the arm cannot follow, TuningError where the surface is not smooth.
    """
    s, points, frames = slide_path(scene.body, place, direction, distance)
    anchor, foot, misfit = fit_patch(scene.body, points, frames)
    depth = scene.patch.depth
    if misfit > MAX_MISFIT * depth:
        raise TuningError(
            "the surface under the manoeuvre is not a smooth patch",
            value=f"a misfit of {1e6 * misfit:.3g} um",
            limit=f"{1e6 * MAX_MISFIT * depth:.3g} um",
            remedy="choose a shorter distance or another place",
        )
    basis = np.vander(s / distance, DEGREE + 1, increasing=True)
    centres = points + (scene.indenter.radius - depth) * frames[:, :, 2]
    headings = np.arange(HEADINGS) * 2 * np.pi / HEADINGS if heading is None else [heading]
    best: tuple[float, Manoeuvre] | None = None
    reason: ReachError | None = None
    for angle in headings:
        poses = scene.rig.frame_poses(centres, frames, angle)
        turned = poses[:, :3, :3].swapaxes(1, 2).reshape(-1, 9)
        rows = np.concatenate([points, poses[:, :3, 3], turned], axis=1)
        coefficients = np.linalg.lstsq(basis, rows, rcond=None)[0]
        try:
            posture, start, margin = _posture(scene, poses[:: max(len(poses) // 20, 1)])
        except ReachError as error:
            reason = reason or error
            continue
        if best is None or margin > best[0]:
            manoeuvre = Manoeuvre(
                distance, float(angle), coefficients, anchor, foot, misfit, posture, start
            )
            best = margin, manoeuvre
    if best is None:
        raise ReachError(
            f"the arm {scene.arm.name} cannot make the manoeuvre: {reason}",
            remedy="choose another place or distance, or move indenter.position_m",
        ) from reason
    return best[1]


def _posture(scene: Scene, poses: Array) -> tuple[Array | None, Array, float]:
    """Joint angles (n,) at the first pose and at the standoff over it; joint margin, rad."""
    lifted = scene.rig.lifted(poses[0], scene.exploration.standoff)
    if scene.loop.mode == "quasi_static":
        return None, lifted, 0.0
    arm, tip_body = scene.arm, inverse(scene.mount_pose)
    q = arm.inverse_kinematics(poses @ tip_body, arm.solve(poses[0] @ tip_body))
    start = arm.inverse_kinematics(lifted[None] @ tip_body, q[0])[0]
    return q[0], start, float(np.minimum(q - arm.lower, arm.upper - q).min())


def slide_path(
    body: Body, place: Array, direction: Array, distance: float
) -> tuple[Array, Array, Array]:
    """A geodesic of the body's surface: arc length (k,), points (k, 3), frames (k, 3, 3).

    Columns of a frame: direction of the slide, normal x direction, outward normal; body frame.
    Raises TuningError where `direction` is normal to the surface.
    """
    place, direction = np.asarray(place, dtype=float), np.asarray(direction, dtype=float)
    normal = body.closest(place[None]).normal[0]
    if not np.linalg.norm(direction - normal * (normal @ direction)) > 1e-6:
        raise TuningError("the slide's direction is normal to the surface", value=direction)
    count = int(np.ceil(distance / GEODESIC_STEP))
    points, frames = [], []
    for hit, ahead in islice(geodesic(body, place, direction, distance / count), count + 1):
        points.append(hit.point[0])
        frames.append(orthonormal_basis(hit.normal[0], ahead))
    s = lengths_along(np.array(points))
    return s * distance / s[-1], np.array(points), np.array(frames)


def fit_patch(body: Body, points: Array, frames: Array) -> tuple[Array, Array, float]:
    """The quintic patch about a slide: anchor (69,), (u, v) of its first point, misfit, m."""
    middle = len(points) // 2
    origin, axes = points[middle], frames[middle]
    size = max(float(np.abs((points - origin) @ axes[:, 0]).max()), PATCH_MARGIN)
    a, b = np.meshgrid(
        np.linspace(-size - PATCH_MARGIN, size + PATCH_MARGIN, 41),
        np.linspace(-PATCH_MARGIN, PATCH_MARGIN, 7),
    )
    grid = origin + np.stack([a.ravel(), b.ravel()], 1) @ axes[:, :2].T
    surface = body.closest(np.concatenate([points, grid])).point
    local = (surface - origin) @ axes
    basis = patches.monomials(local[:, 0] / size, local[:, 1] / size)
    coefficients: Array = np.asarray(np.linalg.lstsq(basis, surface, rcond=None)[0], dtype=float)
    misfit = float(np.linalg.norm(basis @ coefficients - surface, axis=1).max())
    first = (points[0] - origin) @ axes[:, :2] / size
    return flat_anchor(coefficients), first, misfit
