"""The estimator "coactivation": a layout on the body, whose contact points give its place alone."""

from __future__ import annotations

import numpy as np

from ...core.arrays import Array
from ...core.errors import CalibrationError
from ...core.progress import Stage
from .. import centroid
from ..data.measurements import Measurements
from ..result import EstimatorResult
from ..trilateration import trilaterate
from .alignment import aligned
from .coactivity import distinct_levels, path_lengths
from .layout import layout
from .placement import OnBody, settled

ANCHOR = (
    "rigid alignment, or that of the mirror image, with the weighted means of the contact points"
)
FACTORS = (
    "co-activation of the taxels; no contact points beside the anchor's",
    "size of the contacts by the contact model: scale",
    "body surface: position along the normal and tilt",
)


def estimate(data: Measurements, stage: Stage | None = None) -> EstimatorResult:
    """The layout of the taxels on the believed body; stage: whose steps are counted.

    Raises CalibrationError where too few taxels answer together, or have a weighted mean of contact
    points that are not on a line.
    """
    frames, stage = np.zeros((len(data.points), len(data.ids))), stage or Stage()
    frames[data.contact, data.taxel] = np.maximum(data.pressure, 0.0)
    plane = layout(frames, data.ids, touch_radius=touch_radius(data), progress=stage.progress)
    stage.expect(3)
    stage.step()
    means = centroid.estimate(data).points
    rows = np.flatnonzero((plane.reasons == "") & np.isfinite(means).all(axis=1))
    if len(rows) < 3:
        raise CalibrationError(
            "too few taxels have contact points to place a layout by", value=len(rows), limit=3
        )
    lengths = path_lengths(distinct_levels(frames))[np.ix_(rows, rows)]
    start = OnBody.at(data.body, aligned(plane.positions[rows], means[rows]))
    stage.step()
    shape, _ = settled(start, lengths, touch_radius(data), free=False)
    placed = OnBody.at(data.body, aligned(shape.positions, means[rows], mirror=False))
    n = len(data.ids)
    points, rotations = np.full((n, 3), np.nan), np.tile(np.eye(3), (n, 1, 1))
    covariance: Array = np.tile(np.diag([np.inf, np.inf]), (n, 1, 1))
    points[rows], rotations[rows] = placed.positions, placed.rotations
    covariance[rows] = 0.5 * plane.sigma[rows, None, None] ** 2 * np.eye(2)
    reasons = plane.reasons.copy()
    reasons[(reasons == "") & ~np.isin(np.arange(n), rows)] = trilaterate.TOO_FEW
    return EstimatorResult(
        points=points,
        rotations=rotations,
        covariance=covariance,
        chi2=np.full(n, np.nan),
        reasons=reasons,
        factors=FACTORS,
        anchor=ANCHOR,
    )


def touch_radius(data: Measurements) -> float:
    """Distance, m, from a typical contact at which a taxel begins to answer."""
    from ...contact.disc import invert_disc_mean

    radius = float(np.median(data.radii))
    level = data.threshold / data.nominal_peak
    return radius * float(invert_disc_mean([level], [data.disc / radius])[0])
