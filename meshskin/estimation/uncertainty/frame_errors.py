"""Wrong frames of a log, by its contact points and normals: recorded normals against those of the
believed surface, a body or an indenter that moved during the recording, and contact points whose
axes have other signs or another order than those of the body.

On a nearly symmetric body mirrored points lie on the surface almost everywhere, and the readings
fit a mirrored map. The contacts on the parts that are not symmetric show the error, also without
normals.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import permutations, product

import numpy as np

from ...core.arrays import Array
from ...recording.recording import JOINT_ANGLES, Recording
from ..data.measurements import Measurements
from ..data.patch_shape import unevenness
from ..data.unit_checks import angles
from .verdict import FAIL, MIN_CONTACTS, PASS, Finding, doubt, level_of

NORMAL_ANGLES = 20.0, 45.0
"""Median angle between recorded normals and those of the believed surface, degrees: a doubt, a
failure. With friction of 0.3 a force leans by 17 degrees."""
NORMAL_TURNS = -0.5, 0.0
"""Turn of the recorded normals over that of the surface, along the direction where it is least,
with the opposite sign, from which it is a doubt, and a failure: 1 in a sound log, -1 along a
mirrored axis, the cosine of the angle in a frame that is rotated about the normal."""
STRAYS = 0.05
"""Part of the contacts, those with normals farthest from the regression, that is left out of it: on
a patch where normals turn by 0.1 rad, 9 of 3,184 contacts over an edge, 80 degrees off, halved the
ratio."""
BESIDE_EDGE = 0.5e-3
"""Distance, m, from an edge of the body within which the normal of the surface does not count: an
error of the place, or of the body, of this order takes it from one face to the other."""
MIN_TURN = 0.03
"""Spread of the surface's normals along a direction, rad, from which turns along it count."""
PLACES = 16
"""Number of contacts, evenly spaced, at which a body may have moved."""
POINTS, COMPARED = 1000, 300
"""Contact points, at most, by which a move and other axes are judged."""
SMALL = 0.02
"""Distance of the points from the surface (rms), in depths of the indentation, up to which they are
on it: 0.04 mm for the paper's skin."""
WEAK = 0.03
"""Singular value, relative to the largest, below which a displacement hardly changes the distances:
along such directions it is set to zero."""
BETTER = 6.0
"""Ratio of the mean squared distances after one and after two displacements, from which a move is
named. It is 4 for a steady drift, which is named as such."""
NEARER = 1.5, 4.0
"""Ratios of the mean squared distances as recorded and with other axes: a doubt, a failure. On a
body that is symmetric within the errors of its mesh the ratio is smaller."""


def findings(recording: Recording, data: Measurements, points: Array) -> Iterator[Finding]:
    """Findings on the recorded normals, and on contact points (m, 3), m, by their distances from
    the believed surface."""
    yield from _of_normals(recording, data)
    yield from _of_axes(recording, data, points)
    yield from _of_moves(data, points)


def _of_normals(recording: Recording, data: Measurements) -> list[Finding]:
    """Recorded normals against those of the believed surface: their angle, and how both turn from
    contact to contact, which on a small patch shows a mirrored axis better."""
    rows = np.flatnonzero((recording.force > 0) & np.isfinite(recording.normals).all(axis=1))
    computed = recording.metadata.get("source") == JOINT_ANGLES  # the normals are the surface's
    if computed or len(rows) < MIN_CONTACTS:
        return []
    hit = data.body.closest(recording.points[rows])
    apart = unevenness(data.belief, hit, BESIDE_EDGE) == 0
    if apart.sum() < MIN_CONTACTS:
        return []
    hit, normals = hit.take(apart), recording.normals[rows[apart]]
    typical = float(np.degrees(np.median(angles(hit, normals))))
    turn, axis = least_turn(hit.normal, normals)
    if (level := level_of(-turn, NORMAL_TURNS)) != PASS:
        words = (
            f"recorded normals turn {turn:.2g} times as much from contact to contact as those of "
            f"the believed surface, along ({', '.join(f'{x:.2g}' for x in axis)}) (limit "
            f"{-NORMAL_TURNS[0]:g}): check the signs and the order of the axes of contacts and body"
        )
    elif (level := level_of(typical, NORMAL_ANGLES)) != PASS:
        words = (
            f"recorded normals are {typical:.2g} degrees from those of the believed surface in the "
            f"median (limit {NORMAL_ANGLES[0]:g}): check the frame of the body and of the contacts"
        )
    return [] if level == PASS else [(level, words)]


def least_turn(surface: Array, normals: Array) -> tuple[float, Array]:
    """The least eigenvalue of the regression of recorded normals (m, 3) on those of the surface,
    without STRAYS, and its direction (3,); 1 where the normals of the surface hardly turn."""
    centred = surface - surface.mean(axis=0)
    value, vectors = np.linalg.eigh(centred.T @ centred / len(centred))
    basis = vectors[:, value > MIN_TURN**2]
    if not basis.size:
        return 1.0, np.zeros(3)
    across, found = centred @ basis, (normals - normals.mean(axis=0)) @ basis
    slope = np.linalg.lstsq(across, found, rcond=None)[0]
    off = np.linalg.norm(found - across @ slope, axis=1)
    used = off <= np.quantile(off, 1 - STRAYS)
    slope = np.linalg.lstsq(across[used], found[used], rcond=None)[0]
    least, directions = np.linalg.eigh((slope + slope.T) / 2)
    return float(least[0]), basis @ directions[:, 0]


