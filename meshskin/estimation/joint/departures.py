"""What the readings show beyond a contact model: an offset of the indenter, drag, friction,
hysteresis, creep, crosstalk, drifts, and patches that fillets displace.

Each is tested by its score, the derivative of the log-likelihood in its parameter
at zero, relative to its standard deviation there. Where contacts have errors of their own, all
unknowns are estimated beside it; else each taxel's own ones, and the others are taken as known in
that deviation, which makes it too large and the test careful.

Source: Rao, "Large sample tests of statistical hypotheses concerning several parameters",
Mathematical Proceedings of the Cambridge Philosophical Society 44 (1948).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cached_property
from itertools import islice

import numpy as np
from scipy.sparse import csr_array

from ...core.arrays import Array, sums_by_group
from ..data.global_parameters import DRIFT_SIZE, OWN_DEPARTURES, PRIOR_SIGMAS, PRIORS
from ..data.measurements import Measurements
from .coupled_system import CoupledSystem, inner
from .electronics import WIDTH, Electronics
from .friction import shears
from .joint_estimator import JointEstimator
from .parametrization import SurfaceParametrization
from .pressure import costs
from .readings import Readings

MIN_SCORE = 6.0
"""Score, in standard deviations, from which a departure is shown: 1e-9 by chance."""
TOGETHER = 7
"""Candidates whose scores are computed together: all at once need the memory of the derivatives."""
WIDTHS = (0.5, 1.0, 2.0, 4.0)
"""Half-widths of the play operator that are tried, in units of WIDTH."""
LIMITS = (0.1e-3, 0.25e-3, 0.5e-3, 1e-3)
"""Shears, m, from which contacts slide, that are tried."""
TIMES = (0.03, 0.1, 0.4, 1.5, 6.0)
"""Time constants of creep that are tried, in units of creep.TIME."""
ONE_SIDED = ("friction", "hysteresis")
"""Departures whose parameter is positive."""
MAX_OFFSET = PRIOR_SIGMAS * PRIORS["indenter_offset"]
"""Largest offset of the indenter, m: where contacts show hardly any along a direction, as of a ball
along its normals, errors of the response pass for one of centimetres."""
SEEN = 1e-6
"""Least information on a parameter, relative to that with known taxels: rounding is below it."""
FILTER_SHARE = 0.9
"""Share of creep from which the estimate of a low-pass filter, whose share is 1, starts."""
SHARE = 0.2
"""Least share of hysteresis and creep from which an estimate starts: at zero the width and the time
constant have no effect."""


@dataclass(frozen=True)
class FittedReadings:
    """k readings of n taxels at an estimate, in units of `Measurements.sigma`."""

    data: Measurements
    readings: Readings
    points: Array
    """Estimated positions (n, 3), m."""
    mu: Array
    """Predicted readings (k,)."""
    offset: Array
    """Offsets (k,) in them."""
    rate: Array
    """Derivative (k,) of each reading's cost in mu."""
    curvature: Array
    """Second derivative (k,)."""
    own: Array
    """Derivatives (D, k) of mu in the taxel's own unknowns, of which two are its position."""
    prior: Array
    """Prior precisions (D,) of these."""
    tangents: Array
    """Directions (n, 3, 2) of the position's two unknowns."""
    gain: Array | float = 1.0
    """Gains (k,) in them."""
    system: CoupledSystem | None = None
    """Normal equations of all unknowns, where contacts have errors of their own."""
    jacobian: Array = field(default_factory=lambda: np.empty((0, 0)))
    """Derivatives (k, .) of mu in these."""

    def scores(self) -> dict[str, tuple[float, Array]]:
        """Score of each departure, in standard deviations, and the start of its parameters; the
        largest first, but last those of each taxel, for which each of the others can stand in."""
        late = self.moved(self.data.headway[:, :, None])[:, 0]
        own = zip(OWN_DEPARTURES, (self.data.phase[self.readings.contact], late), strict=True)
        found, candidates = dict[str, tuple[float, Array]](), self._candidates()
        while few := list(islice(candidates, TOGETHER)):
            names, each, starts = zip(*few, strict=True)
            ends = np.cumsum([part.shape[1] for part in each])
            slope, information = self.shared(np.column_stack(each))
            for name, start, end, part in zip(names, starts, ends, each, strict=True):
                at = slice(end - part.shape[1], end)
                score, first = _score(slope[at], information[at, at])
                if name in ONE_SIDED:
                    score *= float(np.sign(first)) or 1.0
                elif name == "creep":  # of electronics that average a large part
                    share = np.clip(abs(first), SHARE, FILTER_SHARE)
                    start = np.array([np.copysign(share, first), *start[1:]])
                elif name == "indenter_offset" and abs(first) > MAX_OFFSET:
                    score = 0.0
                if name not in found or score > found[name][0]:
                    found[name] = score, start
        largest_first = dict(sorted(found.items(), key=lambda item: -item[1][0]))
        return largest_first | {name: (self._variance_score(x), np.zeros(0)) for name, x in own}

    def _candidates(self) -> Iterator[tuple[str, Array, Array]]:
        """Departures that all taxels share, with the derivatives (k, q) of the readings in their
        parameters at zero, and the start of these; of candidates of one name the best counts."""
        pressure, k = np.maximum(self.mu - self.offset, 0.0), len(self.mu)
        electronics, data = Electronics(self.data, self.readings, self.points), self.data
        drifts = data.drifts[self.readings.contact]
        yield "crosstalk", (electronics.neighbours @ pressure)[:, None], np.zeros(1)
        for name, along in (("drag", data.headway), ("patch_shift", data.patch_shifts)):
            yield name, self.moved(along[:, :, None]), np.zeros(1)
        yield "gain_drift", drifts * pressure[:, None], np.zeros(DRIFT_SIZE)
        yield "offset_drift", drifts * electronics.peak, np.zeros(DRIFT_SIZE)
        if self.system is not None:
            yield "force_drift", drifts * self.jacobian[:, -1:], np.zeros(DRIFT_SIZE)
        for limit in LIMITS:
            yield "friction", -self.moved(shears(data, limit)[0][:, :, None]), np.array([limit])
        for width in WIDTHS:
            half = np.full(k, width * WIDTH * electronics.peak)
            lag = electronics.play(pressure, half)[0] - pressure
            yield "hysteresis", lag[:, None], np.array([SHARE, np.log(width)])
        for time, rise in zip(TIMES, self.creeps(electronics).T, strict=True):
            yield "creep", rise[:, None], np.array([SHARE, np.log(time), 0.0])
        if data.headings is not None:
            # the closest point moves by 1 / (1 + r k) of a motion of the centre along the surface
            shrunk = 1 / (1 + data.belief.indenter.radius * data.curvature.mean(axis=1))
            moved = self.moved(np.swapaxes(data.headings, 1, 2) * shrunk[:, None, None])
            for column in moved.T:
                yield "indenter_offset", column[:, None], np.zeros(3)

    def creeps(self, electronics: Electronics) -> Array:
        """Derivatives (k, t) of the readings in shares of creep with each of TIMES."""
        pressure = np.maximum(self.mu - self.offset, 0.0)
        rises = [electronics.creep.follow(pressure, np.log(t)) - pressure for t in TIMES]
        return np.column_stack(rises)

    def moved(self, directions: Array) -> Array:
        """Derivatives (k, q) of the readings in displacements of the contacts along `directions`
        (m, 3, q), body frame."""
        contact, found = self.readings.contact, np.zeros((len(self.mu), directions.shape[2]))
        for rows in (slice(k, k + 512) for k in range(0, len(found), 512)):  # fits into a cache
            for axis in range(3):
                found[rows] -= directions[contact[rows], axis] * self._gradient[rows, axis, None]
        return found

    @cached_property
    def _gradient(self) -> Array:
        """Derivatives (k, 3) of the readings in displacements of their taxels."""
        return np.einsum("kia,ak->ki", self.tangents[self.readings.taxel], self.own[:2])

    def _variance_score(self, column: Array) -> float:
        """Score of the variance of a parameter that each taxel has of its own, with the derivatives
        `column` (k,) of the readings; of taxels whose readings determine it."""
        slope, information = self.each(column)
        seen = information > 1e-9
        square = slope[seen] ** 2 / information[seen]
        return float(np.sum(square - 1) / max(2 * len(square), 1) ** 0.5)

    def shared(self, columns: Array) -> tuple[Array, Array]:
        """Derivative (q,) of the log-likelihood in parameters that all taxels share, with the
        derivatives `columns` (k, q) of the readings, and their information (q, q); zero rows where
        the readings do not determine them. What other unknowns that have not converged would
        explain is left out."""
        weighted = self.curvature[:, None] * columns
        information = weighted.T @ columns
        known, slope = np.diag(information).copy(), -(self.rate @ columns)
        if self.system is not None:
            parts = self.system.transposed(self.jacobian, weighted)
            explained, along = self.system.explained(*parts)
            information, slope = information - explained, slope + along
        else:
            part = self._coupling(columns)
            information -= inner(part, self._solved(part))
            # a scale that is wrong would pass for amplitudes that change
            scale, follows, own = self._scale
            common = weighted.T @ scale - inner(part, follows)[:, 0]
            if own > 0:  # zero without any reading that counts
                slope = slope + common * float(self.rate @ scale) / own
                information -= np.outer(common, common) / own
        lost = np.diag(information) <= SEEN * known
        information[lost] = information[:, lost] = 0.0
        return np.where(lost, 0.0, slope), information

    @cached_property
    def _scale(self) -> tuple[Array, Array, float]:
        """Derivatives (k,) of the readings in a common scale, how the taxels' own unknowns follow
        it (n, D, 1), and its information."""
        scale = np.maximum(self.mu - self.offset, 0.0)
        follows = self._solved(self._coupling(scale[:, None]))
        return scale, follows, float(self.each(scale)[1].sum())

    def unexplained(self, columns: Array) -> tuple[Array, Array]:
        """What other unknowns do not explain of `columns` (k, q), derivatives of the readings in
        parameters that all taxels share; and what those other than the errors of the contacts do
        not, whose products with `rate` are the terms of the marginal likelihood's derivative."""
        if self.system is not None:
            parts = self.system.transposed(self.jacobian, self.curvature[:, None] * columns)
            taxels, contacts, shared = self.system.solve(*parts)
            left = columns - self.system.forward(self.jacobian, (taxels, contacts, shared))
            fixed = taxels, np.zeros_like(contacts), shared
            return left, columns - self.system.forward(self.jacobian, fixed)
        found = self._solved(self._coupling(columns)) / self._own_information[0][:, :, None]
        left = columns.copy()
        for k, part in enumerate(np.moveaxis(found, 2, 0)):
            left[:, k] -= np.einsum("ak,ka->k", self.own, part[self.readings.taxel])
        return left, left

    def displaced(self, columns: Array) -> Array:
        """Displacements (n, 2, q) of taxels by errors `columns` (k, q)."""
        if self.system is not None:
            weighted = self.curvature[:, None] * columns
            return self.system.solve(*self.system.transposed(self.jacobian, weighted))[0][:, :2]
        solved = self._solved(self._coupling(columns))
        return np.asarray(solved[:, :2] / self._own_information[0][:, :2, None])

    def each(self, column: Array) -> tuple[Array, Array]:
        """Derivative (n,) of the log-likelihood of each taxel in a parameter with the derivatives
        `column` (k,), and its information where the taxel's own unknowns are estimated."""
        taxel, n, b = self.readings.taxel, len(self.points), self._coupling(column[:, None])
        explained = np.einsum("nai,nai->n", b, self._solved(b))
        information = sums_by_group(self.curvature * column**2, taxel, n) - explained
        return -sums_by_group(self.rate * column, taxel, n), information

    def _coupling(self, columns: Array) -> Array:
        """Couplings (n, D, q) of each taxel's own unknowns, in their scales, with parameters of the
        derivatives `columns` (k, q)."""
        return np.asarray(self._products(columns) / self._own_information[0][:, :, None])

    def _products(self, columns: Array) -> Array:
        """Sums (n, D, q) over each taxel's readings of curvature, own derivative and column."""
        found = self._by_unknown @ columns
        return np.moveaxis(found.reshape(len(self.own), len(self.points), -1), 0, 1)

    @cached_property
    def _by_unknown(self) -> csr_array:
        """Curvature times derivative of the readings (k,) in the taxels' own unknowns (D n,)."""
        (size, count), n = self.own.shape, len(self.points)
        rows = self.readings.taxel + n * np.arange(size)[:, None]
        columns = np.broadcast_to(np.arange(count), rows.shape)
        entries = (self.own * self.curvature).ravel(), (rows.ravel(), columns.ravel())
        return csr_array(entries, shape=(n * size, count))

    def _solved(self, coupling: Array) -> Array:
        return np.asarray(np.linalg.solve(self._own_information[1], coupling))

    @cached_property
    def _own_information(self) -> tuple[Array, Array]:
        """Scales (n, D) of each taxel's own unknowns, and their information (n, D, D) in these."""
        if self.system is not None:
            matrix = self.system.taxels
        else:
            matrix = self._products(self.own.T) + np.diag(self.prior)
        scale = np.sqrt(np.diagonal(matrix, axis1=1, axis2=2)) + 1e-12
        unit = matrix / (scale[:, :, None] * scale[:, None, :]) + 1e-9 * np.eye(len(self.own))
        return scale, unit


