"""Trilateration: a taxel is where the circles of its contacts meet (paper, eq. 15).

Each reading gives the distance of its taxel from a contact: a circle about the contact point in the
tangent plane, or, under an elliptic patch, in the plane scaled along its axes (circles.py). The
distance inverts the disc-averaged profile of the contact model. Two estimators: three chosen
circles, and weighted least squares over all circles; eq15.py has the paper's. A reading at or above
the profile's maximum has the distance 0. The distance is uncertain there, where the slope of the
profile vanishes, and at the patch's edge: least squares weights each circle by its slope, the three
circles are chosen where it is steep.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from ...contact.ellipse import NODES
from ...core.arrays import Array, means_by_group, sums_by_group
from ...core.errors import CalibrationError
from ...geometry.body import Body
from .. import chart
from ..chart import Charts
from ..data.measurements import Measurements
from ..result import SURFACE, EstimatorResult
from .circles import Circles, circles

TOO_FEW = "fewer than three readings"
COLLINEAR = "contacts near a line"
NO_INTERSECTION = "circles that do not meet"
MIN_WIDTH = 0.05
"""Least RMS width of the contacts about their best line, relative to the contact radius: below it
the error across the line is some 20 times that along it, which is no longer an estimate."""
COARSE_NODES = 16
"""Nodes of the disc mean in the first pass over elliptic patches: within 1e-3 of the peak
pressure."""
MIN_STEEPNESS = 0.3
"""Least slope, relative to p_0/a, of the profile at the three circles of a taxel, where a taxel has
enough such readings. A point reading has it from 0.29 a to the edge of the patch."""
FACTORS = ("distance of each reading, at the nominal E*", SURFACE)


def centroids(data: Measurements) -> Array:
    """Mean contact points (n, 3), m, of the taxels, weighted by pressure squared, on the body.

    Readings further from a first mean than the patch reaches (noise above a low threshold) are left
    out of the second. NaN for a taxel without readings.
    """
    weight, points, n = data.pressure**2, data.points[data.contact], len(data.ids)
    far = 1.5 * data.reach()[data.contact]
    first = means_by_group(points, data.taxel, n, weight)
    off = np.linalg.norm(points - first[data.taxel], axis=1)
    second = means_by_group(points, data.taxel, n, np.where(off < far, weight, 0.0))
    start = np.where(np.isfinite(second), second, first)
    seen = np.isfinite(start[:, 0])
    start[seen] = data.body.closest(start[seen]).point
    return start


def starts(data: Measurements) -> Array:
    """`centroids`, and any contact point for a taxel without readings."""
    start = centroids(data)
    start[~np.isfinite(start[:, 0])] = data.points[0]
    return start


def medians(data: Measurements, rows: np.ndarray) -> Array:
    """Geometric medians (r, 3), m, of the contact points of the taxels `rows`, on the body.

    They are weighted by pressure; a minority of readings elsewhere hardly moves them. Source:
    Weiszfeld, Tohoku Math. J. 43 (1937).
    """
    place = np.full(len(data.ids), -1)
    place[rows] = np.arange(len(rows))
    mine = np.flatnonzero(place[data.taxel] >= 0)
    owner, points = place[data.taxel[mine]], data.points[data.contact[mine]]
    weight = power = np.maximum(data.pressure[mine], 0.0)
    for _ in range(30):
        total = np.maximum(np.bincount(owner, weight, len(rows)), 1e-300)
        centre = sums_by_group(weight[:, None] * points, owner, len(rows)) / total[:, None]
        gap = np.linalg.norm(points - centre[owner], axis=1)
        weight = power / np.maximum(gap, 0.1 * data.disc)
    return np.asarray(data.body.closest(centre).point)


def least_squares(data: Measurements) -> EstimatorResult:
    """Each taxel from all its readings, by weighted Gauss-Newton on the distances."""
    near, charts = _near_centroids(data)
    # The second pass, about the estimate, removes the error of the chart.
    for nodes in (COARSE_NODES, NODES):
        found = circles(near, charts.points, nodes=nodes)
        y, information, chi2 = solve(found, charts)
        charts = chart.charts_at(data.body, charts.at(y), charts.rotations)
    return _result(found, charts, information, chi2)


def with_noise_off_edges(data: Measurements) -> Measurements:
    """The measurements with the noise that the circles of contacts off the body's edges show.

    Over edges the readings have an error of their own, which their residuals do not scale. The same
    where the noise is known, where no contact is over an edge, and where too few are off edges.
    """
    if data.noise is not None or not data.edges:
        return data
    chi2 = least_squares(data.select(data.unevenness[data.contact] == 0)).chi2
    chi2 = chi2[np.isfinite(chi2)]
    return replace(data, noise=data.sigma * float(np.median(chi2)) ** 0.5) if len(chi2) else data


def three_circles(data: Measurements) -> EstimatorResult:
    """Each taxel from three of its circles: steep ones about well-separated contacts.

    A better method than the paper's, which draws three at random and takes the readings as those of
    points (eq15.py).
    """
    near, charts = _near_centroids(data)
    three = _three(circles(near, charts.points), charts).reading
    return radical_centres(data.body, charts, lambda points: circles(near, points, three))


def radical_centres(
    body: Body,
    charts: Charts,
    circles_at: Callable[[Array], Circles],
    factors: tuple[str, ...] = FACTORS,
) -> EstimatorResult:
    """Each taxel at the radical centre of its three circles.

    charts: about the starts; circles_at: points (n, 3), m -> the circles with the taxels there;
    factors: what the estimate is made of.
    """
    for _ in range(3):
        found = circles_at(charts.points)
        y = _linear(found, charts, equal=True)
        far = np.linalg.norm(y, axis=1) > 2 * found.patch.max(initial=0.0)
        y[far] = 0.0
        charts = chart.charts_at(body, charts.at(y), charts.rotations)
    residual, _, information = _linearized(found, charts, np.zeros((found.count, 2)))
    fit = _result(found, charts, information, found.sum(residual**2), factors)
    reasons = np.where((fit.reasons == "") & far, NO_INTERSECTION, fit.reasons)
    points = np.where((reasons == "")[:, None], fit.points, np.nan)
    return replace(fit, reasons=reasons, points=points)


def require_any(fit: EstimatorResult) -> EstimatorResult:
    """`fit`. Raises CalibrationError if it determines no taxel."""
    if not fit.found.any():
        raise undetermined(fit.reasons)
    return fit


def undetermined(reasons: np.ndarray) -> CalibrationError:
    """The error of a recording that determines no taxel, for the reasons (n,)."""
    return CalibrationError(
        "no taxel is determined by the recording",
        value=", ".join(sorted(set(map(str, reasons)))),
        remedy="touch every taxel from at least three contacts that are not on a line",
    )


def intersect(found: Circles, charts: Charts) -> tuple[Array, Array, Array]:
    """The radical centre of three well-separated circles of each point.

    Returns coordinates (n, 2), m, information (n, 2, 2), 1/m^2, and chi2 (n,), as `solve`.
    """
    three = _three(found, charts)
    y = _linear(three, charts, equal=True)
    residual, _, information = _linearized(three, charts, y)
    return y, information, three.sum(residual**2)


def solve(found: Circles, charts: Charts, iterations: int = 8) -> tuple[Array, Array, Array]:
    """Weighted least squares in the charts: coordinates (n, 2), m, information (n, 2, 2), 1/m^2,
    and chi2 (n,) per degree of freedom.

    Starts from the linear solution; each step is limited to half a contact radius.
    """
    y = _linear(found, charts)
    y[np.linalg.norm(y, axis=1) > 3 * found.patch.max(initial=0.0)] = 0.0
    limit = 0.5 * float(np.median(found.patch)) if len(found.patch) else 0.0
    for _ in range(iterations):
        residual, jacobian, information = _linearized(found, charts, y)
        step = -_solve2(information, found.sum(jacobian * residual[:, None]))
        size = np.linalg.norm(step, axis=1, keepdims=True)
        y = y + step * np.minimum(1.0, limit / np.maximum(size, 1e-300))
        if np.max(size, initial=0.0) < 1e-9:
            break
    residual, _, information = _linearized(found, charts, y)
    freedom = np.bincount(found.owner, minlength=found.count) - 2
    chi2 = found.sum(residual**2) / np.where(freedom > 0, freedom, np.nan)
    return y, information, chi2


def width(found: Circles, charts: Charts) -> Array:
    """RMS width (n,) of the contacts about their best line, relative to the contact radius."""
    own = found.owner
    number = np.maximum(np.bincount(own, minlength=found.count), 1)
    offset = (found.centres - charts.points[own]) / found.patch[:, None]
    c = np.einsum("kij,ki->kj", charts.tangents[own], offset)
    c = c - (found.sum(c) / number[:, None])[own]
    scatter = found.sum(c[:, :, None] * c[:, None, :]) / number[:, None, None]
    return np.sqrt(np.maximum(np.linalg.eigvalsh(scatter)[:, 0], 0.0))


def _result(
    found: Circles,
    charts: Charts,
    information: Array,
    chi2: Array,
    factors: tuple[str, ...] = FACTORS,
) -> EstimatorResult:
    """The estimate at the origins of the charts; NaN and a reason where it is undetermined."""
    number = np.bincount(found.owner, minlength=found.count)
    reasons = np.where(number < 3, TOO_FEW, "").astype(object)
    reasons[(number >= 3) & (width(found, charts) < MIN_WIDTH)] = COLLINEAR
    bad = reasons != ""
    covariance = np.linalg.inv(np.where(bad[:, None, None], np.eye(2), information))
    covariance[bad] = np.diag([np.inf, np.inf])
    return EstimatorResult(
        points=np.where(bad[:, None], np.nan, charts.points),
        rotations=charts.rotations,
        covariance=covariance,
        chi2=np.where(bad, np.nan, chi2),
        reasons=reasons,
        factors=factors,
    )


def _near_centroids(data: Measurements) -> tuple[Measurements, Charts]:
    """The readings whose contact can reach its taxel's centroid, with 1 mm to spare, and charts
    about the centroids.

    Left out are readings within 3 sigma of zero, whose distance would be a guess at the edge of the
    patch, and saturated ones of a taxel that has three others.
    """
    start = starts(data)
    off = np.linalg.norm(data.points[data.contact] - start[data.taxel], axis=1)
    keep = off < 1.3 * data.reach()[data.contact] + 1e-3
    keep &= data.pressure > 3 * (data.noise or 0.0)
    full = data.pressure >= data.ends[data.taxel]
    others = np.bincount(data.taxel[keep & ~full], minlength=len(data.ids))
    keep &= ~full | (others[data.taxel] < 3)
    return data.select(keep), chart.charts_at(data.body, start)


def _linearized(found: Circles, charts: Charts, y: Array) -> tuple[Array, Array, Array]:
    """Weighted residuals (k,), their derivatives J (k, 2) by the owner's coordinates, and J^T J
    (n, 2, 2) of each point, at the coordinates y (n, 2)."""
    own, weights = found.owner, found.weights
    distance, gradient = found.distance(charts.at(y)[own] - found.centres)
    jacobian = weights[:, None] * np.einsum("ki,kij->kj", gradient, charts.slope(y)[own])
    square = found.sum(jacobian[:, :, None] * jacobian[:, None, :])
    return weights * (distance - found.radii), jacobian, square


def _linear(found: Circles, charts: Charts, equal: bool = False) -> Array:
    """Intersection (n, 2) of the circles in the tangent planes by differences of their equations.

    |y|^2 - 2 c . y + b = r^2 is linear in y once the weighted mean equation is subtracted from
    each. equal: without the weights of the distances.
    """
    own = found.owner
    c, b = found.conic(found.centres - charts.points[own], charts.tangents[own])
    # The equation is in r^2, whose standard deviation is 2 r / weight.
    weight = found.weights / np.maximum(2 * found.radii, 0.2 * found.patch)
    w = np.ones(len(own)) if equal else weight**2
    total = np.maximum(np.bincount(own, w, found.count), 1e-300)
    b = b - found.radii**2
    c = c - (found.sum(w[:, None] * c) / total[:, None])[own]
    b = b - (np.bincount(own, w * b, found.count) / total)[own]
    normal = found.sum(w[:, None, None] * c[:, :, None] * c[:, None, :])
    return _solve2(normal, found.sum((w * b)[:, None] * c) / 2)


def _solve2(matrix: Array, vector: Array) -> Array:
    """Solutions (n, 2) of symmetric 2x2 systems, lightly damped; 0 where the matrix vanishes."""
    trace = matrix[:, 0, 0] + matrix[:, 1, 1]
    damped = matrix + (1e-12 * trace + (trace == 0))[:, None, None] * np.eye(2)
    return np.asarray(np.linalg.solve(damped, vector[:, :, None])[:, :, 0])


def _three(found: Circles, charts: Charts) -> Circles:
    """Three well-separated circles of each point, steep ones where these are not near a line.

    A contact at rest is recorded repeatedly, so that three steep circles may be the same one.
    """
    steep = found.steepness > MIN_STEEPNESS
    best = _well_separated(found.select(steep))
    enough = np.bincount(best.owner, minlength=found.count) == 3
    enough &= width(best, charts) > MIN_WIDTH
    return _well_separated(found.select(steep | ~enough[found.owner]))


def _well_separated(found: Circles) -> Circles:
    """Three circles of each point: far from the mean, far from the first, far from their line."""
    own, centres = found.owner, found.centres
    if not len(own):
        return found
    number = np.bincount(own, minlength=found.count)
    occupied = np.flatnonzero(number)
    begin = np.searchsorted(own, occupied)

    def farthest(distance: Array) -> np.ndarray:
        """Circle (n,) of each point with the largest distance (k,), the last of equal ones; 0 for
        a point without circles."""
        largest = np.zeros(found.count)
        largest[occupied] = np.maximum.reduceat(distance, begin)
        rows = np.where(distance == largest[own], np.arange(len(own)), 0)
        out = np.zeros(found.count, dtype=int)
        out[occupied] = np.maximum.reduceat(rows, begin)
        return out

    mean = (found.sum(centres) / np.maximum(number, 1)[:, None])[own]
    first = farthest(np.linalg.norm(centres - mean, axis=1))
    offset = centres - centres[first][own]
    second = farthest(np.linalg.norm(offset, axis=1))
    line = offset[second][own]
    third = farthest(np.linalg.norm(np.cross(offset, line), axis=1))
    keep = np.zeros(len(own), dtype=bool)
    keep[np.stack([first, second, third])[:, occupied]] = True
    return found.select(keep)
