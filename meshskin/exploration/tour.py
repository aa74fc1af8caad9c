"""Contact paths: pieces of lanes, joined by slides, that are followed without lifting off, and the
time along them: as slow as the limits of speed, rotation and joints require.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from ..core.arrays import Array, Index
from ..core.errors import ReachError
from ..core.se3 import log_so3
from ..geometry.geodesics import rotate_about, transport_along
from ..geometry.surface.closest_point import Closest
from ..robot.contact_rig import ContactRig
from ..scene.scene import Scene
from ..scene.settings import Exploration
from .left_out import Blocked
from .path import Path, body_twists, time_scaling

Parts = tuple[list[Path], list[Blocked]]
"""Parts of a path, and what cannot be touched between them."""

SHORT = 3
"""Fewest samples of a lane that are worth a segment: a spline needs as many."""
LONGEST_LINK = 8.0
"""Longest slide from lane to lane, in lane spacings. Chosen: 28 mm take 0.6 s at 50 mm/s, less than
a lift, a transfer and a new approach."""
SAME_SIDE = 0.5
"""Least cosine of the angle between the normals of neighbouring samples of a slide: a slide through
a thin body comes out on its other side."""

SPIN_WIDTHS = (6.0, 2.0, 0.0)
"""Standard deviations, in samples, of the Gaussian filter of the spin: the first that the joints
allow is taken. The spins are those of a grid of 15 degrees; 6 samples blur its steps."""
POSE_WIDTH = 0.015
"""Standard deviation, s, of the Gaussian filter of the body's pose: over a seam of the surface the
normal turns with a jerk that the body need not follow."""


@dataclass(frozen=True)
class ContactPath:
    """Samples on the surface that the contact point follows in one segment."""

    points: Array
    """(k, 3), body frame, m."""
    normals: Array
    """Outward (k, 3)."""
    stops: tuple[int, ...]
    """Rows at which the contact point rests: both ends of every lane."""

    def __len__(self) -> int:
        return len(self.points)

    def part(self, run: slice) -> ContactPath:
        """The samples of a run, with stops at its ends."""
        inner = [k - run.start for k in self.stops if run.start < k < run.stop - 1]
        stops = (0, *inner, run.stop - run.start - 1)
        return ContactPath(self.points[run], self.normals[run], stops)


def contact_paths(
    rig: ContactRig, pieces: list[Closest], spacing: float, step: float
) -> list[ContactPath]:
    """Join the pieces, each to the nearest one left, by slides where these are short and feasible.

    spacing: of the lanes, m; step: between samples of a slide, m.
    """
    if not pieces:
        return []
    pieces = _nearest_first(pieces)
    here = np.array([piece.point[-1] for piece in pieces[:-1]]).reshape(-1, 3)
    there = np.array([piece.point[0] for piece in pieces[1:]]).reshape(-1, 3)
    near = np.linalg.norm(there - here, axis=1) < LONGEST_LINK * spacing
    slides: list[Closest | None] = [None] * len(near)
    for k, slide in zip(
        np.flatnonzero(near), _slides(rig, here[near], there[near], step), strict=True
    ):
        slides[k] = slide
    paths, legs = [], pieces[:1]
    for slide, piece in zip(slides, pieces[1:], strict=True):
        if slide is None:
            paths.append(_concatenated(legs))
            legs = [piece]
        else:
            legs += [slide, piece]
    return [*paths, _concatenated(legs)]


def _nearest_first(pieces: list[Closest]) -> list[Closest]:
    """The pieces in order: each is followed by the nearest of the others, reversed where its end is
    nearer.

    Those on the other side of a body come last.
    """
    ends = np.array([[piece.point[0], piece.point[-1]] for piece in pieces])
    normals = np.array([[piece.normal[0], piece.normal[-1]] for piece in pieces])
    left = np.ones(len(pieces), dtype=bool)
    size = float(np.linalg.norm(np.ptp(ends.reshape(-1, 3), axis=0)))
    here, facing, out = ends[0, 0], normals[0, 0], []
    for _ in pieces:
        gap = np.linalg.norm(ends - here, axis=2) + np.where(normals @ facing < 0, size, 0.0)
        gap[~left] = np.inf
        k, end = np.unravel_index(int(np.argmin(gap)), gap.shape)
        left[k] = False
        piece = pieces[int(k)]
        out.append(piece.take(slice(None, None, -1)) if end else piece)
        here, facing = out[-1].point[-1], out[-1].normal[-1]
    return out


def _slides(rig: ContactRig, start: Array, end: Array, step: float) -> list[Closest | None]:
    """The straight slides over the surface; None where the indenter does not fit along one, and
    where it would be on the other side of the body.

    start, end (k, 3), m.
    """
    if not len(start):
        return []
    samples = []
    for one, other in zip(start, end, strict=True):
        count = max(int(np.ceil(np.linalg.norm(other - one) / step)), 1)
        s = np.linspace(0.0, 1.0, count + 1)[:, None]
        samples.append((1 - s) * one + s * other)
    hit = rig.body.surface.nearest(np.concatenate(samples))
    blocked = rig.contact_reasons(hit.point, hit.normal) != ""
    counts = [len(points) for points in samples]
    legs, parts = hit.split(counts), np.split(blocked, np.cumsum(counts)[:-1])
    turns = [np.sum(leg.normal[1:] * leg.normal[:-1], axis=1) for leg in legs]
    return [
        None if part.any() or np.any(turn < SAME_SIDE) else leg
        for leg, part, turn in zip(legs, parts, turns, strict=True)
    ]


def _concatenated(legs: list[Closest]) -> ContactPath:
    """Pieces that meet at their ends as one contact path."""
    parts = [legs[0], *(leg.take(slice(1, None)) for leg in legs[1:])]
    stops = np.cumsum([len(part.point) for part in parts]) - 1
    whole = Closest.concatenate(parts)
    stops = np.unique(stops[stops > 0])
    return ContactPath(whole.point, whole.normal, (0, *(int(k) for k in stops)))


def free_paths(scene: Scene, rig: ContactRig, path: ContactPath) -> Parts:
    """The paths along one contact path of a body without an arm, a row a step of the loop."""
    return _paths(scene, rig, path, transport_along(path.normals), np.zeros((len(path), 0)))


def arm_paths(
    scene: Scene, rig: ContactRig, path: ContactPath, tangents: Array, spin: Array, posture: Array
) -> Parts:
    """The paths along one contact path that an arm follows from a posture (n,), a row a step.

    tangents (k, 3): headings at spin 0; spin (k,), rad, is smoothed as far as the joints allow.
    Raises ReachError.
    """
    from scipy.ndimage import gaussian_filter1d

    for width in SPIN_WIDTHS:
        smooth = gaussian_filter1d(spin, width, mode="nearest") if width else spin
        headings = rotate_about(path.normals, tangents, smooth)
        poses = rig.contact_poses(path.points, path.normals, headings)
        try:
            q, held = rig.follow(poses, posture)
            if held is not poses:
                headings = rig.headings(held)
            return _paths(scene, rig, path, headings, q)
        except ReachError as error:
            reason = error
    raise reason


def _paths(scene: Scene, rig: ContactRig, path: ContactPath, headings: Array, q: Array) -> Parts:
    """The paths in time over samples with headings (k, 3) and joint angles (k, n).

    Between samples a row may come near an edge, or to where the contact model does not hold, such
    as a kink of the surface: the path is cut there.
    """
    samples, at = _rows(scene, rig, path, headings, q)
    hit = rig.body.surface.nearest(samples[:, :3])
    reason = rig.patch_reasons(hit.point, hit.curvature)
    if not (reason != "").any():
        return [_path(scene, rig, hit, samples[:, 3:], q)], []
    cut, rows = np.unique(at[reason != ""], return_index=True)
    rows = np.flatnonzero(reason != "")[rows]
    segments, blocked = list[Path](), [(hit.point[rows], reason[rows])]
    for first, last in pairwise([-1, *cut, len(path) - 1]):
        if last - first >= SHORT:
            run = slice(first + 1, last + 1)
            more, others = _paths(scene, rig, path.part(run), headings[run], q[run])
            segments, blocked = segments + more, blocked + others
    return segments, blocked


def _rows(
    scene: Scene, rig: ContactRig, path: ContactPath, headings: Array, q: Array
) -> tuple[Array, Index]:
    """Points and headings (m, 6) at every step in time, and the sample (m,) before each."""
    from scipy.interpolate import PchipInterpolator, make_interp_spline

    exploration, dt = scene.exploration, scene.loop.dt
    slowness, length = _slowness(rig, path, headings, q, exploration)
    rows = np.concatenate([path.points, headings], axis=1)
    parts, before = [rows[:1]], [np.zeros(1, dtype=np.intp)]
    for start, end in pairwise(path.stops):
        s = np.concatenate([[0.0], np.cumsum(length[start:end])])
        t = np.concatenate([[0.0], np.cumsum((slowness * length)[start:end])])
        at = PchipInterpolator(t, s)(time_scaling(t[-1], exploration.ramp, dt) * t[-1])
        parts.append(make_interp_spline(s, rows[start : end + 1], k=min(3, end - start))(at))
        before.append(np.clip(np.searchsorted(s, at) - 1, 0, end - start - 1) + start)
    return np.concatenate(parts), np.concatenate(before)


def _path(scene: Scene, rig: ContactRig, hit: Closest, headings: Array, q: Array) -> Path:
    """The path through contact points (m,), a row a step, with headings (m, 3)."""
    from scipy.ndimage import gaussian_filter1d

    dt = scene.loop.dt
    centres, normals, tangents = (
        gaussian_filter1d(x, POSE_WIDTH / dt, axis=0, mode="nearest")
        for x in (rig.indenter_centres(hit.point, hit.normal), hit.normal, headings)
    )
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    tangents -= np.einsum("ij,ij->i", tangents, normals)[:, None] * normals
    tangents /= np.linalg.norm(tangents, axis=1)[:, None]
    poses = rig.poses(centres, normals, tangents)
    posture = q[:1] if q.size else None
    if posture is not None:
        poses = rig.held_poses(poses, posture[0])
    twists = body_twists(poses, dt)
    return Path(dt, hit.point, hit.normal, poses, twists, hit.face, (), posture)


def _slowness(
    rig: ContactRig, path: ContactPath, headings: Array, q: Array, exploration: Exploration
) -> tuple[Array, Array]:
    """Least time per length (k - 1,), s/m, between samples, and their distances (k - 1,), m."""
    from scipy.ndimage import gaussian_filter1d, maximum_filter1d

    length = np.maximum(np.linalg.norm(np.diff(path.points, axis=0), axis=1), 1e-9)
    rotation = rig.poses(path.points, path.normals, headings)[:, :3, :3]
    turn = np.linalg.norm(log_so3(rotation[1:] @ np.swapaxes(rotation[:-1], 1, 2)), axis=1)
    least = np.maximum(length / exploration.speed, turn / exploration.turn_rate)
    if rig.arm is not None:
        rate = exploration.joint_share * rig.arm.velocity_limit
        least = np.maximum(least, (np.abs(np.diff(q, axis=0)) / rate).max(axis=1))
    # slow down before a slow stretch and speed up after it without a jerk
    return gaussian_filter1d(maximum_filter1d(least / length, 5), 1.0, mode="nearest"), length