@dataclass(frozen=True)
class Displacements:
    """Two displacements of contact points that bring them nearest to the believed surface."""

    part: float
    """Part of the contacts before the second one."""
    one: float
    """Mean squared distance, m^2, after one displacement of all points."""
    two: float
    """Mean squared distance, m^2, after the two displacements."""
    apart: float
    """Length, m, of the difference of the two."""


def displacements(data: Measurements, points: Array) -> Displacements:
    """The two displacements of contact points (k, 3), m, in the order of their times.

    A depth that all points share, as of a body of another size, is estimated, too, and subtracted.
    """
    hit, count = data.body.closest(points), len(points)
    best, found = np.inf, list[Array]()
    for begin in range(0, count, -(-count // PLACES)):
        later = (np.arange(count) >= begin)[:, None]
        columns = np.hstack([hit.normal * ~later, hit.normal * later, np.ones((count, 1))])
        x = np.linalg.lstsq(columns, hit.distance, rcond=WEAK)[0]
        left = float(np.sum((hit.distance - columns @ x) ** 2))
        if not found or left < best:
            best, part, apart = left, begin / count, float(np.linalg.norm(x[3:6] - x[:3]))
            moved = points - np.where(later, x[3:6], x[:3]) - x[6] * hit.normal
            found = [*found[:1], moved]
    one, two = (_mean_square(data, p) for p in (found[0], found[-1]))
    return Displacements(part, one, two, apart)


def _of_moves(data: Measurements, points: Array) -> Iterator[Finding]:
    """A body or an indenter that moved: one displacement brings the contact points before the move
    onto the surface, another one those after it."""
    rows = np.linspace(0, len(points) - 1, min(POINTS, len(points))).astype(int)
    if len(rows) < 2 * PLACES:
        return
    found = displacements(data, points[rows])
    if found.one < max((SMALL * data.indentation) ** 2, BETTER * found.two):
        return
    yield doubt(
        f"the body or the indenter has moved in the course of the recording, at about "
        f"{found.part:.0%} of it: with one displacement of all contact points these lie "
        f"{1e3 * found.one**0.5:.2g} mm off the believed surface (rms); if those from there on are "
        f"displaced by another {1e3 * found.apart:.1g} mm, {1e3 * found.two**0.5:.2g} mm (limit: "
        f"{BETTER**0.5:g} times nearer); calibrate the parts one by one, or record again"
    )


@dataclass(frozen=True)
class NearerAxes:
    """Other axes with which the contact points lie nearer to the believed surface."""

    axes: Array
    """Signed permutation (3, 3)."""
    recorded: float
    """Mean squared distance, m^2, of the points from the surface as recorded."""
    nearest: float
    """Mean squared distance, m^2, with the other axes."""

    @property
    def level(self) -> str:
        """Level of the verdict for the ratio of `recorded` to `nearest`."""
        return level_of(self.recorded / max(self.nearest, 1e-300), NEARER)

    def displacements(self, points: Array) -> Array:
        """Displacements (n, 3), m, of points (n, 3), m, by the other axes if these are a failure;
        else zeros."""
        return points - points @ self.axes.T if self.level == FAIL else np.zeros_like(points)


def nearer_axes(data: Measurements, points: Array) -> NearerAxes:
    """The axes with which contact points (m, 3), m, are nearest to the believed surface.

    These are the recorded axes where the points lie on the surface, or where a displacement brings
    them nearer than other axes do: on a nearly symmetric body, points look mirrored if the body has
    moved, possibly during the recording.
    """
    rows = np.linspace(0, len(points) - 1, min(COMPARED, len(points))).astype(int)
    points, recorded = points[rows], _mean_square(data, points[rows])
    if len(points) < MIN_CONTACTS or recorded <= (SMALL * data.indentation) ** 2:
        return NearerAxes(np.eye(3), recorded, recorded)
    axes = signed_permutations()
    squares = np.array([_mean_square(data, points @ turned.T) for turned in axes])
    best, nearest = int(np.argmin(squares)), float(np.min(squares))
    off = nearest > (SMALL * data.indentation) ** 2
    if off and NEARER[0] * displacements(data, points).two < nearest:
        return NearerAxes(np.eye(3), recorded, recorded)
    return NearerAxes(axes[best], recorded, nearest)


def _of_axes(recording: Recording, data: Measurements, points: Array) -> Iterator[Finding]:
    """Axes with other signs, or in another order."""
    if recording.metadata.get("source") == JOINT_ANGLES:  # the points are the surface's
        return
    found = nearer_axes(data, points)
    if found.level == PASS:
        return
    words = (
        f"contact points lie {1e3 * found.recorded**0.5:.3g} mm off the believed surface (rms), "
        f"and {1e3 * found.nearest**0.5:.3g} mm with their axes as {_name(found.axes)} (limit: "
        f"{NEARER[0] ** 0.5:.2g} times as near): check the signs and the order of the axes of "
        "contacts and body"
    )
    yield found.level, words


def signed_permutations() -> Array:
    """The matrices (47, 3, 3), without the identity, that change the order or signs of axes."""
    every = np.array(
        [
            np.diag(signs) @ np.eye(3)[list(order)]
            for order in permutations(range(3))
            for signs in product((1.0, -1.0), repeat=3)
        ]
    )
    return every[1:]


def _mean_square(data: Measurements, points: Array) -> float:
    """Mean squared distance, m^2, of points (k, 3), m, from the believed surface."""
    return float(np.mean(data.body.closest(points).distance ** 2))


def _name(axes: Array) -> str:
    """Signed axes in words, such as (x, -y, z)."""
    found = np.abs(axes).argmax(axis=1)
    signs = axes[np.arange(3), found]
    names = ["-" * bool(s < 0) + "xyz"[k] for k, s in zip(found, signs, strict=True)]
    return f"({', '.join(names)})"
