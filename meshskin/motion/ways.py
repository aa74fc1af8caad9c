"""Ways that one touch may follow: lanes strung together, and how the body lies on the indenter."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from ..geometry.body import Body
from ..physics.indenter import Indenter
from ..se3 import Array, transform
from . import clear
from .arm import Arm
from .lanes import Piece

HOP = 8.0
"""Spacings over which the contact slides on to the next lane, which is sooner done than a lift."""


@dataclass(frozen=True)
class Setup:
    """What explores: the arm with the body, and the indenter under it."""

    body: Body
    indenter: Indenter
    depth: float
    """Depth to which the indenter is pressed in, m."""
    reach: float
    """Distance along the surface at which a contact is felt, m."""
    arm: Arm | None = None
    """None: the body moves freely, without an arm."""
    mount: Array | None = None
    """T_tip_body (4, 4)."""
    patch: float = 0.0
    """Longer semi-axis of the contact patch, m: no edge may be nearer than that."""
    holds: Callable[[Array], Array] | None = None
    """Principal curvatures (k, 2), 1/m -> why the contact model does not hold there: strings, ""
    where it does. None: it always does."""

    @cached_property
    def brink(self) -> Array:
        """Points (k, 3) on the body's edges."""
        return clear.edges(self.body, 0.2 * self.patch) if self.patch else np.zeros((0, 3))

    @cached_property
    def mounted(self) -> clear.Mounted | None:
        """What of the arm is not judged against the body; None: no arm."""
        if self.arm is None or self.mount is None:
            return None
        return clear.mounted(self.arm, self.body, self.mount)

    def fits(self, points: Array, normals: Array) -> Array:
        """Why the indenter cannot be pressed in at points (k, 3): see `clear.fits`, and `holds`."""
        why = clear.fits(self.body, points, normals, self.indenter, self.depth)
        why[(why == "") & clear.on_edges(points, self.brink, self.patch)] = clear.EDGE
        free = np.flatnonzero(why == "")
        if self.holds is not None and len(free):
            why[free] = self.holds(self.body.closest(points[free]).curvature)
        return why

    @property
    def gap(self) -> float:
        """Height of the indenter's centre over the contact point, m."""
        return self.indenter.radius - self.depth

    def tips(self, points: Array, normals: Array) -> Array:
        """The indenter's centre (..., 3), body frame, when it is pressed in at contact points."""
        return np.asarray(points + self.gap * normals)

    def poses(self, tips: Array, normals: Array, headings: Array) -> Array:
        """T_w_b (..., 4, 4) with the normals (..., 3) straight against the indenter.

        tips (..., 3): where the indenter's centre is in the body frame;
        headings (..., 3): unit tangents that come to lie along x of the indenter's frame.
        """
        tips, normals, headings = np.broadcast_arrays(tips, normals, headings)
        down, x = np.array([0.0, 0.0, -1.0]), np.array([1.0, 0.0, 0.0])
        local = np.stack([headings, np.cross(normals, headings), normals], axis=-1)
        held = self.indenter.frame @ np.stack([x, np.cross(down, x), down], axis=-1)
        rotation = held @ np.swapaxes(local, -1, -2)
        place = np.array(self.indenter.position) - np.einsum("...ij,...j->...i", rotation, tips)
        return np.asarray(transform(rotation, place))


@dataclass(frozen=True)
class Way:
    """k samples on the surface that one touch may follow; it rests at `stops`."""

    points: Array
    normals: Array
    stops: tuple[int, ...]
    """Rows of ends of lanes."""

    def __len__(self) -> int:
        return len(self.points)

    def part(self, run: slice) -> Way:
        """The samples of a run, which rests at its own ends."""
        inner = [k - run.start for k in self.stops if run.start < k < run.stop - 1]
        stops = (0, *inner, run.stop - run.start - 1)
        return Way(self.points[run], self.normals[run], stops)


def joined(setup: Setup, pieces: list[Piece], spacing: float, step: float) -> list[Way]:
    """The pieces strung together, each next one the nearest, over hops where these are short."""
    left, ways = list(pieces), []
    legs: list[Piece] = []
    while left:
        here = legs[-1].points[-1] if legs else left[0].points[0]
        ends = np.array([[p.points[0], p.points[-1]] for p in left])
        gap = np.linalg.norm(ends - here, axis=2)
        k, end = np.unravel_index(int(np.argmin(gap)), gap.shape)
        piece = left.pop(int(k))
        piece = piece.reverse if end else piece
        if legs:
            hop = _hop(setup, here, piece.points[0], step) if gap[k, end] < HOP * spacing else None
            if hop is None:
                ways.append(_way(legs))
                legs = []
            else:
                legs.append(hop)
        legs.append(piece)
    return [*ways, _way(legs)] if legs else []


def _hop(setup: Setup, start: Array, end: Array, step: float) -> Piece | None:
    """The straight way over the surface, or None where the indenter does not fit on it."""
    count = max(int(np.ceil(np.linalg.norm(end - start) / step)), 1)
    part = np.linspace(0.0, 1.0, count + 1)[:, None]
    hit = setup.body.closest((1 - part) * start + part * end)
    why = setup.fits(hit.point, hit.normal)
    return None if (why != "").any() else Piece(hit.point, hit.normal)


def _way(legs: list[Piece]) -> Way:
    """Legs that meet at their ends as one way."""
    parts = [legs[0], *(leg[1:] for leg in legs[1:])]
    stops = np.cumsum([len(part) for part in parts]) - 1
    return Way(
        np.concatenate([p.points for p in parts]),
        np.concatenate([p.normals for p in parts]),
        (0, *(int(k) for k in np.unique(stops[stops > 0]))),
    )


def transported(normals: Array, first: Array | None = None) -> Array:
    """Unit tangents (k, 3) carried along the normals (k, 3) without turning about them."""
    out = np.empty_like(normals)
    way = np.eye(3)[np.argmin(np.abs(normals[0]))] if first is None else first
    for k, n in enumerate(normals):
        way = way - n * (n @ way)
        way = way / np.linalg.norm(way)
        out[k] = way
    return out


def turned(tangents: Array, normals: Array, angle: Array) -> Array:
    """Tangents (..., 3) turned about the normals by `angle` (...), rad."""
    cosine, sine = np.cos(angle)[..., None], np.sin(angle)[..., None]
    return np.asarray(cosine * tangents + sine * np.cross(normals, tangents))
