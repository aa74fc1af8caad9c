"""The running estimate: readings are added as they come, and taxels that moved are estimated anew.

A new reading is linearized at the present estimate of its taxel and added to the taxel's normal
equations. Earlier readings stay linearized where the taxel was then; once it has moved by more than
that bears, it waits for being estimated anew from all its readings by the joint estimator, with the
global parameters as they are.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import replace
from typing import Any

import numpy as np

from ...core.arrays import Array
from .. import chart
from ..data.measurements import Measurements
from ..data.pairs import MAX_SLANT, REACH_MARGIN
from ..joint.contacts import LinearizedContacts
from ..joint.joint_estimator import JointEstimator
from ..joint.rival_optima import OPEN_SECTOR, finish, open_sectors
from .information import TaxelInformation
from .linearization import (
    NewReadings,
    advance,
    contradictions,
    examine,
    local_estimator,
    new_readings,
    summary,
)
from .store import ContactStore, Part

TOLERANCE = 0.001
"""Move of a taxel, in contact radii, of ln gain, or of the global parameters in prior standard
deviations, from which it is estimated anew. A move of 0.003 leaves an estimate up to 0.013 of its
standard deviation from the batch estimate, one of 0.001 up to 0.004, in the same time a frame
(studies/speed/online.py)."""
MAX_MOVE = 0.5
"""Move up to which a linear estimate is believed until then; `SurfaceParametrization.step`."""
THRESHOLD_STEP = 0.05
"""Change of the threshold, in standard deviations of a reading, from which silent readings are
linearized again: the threshold is the smallest reading where none is believed."""
MIN_READINGS = 3
"""Readings from which a taxel is placed: three circles have one point in common."""
GROWTH = 1.25
"""Growth of the number of readings from one attempt to place or examine a taxel to the next."""
MEASURED = 20
"""Contacts after which their sizes are measured again: the global parameters change slowly."""
CHUNK = 256
"""Taxels estimated anew at once, at most: bounds the memory."""
EXAMINED = 2
"""Taxels examined at once: some 33 parts of 4 ms (studies/speed/online.py)."""


class RunningEstimate:
    """Estimates of n taxels and of the global parameters from the contacts so far."""

    def __init__(
        self, first: Measurements, known: Array | None = None, widening: float = 1.0
    ) -> None:
        """first: measurements without contacts, which have all else; known (ks,): the global
        parameters, where contacts are given with their errors; widening: factor of the standard
        deviations then."""
        n, self._known, self.widening = len(first.ids), known, widening
        self.store = ContactStore(first)
        self.parameters, self.sigma = first.parameters, first.sigma
        if known is not None:
            self.parameters = replace(first.parameters, names=(), sigma=np.empty(0))
        self.information = TaxelInformation(n, self.parameters, first.sigma)
        self._measure_at, self._shift, self._growth = 0, 0.0, 1.0
        self.radius = self.reach = 0.0
        """Median radius of the contacts, and the furthest that a taxel may be to respond, m."""
        self.misfit = False
        """Whether the model misfits: set by who tests it."""
        self.fits = np.zeros(n, dtype=bool)
        self.continued = np.zeros(n, dtype=bool)
        """Taxels (n,) that need more steps from where they are."""
        self.moved = np.zeros(n)
        self.tried, self.searched = np.zeros(n, dtype=int), np.zeros(n, dtype=int)
        """Readings (n,) of each taxel when it was estimated anew, and searched for, last."""
        self.examined = np.zeros(n, dtype=int)
        """Readings (n,) of each taxel when it was examined last."""
        self.unique = np.zeros(n, dtype=bool)
        self.spread, self.sector = np.zeros((n, 2, 2)), np.full(n, 2 * np.pi)
        self.residual = np.nan  # as `OnlineStatus.residual`
        self.square, self.freedom = np.zeros(n), np.zeros(n)
        """Squared residuals of each taxel (n,), in units of the noise, and their expectation."""
        self.outlying = np.zeros(n, dtype=int)
        self.linearized_threshold = np.full(n, np.inf)
        self.last_read = np.zeros(n, dtype=int)
        """Contact (n,) that each taxel was read in last."""
        self._examination: Generator[None, None, None] | None = None
        self._begun: tuple[np.ndarray, JointEstimator, Part] | None = None

    @property
    def s(self) -> Array:
        """The global parameters (ks,): known, or as estimated."""
        return self.information.s if self._known is None else self._known

    @property
    def open(self) -> np.ndarray:
        """Placed taxels (n,) bool whose contacts leave a wide sector of directions open."""
        return np.asarray(self.information.placed & (self.sector > OPEN_SECTOR))

    @property
    def covariances(self) -> Array:
        """Covariances (n, 2, 2), m^2, along the charts' tangents; inf where not placed. Where the
        model misfits, or the noise is nominal, they are as wide as the batch estimate's: by the
        variance of the residuals, and the distance from the pressure-weighted mean of the contact
        points. Where global parameters are known, times the square of `widening`."""
        info, spread = self.information, np.where(self.open[:, None, None], self.spread, 0.0)
        found = self.widening**2 * info.covariance[:, :2, :2] + spread
        if self.misfit or self.store.noise_is_nominal:
            found = self.scale**2 * found
            apart = np.nan_to_num(self.store.means - info.points(np.arange(len(found))))
            found += (1 - self.scale**-2) * chart.tangential_square(info.charts.tangents, apart)
        return np.where(info.placed[:, None, None], found, np.diag([np.inf, np.inf]))

    @property
    def sure(self) -> np.ndarray:
        """Placed taxels (n,) bool whose readings fit and allow one place."""
        examined = self.unique & (GROWTH * self.examined >= self.store.counts)
        return np.asarray(self.information.placed & self.fits & (~self.open | examined))

    @property
    def determined(self) -> np.ndarray:
        """Taxels (n,) bool whose readings fit and allow one place, within a contact radius."""
        found = self.sure & (self.moved < MAX_MOVE)
        worst = np.full(len(found), np.inf)
        worst[found] = np.linalg.eigvalsh(self.covariances[found])[:, 1]
        return np.asarray(worst < self.radius**2)

    @property
    def scale(self) -> float:
        """Standard deviation of the residuals of the typical taxel, in units of the noise, or 1."""
        many = self.information.placed & (self.freedom >= 5)
        if not many.any():
            return 1.0
        return max(1.0, float(np.median(self.square[many] / self.freedom[many])) ** 0.5)

    def add(self, block: Measurements, readings: tuple[np.ndarray, np.ndarray, Array]) -> None:
        """Add the contacts of `block` and contact, taxel and pressure (k,) of their readings."""
        first, first_reading = self.store.append(block, readings)
        taxel = readings[1]
        self.last_read[taxel] = self.store.count
        self._measure(block)
        rows = self.near(block.points, taxel)
        if not len(rows):
            return
        info = self.information
        part = self.store.part(rows, np.arange(first, self.store.count), first_reading)
        new = self.linearized(part, rows)
        if new.clear.any():
            self.residual = float(np.sqrt(np.mean(new.residual[new.clear] ** 2)))
        sure = self.fits[rows[new.taxel]]  # taxels on their way contradict whatever comes
        beyond, rejected = contradictions(new, sure, len(block.force), self.scale)
        self.store.misfitting.values[first:] = rejected
        used = ~rejected[new.contact]
        owner = rows[new.taxel]
        np.add.at(self.outlying, owner[used & beyond], 1)
        suspects = owner[used & beyond]
        self.moved[suspects] = np.maximum(self.moved[suspects], 2 * TOLERANCE)
        used &= ~beyond
        info.add(owner[used], new.jacobian[used], new.rate[used], new.curvature[used])
        np.add.at(self.square, owner[used & new.clear], new.residual[used & new.clear] ** 2)
        np.add.at(self.freedom, owner[used & new.clear], 1.0)

    def linearized(self, part: Part, rows: np.ndarray) -> NewReadings:
        """The readings of a part, of the placed taxels `rows`, at the present estimates."""
        info = self.information
        return new_readings(
            part.data, info.charts[rows], info.step[rows, :2], info.nuisances(rows), self.s,
            info.joint_covariance(rows),
        )  # fmt: skip

    def refer(self, template: Measurements) -> None:
        """Take another noise, contact model or other priors; all taxels wait."""
        ratio, info = self.sigma / template.sigma, self.information
        self.store.refer(template)
        if self._known is None:
            self.parameters = template.parameters
        info.rescale(ratio)
        info.take_priors(self.parameters, template.sigma)
        self.sigma, self.square = template.sigma, self.square * ratio**2
        first, second = (self.store.patches[name].values for name in ("first", "second"))
        self.radius = float(np.median(np.sqrt(first * second)))
        self._measure_at = 0
        self.linearized_threshold[:] = np.inf

    def solve(self) -> None:
        """Bring estimates and moves up to date."""
        info = self.information
        info.solve()
        move = np.linalg.norm(info.step[:, :2], axis=1) / max(self.radius, 1e-9)
        if len(self.parameters.nuisance_names) and self.parameters.nuisance_names[0] == "gain":
            move = np.maximum(move, np.abs(info.step[:, 2]))
        shared = np.abs(info.s - info.shared) / self.parameters.sigma
        move = np.maximum(move, shared.max(axis=1, initial=0.0))
        self.moved = np.where(info.placed, np.maximum(self.moved, move), 0.0)

    def waiting(self, tolerance: float = TOLERANCE) -> np.ndarray:
        """Taxels that are to be placed or estimated anew, the most urgent first.

        tolerance: of moves."""
        info, counts = self.information, self.store.counts
        stale = (self.linearized_threshold - self.store.threshold) / (THRESHOLD_STEP * self.sigma)
        score = np.maximum(self.moved / tolerance, np.where(info.placed, stale, 0.0))
        unsettled = (counts >= MIN_READINGS) & ~(info.placed & self.fits)
        due = self.continued | (counts >= GROWTH * self.tried)
        score[unsettled] = np.where(due, 1 / tolerance, 0.0)[unsettled]
        rows = np.flatnonzero(score > 1)
        return rows[np.argsort(-score[rows], kind="stable")]

    def estimate_anew(self, rows: np.ndarray) -> None:
        """Estimate the taxels `rows` from all their readings, with s as it is, in a bounded number
        of steps; those that need more wait for them."""
        self.begin(rows)
        self.complete()

    def begin(self, rows: np.ndarray) -> None:
        """The first half of `estimate_anew`, after which `complete` is to be called before readings
        are added, or s is solved for."""
        self._begun = (rows, *self.estimator(rows)) if len(rows) else None

    def complete(self) -> bool:
        """The second half of `estimate_anew`; whether there was one to do."""
        if self._begun is None:
            return False
        (rows, estimator, part), self._begun = self._begun, None
        self.take(rows, estimator, advance(estimator, self.scale), part)
        return True

    def estimator(self, rows: np.ndarray) -> tuple[JointEstimator, Part]:
        """The estimator of the taxels `rows` from where they are, and their measurements."""
        info, known = self.information, self.fits[rows]
        start = np.where(known[:, None], info.points(rows), info.charts.points[rows])
        fresh = ~known & ~self.continued[rows]
        start[fresh] = self.store.means[rows[fresh]]
        rotations, new = info.charts[rows].rotations, ~info.placed[rows]
        if new.any():
            hit = self.store.template.body.closest(start[new])
            start[new], rotations[new] = hit.point, chart.frames(hit.normal)
        part = self.store.part(rows, self.store.near(start, self.reach))
        weight, nuisance = self.store.weight.values[part.rows], info.nuisances(rows)
        found = local_estimator(part.data, weight, start, rotations, nuisance, self.s)
        return found, part

    def take(
        self, rows: np.ndarray, estimator: JointEstimator, misfits: np.ndarray, part: Part
    ) -> None:
        """Keep the estimate of the taxels `rows`."""
        info, found = self.information, summary(estimator, misfits)
        self.store.weight.values[part.rows] = estimator.weight
        info.put(rows, found.charts, found.nuisance, found.gradient, found.hessian)
        info.counted[rows] = self.fits[rows] = found.fits
        self.continued[rows] = ~found.converged
        self.sector[rows] = open_sectors(estimator, found.charts.points)
        self.square[rows], self.freedom[rows] = found.square, found.freedom
        self.outlying[rows] = found.outlying
        self.moved[rows], self.tried[rows] = 0.0, self.store.counts[rows]
        self.linearized_threshold[rows] = self.store.threshold
        self.solve()

    def unexamined(self, growth: float = GROWTH) -> np.ndarray:
        """Taxels with an open sector whose readings grew by `growth` since they were examined.
        Those not touched for longest come first: the contacts of the others still close in."""
        counts = self.store.counts
        due = self.open & self.fits & (counts > growth * self.examined) & (self.moved < MAX_MOVE)
        rows = np.flatnonzero(due)
        return rows[np.argsort(self.last_read[rows], kind="stable")]

    @property
    def examining(self) -> bool:
        """Whether there is something to examine."""
        return self._examination is not None or len(self.unexamined()) > 0

    def examine(self, parts: int) -> None:
        """So many parts of the work of looking for other places of taxels with an open sector; a
        better place becomes their start."""
        for _ in range(parts):
            if self._examination is None:
                rows = self.unexamined()[:EXAMINED]
                self._examination = self._look_elsewhere(rows) if len(rows) else None
            elif next(self._examination, self) is self:
                self._examination = None

    def examine_all(self, count: int) -> bool:
        """Examine all that was not, `count` taxels at once; whether there were any."""
        self._examination, rows = None, self.unexamined(growth=1.0)
        for begin in range(0, len(rows), count):
            finish(self._look_elsewhere(rows[begin : begin + count]))
        return len(rows) > 0

    def _look_elsewhere(self, rows: np.ndarray) -> Generator[None, None, None]:
        self.begin(rows)  # sectors are those of then, and the estimate is to be the optimum
        yield
        self.complete()
        rows = rows[self.open[rows] & self.fits[rows]]
        if not len(rows):
            return
        yield
        info, counts = self.information, self.store.counts[rows]
        near = self.store.near(info.charts.points[rows], 2 * self.reach)
        part = self.store.part(rows, near)
        covariance = info.covariance[rows, :2, :2]
        yield
        weight = self.store.weight.values[part.rows]
        points, self.spread[rows], self.unique[rows] = yield from examine(
            part.data, weight, info.charts[rows], info.nuisance[rows], self.s, covariance
        )
        self.examined[rows] = counts
        better = np.isfinite(points[:, 0])
        if better.any():
            yield
            rows = rows[better]
            moved = points[better] - info.charts.points[rows]
            self.fits[rows] = True
            info.step[rows, :2] = np.einsum("rij,ri->rj", info.charts.tangents[rows], moved)
            self.estimate_anew(rows)
            self.examined[rows] = 0  # again, from there

    def __getstate__(self) -> dict[str, Any]:
        """Without the work in progress, which starts again."""
        return vars(self) | {"_examination": None, "_begun": None}

    def near(self, points: Array, read: np.ndarray) -> np.ndarray:
        """Placed taxels, rising, within reach of contact points (B, 3), m, or among `read`."""
        placed = np.flatnonzero(self.information.placed)
        if not len(placed):
            return placed
        gap = self.information.points(placed)[:, None] - points
        close = (np.einsum("nbi,nbi->nb", gap, gap) < self.reach**2).any(axis=1)
        return placed[close | np.isin(placed, read)]

    def _measure(self, block: Measurements) -> None:
        """How far a taxel may be from a contact to respond; the contacts' sizes under the present
        global parameters, and how far these move contacts, are looked at every MEASURED contacts.
        """
        if self.store.count >= self._measure_at:
            self._measure_at = self.store.count + MEASURED
            contacts = LinearizedContacts(block, self.s).at(self.s)
            self._shift = float(np.linalg.norm(contacts.points - block.points, axis=1).max())
            self._growth = float(np.median(contacts.radii / block.radii))
            self.radius = self.radius or float(np.median(block.radii))
        rest = REACH_MARGIN + block.disc + 1.5 * self._shift
        self.reach = max(self.reach, MAX_SLANT * (self._growth * float(block.longest.max()) + rest))