def _score(slope: Array, information: Array) -> tuple[float, float]:
    """Score of q parameters together, as `normal_score`, and the first one's estimate by a Newton
    step; 0 where the readings determine none."""
    seen = np.diag(information) > 0
    slope, information = slope[seen], information[np.ix_(seen, seen)]
    if not len(slope):
        return 0.0, 0.0
    scale = np.sqrt(np.diag(information))
    value, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    along = (vectors.T @ (slope / scale)) * (value > SEEN) / np.maximum(value, SEEN) ** 0.5
    square, estimate = float(along @ along), vectors @ (along / np.maximum(value, SEEN) ** 0.5)
    return normal_score(square, len(slope)), float(estimate[0] / scale[0]) if seen[0] else 0.0


def normal_score(square: float, count: int) -> float:
    """Standard deviations of one parameter that are as improbable as a `square`, of the scores of
    `count` parameters together.

    Source: Wilson and Hilferty, "The distribution of chi-square", Proceedings of the National
    Academy of Sciences 17 (1931); too small by 5 % at five standard deviations.
    """
    if count == 1:
        return square**0.5
    spread = 2 / (9 * count)
    return float(((square / count) ** (1 / 3) - 1 + spread) / spread**0.5)


def fitted_readings(estimator: JointEstimator, weight: Array) -> FittedReadings:
    """The readings with weights (k,) at the estimate of independent taxels; those of taxels that
    have not converged, whose score is not zero without a departure, either, have no weight."""
    problem, state, readings = estimator.problem, estimator.state, estimator.likelihood.readings
    data, taxel = estimator.data, readings.taxel
    assert isinstance(problem.parametrization, SurfaceParametrization)
    points = problem.points(state)
    nuisance = problem.nuisance(state.z)
    mu, jacobian = estimator.likelihood.predict(
        readings.contact, points[taxel], nuisance[taxel], problem.contacts.at(state.s),
        estimator.likelihood.groups(taxel),
    )  # fmt: skip
    _, rate, curvature = costs(mu, readings.level / data.sigma, readings.kind)
    names = data.parameters.nuisance_names
    along = np.einsum("kia,ik->ak", problem.parametrization.charts.tangents[taxel], jacobian[:3])
    offset = nuisance[taxel, names.index("offset")] if "offset" in names else np.zeros(len(mu))
    weight = np.where(estimator.unconverged[taxel], 0.0, weight * readings.precision)
    return FittedReadings(
        data=data,
        readings=readings,
        points=points,
        mu=mu,
        offset=offset,
        gain=np.exp(nuisance[taxel, names.index("gain")]) if "gain" in names else 1.0,
        rate=weight * rate,
        curvature=weight * curvature,
        own=np.concatenate([along, jacobian[3 : 3 + len(names)]]),
        tangents=problem.parametrization.charts.tangents,
        prior=np.array([0.0, 0.0, *(sigma**-2 for sigma in estimator.likelihood.nuisance_sigma)]),
    )
