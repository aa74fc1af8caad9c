"""Errors of the body, of the kinematics and of the clocks, as the contact points show them.

Estimates rest on the believed surface and on the recorded contact points. The readings do not show
a body that is too large, a dent, or contact points that are all displaced; the distances of the
contact points from the believed surface show them. The spread of the residuals does not show how
far a delay of the readings displaces a taxel; the path of the contact points shows it.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ...core import se3
from ...core.arrays import Array
from ...core.content_cache import cached_on_argument
from ...geometry.surface.closest_point import Closest
from ..data import delay
from ..data.measurements import Measurements
from ..data.registration import MIN_SCATTER, cells, slopes
from ..trilateration.displacements import surface_motion
from ..trilateration.trilaterate import starts
from .frame_errors import nearer_axes
from .surface_errors import growth, local_means, normal_variance, sheet_covariance, tilts

SHIFT_SIGMAS = 5.0
"""Displacement of the contact points, in standard deviations, above which it is significant."""
MIN_SPREAD = 1e-3
"""Mean square of the normals' components along a direction from which a displacement along it
changes the distances: 2 degrees."""
GROSS = 10.0
"""Distance of a contact point from the surface, relative to the 95th percentile, above which this
single point is wrong."""
TRIALS, RATIO = 25, 2.0
"""Number of standard deviations of a motion that are tried, a factor of 1.33 apart, and the
standard deviation of the logarithm of the ratio between those of turn and shift. With 2, turns
without a shift are expected, too: of the displacement of an egg by such turns 0.93 is stated, with
1 it is 0.8, with 3 0.95."""
SURFACE_DEPTHS = 0.1, 1.5
"""Typical distance of the contact points from the believed surface, in depths of the indentation: a
doubt, a failure. Recorded points lie between the undeformed surface and the indenter's deepest
point. A tenth of the depth is 0.2 mm for the paper's skin."""
MAX_LEFT = 0.1
"""Mean square of the taxels' mean distances that may remain beyond scatter after a displacement of
the contact points, relative to that before: a larger remainder indicates dents of the body."""

REGISTRATIONS = 4
"""Linearizations of a motion: with a frame turned by 3 degrees on the forearm of a UR3e one left
1.2 degrees, two 0.002."""
MAX_SLIDE = 5.0
"""Ratio of the displacement by such a motion to the distances that it explains, both rms, above
which dents explain them as well. It is 2 for that frame, and 80 for dents of 0.1 mm under a skin of
eight taxels."""
ATTEMPTS = (7, REGISTRATIONS), (6, REGISTRATIONS), (7, 1)
"""Entries and linearizations of the motions that are tried, in order."""


def systematic_covariance(
    data: Measurements,
    unknowns: Mapping[str, tuple[float, float]],
    places: Array,
    rotations: Array,
    shape: Array,
    jump: Array | None = None,
) -> Array:
    """What these errors add to the covariances (n, 6, 6) of the taxels' poses, taxel frame.

    unknowns: estimated global parameters, whose offsets may explain the distances. places (n, 3),
    m, and rotations (n, 3, 3): of the taxels; shape (n, 2, 2), 1/m: shape operators; jump (6,):
    small motion of the contacts in a part of the recording.
    """
    points, middles, tangents = nearer_points(data, unknowns), starts(data), rotations[:, :, :2]
    hit, moved_points = on_surface(data, points)
    sideways = moved_points.squares(middles)
    sideways += delay.remaining_squares(data)
    swapped = nearer_axes(data, points).displacements(middles)
    moves = [swapped]
    if jump is not None:
        moves.append(jump[:3] + np.cross(jump[3:], middles))
    if data.belief.surface_sigma > 0.0:
        moves.append(data.belief.surface_sigma * growth(data.body, middles))
    if (moving := data.parameters.motion) is not None:
        moves.append(tilts(data, hit.point, hit.distance))
        if moving.held.size:  # of a body offset (registration.py)
            moves += list(np.moveaxis(slopes(middles, moving.mean) @ moving.held, 2, 0))
    for moved in moves:
        sideways += moved[:, :, None] * moved[:, None, :]
    tangential = np.swapaxes(tangents, 1, 2) @ sideways @ tangents
    into = surface_motion(shape)
    out: Array = into @ tangential @ np.swapaxes(into, 1, 2)
    out[:, 2, 2] += normal_variance(data, hit.distance) + data.belief.surface_sigma**2
    out[:, 2, 2] += np.einsum("ni,ni->n", rotations[:, :, 2], swapped) ** 2
    return out + sheet_covariance(data.body, places)


