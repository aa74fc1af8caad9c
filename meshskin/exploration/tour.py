"""Ways that one touch may follow: lanes strung together, and how the body lies on the indenter."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.se3 import Array
from ..robot.contact_rig import ContactRig
from .lanes import Piece

HOP = 8.0
"""Spacings over which the contact slides on to the next lane, which is sooner done than a lift."""


@dataclass(frozen=True)
class ContactPath:
    """k samples on the surface that one touch may follow; it rests at `stops`."""

    points: Array
    normals: Array
    stops: tuple[int, ...]
    """Rows of ends of lanes."""

    def __len__(self) -> int:
        return len(self.points)

    def part(self, run: slice) -> ContactPath:
        """The samples of a run, which rests at its own ends."""
        inner = [k - run.start for k in self.stops if run.start < k < run.stop - 1]
        stops = (0, *inner, run.stop - run.start - 1)
        return ContactPath(self.points[run], self.normals[run], stops)


def joined(
    setup: ContactRig, pieces: list[Piece], spacing: float, step: float
) -> list[ContactPath]:
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


def _hop(setup: ContactRig, start: Array, end: Array, step: float) -> Piece | None:
    """The straight way over the surface, or None where the indenter does not fit on it."""
    count = max(int(np.ceil(np.linalg.norm(end - start) / step)), 1)
    part = np.linspace(0.0, 1.0, count + 1)[:, None]
    hit = setup.body.closest((1 - part) * start + part * end)
    why = setup.fits(hit.point, hit.normal)
    return None if (why != "").any() else Piece(hit.point, hit.normal)


def _way(legs: list[Piece]) -> ContactPath:
    """Legs that meet at their ends as one way."""
    parts = [legs[0], *(leg[1:] for leg in legs[1:])]
    stops = np.cumsum([len(part) for part in parts]) - 1
    return ContactPath(
        np.concatenate([p.points for p in parts]),
        np.concatenate([p.normals for p in parts]),
        (0, *(int(k) for k in np.unique(stops[stops > 0]))),
    )
