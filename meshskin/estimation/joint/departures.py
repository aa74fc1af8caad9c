"""What the readings show beyond a contact model: errors of the contacts, an offset of the indenter,
drag, friction, hysteresis, crosstalk, and drift.

Each but the first is tested by its score, the derivative of the log-likelihood in its parameter
at zero, relative to its standard deviation there. Where contacts have errors of their own, all
unknowns are estimated beside it; else each taxel's own ones, and the others are taken as known in
that deviation, which makes it too large and the test careful.

Source: Rao, "Large sample tests of statistical hypotheses concerning several parameters",
Mathematical Proceedings of the Cambridge Philosophical Society 44 (1948).
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ...core.arrays import Array, sums_by_group
from ..data.measurements import Measurements
from .coupled_system import CoupledSystem
from .electronics import WIDTH, Electronics
from .friction import shears
from .joint_estimator import JointEstimator
from .likelihood import Readings
from .parametrization import SurfaceParametrization
from .pressure import OBSERVED, costs

CONTACT_ERRORS = "errors of the contacts"
"""Name of the departure that `contact_score` tests."""
MIN_SCORE = 6.0
"""Score, in standard deviations, from which a departure is shown: 1e-9 by chance."""
WIDTHS = (0.5, 1.0, 2.0, 4.0)
"""Half-widths of the play operator that are tried, in units of WIDTH."""
LIMITS = (0.1e-3, 0.25e-3, 0.5e-3, 1e-3)
"""Shears, m, from which contacts slide, that are tried."""
SEEN = 1e-6
"""Least information on a parameter, relative to that with known taxels: rounding is below it."""
JUMPS = 15
"""Places in a recording, evenly spaced, where a jump of the contacts is looked for."""
MIN_SHOWN = 0.02
"""Information on a direction of a jump, relative to the best known one, from which it is estimated:
that along the normals is near zero."""
SHARE = 0.2
"""Share of hysteresis from which an estimate starts: at zero its width has no effect."""


@dataclass(frozen=True)
class Jump:
    """A displacement of all contacts from one on, as of a body that was mounted anew."""

    score: float = 0.0
    """In standard deviations."""
    part: float = 0.0
    """Part of the contacts before it."""
    displacement: Array = field(default_factory=lambda: np.zeros(3))
    """(3,), m."""

    @property
    def shown(self) -> Array:
        """The displacement (3,), m, where its score is above MIN_SCORE, else zero."""
        return self.displacement if self.score > MIN_SCORE else np.zeros(3)

    @property
    def departure(self) -> dict[str, float]:
        """Its score, by a name that says where it is."""
        where = f"at {self.part:.0%} of the recording, as of a body mounted anew"
        return {f"a jump of the contacts {where}": self.score}


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
    system: CoupledSystem | None = None
    """Normal equations of all unknowns, where contacts have errors of their own."""
    jacobian: Array = field(default_factory=lambda: np.empty((0, 0)))
    """Derivatives (k, .) of mu in these."""

    def scores(self) -> dict[str, tuple[float, Array]]:
        """Score of each departure, in standard deviations, and the start of its parameters; the
        largest first, but last the drift, for which each of the others can stand in."""
        pressure = np.maximum(self.mu - self.offset, 0.0)
        electronics = Electronics(self.data, self.readings, self.points)
        best = max((0.0, WIDTHS[0]), *((self._lag(electronics, pressure, w), w) for w in WIDTHS))
        drift = self._each(self.data.phase[self.readings.contact])
        n = max(int(np.sum(drift != 0)), 1)
        dragged = self._shared(self._moved(self.data.headway[:, :, None])[:, 0])
        sheared = max((self._sheared(limit), limit) for limit in LIMITS)
        found: dict[str, tuple[float, Array]] = {
            "indenter_offset": (self._indenter_score(), np.zeros(3)),
            "drag": (abs(dragged), np.zeros(1)),
            "friction": (sheared[0], np.array([sheared[1]])),
            "hysteresis": (best[0], np.array([SHARE, np.log(best[1])])),
            "crosstalk": (self._shared(electronics.neighbours @ pressure), np.zeros(1)),
        }
        largest_first = dict(sorted(found.items(), key=lambda item: -item[1][0]))
        return largest_first | {"drift": (float((drift @ drift - n) / np.sqrt(2 * n)), np.zeros(0))}

    def jump(self) -> Jump:
        """The most significant displacement of all contacts from one on."""
        m, axes = len(self.data.points), np.eye(3)
        first = np.unique(np.linspace(0, m, JUMPS + 2).astype(int)[1:-1])
        moved = self._moved(np.broadcast_to(axes, (m, 3, 3)))
        best = Jump()
        for begin in first:
            later = (self.readings.contact >= begin)[:, None] * moved
            slope, information = self._joint(later)
            value, vectors = np.linalg.eigh(information)
            seen = value > MIN_SHOWN * value[-1]
            along = (vectors.T @ slope)[seen]
            score = float(np.sqrt(np.sum(along**2 / np.maximum(value[seen], 1e-300))))
            if score > best.score:
                size = vectors[:, seen] @ (along / np.maximum(value[seen], 1e-300))
                best = Jump(score, begin / m, size)
        return best

    def _joint(self, columns: Array) -> tuple[Array, Array]:
        """Derivatives (q,) of the log-likelihood in parameters with the derivatives `columns`
        (k, q) of the readings, and their information (q, q) where all others are estimated."""
        weighted = self.curvature[:, None] * columns
        if self.system is None:
            scale, unit = self._own_information
            n = len(self.points)
            products = self.own.T[:, :, None] * weighted[:, None, :]
            b = sums_by_group(products, self.readings.taxel, n) / scale[:, :, None]
            explained = np.einsum("nap,naq->pq", b, np.linalg.solve(unit, b))
        else:
            parts = self.system.pattern.transposed(self.jacobian, weighted, len(self.own))
            solved = self.system.solve(*parts)
            explained = sum(
                p.reshape(-1, p.shape[-1]).T @ x.reshape(-1, x.shape[-1])
                for p, x in zip(parts, solved, strict=True)
            )
        return -columns.T @ self.rate, columns.T @ weighted - explained

    def _lag(self, electronics: Electronics, pressure: Array, width: float) -> float:
        """The score of hysteresis with the relative half-width `width` at pressures (k,)."""
        half = np.full(len(pressure), width * WIDTH * electronics.peak)
        return self._shared(electronics.play(pressure, half)[0] - pressure)

    def _sheared(self, limit: float) -> float:
        """The score of friction whose contacts slide from the shear `limit`, m, on."""
        return -self._shared(self._moved(shears(self.data, limit)[0][:, :, None])[:, 0])

    def _indenter_score(self) -> float:
        """The largest absolute score of an offset of the indenter along the world's axes; 0 without
        headings. An offset along a contact's normal does not move it."""
        data = self.data
        if data.headings is None:
            return 0.0
        # the closest point of a centre at height r moves by 1 / (1 + r k) of the centre's motion
        shrunk = 1 / (1 + data.belief.indenter.radius * data.curvature.mean(axis=1))
        moved = self._moved(np.swapaxes(data.headings, 1, 2) * shrunk[:, None, None])
        return max(abs(self._shared(column)) for column in moved.T)

    def _moved(self, directions: Array) -> Array:
        """Derivatives (k, q) of the readings in displacements of the contacts along `directions`
        (m, 3, q), body frame."""
        moved = directions[self.readings.contact]
        return -np.einsum("kai,ka->ki", moved, self._gradient)

    @cached_property
    def _gradient(self) -> Array:
        """Derivatives (k, 3) of the readings in displacements of their taxels."""
        return np.einsum("kia,ak->ki", self.tangents[self.readings.taxel], self.own[:2])

    def _each(self, column: Array) -> Array:
        """Scores (n,) of a parameter that each taxel has of its own, with the derivatives
        `column` (k,) of the readings; 0 where the readings do not determine it."""
        slope, information = self._moments(column)
        return np.asarray(slope * (information > 1e-9) / np.sqrt(np.maximum(information, 1e-9)))

    def _shared(self, column: Array) -> float:
        """Score of a parameter that all taxels share, with the sign of its estimate; 0 where the
        readings do not determine it."""
        weighted = self.curvature * column
        known = float(weighted @ column)
        if self.system is None:
            information = float(self._moments(column)[1].sum())
        else:
            size = len(self.own)
            b = self.system.pattern.transposed(self.jacobian, weighted[:, None], size)
            explained = zip(b, self.system.solve(*b), strict=True)
            information = known - sum(float(np.vdot(a, x)) for a, x in explained)
        if information <= SEEN * known:
            return 0.0
        return -float(self.rate @ column) / information**0.5

    def _moments(self, column: Array) -> tuple[Array, Array]:
        """Derivative (n,) of the log-likelihood of each taxel in a parameter with the derivatives
        `column` (k,), and its information where the taxel's own unknowns are estimated."""
        taxel, n = self.readings.taxel, len(self.points)
        scale, unit = self._own_information
        b = sums_by_group((self.own * self.curvature * column).T, taxel, n) / scale
        explained = np.einsum("na,na->n", b, np.linalg.solve(unit, b[..., None])[..., 0])
        information = sums_by_group(self.curvature * column**2, taxel, n) - explained
        slope = -sums_by_group(self.rate * column, taxel, n)
        return slope, information

    @cached_property
    def _own_information(self) -> tuple[Array, Array]:
        """Scales (n, D) of each taxel's own unknowns, and their information (n, D, D) in these."""
        taxel, n, size = self.readings.taxel, len(self.points), len(self.own)
        if self.system is not None:
            matrix = self.system.taxels
        else:
            weighted, own = (self.own * self.curvature).T, self.own.T
            products = (weighted[:, :, None] * own[:, None, :]).reshape(-1, size**2)
            matrix = sums_by_group(products, taxel, n).reshape(-1, size, size) + np.diag(self.prior)
        scale = np.sqrt(np.diagonal(matrix, axis1=1, axis2=2)) + 1e-12
        unit = matrix / (scale[:, :, None] * scale[:, None, :]) + 1e-9 * np.eye(size)
        return scale, unit


