"""The exploration path: back-and-forth parallels that turn the body over the fixed indenter.

The contact point runs along parallels of the surface normal about the skin's axis. The arm makes
the polar angle, the spin about the skin's axis the azimuth, which runs from -180 to 180 degrees on
one lane and back on the next, so that the last joint never winds up. At every sample the body's
normal at the contact point faces the indenter (straight against its tip).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..contact.indenter import Indenter
from ..core.errors import SimulationError
from ..core.se3 import Array, exp_so3, log_so3, orthonormal_basis, perpendicular, transform
from ..geometry.body import Body
from ..scene.settings import Exploration


@dataclass(frozen=True)
class Path:
    """A path of the body over the indenter, sampled every `dt`."""

    dt: float
    points: Array
    """Contact points (k, 3), body frame, m."""
    normals: Array
    """Outward normals there (k, 3), body frame."""
    poses: Array
    """T_w_b (k, 4, 4) at the reference depth."""
    twists: Array
    """Velocity of the body's origin and angular velocity (k, 6), world."""
    faces: NDArray[np.intp]
    """The mesh's face at each contact point (k,)."""
    breaks: tuple[int, ...] = ()
    """Rows, in order, at which a new place begins: the body is lifted off before."""
    postures: Array | None = None
    """Joint angles (len(breaks) + 1, n) at the first pose of each place; None: any will do."""
    unreachable: Mapping[int, str] = field(default_factory=dict)
    """Why each taxel (by id) that the path leaves out is left out."""

    @classmethod
    def joined(cls, places: Sequence[Path]) -> Path:
        """The path over places, one after the other."""
        breaks = np.cumsum([len(place.points) for place in places])[:-1]
        held = [place.postures for place in places if place.postures is not None]
        return cls(
            dt=places[0].dt,
            points=np.concatenate([place.points for place in places]),
            normals=np.concatenate([place.normals for place in places]),
            poses=np.concatenate([place.poses for place in places]),
            twists=np.concatenate([place.twists for place in places]),
            faces=np.concatenate([place.faces for place in places]),
            breaks=tuple(int(k) for k in breaks),
            postures=np.concatenate(held) if len(held) == len(places) else None,
        )

    @property
    def places(self) -> list[Path]:
        """The path, place by place."""
        ends = [0, *self.breaks, len(self.points)]
        return [self._place(k, slice(*pair)) for k, pair in enumerate(pairwise(ends))]

    def _place(self, place: int, rows: slice) -> Path:
        return Path(
            dt=self.dt,
            points=self.points[rows],
            normals=self.normals[rows],
            poses=self.poses[rows],
            twists=self.twists[rows],
            faces=self.faces[rows],
            postures=None if self.postures is None else self.postures[place : place + 1],
        )

    def first(self, count: int) -> Path:
        """Its first `count` rows."""
        rows = slice(0, count)
        breaks = tuple(row for row in self.breaks if row < count)
        return replace(
            self,
            points=self.points[rows],
            normals=self.normals[rows],
            poses=self.poses[rows],
            twists=self.twists[rows],
            faces=self.faces[rows],
            breaks=breaks,
            postures=None if self.postures is None else self.postures[: len(breaks) + 1],
        )

    def thinned(self, dt: float, body: Body) -> Path:
        """The rows of each place that are `dt`, s, a multiple of its own, apart; with the faces
        of `body`, another mesh of the same surface.
        """
        every, places = round(dt / self.dt), []
        for place in self.places:
            points, poses = place.points[::every], place.poses[::every]
            places.append(
                replace(
                    place,
                    dt=dt,
                    points=points,
                    normals=place.normals[::every],
                    poses=poses,
                    twists=twists(poses, dt),
                    faces=body.closest(points).face,
                )
            )
        return Path.joined(places)

    @property
    def references(self) -> Array:
        """The rows (k, 18) that the step function follows."""
        r = self.poses[:, :3, :3].transpose(0, 2, 1).reshape(-1, 9)
        return np.concatenate([self.poses[:, :3, 3], r, self.twists], axis=1)


def timed(cruise: float, ramp: float, dt: float) -> Array:
    """Fractions of a way (k,) that takes `cruise` seconds at full speed, with half-cosine ramps."""
    total = max(cruise, 1e-9) + ramp
    count = max(int(np.ceil(total / dt)), 2)
    t = np.linspace(0.0, total, count + 1)[1:]
    r = min(ramp, total / 2)

    def started(x: Array) -> Array:
        x = np.clip(x, 0.0, r)
        return np.asarray(0.5 * (x - r / np.pi * np.sin(np.pi * x / r)))

    way = started(t) + np.clip(t - r, 0.0, total - 2 * r) + r / 2 - started(total - t)
    return np.asarray(way / way[-1])


