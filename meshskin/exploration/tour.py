"""Contact paths: pieces of lanes, joined by slides, that are followed without lifting off."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..core.arrays import Array
from ..geometry.surface.closest_point import Closest
from ..robot.contact_rig import ContactRig

LONGEST_LINK = 8.0
"""Longest slide from lane to lane, in lane spacings. Chosen: 28 mm take 0.6 s at 50 mm/s, less than
a lift, a transfer and a new approach."""


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
    remaining, paths = list(pieces), []
    legs: list[Closest] = []
    while remaining:
        here = legs[-1].point[-1] if legs else remaining[0].point[0]
        ends = np.array([[p.point[0], p.point[-1]] for p in remaining])
        gap = np.linalg.norm(ends - here, axis=2)
        k, end = np.unravel_index(int(np.argmin(gap)), gap.shape)
        piece = remaining.pop(int(k))
        piece = piece.take(slice(None, None, -1)) if end else piece
        if legs:
            near = gap[k, end] < LONGEST_LINK * spacing
            link = _link(rig, here, piece.point[0], step) if near else None
            if link is None:
                paths.append(_concatenated(legs))
                legs = []
            else:
                legs.append(link)
        legs.append(piece)
    return [*paths, _concatenated(legs)] if legs else []


def _link(rig: ContactRig, start: Array, end: Array, step: float) -> Closest | None:
    """The straight slide over the surface, or None where the indenter does not fit along it."""
    count = max(int(np.ceil(np.linalg.norm(end - start) / step)), 1)
    s = np.linspace(0.0, 1.0, count + 1)[:, None]
    hit = rig.body.closest((1 - s) * start + s * end)
    reason = rig.contact_reasons(hit.point, hit.normal)
    return None if (reason != "").any() else hit


def _concatenated(legs: list[Closest]) -> ContactPath:
    """Pieces that meet at their ends as one contact path."""
    parts = [legs[0], *(leg.take(slice(1, None)) for leg in legs[1:])]
    stops = np.cumsum([len(part.point) for part in parts]) - 1
    whole = Closest.concatenate(parts)
    stops = np.unique(stops[stops > 0])
    return ContactPath(whole.point, whole.normal, (0, *(int(k) for k in stops)))
