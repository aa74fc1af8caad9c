"""One joint estimation under way: readings chosen, taxels settled, shared unknowns solved, anchors
renewed until nothing moves, and misfits started again.
"""

from __future__ import annotations

import time
from copy import copy
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from ...core.errors import CalibrationError
from ...core.se3 import Array
from ..data.measurements import Measurements
from ..data.pairs import SPARE
from . import fault_detection
from .contacts import LinearizedContacts
from .likelihood import Likelihood, select
from .newton import NEWTON_TOLERANCE, minimize
from .parametrization import Parametrization, SurfaceParametrization
from .pressure import OBSERVED
from .variable_projection import ReducedProblem, SchurComplement, State

if TYPE_CHECKING:
    from ...geometry.body import Body

MAX_RELINEARIZATIONS = 8
"""Most anchorings; two are usual."""
DECREMENT = 1e-6
"""Largest Newton decrement of the shared unknowns at which a solution is believed."""
ROUGH = 1e-4
"""Newton decrement at which an estimate rests whose contacts move: 0.014 standard deviations. On a
mesh normals and curvatures jump a little from face to face, and with them what is anchored anew."""
MISFIT = 4.0
"""Chi-square per degree of freedom that starts a taxel again: all of them, if all began far off."""
ELSEWHERE = 0.99
"""Part of its chi-square to which a fresh start must bring a taxel: else it came back."""
MISFIT_NOMINAL = 25.0
"""The same where the noise is not known: residuals of 5 % of the peak pressure; but no less than
MISFIT times the median's."""

NEARBY = 0.25
"""Distance from its centroid, in contact radii, within which a taxel has not gone astray: from
there it would come back to where it is."""


