"""One manoeuvre: down from the standoff, touch, settle, slide along a geodesic of the surface.

The contact point runs over a geodesic; the body turns so that the normal there always faces the
indenter straight on and the way ahead keeps its heading in the world. Everything that depends on
the way s is a polynomial in s: what the optimisation differentiates is what the simulator follows.
The surface about the slide is one quintic patch fitted to the body's surface; `misfit` is its
largest distance from it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import islice
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import ArrayLike

from ..contact.indenter import Indenter
from ..core.arguments import check_vector
from ..core.errors import ReachError, TuningError
from ..core.se3 import Array, inverse, orthonormal_basis, transform
from ..exploration.path import Path, body_twists
from ..geometry.body import Body
from ..geometry.geodesics import geodesic
from ..geometry.surface import patch as patches
from ..scene.scene import Scene
from ..scene.settings import Exploration
from ..simulation.closed_loop_model import flat_anchor

DEGREE = 9
"""Degree of the polynomials in the way."""
STRIDE = 2.5e-4
"""Step of the geodesic, m."""
STRIP = 1e-3
"""Half width of the patch about the slide, m."""
MISFIT = 0.01
"""Largest distance of the patch from the surface, part of the reference depth."""
HEADINGS = 8
"""Directions of the slide about the indenter's that are tried for the arm."""


@dataclass(frozen=True, eq=False)
class Manoeuvre:
    """A slide of `distance` over a body, and how the body is held along it."""

    distance: float
    """m."""
    heading: float
    """Direction of the slide in the indenter's frame, rad about its z axis."""
    way: Array
    """Polynomials (DEGREE + 1, 15) of s / distance: contact point (3, body frame), position (3) and
    rotation (9, columns) of the body in the world."""
    anchor: Array
    """The patch about the slide, as the step function takes it (69,)."""
    foot: Array
    """(u, v) of the first contact on it."""
    misfit: float
    """Largest distance of the patch from the body's surface, m."""
    posture: Array | None
    """Joint angles (n,) at the first pose; None without an arm."""
    start: Array
    """Joint angles, or T_w_b (4, 4) without an arm, at the standoff over it."""

    def pose(self, s: Any) -> tuple[Any, Any, Any]:
        """Position (3,) and rotation (9,) of the body and their derivatives (12,) by s, CasADi."""
        x = s / self.distance
        powers = [1.0]
        for _ in range(DEGREE):
            powers.append(powers[-1] * x)
        value = ca.vertcat(*powers).T @ ca.DM(self.way[:, 3:])
        slopes = [k * powers[k - 1] / self.distance for k in range(1, DEGREE + 1)]
        slope = ca.vertcat(*slopes).T @ ca.DM(self.way[1:, 3:])
        return value[:3].T, value[3:].T, slope.T

    def reference(self, s: Any, s_half: Any, speed: Any) -> Any:
        """The step's reference (18,): pose at s, twist at s_half for a speed (m/s)."""
        position, rotation, _ = self.pose(s)
        _, there, slope = self.pose(s_half)
        turn = ca.reshape(slope[3:], 3, 3) @ ca.reshape(there, 3, 3).T
        omega = 0.5 * ca.vertcat(
            turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]
        )
        return ca.vertcat(position, rotation, slope[:3] * speed, omega * speed)

    def path(self, body: Body, exploration: Exploration, dt: float) -> Path:
        """The slide as the simulator follows it, at the exploration's speed and ramp."""
        total = self.distance / exploration.speed + exploration.ramp
        t = np.append(np.arange(0.0, total, dt), total)
        s = travelled(ca.DM(t), exploration.speed, exploration.ramp, self.distance).full().ravel()
        rows = np.vander(s / self.distance, DEGREE + 1, increasing=True) @ self.way
        rotation = rows[:, 6:].reshape(-1, 3, 3).swapaxes(1, 2)
        poses = transform(rotation, rows[:, 3:6])
        hit = body.closest(rows[:, :3])
        held = None if self.posture is None else self.posture[None]
        twists = body_twists(poses, dt)
        return Path(dt, hit.point, hit.normal, poses, twists, hit.face, postures=held)


def travelled(t: Any, speed: Any, ramp: Any, distance: Any) -> Any:
    """Way (m) after t (s) of a slide at `speed` with half-cosine ramps; CasADi."""
    total = distance / speed + ramp
    t = ca.fmin(ca.fmax(t, 0.0), total)

    def started(x: Any) -> Any:
        x = ca.fmin(x, ramp)
        return 0.5 * (x - ramp / np.pi * ca.sin(np.pi * x / ramp))

    middle = ca.fmin(ca.fmax(t - ramp, 0.0), total - 2.0 * ramp)
    return speed * (started(t) + middle + 0.5 * ramp - started(total - t))


def where(
    scene: Scene, place: ArrayLike | None, direction: ArrayLike | None
) -> tuple[Array, Array]:
    """Where the slide begins and where it goes, body frame."""
    wanted = scene.skin.positions.mean(axis=0) if place is None else check_vector("place", place)
    hit = scene.body.closest(wanted[None])
    ahead = hit.direction[0] if direction is None else check_vector("direction", direction)
    return hit.point[0], ahead