def departure_scores(estimator: JointEstimator) -> dict[str, float]:
    """Score of each departure from the contact model, in standard deviations; with rigid modules
    only that of errors of the contacts."""
    found = {CONTACT_ERRORS: contact_score(estimator)}
    if isinstance(estimator.problem.parametrization, SurfaceParametrization):
        found |= {
            name: score
            for name, (score, _) in _fitted(estimator, estimator.likelihood.readings.weight)
            .scores()
            .items()
        }
    return found


def jump_of(estimator: JointEstimator) -> Jump:
    """The most significant displacement of all contacts from one on; with rigid modules none.

    Beside a jump the readings before or after it are outlying: its size is that by all readings.
    """
    if not isinstance(estimator.problem.parametrization, SurfaceParametrization):
        return Jump()
    weight = estimator.likelihood.readings.weight
    found = _fitted(estimator, weight).jump()
    if found.score <= MIN_SCORE:
        return found
    whole = _fitted(estimator, np.ones_like(weight)).jump()
    return replace(found, displacement=whole.displacement)


def _fitted(estimator: JointEstimator, weight: Array) -> FittedReadings:
    """The readings with weights (k,) at the estimate of independent taxels; those of taxels that
    have not converged, whose score is not zero without a departure, either, have no weight."""
    problem, state, readings = estimator.problem, estimator.state, estimator.likelihood.readings
    data, taxel = estimator.data, readings.taxel
    assert isinstance(problem.parametrization, SurfaceParametrization)
    points = problem.points(state)
    nuisance = problem.nuisance(state.z, np.arange(len(points)))
    mu, jacobian = estimator.likelihood.predict(
        readings.contact, points[taxel], nuisance[taxel], problem.contacts.at(state.s)
    )
    _, rate, curvature = costs(mu, readings.level / data.sigma, readings.kind)
    names = data.parameters.nuisance_names
    along = np.einsum("kia,ik->ak", problem.parametrization.charts.tangents[taxel], jacobian[:3])
    offset = nuisance[taxel, names.index("offset")] if "offset" in names else np.zeros(len(mu))
    weight = np.where(estimator.unconverged[taxel], 0.0, weight)
    return FittedReadings(
        data=data,
        readings=readings,
        points=points,
        mu=mu,
        offset=offset,
        rate=weight * rate,
        curvature=weight * curvature,
        own=np.concatenate([along, jacobian[3 : 3 + len(names)]]),
        tangents=problem.parametrization.charts.tangents,
        prior=np.array([0.0, 0.0, *(sigma**-2 for sigma in estimator.likelihood.nuisance_sigma)]),
    )


