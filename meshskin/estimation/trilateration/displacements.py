"""Displacements between co-active taxels: the edges of the pose graph (paper, eq. 1).

Both taxels of a pair are trilaterated from those contacts alone in which both read, and are
expected to, where trilateration from all readings has put them. The displacement is
delta_t = R_i^T (p_j - p_i), delta_R = R_i^T R_j, with frames that continue one frame per taxel by
the shortest rotation to the surface normal, so that the rotation about the normal, which no reading
shows, is the same convention in every edge. The information follows from both trilaterations'
covariances, carried through the body's curvature to the rotations.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ...core import se3
from ...core.arrays import Array, ranges
from ...core.errors import CalibrationError
from ...core.progress import Stage
from .. import chart
from ..chart import Charts
from ..data.measurements import Measurements
from ..result import EstimatorResult
from . import trilaterate
from .circles import Circles, circles

if TYPE_CHECKING:
    from ..posegraph import PoseGraph

Trilateration = Callable[[Circles, Charts], tuple[Array, Array, Array]]
"""Circles and charts -> coordinates (n, 2), m, information (n, 2, 2), 1/m^2, chi2 (n,)."""

MIN_DETERMINANT = 1e-9
"""Least determinant of a trilateration's information, relative to the square of its trace: below,
the inverse keeps fewer than seven digits."""
MIN_SHARED = 4
"""Fewest contacts that a pair must share: three for two unknowns, and one to test them."""
OVER_THRESHOLD, OVER_ZERO = 0.5, 2.0
"""Least expected pressure of a reading that counts, in standard deviations over the threshold and
over zero. Higher values leave too few readings; lower ones select those that noise has raised over
the threshold, which biases the distances."""
NORMAL_FLOOR = 0.1
"""Least standard deviation along the normal, relative to that along the surface. It keeps the
information regular; the surface gives the true value."""
ROTATION_FLOOR = 3.0
"""Least standard deviation of a rotation, rad per m along the surface: it keeps the information
regular about the normal."""
_BLOCKS = (slice(0, 3), slice(3, 6))
"""Translation and rotation of a residual."""


@dataclass(frozen=True)
class Displacements:
    """g displacements between pairs of taxels, measured from their shared contacts."""

    pairs: np.ndarray
    """Rows (g, 2) of the taxels."""
    measured: Array
    """T_i_j (g, 4, 4)."""
    covariance: Array
    """(g, 6, 6) of the residuals, translation first, m and rad."""
    errors: Array
    """Random errors (g, 6, draws) of the displacements that errors of the readings cause. A reading
    errs equally in all pairs that it serves, hence so do the edges of a taxel with each other."""

    def graph(self, fit: EstimatorResult, ids: np.ndarray, isotropic: bool = False) -> PoseGraph:
        """The pose graph of all taxels that `fit` determines, starting at its poses.

        ids (n,): taxel ids, which name the poses. isotropic: one information for all edges, equal
        in every direction, as in the paper, at the level of the median edge.
        """
        from ..posegraph import PoseGraph

        spread = self.covariance
        if isotropic:
            level = [np.median(np.trace(spread[:, s, s], axis1=1, axis2=2)) / 3 for s in _BLOCKS]
            spread = np.broadcast_to(np.diag(np.repeat(level, 3)), spread.shape)
        live = np.flatnonzero(fit.found)
        row = np.full(len(fit.found), -1)
        row[live] = np.arange(len(live))
        return PoseGraph(
            poses=se3.transform(fit.rotations[live], fit.points[live]),
            edges=row[self.pairs],
            measurements=self.measured,
            information=np.asarray(np.linalg.inv(spread), dtype=float),
            ids=np.asarray(ids)[live],
        )


class SharedContacts:
    """Pairs of taxels with the circles of the contacts that they share."""

    def __init__(self, data: Measurements, fit: EstimatorResult) -> None:
        """Raises CalibrationError if no two taxels share enough contacts."""
        self.data, self.fit = expected_readings(data, fit), fit
        self.pairs, self.rows, self.owner = _shared_readings(self.data, fit.found)
        if not len(self.pairs):
            raise CalibrationError(
                "no two taxels are active together often enough for a displacement",
                limit=f"{MIN_SHARED} shared contacts",
                remedy="use method='joint', a softer material, or a denser skin",
            )
        self._perturbed: dict[tuple[int, float], Circles] = {}
        self._rng, self._noise = np.random.default_rng(0), list[Array]()

    @cached_property
    def circles(self) -> Circles:
        """The circles of the readings; owners 2 g and 2 g + 1 are the taxels of pair g."""
        return circles(self.data, self.fit.points, self.rows, self.owner)

    @cached_property
    def charts(self) -> Charts:
        """A chart for each owner (2 g), about its taxel's estimate."""
        fit = self.fit
        points = np.where(fit.found[:, None], fit.points, self.data.points[0])
        return chart.charts_at(self.data.body, points, fit.rotations)[self.pairs.ravel()]

    def perturbed(self, draw: int, level: float) -> Circles:
        """The circles of the readings with noise of `level` sigma, of one of several `draws`."""
        if (draw, level) not in self._perturbed:
            data = self.data
            while len(self._noise) <= draw:
                self._noise.append(self._rng.standard_normal(len(data.pressure)))
            noise = level * data.spread[data.contact] * self._noise[draw]
            noisy = replace(data, pressure=data.pressure + noise)
            self._perturbed[draw, level] = circles(noisy, self.fit.points, self.rows, self.owner)
        return self._perturbed[draw, level]

    def displacements(
        self,
        trilateration: Trilateration = trilaterate.solve,
        draws: int = 0,
        stage: Stage | None = None,
    ) -> Displacements:
        """The displacements, each taxel of a pair by `trilateration` from their shared contacts.

        trilateration: `trilaterate.solve` uses all circles, `trilaterate.intersect` three chosen
        ones. draws: number of random errors; stage: its steps are the draws. Raises
        CalibrationError if none can be trilaterated.
        """
        data, charts, stage = self.data, self.charts, stage or Stage()
        stage.expect(draws + 3)
        y, information, chi2 = trilateration(self.circles, charts)
        valid = np.asarray(trilaterate.width(self.circles, charts) > trilaterate.MIN_WIDTH)
        valid &= np.linalg.norm(y, axis=1) < data.disc
        trace = np.trace(information, axis1=1, axis2=2)
        valid &= np.linalg.det(information) > MIN_DETERMINANT * trace**2
        good: np.ndarray = np.all(valid.reshape(-1, 2), axis=1)
        if not good.any():
            raise CalibrationError(
                "no displacement can be trilaterated",
                value=f"{len(good)} pairs, all with contacts near a line or circles that do not "
                "meet",
                remedy="explore along lanes closer to each other",
            )
        both = np.repeat(good, 2)
        used, y = charts[both], y[both]
        # three exact circles leave no residual
        known = data.noise is not None
        level = 1.0 if known else max(float(np.nanmedian(chi2)), 1e-12) ** 0.5
        covariance = np.asarray(level**2 * np.linalg.inv(information[both]), dtype=float)
        measured = _measured(data, used, y)
        spread = error_covariance(
            measured, used.shape[::2], used.shape[1::2], covariance[::2], covariance[1::2]
        )
        errors = np.empty((len(measured), 6, draws))
        for k in range(draws):
            stage.step()
            moved_y = trilateration(self.perturbed(k, level), charts)[0][both]
            moved = _measured(data, used, moved_y)
            turned = np.swapaxes(measured[:, :3, :3], 1, 2) @ moved[:, :3, :3]
            errors[:, :3, k] = moved[:, :3, 3] - measured[:, :3, 3]
            errors[:, 3:, k] = se3.log_so3(turned)
            invalid = np.linalg.norm(moved_y, axis=1) > data.disc  # would have been left out
            errors[invalid.reshape(-1, 2).any(axis=1), :, k] = 0.0
        return Displacements(self.pairs[good], measured, spread, errors)


