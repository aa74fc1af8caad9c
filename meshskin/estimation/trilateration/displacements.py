"""Displacements between taxels active together: the edges of the pose graph (paper, eq. 1).

For each pair, both taxels are trilaterated from those contacts alone in which both read, and are
expected to, where trilateration from all readings has put them. The
displacement is delta_t = R_i^T (p_j - p_i), delta_R = R_i^T R_j, with frames that continue one
frame per taxel (z = surface normal, turned the least way): so the spin, which no reading shows, is
the same convention in every edge. The information comes from both trilaterations' covariances,
carried through the body's curvature to the rotations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ...core import se3
from ...core.arrays import ranges
from ...core.errors import CalibrationError
from ...core.se3 import Array
from .. import chart
from ..chart import Charts
from ..data.measurements import Measurements, reach
from ..posegraph import PoseGraph
from . import trilaterate
from .circles import Circles, circles
from .trilaterate import Fit

if TYPE_CHECKING:
    from ...geometry.body import Body

Trilateration = Callable[[Circles, Charts], tuple[Array, Array, Array]]
"""Circles and charts -> coordinates (n, 2), m, information (n, 2, 2), chi2 (n,)."""

SINGULAR = 1e-9
"""Least determinant of a trilateration's information, relative to the square of its trace."""
SHARED = 4
"""Fewest contacts that a pair must share."""
ABOVE, LEAST = 0.5, 2.0
"""Pressure to be expected of a reading that counts, in standard deviations: over the threshold, and
over nothing. More leaves too few readings, less a bias of those that noise raised over the limit.
"""
NORMAL_FLOOR = 0.1
"""Least standard deviation along the normal, relative to the one along the surface."""
ROTATION_FLOOR = 3.0
"""Least standard deviation of a rotation, rad for every m along the surface."""
_BLOCKS = (slice(0, 3), slice(3, 6))
"""Translation and rotation of a residual."""


def displacements(
    data: Measurements,
    body: Body,
    fit: Fit | None = None,
    isotropic: bool = False,
    trilateration: Trilateration = trilaterate.solve,
) -> PoseGraph:
    """The pose graph of all taxels that `fit` determines, starting at the poses of `fit`.

    Its ids are the taxels' ids. `isotropic`: one information for all edges, the same in every
    direction, as in the paper, at the level of the median edge. `trilateration`: of both taxels
    from their shared contacts; `trilaterate.solve` takes all circles, `trilaterate.intersect` the
    paper's three.
    Raises CalibrationError if no two taxels share enough contacts.
    """
    return displacements_with_errors(data, body, fit, isotropic, trilateration, draws=0)[0]


