"""Where on a body a plane layout lies: the place whose curvature agrees with it best.

A body that looks the same in several places, as a sphere does everywhere, does not tell them apart:
the misfits of all places tried say how far it does.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from ...core.arrays import Array, far_apart
from ...core.se3 import orthonormal_basis
from .alignment import aligned
from .placement import OnBody, settled
from .stress import misfit

if TYPE_CHECKING:
    from ...geometry.body import Body

PLACES, TURNS = 24, 8
"""Places on a body and turns about its normal that are tried, with both mirror images: 45 degrees
apart, from which the taxels find their way."""
KEPT = 16
"""Placements, of those that start well, whose taxels are settled."""
ALIKE = 1.1
"""Misfit over that of the best placement up to which another starts as well: the best start is
often not the best end."""
EQUAL = 1.02
"""The same of settled placements, which the distances do not tell apart: on the shipped scenes
their misfit differs by less than 1 % where their shapes differ by half a pitch."""


def places_on(body: Body) -> Array:
    """Places (p, 3), m, all over the body, where the middle of a skin may be."""
    vertices = np.asarray(body.facets.vertices)
    order = np.random.default_rng(0).permutation(len(vertices))
    apart = float(np.linalg.norm(np.ptp(vertices, axis=0))) / PLACES
    return np.asarray(vertices[far_apart(vertices, order, apart, PLACES)])


def placed(
    body: Body, plane: Array, lengths: Array, unit: float, middles: Array
) -> tuple[OnBody, Array, int]:
    """The placement of least stress of a layout `plane` (n, 2), m, on a body.

    lengths (n, n) in a `unit`, m; middles (p, 3): where the middle of the layout is tried. Of
    placements that fit equally well, it is the one most like the others. Returns it, the root mean
    square distances (n,), m, of its taxels from those of the others, aligned, and the number of
    middles where one starts as well.
    """
    trials = [
        (start, k) for k, middle in enumerate(middles) for start in _starts(body, plane, middle)
    ]
    cost = np.array([misfit(start.along, lengths, unit) for start, _ in trials])
    good = np.flatnonzero(cost <= ALIKE * cost.min())
    tried = good[np.unique(np.linspace(0, len(good) - 1, KEPT).astype(int))]
    ends = [settled(trials[k][0], lengths, unit, free=False)[0] for k in tried]
    ends.sort(key=lambda end: misfit(end.along, lengths, unit))
    least = misfit(ends[0].along, lengths, unit)
    equal = [e.positions for e in ends if misfit(e.along, lengths, unit) <= EQUAL * least]
    square = np.array([[np.sum((aligned(b, a) - a) ** 2, axis=1) for b in equal] for a in equal])
    chosen = int(np.argmin(np.median(square.mean(axis=2), axis=1)))
    spread = np.sqrt(square[chosen].mean(axis=0))
    return ends[chosen], spread, len({trials[k][1] for k in good})


def _starts(body: Body, plane: Array, middle: Array) -> list[OnBody]:
    """Placements with the layout's middle at a point of the body, in all turns and both images."""
    hit = body.closest(middle[None])
    basis = orthonormal_basis(hit.normal[0])[:, :2]
    centred = plane - plane.mean(axis=0)
    found = []
    for angle in 2 * np.pi * np.arange(TURNS) / TURNS:
        turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
        for image in ([1.0, 1.0], [1.0, -1.0]):
            tangent = (centred * image) @ turn.T
            found.append(OnBody.at(body, hit.point[0] + tangent @ basis.T))
    return found