def _measured(data: Measurements, charts: Charts, y: Array) -> Array:
    """Displacements (g, 4, 4) of pairs of taxels at y (2 g, 2), m, in their charts (2 g)."""
    hit = data.body.closest(charts.at(y))
    poses = se3.transform(chart.align_normals(charts.rotations, hit.normal), hit.point)
    return np.asarray(se3.inverse(poses[::2]) @ poses[1::2])


def expected_readings(data: Measurements, fit: EstimatorResult) -> Measurements:
    """The readings whose expected pressure, with taxels as in `fit`, is clearly above noise.

    The choice rests on the model, not on the reading: readings that noise has raised over a limit
    all give too small distances, a bias that averaging over many pairs does not remove.
    """
    known = data.noise is not None
    noise = data.sigma * (1.0 if known else float(np.sqrt(np.nanmedian(fit.chi2))))
    across = fit.points[data.taxel] - data.points[data.contact]
    along = data.directions[data.contact]
    x = np.einsum("ki,ki->k", across, along)
    y = np.einsum("ki,ki->k", across, np.cross(data.normals[data.contact], along))
    near = np.flatnonzero(np.hypot(x, y) < data.reach()[data.contact])  # NaN is not near
    patches = data.patches.take(data.contact[near])
    expected = patches.reading(x[near], y[near], data.disc)
    least = max(data.threshold + OVER_THRESHOLD * noise, OVER_ZERO * noise)
    return data.select(near[expected > least])


