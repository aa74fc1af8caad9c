"""One joint estimation in progress: readings are selected, taxels and global parameters optimized,
and the problem linearized again until nothing moves; misfitting taxels are started again.
"""

from __future__ import annotations

import time
from copy import copy
from dataclasses import replace

import numpy as np

from ...core.arrays import Array
from ...core.errors import UnconvergedError
from ...core.progress import Stage
from ..data.measurements import Measurements
from ..data.pairs import REACH_MARGIN
from . import fault_detection
from .contacts import LinearizedContacts
from .likelihood import Likelihood
from .parametrization import Parametrization, SurfaceParametrization
from .pressure import OBSERVED
from .readings import select
from .reduced_nlp import NEWTON_TOLERANCE, minimize
from .variable_projection import MAX_STEPS, ReducedProblem, State

MAX_RELINEARIZATIONS = 8
"""Largest number of linearizations; two are usual."""
TRIED = 2
"""Linearizations in which a taxel takes all its steps without reaching an optimum, from which it
stays where it is until the next optimization. With contact points 15 mm aside on a link of a UR3e
14 of 96 taxels had none after 40 steps in each of 8 linearizations either; with this limit the
search for outlying readings took 7.6 s of processor time in place of 14.0."""
MAX_DECREMENT = 1e-6
"""Largest Newton decrement of the global parameters at which a solution is accepted: within 1.4e-3
standard deviations of the optimum."""
MESH_TOLERANCE = 1e-4
"""Least Newton decrement asked for where contacts move: within 0.014 standard deviations. Normals
and curvatures of a mesh change discontinuously from face to face, and the linearization with them.
"""
SHORTENED = (1.0, 0.25, 0.06)
"""Parts of a move of the contacts that are tried until the cost decreases."""
CHARTS = 2
"""Linearizations of the taxels' charts after a move of the contacts was taken back."""
MAX_VARIANCE = 1e3, 1e4
"""Variances of the residuals up to which tolerances grow with its square, and with it. Where the
model misfits, standard deviations are as much wider, and Gauss-Newton converges slowly: a decrement
of 1e-8 of the variance is asked for at a variance of 1, of 1e-5 (0.0045 standard deviations) at
1e3 and more."""
MAX_CHI2 = 4.0
"""Chi-square per degree of freedom above which a taxel is started again: readings that are fitted
at the wrong optimum differ by many standard deviations; 20 sound ones exceed it by chance with a
probability of 2e-8."""
MAX_CHI2_UNKNOWN_NOISE = 25.0
"""MAX_CHI2 where the noise is not known: residuals of 5 % of the peak pressure; but at least
MAX_CHI2 times the median taxel's."""
RESTART_IMPROVEMENT = 0.99
"""Fraction of its chi-square below which a restarted taxel is at another, better optimum."""
MIN_DISTANCE = 0.25
"""Distance from its contact centroid, in contact radii, from which a misfitting taxel is started
again: from closer it would converge to where it is."""


