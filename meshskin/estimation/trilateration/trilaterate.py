"""Trilateration: a taxel lies where the circles of its contacts meet (paper, eq. 15).

Each reading says how far its taxel is from a contact: a circle about the contact point in the
tangent plane, or, under an elliptic patch, in the plane scaled along its axes (circles.py). The
distance inverts the disc-averaged profile of the contact model. Two estimators: the paper's
three circles, and weighted least squares over all circles. A reading at or above the profile's
maximum has the distance 0. Near there the slope of the profile vanishes and the distance is
uncertain; so it is at the patch's edge: least squares weighs each circle by its slope, the
three circles are chosen where it is steep.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from ...contact.ellipse import NODES
from ...core.se3 import Array
from .. import chart
from ..chart import Charts
from ..data.measurements import Measurements, reach
from .circles import Circles, circles

if TYPE_CHECKING:
    from ...geometry.body import Body

FEW = "fewer than three readings"
LINE = "contacts near a line"
MISS = "circles that do not meet"
NARROW = 0.05
"""Least width of the contacts about their best line, relative to the contact radius."""
ROUGH = 16
"""Nodes of the disc mean of the first pass over ellipses: within 1e-3 of the peak."""
STEEP = 0.3
"""Slope, relative to p_0/a, that the paper's three circles should have."""


@dataclass(frozen=True)
class Fit:
    """n points on the body, each with what is known of it."""

    points: Array
    """(n, 3), m; NaN where undetermined."""
    rotations: Array
    """Frames (n, 3, 3): z = outward normal, x by the rule of `chart.frames` or of the reference."""
    covariance: Array
    """(n, 2, 2) in the tangent plane, m^2; inf on the diagonal where undetermined."""
    chi2: Array
    """Weighted squared residuals per degree of freedom (n,); NaN with none left."""
    reasons: np.ndarray
    """Why a point is undetermined (n,): FEW, LINE or MISS; "" where it is determined."""

    @property
    def found(self) -> np.ndarray:
        """Whether each point is determined (n,)."""
        return np.asarray(self.reasons == "")


def centroids(data: Measurements, body: Body) -> Array:
    """Where each taxel roughly is (n, 3), m: the mean contact point, weighted by pressure squared.

    Readings out of the patch's reach of a first mean (noise above a low threshold) are left out of
    the second. NaN for a taxel without readings.
    """
    weight = data.pressure**2
    far = 1.5 * reach(data)[data.contact]

    def mean(weight: Array) -> Array:
        points = weight[:, None] * data.points[data.contact]
        total = np.bincount(data.taxel, weight, len(data.ids))
        columns = [np.bincount(data.taxel, column, len(data.ids)) for column in points.T]
        with np.errstate(invalid="ignore"):
            return np.stack(columns, axis=1) / total[:, None]

    first = mean(weight)
    off = np.linalg.norm(data.points[data.contact] - first[data.taxel], axis=1)
    second = mean(np.where(off < far, weight, 0.0))
    start = np.where(np.isfinite(second), second, first)
    seen = np.isfinite(start[:, 0])
    start[seen] = body.closest(start[seen]).point
    return start


def medians(data: Measurements, body: Body, rows: np.ndarray) -> Array:
    """Where most readings of the taxels `rows` are (r, 3), m: the geometric median of the contact
    points, weighted by pressure (Weiszfeld's iteration), which a minority elsewhere does not move.
    """
    place = np.full(len(data.ids), -1)
    place[rows] = np.arange(len(rows))
    mine = np.flatnonzero(place[data.taxel] >= 0)
    owner, points = place[data.taxel[mine]], data.points[data.contact[mine]]
    weight = power = np.maximum(data.pressure[mine], 0.0)
    for _ in range(30):
        total = np.maximum(np.bincount(owner, weight, len(rows)), 1e-300)
        sums = [np.bincount(owner, weight * x, len(rows)) for x in points.T]
        centre = np.stack(sums, axis=1) / total[:, None]
        gap = np.linalg.norm(points - centre[owner], axis=1)
        weight = power / np.maximum(gap, 0.1 * data.disc)
    return np.asarray(body.closest(centre).point)