def error_covariance(
    measured: Array, shape_i: Array, shape_j: Array, cov_i: Array, cov_j: Array
) -> Array:
    """Covariance (m, 6, 6) of the residual of displacements `measured` (m, 4, 4).

    From the tangential covariances (m, 2, 2), m^2, of both taxels and the shape operators
    (m, 2, 2), 1/m, there: a taxel that is off by y along the surface is tilted by K y. Floors keep
    it well-conditioned where trilateration gives nothing: along and about the normal.
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
    """Translation and rotation (m, 6, 2), taxel frame, per unit move along the surface.

    shape (m, 2, 2), 1/m: shape operators. The normal moves by K y = w x z, so that the rotation is
    w = (-(K y)_2, (K y)_1, 0).
    """
    out = np.zeros((len(shape), 6, 2))
    out[:, 0, 0] = out[:, 1, 1] = 1.0
    out[:, 3], out[:, 4] = -shape[:, 1], shape[:, 0]
    return out


def _shared_readings(
    data: Measurements, found: np.ndarray
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Pairs of taxels (g, 2) with shared contacts; their readings and the owner of each.

    Owner 2 g is the first taxel of pair g, 2 g + 1 the second.
    """
    use = np.flatnonzero(found[data.taxel])
    use = use[np.argsort(data.contact[use], kind="stable")]
    contact = data.contact[use]
    first = np.searchsorted(contact, contact, side="left")
    number = np.searchsorted(contact, contact, side="right") - first  # readings in its contact
    one, other = np.repeat(np.arange(len(use)), number), ranges(first, number)
    ordered = data.taxel[use[one]] < data.taxel[use[other]]
    a, b = use[one[ordered]], use[other[ordered]]
    key = data.taxel[a] * len(data.ids) + data.taxel[b]
    keys, group, counts = np.unique(key, return_inverse=True, return_counts=True)
    enough = counts >= MIN_SHARED
    keep = enough[group]
    g = (np.cumsum(enough) - 1)[group[keep]]
    pairs = np.stack([keys // len(data.ids), keys % len(data.ids)], axis=1)[enough]
    return pairs, np.concatenate([a[keep], b[keep]]), np.concatenate([2 * g, 2 * g + 1])
