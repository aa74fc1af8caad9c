"""Contacts with errors of their own, and all variances estimated from the data.

Contact points and forces are measurements: every contact has a displacement in its tangent plane
and an error of ln F, normal and independent with unknown variances. So have the gains and offsets
of the taxels, and the coefficients of the learned profile. A reading has noise with a constant part
and one proportional to its level. Given the variances, all unknowns move together by Gauss-Newton
steps (coupled_system.py); between the steps each variance moves by Fisher scoring of the restricted
likelihood: an effect x_j with posterior variance V_j has the expectation E[x_j^2] = s^2 - V_j at
its true variance s^2. The sums of V_j over the contacts are estimated by Hutchinson's probes.

Sources: Patterson and Thompson, "Recovery of inter-block information when block sizes are unequal",
Biometrika 58 (1971); Hutchinson, Commun. Stat. Simul. Comput. 18 (1989).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ...contact.learned import PROFILE_SIZE
from ...core.arrays import Array
from ..data.measurements import Measurements
from ..posegraph.symmetric_blocks import SingularMatrixError
from . import fault_detection
from .contacts import LinearizedContacts
from .coupled_system import CONTACT_SIZE, CoupledSystem, CouplingPattern, sums
from .deviations import Deviations
from .likelihood import Likelihood, Readings
from .parametrization import SurfaceParametrization
from .pressure import OBSERVED, costs
from .variable_projection import LOOSE_SIGMA

MAX_ITERATIONS = 60
"""Largest number of Gauss-Newton steps; 10 to 25 are usual."""
PROBES = 6
"""Hutchinson's probes: with m contacts the sum is known to about 1 / sqrt(PROBES m)."""
SETTLED = 0.01
"""Expected decrease of the cost per reading from which on variances move: before, residuals and
effects are not those of the optimum."""
MAX_TRIALS, MIN_DAMPING = 8, 1e-3
"""Trials of a step, with 10 times the damping each, and the least damping, relative to the diagonal
of the normal equations."""
HUBER = 4.0
"""Residual, in standard deviations, from which a reading's cost grows linearly: 6e-5 of the sound
ones exceed it."""
PROPORTIONAL = 5.0
"""Expected increase of the restricted likelihood by a variance below which the noise may grow with
the reading: before, what the effects do not explain yet would pass for it."""
MIN_CLEARANCE = 3.0
"""Distance of a predicted reading from threshold and saturation, in standard deviations, from which
it enters the estimate of the noise: 1e-3 of such readings are censored."""
MOVE_TOLERANCE = 0.05
"""RMS move of the taxels, in standard deviations, at which steps end."""
TOLERANCE = 0.2
"""Expected increase of the logarithm of the restricted likelihood at which a variance has
converged."""
NOISE_TOLERANCE = 0.03
"""Change of the logarithm of the noise at which it has converged."""


@dataclass(frozen=True)
class Unknowns:
    """A value of all unknowns."""

    parametrization: SurfaceParametrization
    nuisance: Array
    """(n, 2), ln gain and offset."""
    errors: Array
    """(m, 3) of the contacts."""
    s: Array
    """(ks,)."""