class JointEstimator:
    """One estimation under way."""

    def __init__(
        self,
        data: Measurements,
        body: Body,
        live: np.ndarray,
        places: Parametrization,
        weight: Array,
        iterations: int,
        tolerance: float = NEWTON_TOLERANCE,
    ) -> None:
        self.data, self.body, self.live, self.iterations = data, body, live, iterations
        self.tolerance = max(tolerance, ROUGH) if data.shared.moving else tolerance
        self.inner_tolerance = tolerance / 10
        self.weight = weight
        self.silent_weight = np.ones(len(live))
        self.seconds = {"readings": 0.0, "solve": 0.0}
        self.iterates = [places.points()]
        self.faults = np.full(len(data.ids), "", dtype=object)
        self.broken = np.zeros(len(live), dtype=bool)
        self.relinearize(places, np.zeros(len(data.shared.sigma)), select_anew=True)

    def trial(self) -> JointEstimator:
        """Another run from the same point: what is tried in it leaves this one as it is."""
        other = copy(self)
        other.weight, other.silent_weight = self.weight.copy(), self.silent_weight.copy()
        other.iterates, other.faults = list(self.iterates), self.faults.copy()
        return other

    def relinearize(
        self, places: Parametrization, s: Array, z: Array | None = None, select_anew: bool = False
    ) -> None:
        """Take up places and contacts anchored at s, with gains and offsets from z (G, D)."""
        contacts = LinearizedContacts(self.data.shared, self.data, self.body, s)
        stretch = float(np.median(np.log(contacts.at(s).radii / self.data.radii)))
        if select_anew or not self._covers(places, contacts, stretch):
            clock = time.perf_counter()
            points = places.points()
            readings = select(
                contacts.data, self.live, points, stretch, self.weight, self.silent_weight
            )
            self.likelihood = Likelihood(self.data, readings, self.data.shared)
            self.about = points, contacts.data.points, stretch
            self.seconds["readings"] += time.perf_counter() - clock
        self.problem = ReducedProblem(self.likelihood, places, contacts, self.inner_tolerance)
        self.state = self.problem.start(s, z)

    def _covers(
        self, places: Parametrization, contacts: LinearizedContacts, stretch: float
    ) -> bool:
        """Whether what was judged to be in reach still is, with SPARE to spare."""
        points, centres, before = self.about
        moved = (
            np.abs(places.points() - points).max() + np.abs(contacts.data.points - centres).max()
        )
        grown = float(self.data.longest.max()) * abs(np.exp(stretch) - np.exp(before))
        return bool(moved + grown < SPARE / 2)

    def converge(self) -> None:
        """Settle, solve and anchor anew until all stands still; `restless` are taxels that do not.

        Raises CalibrationError without convergence.
        """
        status, clock = "", time.perf_counter()
        for turn in range(MAX_RELINEARIZATIONS):
            problem, fresh = self.problem, self.problem.blocks(self.state)
            self.unconverged = (fresh.decrement > self.tolerance)[problem.parametrization.group]
            moving = self.unconverged.any() or problem.reduce(self.state).decrement > self.tolerance
            if turn and not moving:
                break
            problem.solve_inner(self.state)
            left = problem.reduce(self.state)
            self.watch(self.state)
            if left.decrement > self.tolerance:
                self.state, status = minimize(
                    problem, self.state, self.iterations, self.watch, self.tolerance
                )
                left = problem.reduce(self.state)
            self._check(left, status)
            z, size = self.state.z.copy(), problem.parametrization.size
            places = problem.parametrization.relinearized(self.body, z[:, :size])
            z[:, :size] = 0.0
            self.relinearize(places, self.state.s, z)
        self.seconds["solve"] += time.perf_counter() - clock

    def _check(self, left: SchurComplement, status: str) -> None:
        believed = max(DECREMENT, 100 * self.tolerance, 1e-9 * len(self.data.pressure))
        if not left.decrement < believed:
            raise CalibrationError(
                "the joint estimate did not converge",
                value=f"Newton decrement {left.decrement:.3g}, {status}",
                limit=DECREMENT,
                remedy="raise the iteration limit; check the contact model, the noise and the "
                "units of force and pressure",
            )

    def watch(self, state: State) -> None:
        """Keep the points of a state under way."""
        self.iterates.append(self.problem.points(state))

    @property
    def chi2(self) -> Array:
        """Squared residuals per degree of freedom (n,), of outlying readings, too; NaN with none
        left."""
        readings, n = self.likelihood.readings, len(self.live)
        heard = readings.kind == OBSERVED
        square = np.bincount(readings.taxel[heard], self.residuals()[heard] ** 2, n)
        places = self.problem.parametrization
        sizes = np.bincount(places.group, minlength=places.count)
        freedom = np.bincount(readings.taxel[heard], minlength=n) - self.problem.extra
        freedom = freedom - places.size / sizes[places.group]
        return np.asarray(square / np.where(freedom > 0, freedom, np.nan))

    def restart(self, centroids: Array) -> np.ndarray:
        """Start misfitting taxels again from `centroids` (n, 3), where they have gone away from
        these; keep what fits better.

        Returns the rows of the taxels that were moved.
        """
        places, before = self.problem.parametrization, self.chi2
        known = before[np.isfinite(before)]
        typical = float(np.median(known)) if len(known) else 1.0
        limit = MISFIT if self.data.noise else max(MISFIT_NOMINAL, MISFIT * typical)
        off = np.linalg.norm(self.problem.points(self.state) - centroids, axis=1)
        astray = (before > limit) & ~(off <= NEARBY * float(np.median(self.data.radii)))
        bad = np.flatnonzero(astray | self.unconverged)
        if not len(bad) or not isinstance(places, SurfaceParametrization):
            return bad[:0]
        kept, restless = self.state, self.unconverged
        standing = self.problem, self.likelihood, self.about
        points = places.points().copy()
        points[bad] = centroids[bad]
        z = kept.z.copy()
        z[:, : places.size] = 0.0
        moved = places.about(self.body, points)
        self.relinearize(moved, kept.s, z, select_anew=True)
        self.problem.solve_inner(self.state, bad)
        settled = self.state.decrement[bad] <= self.problem.inner_tolerance
        # The cost counts silent readings, too; readings of other places are other readings.
        better = bad[(self.chi2[bad] < ELSEWHERE * before[bad]) | (settled & restless[bad])]
        if not len(better):
            (self.problem, self.likelihood, self.about), self.state = standing, kept
            return better
        points = places.points().copy()
        points[better] = self.problem.points(self.state)[better]
        self.relinearize(places.about(self.body, points), kept.s, z, select_anew=True)
        self.converge()
        return better

    def residuals(self) -> Array:
        problem, state = self.problem, self.state
        extras = problem.extras(state.z, np.arange(problem.parametrization.count))
        mu = self.likelihood.means(problem.points(state), extras, problem.contacts.at(state.s))
        return fault_detection.residuals(self.likelihood.readings, mu, self.data.sigma)

    def reweight(self, weight: Array) -> None:
        """Give the readings other weights, and take up the state anew."""
        readings = replace(self.likelihood.readings, weight=weight)
        heard = readings.source >= 0
        self.weight[readings.source[heard]] = weight[heard]
        self.likelihood = replace(self.likelihood, readings=readings)
        self.relinearize(self.problem.parametrization, self.state.s, self.state.z)