def displacements_with_errors(
    data: Measurements,
    body: Body,
    fit: Fit | None = None,
    isotropic: bool = False,
    trilateration: Trilateration = trilaterate.solve,
    draws: int = 1,
) -> tuple[PoseGraph, Array]:
    """`displacements`, and errors (m, 6, draws) of its m edges as errors of the readings make them.

    A reading errs alike in all pairs that it serves: so do the edges of a taxel with each other.
    """
    fit = fit or trilaterate.least_squares(data, body)
    data = expected_readings(data, fit)
    pairs, rows, owner = _shared(data, fit.found)
    if not len(pairs):
        raise CalibrationError(
            "no two taxels are active together often enough for a displacement",
            limit=f"{SHARED} shared contacts",
            remedy="use method='joint', a softer material, or a denser skin",
        )
    found = circles(data, fit.points, rows, owner)
    own = chart.charts_at(
        body, np.where(fit.found[:, None], fit.points, data.points[0]), fit.rotations
    )
    charts = own[pairs.ravel()]  # owner 2 g is the first taxel of pair g, 2 g + 1 the second
    y, information, chi2 = trilateration(found, charts)
    sane = (trilaterate.width(found, charts) > trilaterate.NARROW) & (
        np.linalg.norm(y, axis=1) < data.disc
    )
    sane &= np.linalg.det(information) > SINGULAR * np.trace(information, axis1=1, axis2=2) ** 2
    good = sane.reshape(-1, 2).all(axis=1)
    if not good.any():
        raise CalibrationError(
            "no displacement can be trilaterated",
            value=f"{len(good)} pairs, all with contacts near a line or circles that do not meet",
            remedy="explore along lanes closer to each other",
        )
    both = np.repeat(good, 2)
    covariance = np.asarray(np.linalg.inv(information[both]), dtype=float)
    # three exact circles leave nothing
    level = 1.0 if data.noise else max(float(np.nanmedian(chi2)), 1e-12) ** 0.5
    measured = _measured(body, charts[both], y[both])
    graph = _graph(
        fit, data.ids, pairs[good], measured, charts[both].shape, level**2 * covariance, isotropic
    )
    rng, errors = np.random.default_rng(0), np.empty((len(measured), 6, draws))
    for k in range(draws):
        noise = level * data.sigma * rng.standard_normal(len(data.pressure))
        off = circles(replace(data, pressure=data.pressure + noise), fit.points, rows, owner)
        there = trilateration(off, charts)[0][both]
        moved = _measured(body, charts[both], there)
        turned = np.swapaxes(measured[:, :3, :3], 1, 2) @ moved[:, :3, :3]
        errors[:, :3, k] = moved[:, :3, 3] - measured[:, :3, 3]
        errors[:, 3:, k] = se3.log_so3(turned)
        wild = np.linalg.norm(there, axis=1) > data.disc  # would have been left out
        errors[wild.reshape(-1, 2).any(axis=1), :, k] = 0.0
    return graph, errors


def _measured(body: Body, charts: Charts, y: Array) -> Array:
    """Displacements (g, 4, 4) of pairs of taxels at y (2 g, 2) in their charts, one after the
    other."""
    hit = body.closest(charts.at(y))
    poses = se3.transform(chart.align_normals(trilaterate.frames_of(charts), hit.normal), hit.point)
    return np.asarray(se3.inverse(poses[::2]) @ poses[1::2])


def expected_readings(data: Measurements, fit: Fit) -> Measurements:
    """The readings that are no mere noise, where the taxels are as `fit` says.

    Pressures to be expected are ABOVE standard deviations over the threshold, LEAST over nothing.
    The choice is not the reading's: those that noise has raised over a limit all seem nearer than
    they are, and of many pairs no averaging takes that out.
    """
    noise = data.sigma * (1.0 if data.noise else float(np.sqrt(np.nanmedian(fit.chi2))))
    across = fit.points[data.taxel] - data.points[data.contact]
    along = data.directions[data.contact]
    x = np.einsum("ki,ki->k", across, along)
    y = np.einsum("ki,ki->k", across, np.cross(data.normals[data.contact], along))
    near = np.flatnonzero(np.hypot(x, y) < reach(data)[data.contact])  # NaN is not near
    patches = data.patches.take(data.contact[near])
    expected = patches.reading(x[near], y[near], data.disc)
    keep = near[expected > max(data.threshold + ABOVE * noise, LEAST * noise)]
    return replace(data, **{k: getattr(data, k)[keep] for k in ("contact", "taxel", "pressure")})


