"""Where taxels are by co-activation alone: which contacts each answered, whatever it said.

No pressure enters, nor E*, gain or force: this holds where trilateration fails, because its
distances are wrong or too few are left, and is near enough for the joint estimate to find its
optimum (studies/estimators.py measures how near that is).
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from . import chart, trilaterate
from .measurements import Measurements

if TYPE_CHECKING:
    from ..geometry.body import Body

OUTSIDE = 2.0
"""Distance of a trilaterated taxel from the middle of its contacts at which it is not believed,
relative to their spread."""
SCATTERED = 3.0
"""Spread of a taxel's contacts, relative to the median taxel's, beyond which they show nothing."""
EVERYWHERE = "answers to contacts all over"
"""Why a taxel is then undetermined."""


def alone(data: Measurements, body: Body) -> trilaterate.Fit:
    """Every taxel (n) at the middle of its contacts, where three or more answered, not on a line.

    The middle is the geometric median, which a few false answers elsewhere do not move. Its
    covariance is that of the contacts about it: a bound, and a generous one.
    """
    n, seen = len(data.ids), np.flatnonzero(data.counts)
    points, why = np.full((n, 3), np.nan), np.full(n, trilaterate.FEW, dtype=object)
    rotations, scatter = np.tile(np.eye(3), (n, 1, 1)), np.full((n, 3, 3), np.inf)
    if len(seen):
        equal = replace(data, pressure=np.ones_like(data.pressure))
        points[seen] = trilaterate.medians(equal, body, seen)
        rotations[seen] = chart.frames(body.closest(points[seen]).normal)
        local = np.einsum("kij,ki->kj", rotations[data.taxel],
                          data.points[data.contact] - points[data.taxel])  # fmt: skip
        for i, j in np.ndindex(3, 3):
            total = np.bincount(data.taxel, local[:, i] * local[:, j], n)
            scatter[seen, i, j] = total[seen] / data.counts[seen]
    flat = scatter[:, :2, :2]
    spread = np.sqrt(np.trace(flat, axis1=1, axis2=2))
    enough = data.counts >= 3
    why[enough] = ""
    least = np.zeros(n)
    least[enough] = np.sqrt(np.maximum(np.linalg.eigvalsh(flat[enough])[:, 0], 0.0))
    why[enough & (least < trilaterate.NARROW * float(np.median(data.radii)))] = trilaterate.LINE
    if enough.any():
        why[enough & (spread > SCATTERED * np.median(spread[enough]))] = EVERYWHERE
    bad = why != ""
    points[bad], flat[bad] = np.nan, np.diag([np.inf, np.inf])
    return trilaterate.Fit(points, rotations, flat, np.full(n, np.nan), why)


def start(data: Measurements, body: Body) -> trilaterate.Fit:
    """Trilateration by least squares, and co-activation for the taxels where it fails."""
    fit, rough = trilaterate.least_squares(data, body), alone(data, body)
    off = np.linalg.norm(fit.points - rough.points, axis=1)
    spread = np.sqrt(np.trace(rough.covariance, axis1=1, axis2=2))
    take = rough.found & (~fit.found | (off > OUTSIDE * spread))
    at = take[:, None, None]
    return trilaterate.Fit(
        points=np.where(at[:, 0], rough.points, fit.points),
        rotations=np.where(at, rough.rotations, fit.rotations),
        covariance=np.where(at, rough.covariance, fit.covariance),
        chi2=np.where(take, np.nan, fit.chi2),
        why=np.where(take, "", fit.why),
    )
