"""Eq. 15 as the paper prints it: three circles of each taxel, from readings of points.

r = a sqrt(1 - (p/p_0)^2) is the distance at which a point of the patch is under the pressure p. A
taxel reads the mean over its disc instead, so that the distances err even without noise: on the
paper's sphere, with discs of 2 mm in patches of 4.3 mm, by 0.94 mm rms. The three readings of a
taxel are drawn at random. `trilaterate.three_circles` improves on both: it inverts the mean over
the disc, and chooses its circles.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ...core.arrays import Array
from ...core.provenance import random_stream
from .. import chart
from ..chart import Charts
from ..data.measurements import Measurements
from ..result import SURFACE, EstimatorResult
from . import trilaterate
from .circles import SLOPE_FLOOR, Circles

DRAWS = 20
"""Largest number of draws of three readings; with contacts in lanes, the contacts of a fifth of the
draws lie near a line."""
FACTORS = (
    "distances of three readings drawn at random, by eq. 15 at the nominal E*, as of points",
    SURFACE,
)


def estimate(data: Measurements, rng: np.random.Generator | None = None) -> EstimatorResult:
    """Each taxel from three of its readings, drawn at random.

    rng: draws the readings; by default every call draws the same ones. The covariance includes the
    noise of the readings and the error of eq. 15 for a disc.
    """
    draw = random_stream(0, "eq. 15") if rng is None else rng
    charts = chart.charts_at(data.body, trilaterate.starts(data))
    rows = np.argsort(data.taxel, kind="stable")
    found = point_circles(data, rows, data.taxel[rows], len(data.ids))
    three = random_three(found, charts, draw)
    fit = trilaterate.radical_centres(data.body, charts, lambda points: three, FACTORS)
    return replace(fit, covariance=_covariance(three, fit))


def random_three(found: Circles, charts: Charts, rng: np.random.Generator) -> Circles:
    """Three circles of each point, drawn again where their contacts are near a line: at most DRAWS
    times.
    """
    own = found.owner
    first = np.searchsorted(own, own)
    chosen, near_line = np.zeros(len(own), dtype=bool), np.ones(found.count, dtype=bool)
    for _ in range(DRAWS):
        drawn = np.empty(len(own), dtype=bool)
        drawn[np.lexsort((rng.random(len(own)), own))] = np.arange(len(own)) - first < 3
        chosen = np.where(near_line[own], drawn, chosen)
        three = found.select(chosen)
        near_line = trilaterate.width(three, charts) < trilaterate.MIN_WIDTH
        if not near_line.any():
            break
    return three


def point_distance(pressure: Array, peak: Array, radius: Array) -> Array:
    """Eq. 15: distances (k,), m, at which points are under `pressure`, Pa; 0 from `peak` on."""
    ratio = np.clip(pressure / peak, 0.0, 1.0)
    return np.asarray(radius * np.sqrt(1.0 - ratio**2))


def point_circles(data: Measurements, rows: np.ndarray, owner: np.ndarray, count: int) -> Circles:
    """The circles by eq. 15 of the readings `rows` (k,), of the points `owner` (k,), rising."""
    contact = data.contact[rows]
    a, peak = data.radii[contact], data.peaks[contact]
    r = point_distance(data.pressure[rows], peak, a)
    slope = data.slope[rows]
    noise = data.spread[contact] / np.hypot(slope, SLOPE_FLOOR * peak / a)
    return Circles(
        owner=owner,
        reading=rows,
        centres=data.points[contact],
        normals=data.normals[contact],
        radii=r,
        weights=1.0 / np.hypot(noise, r - data.distance[rows]),
        steepness=slope * a / peak,
        patch=a,
        count=count,
    )


def _covariance(found: Circles, fit: EstimatorResult) -> Array:
    """Covariance (n, 2, 2), m^2, of the radical centres that errors of the distances cause.

    Unlike the information of the circles, it is valid for equal weights, and for distances that are
    small against their errors.
    """
    own, good = found.owner, fit.found
    c, _ = found.conic(found.centres - fit.points[own], fit.rotations[own, :, :2])
    c = c - (found.sum(c) / 3.0)[own]
    normal = found.sum(c[:, :, None] * c[:, None, :])
    normal[~good] = np.eye(2)
    sigma = 1.0 / found.weights
    square = np.hypot(2.0 * found.radii * sigma, sigma**2)  # error of the squared distance
    move = np.linalg.solve(normal[own], (0.5 * square[:, None] * c)[:, :, None])[:, :, 0]
    total = found.sum(move[:, :, None] * move[:, None, :])
    return np.where(good[:, None, None], total, fit.covariance)
