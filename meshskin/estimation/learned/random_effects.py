"""Contacts with errors of their own, and all variances estimated from the data.

Contact points and forces are measurements: every contact has a displacement in its tangent plane
and an error of ln F, normal and independent with unknown variances. So have the gains and offsets
of the taxels, and the coefficients of the learned profile. A reading has noise with a constant part
and one proportional to its level. Given the variances, all unknowns move together by Gauss-Newton
steps (coupled_system.py). From where these are near the optimum on, each variance moves after every
step by Fisher scoring of the restricted likelihood (deviations.py, with the source); one
factorization serves the step and the posterior before it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any, TypeVar, cast

import numpy as np

from ...core.arrays import Array
from ...core.progress import Stage
from ..data.global_parameters import ELECTRONICS
from ..data.measurements import Measurements
from ..joint import fault_detection
from ..joint.contacts import LinearizedContacts
from ..joint.coupled_system import CoupledSystem, CouplingPattern
from ..joint.departures import FittedReadings
from ..joint.electronics import Electronics
from ..joint.likelihood import BLOCK, Likelihood
from ..joint.noise import certain_silences, clear_of_limits
from ..joint.parametrization import Unknowns
from ..joint.pressure import OBSERVED, robust_costs
from ..joint.reading_sums import CONTACT_SIZE
from ..joint.readings import Readings
from ..joint.rejected_readings import HUBER
from ..joint.variable_projection import LOOSE_SIGMA
from .deviations import Deviations, Effects, Posterior, Probes
from .lagged_system import LaggedSystem

MAX_ITERATIONS, USUAL_ITERATIONS, MAX_IMPLAUSIBLE = 60, 30, 10
"""Largest number of Gauss-Newton steps; 10 to 25 are usual, and after 30 variances near zero that
grow and vanish in turn come to rest; after ten in a row out of a prior's reach none came back."""
SETTLED, MAX_DECREASE = 0.01, 0.25
"""Expected decrease of the cost per reading from which on variances move: before, residuals and
effects are not those of the optimum; and that from which an estimate is not there: noise costs 0.5,
and the rests were 0 to 0.04, or 1 to 1.5 where steps had lost the way."""
MAX_RISE = 10.0
"""Largest rise of the cost, relative to it, in a step that leaves a curved valley: beyond, the step
is none of a linear cost's."""
LEAST_FALL = 0.1
"""Largest part of that rise which a step back leaves: Gauss and Newton's leave about its square."""
TRIALS = (0, 1, 1.0), (10, 0.03, 1.0), (10, 1, 1.0), *((1e3, 1, 0.4**part) for part in range(5))
"""Trials of a step: weight of the global parameters' priors on it, its factor for the profile's,
and part of the step. A profile that is hardly restrained follows along the valley; with 0 or 0.1
some recordings with errors of amplitude or logarithmic responses did not reach their optimum."""
RESTRAINED = 3
"""The trial that the first step begins with: far from the optimum, global parameters would go along
the valley by what places and effects still lack."""
PROPORTIONAL = 5.0
"""Expected increase of the restricted likelihood by a variance below which the noise may begin to
grow with the reading: before, what the effects do not explain yet would pass for it. From then on
it does: the constant part alone would take over the other, and both would grow in turn."""
MOVE_TOLERANCE, TOLERANCE = 0.05, 0.2
"""RMS move of the taxels, in standard deviations, and expected increase of the logarithm of the
restricted likelihood by a variance, at which steps end."""
NOISE_TOLERANCE = 0.03
"""Change of the logarithm of the noise at which it has converged."""

T = TypeVar("T")