class RandomEffects:
    """An estimate with random effects in progress."""

    def __init__(
        self, data: Measurements, readings: Readings, unknowns: Unknowns, deviations: Deviations
    ) -> None:
        """data: with a learned profile, gains and offsets among its parameters."""
        self.data, self.readings = data, readings
        self.likelihood = Likelihood(data, readings)
        self.pattern = CouplingPattern(readings, len(data.points))
        self.linearized = LinearizedContacts(data, unknowns.s)
        self.deviations, self.damping = deviations, 0.0
        self.noise_known = data.belief.noise_sigma is not None
        self.leverages = np.zeros(len(readings.taxel))
        self.reading_probes = np.random.default_rng(1).choice(
            [-1.0, 1.0], size=(PROBES, len(readings.taxel))
        )
        self.iterates = [unknowns.parametrization.points()]
        self.touched = np.bincount(readings.contact, minlength=len(data.points)) > 0
        shape = len(data.points), CONTACT_SIZE, PROBES
        self.probes = np.random.default_rng(0).choice([-1.0, 1.0], size=shape)
        self.probes *= self.touched[:, None, None]
        self.spread = np.ones(len(readings.taxel))
        self.move(unknowns)
        self.spread = self.noise_of(self.mu)

    @property
    def prior(self) -> tuple[Array, Array, Array]:
        """Prior precisions of a taxel (4,), a contact (3,) and the global parameters (ks,)."""
        d, sigma = self.deviations, self.data.parameters.sigma.copy()
        at = self.data.parameters.columns.get("profile", slice(0, 0))
        sigma[at] = d.profile
        taxel = np.array([0.0, 0.0, d.gain**-2, d.offset**-2])
        return taxel, np.array([d.position, d.position, d.force]) ** -2.0, sigma**-2.0

    def noise_of(self, mu: Array) -> Array:
        """Standard deviation (k,) of readings with the expectations mu (k,)."""
        return self.deviations.noise_of(mu)

    def move(self, unknowns: Unknowns) -> None:
        """Evaluate the readings and their derivatives at other values."""
        self.unknowns, taxel = unknowns, self.readings.taxel
        contacts = self.linearized.with_errors(unknowns.s, unknowns.errors)
        self.contacts_at = contacts
        points = unknowns.parametrization.points()
        self.mu, jacobian = self.likelihood.predict(
            self.readings.contact, points[taxel], unknowns.nuisance[taxel], contacts
        )
        tangents = unknowns.parametrization.charts.tangents[taxel]
        along = np.einsum("kia,ik->ak", tangents, jacobian[:3])
        self.jacobian = np.concatenate([along, jacobian[3:]])

    def response_levels(self) -> tuple[float, float]:
        """Levels of the readings, relative to the nominal peak, that determine gains and errors of
        ln F: means over taxels and contacts, weighted by the information of each reading.

        A compression that made gains smaller at the same readings would be preferred for that
        alone: the estimate is the mode, in which a change of scale of its effects counts.
        """
        level = self.mu * self.data.sigma / float(np.median(self.data.peaks))
        found = []
        for row, owner in ((2, self.readings.taxel), (-1, self.readings.contact)):
            weight = self.jacobian[row] ** 2
            total = np.bincount(owner, weight)
            mean = np.bincount(owner, weight * level) / np.maximum(total, 1e-300)
            found.append(float(np.mean(mean[total > 0])))
        return found[0], found[1]

    def residuals(self) -> Array:
        """Residuals (k,) in standard deviations of each reading's noise."""
        scaled = fault_detection.residuals(self.readings, self.mu, self.data.sigma)
        return np.asarray(scaled / self.spread)

    def cost(self) -> float:
        """Cost of readings and random effects at the present values."""
        cost = self._costs()[0]
        taxel, contact, shared = self.prior
        u = self.unknowns
        total = cost.sum() + (taxel[2:] * u.nuisance**2).sum() / 2
        return float(total + (contact * u.errors**2).sum() / 2 + (shared * u.s**2).sum() / 2)

    def _costs(self) -> tuple[Array, Array, Array]:
        """Cost (k,), its derivative and its curvature in mu, Huber's beyond HUBER."""
        readings, spread = self.readings, self.spread
        level = readings.level / self.data.sigma / spread
        cost, rate, curvature = costs(self.mu / spread, level, readings.kind)
        r = np.abs(self.mu / spread - level)
        far = (readings.kind == OBSERVED) & (r > HUBER)
        cost = np.where(far, HUBER * r - HUBER**2 / 2, cost)
        share = np.where(far, HUBER / np.maximum(r, HUBER), 1.0)
        weight = readings.weight
        return weight * cost, weight * rate * share, weight * curvature * share

    def system(self) -> CoupledSystem:
        """The normal equations at the present values, with priors."""
        _, rate, curvature = self._costs()
        jacobian = self.jacobian / self.spread
        bare = CoupledSystem.from_readings(self.pattern, jacobian, rate, curvature, 4)
        taxel, contact, shared = self.prior
        u = self.unknowns
        # a taxel that no reading determines keeps its place
        weak = np.diag(np.where(taxel > 0, taxel, LOOSE_SIGMA**-2))
        g = bare.gradient
        prior_taxel = np.concatenate([np.zeros_like(u.nuisance), u.nuisance], 1) * taxel
        return replace(
            bare,
            taxels=bare.taxels + weak,
            contacts=bare.contacts + np.diag(contact),
            shared=bare.shared + np.diag(shared),
            gradient=(g[0] + prior_taxel, g[1] + contact * u.errors, g[2] + shared * u.s),
        )

    def step(self) -> tuple[float, float]:
        """One Gauss-Newton step, damped until the cost decreases; returns the expected decrease,
        and the rms move of the taxels in their standard deviations at fixed contacts."""
        before, cost, kept = self.unknowns, self.cost(), (self.mu, self.jacobian)
        bare, charts = self.system(), before.parametrization
        for _ in range(MAX_TRIALS):
            system = bare.damped(self.damping)
            gradient = system.gradient
            try:
                x = system.solve(*(g[..., None] for g in gradient))
            except SingularMatrixError:  # rounding, where the variances differ by many orders
                self.damping = max(10 * self.damping, MIN_DAMPING)
                continue
            taxels, errors, s = (-part[..., 0] for part in x)
            steps = zip((taxels, errors, s), gradient, strict=True)
            decrease = -0.5 * sum(float((x * g).sum()) for x, g in steps)
            moved = charts.relinearized(self.data.body, charts.limit_step(taxels[:, :2]))
            nuisance = before.nuisance + taxels[:, 2:]
            self.move(Unknowns(moved, nuisance, before.errors + errors, before.s + s))
            if self.cost() <= cost + 1e-9 * abs(cost):
                self.damping = self.damping / 100 if self.damping > MIN_DAMPING else 0.0
                moves = np.einsum("ni,nij,nj->n", taxels, bare.taxels, taxels)
                return decrease, float(np.sqrt(np.mean(moves)))
            self.damping = max(10 * self.damping, MIN_DAMPING)
        self.unknowns, (self.mu, self.jacobian) = before, kept
        return 0.0, 0.0

    def converge(self) -> bool:
        """Move unknowns and variances until they no longer change; False at the limit of steps."""
        settled = SETTLED * int((self.readings.kind == OBSERVED).sum())
        for iteration in range(MAX_ITERATIONS):
            (decrease, move), gain = self.step(), np.inf
            if decrease < settled:
                gain = self.update_variances()
            elif iteration < 2:
                self.deviations = self._with_noise(self.deviations, 1)
            self.spread = self.noise_of(self.mu)
            self.iterates.append(self.unknowns.parametrization.points())
            if move < MOVE_TOLERANCE and gain < TOLERANCE:
                return True
        return False

    def update_variances(self) -> float:
        """Move every variance; returns the largest expected increase of the restricted likelihood
        by one of them."""
        system, d = self.system(), self.deviations
        relative, self.leverages = self._probe(system)
        moved, largest = d.moved(self._effects(system, relative))
        self.deviations = self._with_noise(moved, 2 if largest < PROPORTIONAL else 1)
        change = abs(np.log(self.deviations.noise / d.noise))
        return np.inf if change > NOISE_TOLERANCE else largest

    def _effects(
        self, system: CoupledSystem, relative: Array
    ) -> dict[str, tuple[float, float, int]]:
        """Sum of squares, sum of posterior variances, and number of the effects of each kind;
        relative (2,): as of `_probe`."""
        covariance, shared = system.covariances()
        own, u, d = np.diagonal(covariance, axis1=1, axis2=2), self.unknowns, self.deviations
        seen, m = np.diff(self.readings.starts) > 0, int(self.touched.sum())
        at = self.data.parameters.columns["profile"]
        n, errors = int(seen.sum()), np.sum(u.errors**2, axis=0)
        nuisance = np.sum(u.nuisance[seen] ** 2, axis=0)
        posterior = own[seen].sum(axis=0)
        return {
            "position": (float(errors[:2].sum()), float(relative[0]) * d.position**2, 2 * m),
            "force": (float(errors[2]), float(relative[1]) * d.force**2, m),
            "profile": (float(u.s[at] @ u.s[at]), float(np.trace(shared[at, at])), PROFILE_SIZE),
            "gain": (float(nuisance[0]), float(posterior[2]), n),
            "offset": (float(nuisance[1]), float(posterior[3]), n),
        }

    def _probe(self, system: CoupledSystem) -> tuple[Array, Array]:
        """Sums (2,) over the contacts of the posterior variances of their displacements along both
        tangents, and of ln F, relative to the prior ones; and leverages (k,) of the readings.

        Each leverage has the error of a few probes: they serve for sums of many.
        """
        readings, pattern = self.readings, self.pattern
        jacobian = self.jacobian * (np.sqrt(self._costs()[2]) / self.spread)
        own, shared, at = jacobian[:4], jacobian[4:-CONTACT_SIZE], jacobian[-CONTACT_SIZE:]
        z = self.reading_probes
        # in units of the prior deviations no effect's probe drowns another's
        unit = np.sqrt(self.prior[1])[:, None]
        read = [sums(pattern.by_taxel, (own * probe).T) for probe in z]
        pressed = [sums(pattern.by_contact, (at * probe).T) for probe in z]
        n, ks = pattern.taxels, len(shared)
        x = system.solve(
            np.concatenate([np.stack(read, axis=2), np.zeros((n, 4, PROBES))], axis=2),
            np.concatenate([np.stack(pressed, axis=2), unit * self.probes], axis=2),
            np.concatenate([shared @ z.T, np.zeros((ks, PROBES))], axis=1),
        )
        variances = np.einsum("mic,mic->i", self.probes, unit * x[1][..., PROBES:]) / PROBES
        back = np.einsum("ak,kap->pk", own, x[0][readings.taxel][..., :PROBES])
        back += np.einsum("ak,kap->pk", at, x[1][readings.contact][..., :PROBES])
        back += x[2][:, :PROBES].T @ shared
        relative = np.array([variances[0] + variances[1], variances[2]])
        return relative, np.asarray(np.mean(z * back, axis=0))

    def clear(self) -> np.ndarray:
        """Readings (k,) bool that are predicted well inside the sensor's range, so that their
        residuals are not censored."""
        spread, sigma = self.spread, self.data.sigma
        clear = (self.readings.kind == OBSERVED) & (self.readings.weight > 0.5)
        clear &= self.mu > self.data.threshold / sigma + MIN_CLEARANCE * spread
        clear &= self.mu < self.data.saturation / sigma - MIN_CLEARANCE * spread
        return np.asarray(clear)

    def _with_noise(self, d: Deviations, parts: int) -> Deviations:
        """Deviations with the constant part of the noise from the residuals, or both `parts`."""
        clear = self.clear()
        if self.noise_known or not clear.any():
            return d
        level = self.readings.level[clear] / self.data.sigma
        r2 = np.minimum(np.abs(self.mu[clear] - level), HUBER * self.spread[clear]) ** 2
        return d.with_noise(self.mu[clear], r2, 1 - self.leverages[clear], parts)
