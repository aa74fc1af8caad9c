"""Joint maximum likelihood: all readings of all contacts, every unknown at once.

Unknown are two coordinates of every taxel in a chart of the surface, or the poses of rigid modules,
gains and offsets where declared, and what all share (E*, force, indenter, body). The taxels are
eliminated from the shared unknowns (eliminate.py), which IPOPT finds (solve.py). Charts and
contacts are anchored anew at the solution until nothing moves, so that every taxel ends on the
surface. The Hessian is Gauss-Newton throughout: the exact one finds wrong optima from starts as
near as 0.7 mm. IPOPT's status is not believed: the Newton decrement and every taxel's chi-square
are, and a taxel that misfits is started again from the centroid of its contacts.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from ..errors import CalibrationError
from ..se3 import Array
from . import chart, trilaterate
from .eliminate import SETTLED, Problem, Reduced, State
from .factors.shared import Anchored, anchored
from .likelihood import Likelihood, select
from .measurements import SPARE, Measurements
from .places import Free, Places
from .solve import ITERATIONS, minimise

if TYPE_CHECKING:
    from ..geometry.body import Body

RESTLESS = "no place where it comes to rest"
"""Why a taxel is not determined though its trilateration is."""
PASSES = 8
"""Most anchorings; two are usual."""
STILL = 1e-9
"""Move of the taxels at which the anchoring ends, m."""
DECREMENT = 1e-6
"""Largest Newton decrement, in units of the cost, at which a solution is believed."""
MISFIT = 4.0
"""Chi-square per degree of freedom, relative to the median's, that starts a taxel again."""
MISFIT_NOMINAL = 25.0
"""The same where the noise is not known: residuals of 5 % of the peak pressure."""


@dataclass(frozen=True)
class Joint:
    """The joint estimate of n taxels; entries of taxels that are not determined are NaN or inf."""

    points: Array
    """(n, 3) on the surface, body frame, m."""
    rotations: Array
    """Frames (n, 3, 3), z the outward normal; the spin is a convention."""
    covariance: Array
    """(n, 2, 2) in the tangent plane, m^2, all else being unknown too."""
    shared: Array
    """The shared unknowns (ks,), as `data.shared` orders them."""
    shared_covariance: Array
    """(ks, ks)."""
    information: Array
    """What the readings alone say of the shared unknowns (ks, ks)."""
    extras: Array
    """ln gain and offset (Pa) of each taxel (n, extras), as far as they are declared."""
    extras_sigma: Array
    """Their standard deviations (n, extras)."""
    chi2: Array
    """Of the readings of each taxel, per degree of freedom (n,)."""
    why: np.ndarray
    """Why a taxel is not determined (n,); "" where it is."""
    iterates: tuple[Array, ...]
    """Points (n, 3) along the way, the start first."""
    restarted: np.ndarray
    """Rows of taxels that were started again."""
    data: Measurements
    """What was estimated from."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Seconds of choosing the readings, of settling and solving, and of all."""

    @property
    def modulus(self) -> float:
        """E*, Pa."""
        return self.data.modulus * float(np.exp(self.data.shared.value("modulus", self.shared)))

    @property
    def modulus_sigma(self) -> float:
        """Its standard deviation, Pa; 0 where it was not estimated."""
        columns = self.data.shared.columns
        if "modulus" not in columns:
            return 0.0
        k = columns["modulus"].start
        return self.modulus * float(np.sqrt(self.shared_covariance[k, k]))