def displacement(distance: Array, normals: Array) -> Array:
    """The displacement (3,), m, of contact points that explains their distances (m,), m, from a
    surface with normals (m, 3); zero where it is within SHIFT_SIGMAS of chance.

    Single contacts far off the surface have no part in it, nor what the distances do not show.
    """
    near = _sound(distance)
    distance, normals = distance[near], normals[near]
    value, vectors = np.linalg.eigh(normals.T @ normals)
    good = value > MIN_SPREAD * len(normals)
    basis = vectors[:, good] / np.sqrt(value[good])
    along = basis.T @ (normals.T @ distance)
    rest = float(np.sum(distance**2) - np.sum(along**2)) / max(len(distance) - 3, 1)
    along[np.abs(along) < SHIFT_SIGMAS * np.sqrt(max(rest, 0.0))] = 0.0
    return np.asarray(basis @ along)


def _sound(distance: Array) -> np.ndarray:
    """Whether each contact point (m,) is not far off the surface compared with the others."""
    size = np.abs(distance)
    return np.asarray(size <= GROSS * np.quantile(size, 0.95))


@dataclass(frozen=True)
class Motion:
    """A displacement of points with a turn and a change of scale about their middle."""

    middle: Array
    """(3,), m."""
    shift: Array
    """(3,), m."""
    turn: Array
    """(3,), rad."""
    stretch: float
    """Relative change of size."""
    covariance: Array
    """(7, 7), of shift, turn and stretch: of what the distances do not determine."""

    def at(self, points: Array) -> Array:
        """Displacements (m, 3), m, of points (m, 3), m."""
        arm = points - self.middle
        return np.asarray(self.shift + np.cross(self.turn, arm) + self.stretch * arm)

    def squares(self, points: Array) -> Array:
        """Mean squares (m, 3, 3), m^2, of the displacements of points (m, 3), m."""
        arm, moved = points - self.middle, self.at(points)
        unit = np.broadcast_to(np.eye(3), (len(arm), 3, 3))
        slopes = np.concatenate([unit, -se3.hat(arm), arm[:, :, None]], axis=2)
        spread = slopes @ self.covariance @ np.swapaxes(slopes, 1, 2)
        return np.asarray(moved[:, :, None] * moved[:, None, :] + spread)

    @classmethod
    def none(cls, points: Array) -> Motion:
        """The zero motion, about the middle of the points (m, 3), m."""
        return cls(points.mean(axis=0), np.zeros(3), np.zeros(3), 0.0, np.zeros((7, 7)))

    def among(self, motions: Array) -> Motion:
        """One of equally likely motions (q, 7), of shift, turn and stretch about this one's middle:
        their mean, and their covariance about it."""
        mean = motions.mean(axis=0)
        off = motions - mean
        return Motion(self.middle, mean[:3], mean[3:6], float(mean[6]), off.T @ off / len(off))

    @classmethod
    def explaining(
        cls, bounds: Array, points: Array, distance: Array, normals: Array, entries: int = 7
    ) -> Motion:
        """The most likely one of contact points (m, 3), m, by their distances (m,), m, from a
        surface with normals (m, 3), about the middle of the body's bounds (2, 3), m; of 7 entries,
        or of 6, without a change of scale.

        The heights over the middle that a stretch changes are those of the surface below them.

        Shift, and turn and stretch times half the bounds' diagonal are alike before: a body that
        slides along its own surface has no distances, and is expected to have moved so as far as it
        has moved otherwise. That is the covariance.
        """
        middle, size = bounds.mean(axis=0), float(np.linalg.norm(np.ptp(bounds, axis=0))) / 2
        arm = points - middle
        outward = (np.einsum("mi,mi->m", arm, normals) - distance)[:, None] / size
        columns = np.hstack([normals, np.cross(arm, normals) / size, outward])
        x, covariance = np.zeros(7), np.zeros((7, 7))
        x[:entries], covariance[:entries, :entries] = _posterior(
            columns[:, :entries], distance, points
        )
        unit = np.array([1.0, 1.0, 1.0, *np.full(4, 1 / size)])
        x, covariance = unit * x, unit[:, None] * covariance * unit
        return cls(middle, x[:3], x[3:6], float(x[6]), covariance)