def least_squares(data: Measurements, body: Body) -> Fit:
    """Each taxel from all its readings: (n,) points, by weighted Gauss-Newton on the distances."""
    start = centroids(data, body)
    seen = np.isfinite(start[:, 0])
    start[~seen] = data.points[0]
    near, charts = _within_reach(data, start), chart.charts_at(body, start)
    # The second time about the estimate, to take out the chart's own error.
    for nodes in (ROUGH, NODES):
        found = circles(near, charts.points, nodes=nodes)
        y, information, chi2 = solve(found, charts)
        charts = chart.charts_at(body, charts.at(y), frames_of(charts))
    return finish(found, charts, information, chi2)


def three_circles(data: Measurements, body: Body) -> Fit:
    """Each taxel from three well-separated contacts: the paper's method (eq. 15).

    The circles are intersected in the tangent plane by their radical centre.
    """
    start = centroids(data, body)
    seen = np.isfinite(start[:, 0])
    start[~seen] = data.points[0]
    near, charts = _within_reach(data, start), chart.charts_at(body, start)
    three = _three(circles(near, charts.points), charts).reading
    for _ in range(3):
        found = circles(near, charts.points, three)
        y, information = _linear(found, charts, equal=True)
        far = np.linalg.norm(y, axis=1) > 2 * found.patch.max(initial=0.0)
        y[far] = 0.0
        charts = chart.charts_at(body, charts.at(y), frames_of(charts))
    residual, jacobian = _residuals(found, charts, np.zeros((found.count, 2)))
    information = found.sum(jacobian[:, :, None] * jacobian[:, None, :])
    fit = finish(found, charts, information, found.sum(residual**2))
    why = np.where((fit.reasons == "") & far, MISS, fit.reasons)
    return replace(fit, reasons=why, points=np.where((why == "")[:, None], fit.points, np.nan))


def intersect(found: Circles, charts: Charts) -> tuple[Array, Array, Array]:
    """The radical centre of three well-separated circles of each point, as `solve` gives it."""
    three = _three(found, charts)
    y, _ = _linear(three, charts, equal=True)
    residual, jacobian = _residuals(three, charts, y)
    information = three.sum(jacobian[:, :, None] * jacobian[:, None, :])
    return y, information, three.sum(residual**2)


def solve(found: Circles, charts: Charts, iterations: int = 8) -> tuple[Array, Array, Array]:
    """Weighted least squares in the charts: coordinates (n, 2), information (n, 2, 2), chi2 (n,).

    Starts from the linear solution; each step is limited to half a contact radius.
    """
    y, _ = _linear(found, charts)
    y[np.linalg.norm(y, axis=1) > 3 * found.patch.max(initial=0.0)] = 0.0
    limit = 0.5 * float(np.median(found.patch)) if len(found.patch) else 0.0
    for _ in range(iterations):
        residual, jacobian = _residuals(found, charts, y)
        information = found.sum(jacobian[:, :, None] * jacobian[:, None, :])
        step = -_solve2(information, found.sum(jacobian * residual[:, None]))
        size = np.linalg.norm(step, axis=1, keepdims=True)
        y = y + step * np.minimum(1.0, limit / np.maximum(size, 1e-300))
        if np.max(size, initial=0.0) < 1e-9:
            break
    residual, jacobian = _residuals(found, charts, y)
    information = found.sum(jacobian[:, :, None] * jacobian[:, None, :])
    freedom = np.bincount(found.owner, minlength=found.count) - 2
    chi2 = found.sum(residual**2) / np.where(freedom > 0, freedom, np.nan)
    return y, information, chi2


def finish(found: Circles, charts: Charts, information: Array, chi2: Array) -> Fit:
    """The fit at the origin of the charts, with NaN and the reason where it is undetermined."""
    number = np.bincount(found.owner, minlength=found.count)
    why = np.where(number < 3, FEW, "").astype(object)
    why[(number >= 3) & (width(found, charts) < NARROW)] = LINE
    bad = why != ""
    points = np.where(bad[:, None], np.nan, charts.points)
    safe = np.where(bad[:, None, None], np.eye(2), information)
    covariance = np.linalg.inv(safe)
    covariance[bad] = np.diag([np.inf, np.inf])
    return Fit(points, frames_of(charts), covariance, np.where(bad, np.nan, chi2), why)


def frames_of(charts: Charts) -> Array:
    """Rotations (n, 3, 3) of the charts: tangents and normal."""
    return np.concatenate([charts.tangents, charts.normals[:, :, None]], axis=2)