class RandomEffects:
    """An estimate with random effects in progress."""

    def __init__(
        self, data: Measurements, readings: Readings, unknowns: Unknowns, deviations: Deviations,
        pattern: CouplingPattern | None = None, stage: Stage | None = None,
    ) -> None:  # fmt: skip
        """data: with a learned profile, gains and offsets among its parameters; pattern: of the
        readings, if it is known; stage: its steps are those of Gauss and Newton."""
        self.data, self.readings, self.stage = data, readings, stage or Stage()
        self.likelihood = Likelihood(data, readings)
        self.pattern = pattern or CouplingPattern(readings, len(data.points))
        self.selected: tuple[Readings, CouplingPattern | None] = readings, self.pattern
        """All readings, also those left out on the way, and their pattern while in use."""
        self.size = 2 + unknowns.nuisance.shape[1]
        """Unknowns of a taxel: two coordinates in its chart, ln gain, offset, and drift if any."""
        self.probes = Probes(readings, len(data.points), self.size)
        points, k = unknowns.parametrization.points(), len(readings.taxel)
        shown = set(ELECTRONICS) & set(data.parameters.names)
        self.electronics = Electronics(data, readings, points) if shown else None
        self.linearized, self.deviations = LinearizedContacts(data, unknowns.s), deviations
        self.restraint, self.last_decrease, self.iterates = RESTRAINED, np.inf, [points]
        self.crossed: tuple[Unknowns, float, float] | None = None
        """Where steps left a curved valley, the cost there, and its rise; None if none did."""
        self.noise_known = data.belief.noise_sigma is not None
        self.uneven = data.uneven[readings.contact]
        self.mu, self.leverages, self.spread = np.empty(k), np.zeros(k), np.ones(k)
        self.jacobian = np.empty((k, self.size + len(unknowns.s) + CONTACT_SIZE))
        self.lag, self.rests_on = np.zeros((k, CONTACT_SIZE)), readings.contact
        self._made, self._made_at = dict[str, Any](), (unknowns, deviations, self.mu)
        self.move(unknowns)
        self.spread = self.deviations.noise_of(self.mu, self.uneven)

    def _leave_out_certain_silences(self) -> None:
        """Leave out silent readings that do not inform, where no reading depends on others."""
        certain = certain_silences(self.readings, self.mu, self.data, self.spread)
        if self.electronics or not certain.any():
            return
        self.selected = self.readings, None
        self.readings = readings = self.readings.without(certain)
        self.likelihood = Likelihood(self.data, readings)
        self.pattern = CouplingPattern(readings, len(self.data.points))
        self.probes = Probes(readings, len(self.data.points), self.size)
        for name in ("mu", "leverages", "spread", "uneven", "jacobian", "lag", "rests_on"):
            setattr(self, name, getattr(self, name)[~certain])

    @property
    def prior(self) -> tuple[Array, Array, Array]:
        """Prior precisions of a taxel (2 + q,), a contact (3,) and the global parameters (ks,)."""
        d, p = self.deviations, self.data.parameters
        sigma = p.sigma.copy()
        sigma[p.columns.get("profile", slice(0, 0))] = d.profile
        taxel = np.array([0.0, 0.0, *(getattr(d, name) ** -2.0 for name in p.nuisance_names)])
        return taxel, np.array([d.position, d.position, d.force]) ** -2.0, sigma**-2.0

    def move(self, unknowns: Unknowns) -> None:
        """Evaluate the readings mu (k,), their derivatives (k, D + ks + 3), and those `lag` (k, 3)
        in the errors of the earlier contacts `rests_on` (k,), at other values."""
        self.unknowns = unknowns
        tangents = unknowns.parametrization.charts.tangents
        for rows, mu, jacobian in self._predicted(self.electronics, unknowns):
            taxel = self.readings.taxel[rows]
            self.mu[rows] = mu
            self.jacobian[rows, :2] = np.einsum("kia,ik->ka", tangents[taxel], jacobian[:3])
            end = 1 + self.jacobian.shape[1]
            self.jacobian[rows, 2:] = jacobian[3:end].T
            if self.electronics is not None and len(jacobian) > end:
                self.lag[rows] = jacobian[end:].T
                self.rests_on = self.readings.contact[self.electronics.source]

    def added_by(self, names: tuple[str, ...]) -> Array:
        """What departures, ELECTRONICS among them, add to each reading (k,), in units of noise."""
        p = self.data.parameters
        if not {*names} & {*p.names, *p.nuisance_names}:
            return np.zeros_like(self.mu)
        without = self._predicted(None, self.unknowns.without(names, p))
        return self.mu - np.concatenate([mu for _, mu, _ in without])

    def _predicted(self, by: Electronics | None, u: Unknowns) -> Iterator[tuple[Any, Array, Array]]:
        """Blocks of readings, their mu and its derivatives, as of `Likelihood.predict`."""
        readings, points = self.readings, u.parametrization.points()
        contacts, count = self.linearized.with_errors(u.s, u.errors), len(readings.taxel)
        size = BLOCK if by is None else max(count, 1)
        for begin in range(0, count, size):
            rows = slice(begin, begin + size)
            at, own = readings.contact[rows], readings.taxel[rows]
            values = points[own], u.nuisance[own], contacts, self.likelihood.groups(own), by
            yield rows, *self.likelihood.predict(at, *values)

    def fitted(self) -> FittedReadings:
        """The readings at the present values."""
        return self._once(self._fitted)

    def slopes(self) -> tuple[Array, Array]:
        """First and second derivatives (k,) of the readings' costs in mu."""
        _, rate, curvature = self._once(self._costs)
        return rate / self.spread, curvature / self.spread**2

    def _fitted(self) -> FittedReadings:
        rate, curvature = self.slopes()
        return FittedReadings(
            data=self.data,
            readings=self.readings,
            points=self.unknowns.parametrization.points(),
            mu=self.mu,
            offset=self.unknowns.nuisance[self.readings.taxel, 1],
            rate=rate,
            curvature=curvature,
            gain=np.exp(self.unknowns.nuisance[self.readings.taxel, 0]),
            own=self.jacobian[:, : self.size].T,
            prior=self.prior[0],
            tangents=self.unknowns.parametrization.charts.tangents,
            system=self.system(),
            jacobian=self.jacobian,
        )

    def residuals(self) -> Array:
        """Residuals (k,) in standard deviations of each reading's noise."""
        scaled = fault_detection.residuals(self.readings, self.mu, self.data.sigma)
        return np.asarray(scaled / self.spread)

    def cost(self) -> float:
        """Cost of readings and random effects at the present values."""
        u, (taxel, contact, shared) = self.unknowns, self.prior
        total = self._once(self._costs)[0].sum() + (taxel[2:] * u.nuisance**2).sum() / 2
        return float(total + (contact * u.errors**2).sum() / 2 + (shared * u.s**2).sum() / 2)

    def _costs(self) -> tuple[Array, Array, Array]:
        """Cost (k,), its derivative and its curvature in mu, Huber's beyond HUBER."""
        readings, spread = self.readings, self.spread
        level = readings.level / self.data.sigma / spread
        found = robust_costs(self.mu / spread, level, readings.kind, HUBER)
        return found[0] * readings.weight, found[1] * readings.weight, found[2] * readings.weight

    def _once(self, make: Callable[[], T]) -> T:
        """What `make` gives at the present values, made once."""
        values = self.unknowns, self.deviations, self.spread
        if any(a is not b for a, b in zip(values, self._made_at, strict=True)):
            self._made.clear()  # its memory serves what follows
            self._made_at = values
        if make.__name__ not in self._made:
            self._made[make.__name__] = make()
        return cast(T, self._made[make.__name__])

    def system(self) -> CoupledSystem:
        """The normal equations at the present values, with priors."""
        return self._once(self._normal_equations)

    def _normal_equations(self) -> CoupledSystem:
        (taxel, contact, shared), u, slopes = self.prior, self.unknowns, self.slopes()
        bare = CoupledSystem.from_readings(self.pattern, self.jacobian, *slopes, self.size)
        if self.lag.any():
            bare = LaggedSystem.extended(bare, self.jacobian, *slopes, self.lag, self.rests_on)
        # a taxel that no reading determines keeps its place
        weak = np.diag(np.where(taxel > 0, taxel, LOOSE_SIGMA**-2))
        g = bare.gradient
        prior_taxel = np.concatenate([np.zeros((len(u.nuisance), 2)), u.nuisance], axis=1) * taxel
        return replace(
            bare,
            taxels=bare.taxels + weak,
            contacts=bare.contacts + np.diag(contact),
            shared=bare.shared + np.diag(shared),
            gradient=(g[0] + prior_taxel, g[1] + contact * u.errors, g[2] + shared * u.s),
        )

    def step(self, settled: float) -> tuple[float, Posterior | None]:
        """One Gauss-Newton step, restrained until the cost decreases.

        Global parameters that trade against each other, as compression and profile do, have a
        curved valley of nearly equal cost. Near the optimum a step may leave it, where the next one
        leads back to a lower cost (a watchdog). Else the step of the global parameters is
        restrained by their priors, in whose units the valley is not long. Source: Chamberlain and
        others, "The watchdog technique for forcing convergence", Math. Prog. Study 16 (1982).

        Returns the rms move of the taxels by an unrestrained step, in their standard deviations at
        fixed contacts, and the posterior before it where its expected decrease, or the last one, is
        below `settled`; an infinite move and none after a step that leaves the valley.
        """
        crossed, self.crossed = self.crossed, None
        before, cost, rise = crossed or (self.unknowns, self.cost(), np.inf)
        here, (system, x, decrease) = self.unknowns, self.system().newton_step()
        settles = crossed is None and min(decrease, self.last_decrease) < settled
        posterior = self.posterior(system) if settles else None
        for weight, held, part in TRIALS[self.restraint :]:
            restraint = weight * self.prior[2]
            restraint[self.data.parameters.columns["profile"]] *= held
            change = system.restrained(x[2], restraint) - x[2]
            follow = system.following(change)
            step = [-part * (a + b) for a, b in zip(x, follow, strict=True)]
            self._move_by(here, *step)
            self.last_decrease = cost - self.cost()
            if self.last_decrease >= -1e-9 * abs(cost):
                self.restraint = max(self.restraint - 1, 0)
                moves = np.einsum("ni,nij,nj->n", x[0], system.taxels, x[0])
                return float(np.sqrt(np.mean(moves))), posterior
            lowered, rise = -self.last_decrease < LEAST_FALL * rise, -self.last_decrease
            near = decrease < SETTLED * len(self.mu) and rise < MAX_RISE * cost
            leaves = near and not self.restraint if crossed is None else lowered
            if leaves:
                self.crossed = before, cost, rise
                return np.inf, None
            self.restraint = min(self.restraint + 1, len(TRIALS) - 1)
            if crossed is not None:
                break
        self.move(before)
        return (0.0 if crossed is None else np.inf), posterior

    def _move_by(self, before: Unknowns, taxels: Array, errors: Array, s: Array) -> None:
        """Move by a step (n, 4), (m, 3), (ks,) from the unknowns `before`."""
        charts = before.parametrization
        moved = charts.relinearized(self.data.body, charts.limit_step(taxels[:, :2]))
        nuisance = before.nuisance + taxels[:, 2:]
        self.move(Unknowns(moved, nuisance, before.errors + errors, before.s + s))

    def converge(self, plausible: Callable[[], bool] = lambda: True) -> bool:
        """Move unknowns and variances until they no longer change; False at the limit of steps, or
        of those in a row that end where it is not `plausible`."""
        settled, outside = SETTLED * int((self.readings.kind == OBSERVED).sum()), 0
        for iteration in range(MAX_ITERATIONS):
            self.stage.step()
            (move, posterior), gain = self.step(settled), np.inf
            if posterior is not None:
                gain = self.update_variances(posterior)
            elif iteration < 2 and self.crossed is None:  # effects may take the noise, too
                grown = self._with_noise(self.deviations, 1)
                self.deviations = max(self.deviations, grown, key=lambda d: d.noise)
            if self.crossed is None:
                self.spread = self.deviations.noise_of(self.mu, self.uneven)
            if posterior is not None and np.isfinite(settled):
                settled = np.inf  # from here on a decrease follows from the change of variances
                self._leave_out_certain_silences()
            self.iterates.append(self.unknowns.parametrization.points())
            outside = 0 if plausible() else outside + 1
            if at_rest := move < MOVE_TOLERANCE and gain < TOLERANCE:  # but for the variances' step
                at_rest = self.system().newton_step()[2] < MAX_DECREASE * len(self.mu)
            if at_rest or outside == MAX_IMPLAUSIBLE:
                return at_rest
        return False

    def posterior(self, system: CoupledSystem) -> Posterior:
        """The posterior of the effects at the present point."""
        root, p = np.sqrt(self._once(self._costs)[2]) / self.spread, self.data.parameters
        profile, names = p.columns["profile"], p.nuisance_names
        return Posterior.of(system, self.jacobian, root, self.prior, self.probes, profile, names)

    def update_variances(self, posterior: Posterior) -> float:
        """Move every variance; returns the largest expected increase of the restricted likelihood
        by one of them."""
        u, d, self.leverages = self.unknowns, self.deviations, posterior.leverages
        s, names = u.s[self.data.parameters.columns["profile"]], self.data.parameters.nuisance_names
        taxels, contacts = int(self.probes.seen.sum()), int(self.probes.touched.sum())
        squares = {
            "position": (np.sum(u.errors[:, :2] ** 2), 2 * contacts),
            "force": (np.sum(u.errors[:, 2] ** 2), contacts),
            "profile": (s @ s, len(s)),
        }
        squares |= {name: (np.sum(u.nuisance[:, k] ** 2), taxels) for k, name in enumerate(names)}
        effects = {}
        for name, (square, n) in squares.items():
            known = posterior.determined[name], posterior.information[name]
            effects[name] = Effects(float(square) / getattr(d, name) ** 2, *known, n)
        moved, largest = d.moved(effects, careful=len(self.iterates) > USUAL_ITERATIONS)
        both = largest < PROPORTIONAL or d.relative > 0
        self.deviations = self._with_noise(moved, 2 if both else 1)
        return np.inf if abs(np.log(self.deviations.noise / d.noise)) > NOISE_TOLERANCE else largest

    def clear(self) -> np.ndarray:
        """Readings (k,) bool predicted well inside the sensor's range, of whole residuals."""
        clear = (self.readings.kind == OBSERVED) & (self.readings.weight > 0.5)
        return np.asarray(clear & clear_of_limits(self.mu, self.data, self.spread))

    def _with_noise(self, d: Deviations, parts: int) -> Deviations:
        """Deviations with the noise by the residuals: its constant part, or both `parts`."""
        if self.noise_known or not (clear := self.clear()).any():
            return d
        level = self.readings.level[clear] / self.data.sigma
        r2 = np.minimum(np.abs(self.mu[clear] - level), HUBER * self.spread[clear]) ** 2
        free = 1 - self.leverages[clear]
        return d.with_noise(self.mu[clear], self.uneven[clear], r2, free, parts)