def contact_score(estimator: JointEstimator) -> float:
    """The larger of two scores, in standard deviations, of errors that the readings of a contact
    share: a displacement of its point, and an error of its force.

    The sum over all pairs of readings of a contact of the products of their residuals, weighted by
    what each would change: zero on average for independent errors, whatever their variance.
    """
    problem, state, m = estimator.problem, estimator.state, len(estimator.data.points)
    contacts = problem.contacts.with_errors(state.s, np.zeros((m, 3)))
    readings = estimator.likelihood.readings
    nuisance = problem.nuisance(state.z, np.arange(problem.parametrization.count))
    jacobian = estimator.likelihood.derivatives(problem.points(state), nuisance, contacts)[-3:]
    used = (readings.kind == OBSERVED) & (readings.weight > 0.5)
    owner = readings.contact[used]
    product = jacobian[:, used] * estimator.residuals()[used]
    found = []
    for rows in (slice(0, 2), slice(2, 3)):
        excess = variance = 0.0
        for x in product[rows]:
            squares = np.bincount(owner, x**2, m)
            excess += float(np.sum(np.bincount(owner, x, m) ** 2 - squares))
            variance += 2 * float(np.sum(squares**2 - np.bincount(owner, x**4, m)))
        found.append(excess / max(variance, 1e-300) ** 0.5)
    return max(found)