class JointEstimator:
    """One joint estimation in progress."""

    def __init__(
        self,
        data: Measurements,
        live: np.ndarray,
        parametrization: Parametrization,
        weight: Array,
        iterations: int,
        tolerance: float = NEWTON_TOLERANCE,
        shared: Array | None = None,
        nuisance: Array | None = None,
        stage: Stage | None = None,
    ) -> None:
        """live: rows of the taxels that are estimated; weight (k,): of the readings; iterations,
        tolerance: as of `maximum_likelihood.optimum`; shared (ks,): values at which the global
        parameters stay, by default they are estimated; nuisance (n, .): start of the taxels';
        stage: its steps are the linearizations.
        """
        self.data, self.live, self.iterations = data, live, iterations
        moving = data.parameters.move_contacts
        self.tolerance = max(tolerance, MESH_TOLERANCE) if moving else tolerance
        self.base_tolerances = self.tolerance, tolerance / 10
        self.weight = weight
        self.silent_weight = np.ones(len(live))
        self.seconds = {"readings": 0.0, "solve": 0.0}
        self.iterates = [parametrization.points()]
        self.faults = np.full(len(data.ids), "", dtype=object)
        self.broken = np.zeros(len(live), dtype=bool)
        self.frozen, self.stage = shared is not None, stage or Stage()
        self.resting: np.ndarray | None = None
        self._last: tuple[ReducedProblem, Array, Array, Array] | None = None
        s = data.parameters.start() if shared is None else shared
        self.contacts = LinearizedContacts(data, s)
        z = None
        if nuisance is not None:
            z = np.concatenate([np.zeros((len(nuisance), parametrization.size)), nuisance], axis=1)
        self.relinearize(parametrization, s, z, select_anew=True)

    def trial(self) -> JointEstimator:
        """A copy at the same point: changes of it leave this one as it is."""
        other = copy(self)
        other.weight, other.silent_weight = self.weight.copy(), self.silent_weight.copy()
        other.iterates, other.faults = list(self.iterates), self.faults.copy()
        return other

    def relinearize(
        self,
        parametrization: Parametrization,
        s: Array,
        z: Array | None = None,
        select_anew: bool = False,
    ) -> None:
        """Linearize at a parametrization, at contacts of s, and with nuisance parameters of z.

        The readings are selected again if asked for, or if taxels or contacts have moved too far.
        """
        contacts = self.contacts = self.contacts.near(self.data, s)
        log_radius = contacts.log_growth(s)
        if select_anew or not self._in_reach(parametrization, contacts, log_radius):
            clock = time.perf_counter()
            points = parametrization.points()
            readings = select(
                contacts.data, self.live, points, parametrization.rotations()[:, :, 2],
                log_radius, self.weight, self.silent_weight,
            )  # fmt: skip
            self.likelihood = Likelihood(self.data, readings)
            self.selected_at = points, contacts.data.points, log_radius
            self.seconds["readings"] += time.perf_counter() - clock
        self.problem = ReducedProblem(
            self.likelihood, parametrization, contacts, resting=self.resting
        )
        self.state = self.problem.start(s, z)
        self._set_tolerances()

    def _set_tolerances(self) -> None:
        """Newton decrements to reach, which grow with the misfit (MAX_VARIANCE)."""
        readings = self.likelihood.readings
        count = float(readings.weight[readings.kind == OBSERVED].sum())
        variance = float(self.state.moments.square.sum()) / max(count, 1.0)
        few, many = (min(max(variance, 1.0), most) for most in MAX_VARIANCE)
        self.slack = few * many
        self.tolerance, self.inner_tolerance = (self.slack * x for x in self.base_tolerances)
        self.problem.inner_tolerance = self.inner_tolerance

    def _in_reach(
        self, parametrization: Parametrization, contacts: LinearizedContacts, log_radius: float
    ) -> bool:
        """Whether the selection of readings is still valid, by half of REACH_MARGIN."""
        points, centres, before = self.selected_at
        moved = np.abs(parametrization.points() - points).max()
        moved += np.abs(contacts.data.points - centres).max()
        grown = float(self.data.longest.max()) * abs(np.exp(log_radius) - np.exp(before))
        return bool(moved + grown < REACH_MARGIN / 2)

    def start_at(self, points: Array, select_anew: bool = False) -> None:
        """Linearize single taxels at other points (n, 3), m; s and nuisance parameters are kept."""
        parametrization = self.problem.parametrization
        assert isinstance(parametrization, SurfaceParametrization)
        z = self.state.z.copy()
        z[:, : parametrization.size] = 0.0
        moved = parametrization.about(self.data.body, points)
        self.relinearize(moved, self.state.s, z, select_anew)

    def converge(self, most: int = MAX_RELINEARIZATIONS, steps: int = MAX_STEPS) -> None:
        """Optimize and linearize until nothing moves; taxels that do not converge, or to the other
        side of the body than their contacts', are marked in `unconverged`. Those that take all
        steps in TRIED linearizations stay where they are.

        most: linearizations; steps: Gauss-Newton steps of a taxel in each. Raises CalibrationError
        if the global parameters do not converge.
        """
        status, clock = "", time.perf_counter()
        self.problem.evaluations, count = 0.0, self.problem.parametrization.count
        self.resting, tried = np.zeros(count, dtype=bool), np.zeros(count, dtype=int)
        self.problem.resting = self.resting
        for iteration in range(most):
            problem = self.problem
            far = problem.blocks(self.state).decrement > self.tolerance
            self.unconverged = far[problem.parametrization.group]
            moving = bool((far & ~self.resting).any())
            if not (moving or self.frozen):
                moving = problem.reduce(self.state).decrement > self.tolerance
            if iteration and not moving:
                break
            exact = self.frozen or self.data.parameters.move_contacts
            decrement = 0.0 if exact else problem.reduce(self.state).decrement
            problem.solve_inner(self.state, most=steps, decrement=decrement)
            tried += self.state.decrement > problem.tolerance(decrement)
            self.resting = problem.resting = tried >= TRIED
            here = problem, self.likelihood, self.selected_at, self.state
            self.stage.step()
            self.record(self.state)
            if not self.frozen:
                status = self._solve_shared(status)
            self._relinearize_here()
            moved = not self.frozen and self.data.parameters.move_contacts
            if moved and not self._decreases(here, steps):
                break
        if isinstance(self.problem.parametrization, SurfaceParametrization):
            self.unconverged |= self.problem.parametrization.on_other_side
        self.resting = self.problem.resting = None
        self.seconds["solve"] += time.perf_counter() - clock

    def _relinearize_here(self) -> None:
        """Linearize at the present state."""
        before, z, size = self.problem, self.state.z.copy(), self.problem.parametrization.size
        relinearized = before.parametrization.relinearized(self.data.body, z[:, :size])
        z[:, :size] = 0.0
        self.relinearize(relinearized, self.state.s, z)
        self.problem.evaluations = before.evaluations

    def _decreases(
        self,
        before: tuple[ReducedProblem, Likelihood, tuple[Array, Array, float], State],
        steps: int,
    ) -> bool:
        """Whether the cost where contacts have moved to is lower than `before`, after their move
        is shortened if need be; if not, the estimate is back there.

        Contacts are linearized where they were: beyond an edge of the mesh their normals are
        others, and a step that lowers the linearized cost may raise the cost itself.
        """
        problem, likelihood, selected_at, state = before
        cost, s = problem.reduce(state).cost, self.state.s
        for part in SHORTENED:
            if part < 1.0:
                shorter, spent = state.s + part * (s - state.s), self.problem.evaluations
                self.relinearize(problem.parametrization, shorter, state.z)
                self.problem.evaluations = spent
            self.problem.solve_inner(self.state, most=steps)
            if self.problem.reduce(self.state).cost < cost + self.tolerance:
                return True
        self.problem, self.likelihood, self.selected_at = problem, likelihood, selected_at
        self.state = state
        for _ in range(CHARTS):
            self._relinearize_here()
            self.problem.solve_inner(self.state, most=steps)
        self._relinearize_here()
        decrement = self.problem.blocks(self.state).decrement
        self.unconverged = (decrement > self.tolerance)[problem.parametrization.group]
        return False

    def _solve_shared(self, status: str) -> str:
        """Bring the global parameters to their optimum; returns IPOPT's status, the last one where
        they are there already. Raises CalibrationError if they do not converge."""
        problem = self.problem
        reduced = problem.reduce(self.state)
        if reduced.decrement > self.tolerance:
            self.state, status = minimize(
                problem, self.state, self.iterations, self.record, self.tolerance
            )
            reduced = problem.reduce(self.state)
        least = max(MAX_DECREMENT, 1e-9 * len(self.data.pressure)) * self.slack
        limit = max(least, 100 * self.tolerance)
        if not reduced.decrement < limit:
            more = "; raise the iteration limit, calibrate(iterations=...)"
            raise UnconvergedError(
                "the joint estimate did not converge",
                value=f"Newton decrement {reduced.decrement:.3g}, {status}",
                limit=limit,
                remedy="check the scale of pressures and forces, that points and readings have the "
                "same times, the contact model and the noise"
                + (more if status == "Maximum_Iterations_Exceeded" else ""),
            )
        return status

    def record(self, state: State) -> None:
        """Keep the points of an intermediate state."""
        self.iterates.append(self.problem.points(state))

    @property
    def chi2(self) -> Array:
        """Squared residuals per degree of freedom (n,), outliers included; NaN with none left."""
        readings, n = self.likelihood.readings, len(self.live)
        observed = readings.kind == OBSERVED
        square = np.bincount(readings.taxel[observed], self.residuals()[observed] ** 2, n)
        parametrization = self.problem.parametrization
        sizes = np.bincount(parametrization.group, minlength=parametrization.count)
        count = np.bincount(readings.taxel[observed], minlength=n)
        freedom = count - self.problem.per_taxel
        freedom = freedom - parametrization.size / sizes[parametrization.group]
        return np.asarray(square / np.where(freedom > 0, freedom, np.nan))

    def restart(self, centroids: Array) -> np.ndarray:
        """Start misfitting taxels again from `centroids` (n, 3), m, where they are away from these;
        keep what fits better.

        Returns the rows of the taxels that were moved.
        """
        parametrization, before = self.problem.parametrization, self.chi2
        known = before[np.isfinite(before)]
        typical = float(np.median(known)) if len(known) else 1.0
        limit = MAX_CHI2
        if self.data.noise is None:
            limit = max(MAX_CHI2_UNKNOWN_NOISE, MAX_CHI2 * typical)
        off = np.linalg.norm(self.problem.points(self.state) - centroids, axis=1)
        close = off <= MIN_DISTANCE * float(np.median(self.data.radii))
        bad = np.flatnonzero(((before > limit) & ~close) | self.unconverged)
        if not len(bad) or not isinstance(parametrization, SurfaceParametrization):
            return bad[:0]
        kept, unconverged = self.state, self.unconverged
        previous = self.problem, self.likelihood, self.selected_at
        points = parametrization.points().copy()
        points[bad] = centroids[bad]
        self.start_at(points, select_anew=True)
        self.problem.solve_inner(self.state, bad)
        solved = self.state.decrement[bad] <= self.problem.inner_tolerance
        # Not by the cost, which counts silent readings: at another place they are others.
        improved = self.chi2[bad] < RESTART_IMPROVEMENT * before[bad]
        better = bad[improved | (solved & unconverged[bad])]
        found = self.problem.points(self.state)
        (self.problem, self.likelihood, self.selected_at), self.state = previous, kept
        if len(better):
            points = parametrization.points().copy()
            points[better] = found[better]
            self.start_at(points, select_anew=True)
            self.converge()
        return better

    def residuals(self) -> Array:
        """Residuals (k,) of the selected readings at the present state, in units of the noise; the
        last ones are kept."""
        problem, state = self.problem, self.state
        if self._last is not None:
            known, z, s, r = self._last
            if known is problem and np.array_equal(z, state.z) and np.array_equal(s, state.s):
                return r
        nuisance, contacts = problem.nuisance(state.z), problem.contacts.at(state.s)
        mu = self.likelihood.means(problem.points(state), nuisance, contacts)
        r = fault_detection.residuals(self.likelihood.readings, mu, self.data.sigma)
        self._last = problem, state.z.copy(), state.s.copy(), r
        return r

    def reweight(self, weight: Array) -> None:
        """Give the readings other weights (k,), and linearize at the present state."""
        readings = replace(self.likelihood.readings, weight=weight)
        measured = readings.source >= 0
        self.weight[readings.source[measured]] = weight[measured]
        self.likelihood = replace(self.likelihood, readings=readings)
        self.relinearize(self.problem.parametrization, self.state.s, self.state.z)