def _within_reach(data: Measurements, start: Array) -> Measurements:
    """The readings whose contact can reach its taxel's start (n, 3), with 1 mm to spare.

    Readings within 3 sigma of nothing are left out: their distance would be a guess at the edge; so
    are saturated ones of a taxel that has three others.
    """
    off = np.linalg.norm(data.points[data.contact] - start[data.taxel], axis=1)
    keep = off < 1.3 * reach(data)[data.contact] + 1e-3
    keep &= data.pressure > 3 * (data.noise or 0.0)
    full = data.pressure >= data.saturation
    others = np.bincount(data.taxel[keep & ~full], minlength=len(data.ids))
    keep &= ~full | (others[data.taxel] < 3)
    part = {name: getattr(data, name)[keep] for name in ("contact", "taxel", "pressure")}
    return replace(data, **part)


def _residuals(found: Circles, charts: Charts, y: Array) -> tuple[Array, Array]:
    """Weighted residuals (k,) and their derivatives (k, 2) by the owner's coordinates."""
    own = found.owner
    distance, gradient = found.distance(charts.at(y)[own] - found.centres)
    sag = np.einsum("nij,nj->ni", charts.shape, y)
    along = charts.tangents - charts.normals[:, :, None] * sag[:, None, :]  # dx/dy (n, 3, 2)
    jacobian = np.einsum("ki,kij->kj", gradient, along[own])
    return found.weights * (distance - found.radii), found.weights[:, None] * jacobian


def _linear(found: Circles, charts: Charts, equal: bool = False) -> tuple[Array, Array]:
    """Intersection (n, 2) of the circles in the tangent planes by differences of their equations.

    |y|^2 - 2 c . y + b = r^2 is linear in y once the weighted mean equation is taken off each.
    Also the normal matrix (n, 2, 2). `equal`: without the weights of the distances.
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
    return _solve2(normal, found.sum((w * b)[:, None] * c) / 2), normal


def _solve2(matrix: Array, vector: Array) -> Array:
    """Solutions (n, 2) of symmetric 2x2 systems, lightly damped; 0 where the matrix vanishes."""
    trace = matrix[:, 0, 0] + matrix[:, 1, 1]
    damped = matrix + (1e-12 * trace + (trace == 0))[:, None, None] * np.eye(2)
    return np.asarray(np.linalg.solve(damped, vector[:, :, None])[:, :, 0])


def width(found: Circles, charts: Charts) -> Array:
    """RMS width (n,) of the contacts about their best line, relative to the contact radius."""
    own = found.owner
    number = np.maximum(np.bincount(own, minlength=found.count), 1)
    offset = (found.centres - charts.points[own]) / found.patch[:, None]
    c = np.einsum("kij,ki->kj", charts.tangents[own], offset)
    c = c - (found.sum(c) / number[:, None])[own]
    scatter = found.sum(c[:, :, None] * c[:, None, :]) / number[:, None, None]
    return np.sqrt(np.maximum(np.linalg.eigvalsh(scatter)[:, 0], 0.0))


def _three(found: Circles, charts: Charts) -> Circles:
    """Three well-separated circles of each point, steep ones where these are not near a line.

    A contact at rest is recorded again and again: three of its circles are no three circles.
    """
    steep = found.steepness > STEEP
    best = _well_separated(found.select(steep))
    enough = np.bincount(best.owner, minlength=found.count) == 3
    enough &= width(best, charts) > NARROW
    return _well_separated(found.select(steep | ~enough[found.owner]))


def _well_separated(found: Circles) -> Circles:
    """Three circles of each point: far from the mean, far from the first, far from their line."""
    if not len(found.owner):
        return found
    number = np.maximum(np.bincount(found.owner, minlength=found.count), 1)
    mean = (found.sum(found.centres) / number[:, None])[found.owner]
    first = _farthest(found, np.linalg.norm(found.centres - mean, axis=1))
    one = found.centres[first][found.owner]
    second = _farthest(found, np.linalg.norm(found.centres - one, axis=1))
    line = found.centres[second][found.owner] - one
    off = np.linalg.norm(np.cross(found.centres - one, line), axis=1)
    third = _farthest(found, off)
    keep = np.zeros(len(found.owner), dtype=bool)
    rows = np.stack([first, second, third])
    keep[rows[found.owner[rows] == np.arange(found.count)]] = True
    return found.select(keep)


def _farthest(found: Circles, distance: Array) -> np.ndarray:
    """Row (n,) of the circle of each point with the largest distance (k,); for no circle one of
    another point.
    """
    order = np.lexsort((distance, found.owner))
    last = np.searchsorted(found.owner[order], np.arange(found.count), side="right") - 1
    return np.asarray(order[np.maximum(last, 0)])