def _graph(
    fit: Fit,
    ids: np.ndarray,
    pairs: np.ndarray,
    measured: Array,
    shape: Array,
    covariance: Array,
    isotropic: bool,
) -> PoseGraph:
    """The graph of g `pairs` (g, 2) of taxels, rows of `fit` and `ids`.

    Their displacements are `measured` (g, 4, 4). Of both taxels of each pair, one after the other:
    the shape operators (2 g, 2, 2), 1/m, and tangential covariances (2 g, 2, 2), m^2, there.
    """
    spread = error_covariance(measured, shape[::2], shape[1::2], covariance[::2], covariance[1::2])
    if isotropic:
        level = [np.median(np.trace(spread[:, s, s], axis1=1, axis2=2)) / 3 for s in _BLOCKS]
        spread = np.broadcast_to(np.diag(np.repeat(level, 3)), spread.shape)
    live = np.flatnonzero(fit.found)
    place = np.full(len(fit.found), -1)
    place[live] = np.arange(len(live))
    return PoseGraph(
        poses=se3.transform(fit.rotations[live], fit.points[live]),
        edges=place[pairs],
        measurements=measured,
        information=np.asarray(np.linalg.inv(spread), dtype=float),
        ids=np.asarray(ids)[live],
    )


def error_covariance(
    measured: Array, shape_i: Array, shape_j: Array, cov_i: Array, cov_j: Array
) -> Array:
    """Covariance (m, 6, 6) of the residual of displacements `measured` (m, 4, 4).

    From the tangential covariances (m, 2, 2), m^2, of both taxels and the shape operators
    (m, 2, 2), 1/m, there: a taxel that is off by y along the surface is tilted by K y. Floors keep
    it well-conditioned where the trilaterations say nothing: along the normal and in spin.
    """
    into_i, into_j = surface_motion(shape_i), surface_motion(shape_j)
    rotation, offset = measured[:, :3, :3], measured[:, :3, 3]
    jacobian_i = -into_i
    jacobian_i[:, :3] += se3.hat(offset) @ into_i[:, 3:]
    jacobian_i[:, 3:] = -np.swapaxes(rotation, 1, 2) @ into_i[:, 3:]
    jacobian_j = into_j.copy()
    jacobian_j[:, :3] = rotation @ into_j[:, :3]
    total = jacobian_i @ cov_i @ np.swapaxes(jacobian_i, 1, 2)
    total = total + jacobian_j @ cov_j @ np.swapaxes(jacobian_j, 1, 2)
    level = (np.trace(cov_i, axis1=1, axis2=2) + np.trace(cov_j, axis1=1, axis2=2)) / 2
    floor = np.repeat([NORMAL_FLOOR**2, ROTATION_FLOOR**2], 3)
    return np.asarray(total + level[:, None, None] * np.diag(floor))


def surface_motion(shape: Array) -> Array:
    """Translation and rotation (m, 6, 2), in the taxel's frame, of a unit move along the surface.

    The normal moves by K y = w x z, so that the rotation is w = (-(K y)_2, (K y)_1, 0).
    """
    out = np.zeros((len(shape), 6, 2))
    out[:, 0, 0] = out[:, 1, 1] = 1.0
    out[:, 3], out[:, 4] = -shape[:, 1], shape[:, 0]
    return out


def _shared(data: Measurements, found: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pairs of taxels (g, 2) with shared contacts; their readings and the owner of each.

    Owner 2 g is the first taxel of pair g, 2 g + 1 the second.
    """
    use = np.flatnonzero(found[data.taxel])
    use = use[np.argsort(data.contact[use], kind="stable")]
    contact = data.contact[use]
    first = np.searchsorted(contact, contact, side="left")
    number = np.searchsorted(contact, contact, side="right") - first  # readings in its contact
    one = np.repeat(np.arange(len(use)), number)
    other = ranges(first, number)
    ahead = data.taxel[use[one]] < data.taxel[use[other]]
    a, b = use[one[ahead]], use[other[ahead]]
    key = data.taxel[a] * len(data.ids) + data.taxel[b]
    keys, group, counts = np.unique(key, return_inverse=True, return_counts=True)
    enough = counts >= SHARED
    number_of = np.cumsum(enough) - 1
    keep = enough[group]
    g = number_of[group[keep]]
    pairs = np.stack([keys // len(data.ids), keys % len(data.ids)], axis=1)[enough]
    return pairs, np.concatenate([a[keep], b[keep]]), np.concatenate([2 * g, 2 * g + 1])