def plan(
    scene: Scene, place: Array, direction: Array, distance: float, heading: float | None = None
) -> Manoeuvre:
    """The slide from `place` (3,) on the scene's body along `direction` (3,), body frame.

    heading: of the slide, rad about the indenter; None: the one farthest from the joints' limits.
    Raises ReachError where the arm cannot follow, TuningError where the surface is no smooth patch.
    """
    s, points, frames = slide_path(scene.body, place, direction, distance)
    anchor, foot, misfit = fitted(scene.body, points, frames)
    depth = scene.patch.depth
    if misfit > MISFIT * depth:
        raise TuningError(
            "the surface under the manoeuvre is no smooth patch",
            value=f"{1e6 * misfit:.3g} um off",
            limit=f"{1e6 * MISFIT * depth:.3g} um",
            remedy="take a shorter distance or another place",
        )
    basis = np.vander(s / distance, DEGREE + 1, increasing=True)
    tips = points + (scene.indenter.radius - depth) * frames[:, :, 2]
    headings = np.arange(HEADINGS) * 2 * np.pi / HEADINGS if heading is None else [heading]
    best: tuple[float, Manoeuvre] | None = None
    reason: ReachError | None = None
    for angle in headings:
        rotation, position = _on_heading(scene.indenter, frames, tips, angle)
        rows = np.concatenate([points, position, rotation.swapaxes(1, 2).reshape(-1, 9)], axis=1)
        way = np.linalg.lstsq(basis, rows, rcond=None)[0]
        poses = transform(rotation, position)
        try:
            posture, start, spare = _posture(scene, poses[:: max(len(poses) // 20, 1)])
        except ReachError as error:
            reason = reason or error
            continue
        made = Manoeuvre(distance, float(angle), way, anchor, foot, misfit, posture, start)
        if best is None or spare > best[0]:
            best = spare, made
    if best is None:
        raise ReachError(
            f"the arm {scene.arm.name} cannot make the manoeuvre: {reason}",
            remedy="take another place or distance, or move indenter.position_m",
        ) from reason
    return best[1]


def _on_heading(
    indenter: Indenter, frames: Array, tips: Array, angle: float
) -> tuple[Array, Array]:
    """Rotations (k, 3, 3) and positions (k, 3) of the body, world, that bring the frames (k, 3, 3)
    of a slide onto the indenter, its way ahead at `angle`, rad, about it.

    tips (k, 3): the indenter's centre in the body frame, m.
    """
    ahead, down = np.array([np.cos(angle), np.sin(angle), 0.0]), np.array([0.0, 0.0, -1.0])
    world = indenter.rotation @ orthonormal_basis(down, ahead)
    rotation = world @ frames.swapaxes(1, 2)
    return rotation, np.array(indenter.position) - np.einsum("kij,kj->ki", rotation, tips)


def _posture(scene: Scene, poses: Array) -> tuple[Array | None, Array, float]:
    """Joint angles at the first pose and at the standoff over it; least distance from a limit."""
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
    """A geodesic of the body's surface: way (k,), points (k, 3), frames (k, 3, 3).

    Columns of a frame: the way ahead, normal x ahead, outward normal; body frame. Raises
    TuningError where `direction` is normal to the surface.
    """
    place, direction = np.asarray(place, dtype=float), np.asarray(direction, dtype=float)
    normal = body.closest(place[None]).normal[0]
    if not np.linalg.norm(direction - normal * (normal @ direction)) > 1e-6:
        raise TuningError("the slide points along the normal", value=direction)
    count = int(np.ceil(distance / STRIDE))
    points, frames = [], []
    for hit, ahead in islice(geodesic(body, place, direction, distance / count), count + 1):
        points.append(hit.point[0])
        frames.append(orthonormal_basis(hit.normal[0], ahead))
    way = np.linalg.norm(np.diff(np.array(points), axis=0), axis=1)
    s = np.concatenate([[0.0], np.cumsum(way)])
    return s * distance / s[-1], np.array(points), np.array(frames)


def fitted(body: Body, points: Array, frames: Array) -> tuple[Array, Array, float]:
    """The quintic patch about a slide: anchor (69,), (u, v) of its first point, largest misfit."""
    middle = len(points) // 2
    origin, axes = points[middle], frames[middle]
    size = max(float(np.abs((points - origin) @ axes[:, 0]).max()), STRIP)
    a, b = np.meshgrid(np.linspace(-size - STRIP, size + STRIP, 41), np.linspace(-STRIP, STRIP, 7))
    reach = np.concatenate([points, origin + np.stack([a.ravel(), b.ravel()], 1) @ axes[:, :2].T])
    feet = body.closest(reach).point
    local = (feet - origin) @ axes
    u, v = local[:, 0] / size, local[:, 1] / size
    basis = patches.monomials(u, v)
    coefficients: Array = np.asarray(np.linalg.lstsq(basis, feet, rcond=None)[0], dtype=float)
    misfit = float(np.linalg.norm(basis @ coefficients - feet, axis=1).max())
    first = (points[0] - origin) @ axes[:, :2] / size
    return flat_anchor(coefficients), first, misfit