def _posterior(columns: Array, distance: Array, points: Array) -> tuple[Array, Array]:
    """The combination (q,) of `columns` (m, q) by the distances (m,), m, of points (m, 3), m, and
    its covariance (q, q); zeros where the distances are within SHIFT_SIGMAS of chance.

    Its entries are normal about zero, with one standard deviation of the turn and one of the
    others, over which the mean is taken: their densities fall with their square, for few entries
    tell little of them, and their ratio is log-normal about 1.
    """
    near = _sound(distance)
    columns, distance, points = columns[near], distance[near], points[near]
    left = distance - columns @ np.linalg.lstsq(columns, distance, rcond=1e-6)[0]
    explained, rest = float(np.sum(distance**2) - np.sum(left**2)), float(np.mean(left**2))
    entries = columns.shape[1]
    if explained < (entries + SHIFT_SIGMAS**2) * max(rest, MIN_SCATTER**2):
        return np.zeros(entries), np.zeros((entries, entries))
    rest = effective_variance(left, points)
    matrix, right = columns.T @ columns / rest, columns.T @ distance / rest
    scale = np.mean(distance**2) ** 0.5 * np.logspace(-1, 2, TRIALS)
    pair = np.stack(np.meshgrid(scale, scale, indexing="ij"), axis=-1).reshape(-1, 2)
    prior = pair[:, [0, 0, 0, 1, 1, 1, 0][:entries]]
    unit = np.eye(entries) + prior[:, :, None] * matrix * prior[:, None, :]
    inverse = np.linalg.inv(unit)
    mean = prior * np.einsum("tij,tj->ti", inverse, prior * right)
    ratio = np.log(pair[:, 1] / pair[:, 0]) / RATIO
    log_weight = (mean @ right - np.linalg.slogdet(unit)[1] - ratio**2) / 2
    log_weight -= np.log(pair).sum(axis=1)
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    found = weight @ mean
    apart = mean - found
    covariance = prior[:, :, None] * inverse * prior[:, None, :]
    covariance += apart[:, :, None] * apart[:, None, :]
    return np.asarray(found), np.asarray(np.tensordot(weight, covariance, 1))


def effective_variance(rest: Array, points: Array) -> float:
    """Variance, m^2, of independent errors that are worth as much as those which leave distances
    `rest` (m,), m, at points (m, 3), m: errors of contacts in the same cell may be alike, as over a
    dent."""
    cell = cells(points)
    between = float(np.mean(np.bincount(cell, rest) ** 2 / np.bincount(cell)))
    return max(float(np.mean(rest**2)), between, MIN_SCATTER**2)