def lanes(extent: float, radius: float, exploration: Exploration) -> Array:
    """Polar angles of the lanes, rad, for a skin that reaches to polar angle `extent`.

    radius: mean radius of curvature along the meridian, m.
    """
    reach = extent + exploration.margin / radius
    pitch = exploration.lane_spacing / radius
    count = max(int(np.ceil(reach / pitch)), 2)
    return np.asarray((np.arange(count) + 0.5) * reach / (count - 0.5), dtype=float)


def parallels(polar: Array, radius: float, exploration: Exploration, dt: float) -> Array:
    """Polar angle and azimuth (k, 2) of the contact's normal at every step."""

    def cruise(angle: float, arm: float) -> float:
        return max(angle * arm / exploration.speed, angle / exploration.turn_rate)

    way = [np.array([[polar[0], -np.pi]])]
    for k, theta in enumerate(polar):
        start = -np.pi if k % 2 == 0 else np.pi
        s = timed(cruise(2 * np.pi, radius * np.sin(theta)), exploration.ramp, dt)
        way.append(np.stack([np.full_like(s, theta), start * (1 - 2 * s)], axis=1))
        if k + 1 < len(polar):
            hop = polar[k + 1] - theta
            s = timed(cruise(hop, radius), exploration.ramp, dt)
            way.append(np.stack([theta + hop * s, np.full_like(s, -start)], axis=1))
    return np.concatenate(way)


def _rotation(axis: Array, angle: Array) -> Array:
    """Rotations (k, 3, 3) by `angle` (k,) about a unit `axis` (3,)."""
    return exp_so3(angle[:, None] * axis)


def body_rotations(normals: Array, axis: Array, heading: float) -> Array:
    """Rotations (k, 3, 3) of the body in the indenter's frame, the normals (k, 3) along its -z.

    First the spin about the skin's axis brings the normal into one meridian, then the tilt lowers
    it; `heading` (rad) is the direction of that meridian about the frame's z.
    """
    basis = orthonormal_basis(axis, perpendicular(axis))
    e1, e2, _ = basis.T
    polar = np.arctan2(np.hypot(normals @ e1, normals @ e2), normals @ axis)
    azimuth = np.unwrap(np.arctan2(normals @ e2, normals @ e1))
    h = np.array([np.cos(heading), np.sin(heading), 0.0])
    down = np.array([0.0, 0.0, -1.0])
    side = np.cross(down, h)
    # columns: where e1, e2, axis go with no tilt
    base = np.stack([h, side, down], axis=1) @ basis.T
    tilt = _rotation(side, -polar)
    return np.asarray(tilt @ base @ _rotation(axis, -azimuth))


def plan(
    body: Body,
    axis: Array,
    extent: float,
    exploration: Exploration,
    *,
    indenter: Indenter,
    gap: float,
    heading: float,
    dt: float,
) -> Path:
    """The path of the body over an indenter whose centre stays `gap` (m) from the surface.

    axis (3,) is the skin's mean normal in the body frame, extent (rad) the largest angle of a
    taxel's normal to it. Raises SimulationError if the surface is flat or concave there.
    """
    centre = body.mesh.bounds.mean(axis=0)
    size = float(np.linalg.norm(np.ptp(body.mesh.bounds, axis=0)))
    pole = body.closest((centre + size * axis)[None])
    radius = 1.0 / max(float(pole.curvature.mean()), 1e-6)
    if radius > size:
        raise SimulationError(
            "parallels need a convex skin", value=f"radius {radius:.3g} m at its centre",
            limit=f"the body's size {size:.3g} m", remedy="give a convex skin region",
        )  # fmt: skip
    angles = parallels(lanes(extent, radius, exploration), radius, exploration, dt)
    e1, e2, _ = orthonormal_basis(axis, perpendicular(axis)).T
    s = np.sin(angles[:, :1])
    wanted = (
        np.cos(angles[:, :1]) * axis
        + s * np.cos(angles[:, 1:]) * e1
        + s * np.sin(angles[:, 1:]) * e2
    )
    # seen from far away along a direction, the closest point of a convex body has about that normal
    hit = body.closest(centre + 10 * size * wanted)
    rotations = indenter.rotation @ body_rotations(hit.normal, axis, heading)
    reach = hit.point + gap * hit.normal
    positions = np.array(indenter.position) - np.einsum("kij,kj->ki", rotations, reach)
    poses = transform(rotations, positions)
    return Path(dt, hit.point, hit.normal, poses, twists(poses, dt), hit.face)


def twists(poses: Array, dt: float) -> Array:
    """Twists (k, 6) that carry each pose to the next within dt, linear first; rest at the end."""
    r, p = poses[:, :3, :3], poses[:, :3, 3]
    turn = log_so3(r[1:] @ r[:-1].transpose(0, 2, 1))
    twists = np.concatenate([np.diff(p, axis=0), turn], axis=1) / dt
    return np.concatenate([twists, np.zeros((1, 6))])