def estimate(
    data: Measurements,
    body: Body,
    start: trilaterate.Fit | None = None,
    iterations: int = ITERATIONS,
) -> Joint:
    """The most likely unknowns, from the least-squares trilateration as a start.

    `iterations`: the most that IPOPT may take. Raises CalibrationError if no taxel is determined or
    the optimiser does not converge.
    """
    clock = time.perf_counter()
    start = start or trilaterate.least_squares(data, body)
    live = np.flatnonzero(start.found)
    if not len(live):
        raise CalibrationError(
            "no taxel is determined by the recording",
            value=", ".join(sorted(set(map(str, start.why)))),
            remedy="touch every taxel from at least three contacts that are not on a line",
        )
    charts = chart.about(body, start.points[live], start.rotations[live])
    run = Run(data, body, live, Free(charts, step=float(np.median(data.radii)) / 2), iterations)
    run.converge()
    again = run.restart(trilaterate.centroids(data, body)[live])
    if run.restless.all():
        raise CalibrationError(
            "the joint estimate does not come to rest",
            value=f"{len(live)} taxels still move after {PASSES} anchorings",
            remedy="check the contact model and the units of force and pressure",
        )
    return run.result(start.why, again, clock)


class Run:
    """One estimation under way."""

    def __init__(
        self, data: Measurements, body: Body, live: np.ndarray, places: Places, iterations: int
    ) -> None:
        self.data, self.body, self.live, self.iterations = data, body, live, iterations
        self.weight = np.ones(len(data.pressure))
        self.seconds = {"readings": 0.0, "solve": 0.0}
        self.iterates = [places.points()]
        self.anchor(places, np.zeros(len(data.shared.sigma)), select_anew=True)

    def anchor(
        self, places: Places, s: Array, z: Array | None = None, select_anew: bool = False
    ) -> None:
        """Take up places and contacts anchored at s, with gains and offsets from z (G, D)."""
        contacts = anchored(self.data.shared, self.data, self.body, s)
        stretch = float(np.median(np.log(contacts.at(s).radii / self.data.radii)))
        if select_anew or not self._covers(places, contacts, stretch):
            clock = time.perf_counter()
            points = places.points()
            readings = select(contacts.data, self.live, points, stretch, self.weight)
            self.likelihood = Likelihood(self.data, readings, self.data.shared)
            self.about = points, contacts.data.points, stretch
            self.seconds["readings"] += time.perf_counter() - clock
        self.problem = Problem(self.likelihood, places, contacts)
        self.state = self.problem.start(s, z)

    def _covers(self, places: Places, contacts: Anchored, stretch: float) -> bool:
        """Whether what was judged to be in reach still is, with SPARE to spare."""
        points, centres, before = self.about
        moved = (
            np.abs(places.points() - points).max() + np.abs(contacts.data.points - centres).max()
        )
        grown = float(self.data.radii.max()) * abs(np.exp(stretch) - np.exp(before))
        return bool(moved + grown < SPARE / 2)

    def converge(self) -> None:
        """Settle, solve and anchor anew until all stands still; `restless` are taxels that do not.

        Raises CalibrationError without convergence.
        """
        status = ""
        clock = time.perf_counter()
        for turn in range(PASSES):
            problem = self.problem
            problem.settle(self.state)
            left = problem.reduce(self.state)
            self._watch(self.state)
            if left.decrement > DECREMENT * 1e-2:
                self.state, status = minimise(problem, self.state, self.iterations, self._watch)
                left = problem.reduce(self.state)
            self._check(left, status)
            still = self._still()
            if still and turn:
                break
            z, size = self.state.z.copy(), problem.places.size
            places = problem.places.anchored(self.body, z[:, :size])
            z[:, :size] = 0.0
            self.anchor(places, self.state.s, z)
        self.seconds["solve"] += time.perf_counter() - clock

    def _check(self, left: Reduced, status: str) -> None:
        if not left.decrement < max(DECREMENT, 1e-9 * len(self.data.pressure)):
            raise CalibrationError(
                "the joint estimate did not converge",
                value=f"Newton decrement {left.decrement:.3g}, {status}",
                limit=DECREMENT,
                remedy="raise the iteration limit; check the contact model, the noise and the "
                "units of force and pressure",
            )

    def _still(self) -> bool:
        """Note which taxels still move; whether none does."""
        size = self.problem.places.size
        moved = np.abs(self.state.z[:, :size]).max(axis=1)
        unsettled = self.state.decrement > 1e3 * SETTLED
        self.restless = ((moved >= STILL) | unsettled)[self.problem.places.group]
        return not self.restless.any()

    def _watch(self, state: State) -> None:
        self.iterates.append(self.problem.points(state))

    @property
    def chi2(self) -> Array:
        """Squared residuals per degree of freedom (n,); NaN with none left."""
        readings = self.likelihood.readings
        heard = np.bincount(readings.taxel, readings.weight * (readings.kind == 0), len(self.live))
        places = self.problem.places
        sizes = np.bincount(places.group, minlength=places.count)
        freedom = heard - places.size / sizes[places.group] - self.problem.extra
        return self.state.moments.square / np.where(freedom > 0, freedom, np.nan)

    def restart(self, centroids: Array) -> np.ndarray:
        """Start misfitting taxels again from `centroids` (n, 3); keep what fits better.

        Returns the rows of the taxels that were moved.
        """
        places, before = self.problem.places, self.chi2
        limit = max(
            MISFIT if self.data.noise else MISFIT_NOMINAL, MISFIT * float(np.nanmedian(before))
        )
        bad = np.flatnonzero((before > limit) | self.restless)
        if not len(bad) or not isinstance(places, Free):
            return bad[:0]
        kept, restless = self.state, self.restless
        points = places.points().copy()
        points[bad] = centroids[bad]
        z = kept.z.copy()
        z[:, : places.size] = 0.0
        moved = places.about(self.body, points)
        self.anchor(moved, kept.s, z, select_anew=True)
        self.problem.settle(self.state, bad)
        settled = self.state.decrement[bad] <= SETTLED
        # The cost counts silent readings, too; readings of other places are other readings.
        better = bad[(self.chi2[bad] < before[bad]) | (settled & restless[bad])]
        points = places.points().copy()
        points[better] = self.problem.points(self.state)[better]
        self.anchor(places.about(self.body, points), kept.s, z, select_anew=True)
        self.converge()
        return better

    def result(self, why: np.ndarray, again: np.ndarray, clock: float) -> Joint:
        """What was found, of all taxels."""
        data, problem, state = self.data, self.problem, self.state
        reduced = problem.reduce(state)
        covariance, shared = problem.covariances(state, reduced)
        covariance[self.restless] = np.diag([np.inf] * problem.width)
        why = why.copy()
        why[self.live[self.restless]] = RESTLESS
        points = np.where(self.restless[:, None], np.nan, problem.places.points())
        chi2, heard = self.chi2, int(np.sum(self.likelihood.readings.kind == 0))
        freedom = heard - state.z.size - len(state.s)
        scale = 1.0 if data.noise else float(state.moments.square.sum()) / max(freedom, 1)
        groups = np.arange(problem.places.count)
        sigma = np.sqrt(scale * np.diagonal(covariance, axis1=1, axis2=2))
        unit = [data.sigma if name == "offset" else 1.0 for name in data.shared.local_names]

        def spread(values: Array, missing: object) -> Array:
            out = np.empty((len(data.ids), *values.shape[1:]))
            out[:] = missing
            out[self.live] = values
            return out

        return Joint(
            points=spread(points, np.nan),
            rotations=spread(problem.places.rotations(), np.nan),
            covariance=spread(scale * covariance[:, :2, :2], np.diag([np.inf, np.inf])),
            shared=state.s,
            shared_covariance=scale * shared,
            information=problem.information(state) / scale,
            extras=spread(problem.extras(state.z, groups) * unit, np.nan),
            extras_sigma=spread(problem.extras(sigma, groups) * unit, np.inf),
            chi2=spread(chi2 / scale, np.nan),
            why=why,
            iterates=tuple(spread(p, np.nan) for p in self.iterates),
            restarted=self.live[again],
            data=data,
            seconds=self.seconds | {"joint": time.perf_counter() - clock},
        )