def motion(data: Measurements, points: Array, distance: Array, normals: Array) -> Motion:
    """The motion of the contact points (m, 3) that displaces the taxels, too.

    It is none where a body of another size, scaled or offset along its normals, explains the
    distances (m,), m, better: its taxels are where the contacts are. Where contact points of
    another scale do so as well, that counts by half. One with turn and scale, or
    with a turn alone where that runs far off, must leave a tenth of what the simpler ones leave,
    and the moved points must lie as near: a large one on a small part of the body fits its dents to
    first order only. Distances that none of these explains are dents of the body; where they are as
    large as a failure of the verdict, or ask for such a displacement, the points may be anywhere on
    the body: its extents are the covariance.
    """
    shift = displacement(distance, normals)

    def left(rest: Array) -> tuple[float, float]:
        """Sum of the taxels' squared mean distances, and the part of it that scatter explains."""
        mean, variance = local_means(data, rest)
        return float(np.sum(mean**2)), 2 * float(np.sum(variance))

    rests = [distance - normals @ shift]
    heights = np.einsum("mi,mi->m", points, normals) - distance  # of the surface below them
    for size in (np.ones(len(distance)), heights):
        size_factor = float(size @ distance) / max(float(size @ size), 1e-300)
        rests.append(distance - size_factor * size)
    squares = [float(np.sum(rest**2)) for rest in rests]
    whole, (simple, scatter) = left(distance)[0], left(rests[int(np.argmin(squares))])
    facets = getattr(data.body, "facets", None)  # an exact surface has none
    corners = points if facets is None else facets.vertices
    bounds = np.stack([corners.min(axis=0), corners.max(axis=0)])
    enough = MAX_LEFT * whole + scatter
    moves = squares[0] < min(squares[1:]) and simple <= enough
    for entries, linearizations in ATTEMPTS:
        apart, across = distance, normals
        for _ in range(linearizations):
            found = Motion.explaining(bounds, points, apart, across, entries)
            moved = found.at(points)
            hit = data.body.closest(points - moved)  # far motions are not linear
            across = hit.normal
            apart = hit.distance + np.einsum("mi,mi->m", across, moved)
        after = left(hit.distance)
        slides = linearizations > 1 and np.sum(moved**2) > MAX_SLIDE**2 * np.sum(distance**2)
        if not slides and (sum(after) < MAX_LEFT * simple or (moves and after[0] <= enough)):
            return found
    none = Motion.none(points)
    if simple <= enough:
        parts = [np.append(moves * shift, np.zeros(4))]
        far = size_factor**2 * np.sum(points**2) > MAX_SLIDE**2 * np.sum(distance**2)
        if not far and left(rests[2])[0] <= enough:
            parts.append(size_factor * np.append(none.middle, [0.0, 0.0, 0.0, 1.0]))
        return none.among(np.array(parts))
    size = max(float(np.median(np.abs(distance))), float(np.linalg.norm(shift)))
    if size > SURFACE_DEPTHS[1] * data.indentation:
        none.covariance[:3, :3] = float(np.sum(np.ptp(bounds, axis=0) ** 2)) / 12 * np.eye(3)
    return none


def on_surface(data: Measurements, points: Array) -> tuple[Closest, Motion]:
    """The believed surface below contact points (m, 3), m, and their motion as of `motion`."""
    return _recorded_on_surface(data) if points is data.points else _on_surface(data, points)


@cached_on_argument
def _recorded_on_surface(data: Measurements) -> tuple[Closest, Motion]:
    """`on_surface` of the points as recorded, which every method asks for."""
    return _on_surface(data, data.points)


def _on_surface(data: Measurements, points: Array) -> tuple[Closest, Motion]:
    hit = data.body.closest(points)
    return hit, motion(data, points, hit.distance, hit.normal)


def nearer_points(data: Measurements, unknowns: Mapping[str, tuple[float, float]]) -> Array:
    """The contact points (m, 3), m, moved by the estimated offsets where these bring them nearer to
    the surface: readings do not show an offset along the normals, which then is none."""
    points, moved = data.points, data.points + offsets(data, unknowns)
    if np.array_equal(points, moved):
        return points
    before, after = (np.sum(data.body.closest(p).distance ** 2) for p in (points, moved))
    return moved if after < before else points


def offsets(data: Measurements, unknowns: Mapping[str, tuple[float, float]]) -> Array:
    """Displacements (m, 3), m, of the contact points by the estimated offsets."""
    motion = data.parameters.motion
    by_motion = () if motion is None else motion.labels

    def value(name: str, kind: str = "") -> Array:
        if f"{name} {kind}x" in by_motion:
            return np.zeros(3)
        return np.array([unknowns.get(f"{name} {kind}{axis}", (0.0, 0.0))[0] for axis in "xyz"])

    turned = data.points @ se3.exp_so3(value("body_offset", "rotation ")).T
    out: Array = turned - data.points + value("body_offset")
    if data.headings is not None:
        out += np.swapaxes(data.headings, 1, 2) @ value("indenter_offset")
    if motion is not None:
        found = np.array([unknowns[label][0] for label in motion.labels if label in unknowns])
        if len(found):  # contacts keep their heights
            moved = motion.slopes @ (found - motion.mean - motion.root @ motion.about)
            along = np.einsum("mi,mi->m", moved, data.normals)
            out += moved - along[:, None] * data.normals
    return out
