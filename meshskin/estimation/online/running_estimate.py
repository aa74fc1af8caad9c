"""The running estimate: readings are added as they come, and taxels that moved are estimated anew.

A new reading is linearized at the present estimate of its taxel and added to the taxel's normal
equations. Earlier readings stay linearized where the taxel was then; once it has moved by more than
that bears, it waits for being estimated anew from all its readings by the joint estimator, with the
global parameters as they are.
"""

from __future__ import annotations

import numpy as np

from ...core.arrays import Array
from .. import chart
from ..data.measurements import Measurements
from ..data.pairs import MAX_SLANT, REACH_MARGIN
from ..joint import fault_detection as faults
from ..joint.contacts import LinearizedContacts
from ..joint.rival_optima import OPEN_SECTOR, open_sectors
from . import basins
from .information import TaxelInformation
from .linearization import local_estimator, new_readings, summary, without_outliers
from .store import ContactStore

TOLERANCE = 0.003
"""Move of a taxel, in contact radii, of ln gain, or of the global parameters in prior standard
deviations, from which it is estimated anew. The slopes of its readings change by about as much, and
the estimate by that part of its standard deviation."""
MAX_MOVE = 0.5
"""Move up to which a linear estimate is believed until then; `SurfaceParametrization.step`."""
THRESHOLD_STEP = 0.05
"""Change of the threshold, in standard deviations of a reading, from which silent readings are
linearized again: the threshold is the smallest reading where none is believed."""
MIN_READINGS = 3
"""Readings from which a taxel is placed: three circles have one point in common."""
GROWTH = 1.25
"""Growth of the number of readings from one attempt to place or examine a taxel to the next."""
MAX_RESIDUAL = faults.CUTOFF
"""Residual, in standard deviations of noise and estimate, from which a new reading is left out."""
MIN_CONTRADICTIONS = 3
"""Outlying readings of a contact, and more than half of its readings, from which it is rejected."""
CHUNK = 256
"""Taxels estimated anew at once, at most: bounds the memory."""
EXAMINED = 16
"""Taxels examined at once, at most."""
MAX_ROUNDS = 8
"""Rounds of `settle`; three are usual."""


class RunningEstimate:
    """Estimates of n taxels and of the global parameters from the contacts so far."""

    def __init__(self, first: Measurements) -> None:
        """first: measurements without contacts, which have all else."""
        n = len(first.ids)
        self.store = ContactStore(first)
        self.information = TaxelInformation(n, first.parameters, first.sigma)
        self.parameters, self.sigma = first.parameters, first.sigma
        self.radius = self.reach = 0.0
        """Median radius of the contacts, and the furthest that a taxel may be to respond, m."""
        self.fits = np.zeros(n, dtype=bool)
        self.moved, self.tried = np.zeros(n), np.zeros(n, dtype=int)
        self.examined = np.zeros(n, dtype=int)
        """Readings (n,) of each taxel when it was examined last."""
        self.unique = np.zeros(n, dtype=bool)
        self.spread, self.sector = np.zeros((n, 2, 2)), np.full(n, 2 * np.pi)
        self.residual = np.nan
        """Root mean square of the residuals of the last readings of placed taxels, in standard
        deviations of noise and estimate together."""
        self.square, self.freedom = np.zeros(n), np.zeros(n)
        """Squared residuals of each taxel (n,), in units of the noise, and their expectation."""
        self.outlying = np.zeros(n, dtype=int)
        self.linearized_threshold = np.full(n, np.inf)
        self._mass, self._moment = np.zeros(n), np.zeros((n, 3))

    @property
    def means(self) -> Array:
        """Mean contact points (n, 3), m, weighted by pressure squared; NaN without readings."""
        with np.errstate(invalid="ignore"):
            return np.asarray(self._moment / self._mass[:, None])

    @property
    def open(self) -> np.ndarray:
        """Placed taxels (n,) bool whose contacts leave a wide sector of directions open."""
        return np.asarray(self.information.placed & (self.sector > OPEN_SECTOR))

    @property
    def covariances(self) -> Array:
        """Covariances (n, 2, 2), m^2, along the charts' tangents; inf where not placed."""
        wide = np.where(self.open[:, None, None], self.spread, 0.0)
        found = self.information.covariance[:, :2, :2] + wide
        infinite = np.diag([np.inf, np.inf])
        return np.where(self.information.placed[:, None, None], found, infinite)

    @property
    def determined(self) -> np.ndarray:
        """Taxels (n,) bool whose readings fit and allow one place, within a contact radius."""
        info = self.information
        sure = ~self.open | (self.unique & (GROWTH * self.examined >= self.store.counts))
        found = info.placed & self.fits & sure & (self.moved < MAX_MOVE)
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
        contact, taxel, pressure = readings
        weight = np.nan_to_num(pressure) ** 2
        np.add.at(self._mass, taxel, weight)
        np.add.at(self._moment, taxel, weight[:, None] * block.points[contact])
        self._measure(block)
        rows = self._near(block.points, taxel)
        if not len(rows):
            return
        info = self.information
        part = self.store.part(rows, np.arange(first, self.store.count), first_reading)
        new = new_readings(
            part, info.charts[rows], info.step[rows, :2], info.nuisances(rows), info.s,
            info.joint_covariance(rows),
        )  # fmt: skip
        if new.clear.any():
            self.residual = float(np.sqrt(np.mean(new.residual[new.clear] ** 2)))
        beyond, m = np.abs(new.residual) > MAX_RESIDUAL * self.scale, len(block.force)
        count = np.bincount(new.contact, minlength=m)
        contradicting = np.bincount(new.contact, beyond, m)
        rejected = (contradicting >= MIN_CONTRADICTIONS) & (2 * contradicting > count)
        self.store.misfitting.values[first:] = rejected
        used = ~rejected[new.contact]
        owner = rows[new.taxel]
        np.add.at(self.outlying, owner[used & beyond], 1)
        used &= ~beyond
        info.add(owner[used], new.jacobian[used], new.rate[used], new.curvature[used])
        np.add.at(self.square, owner[used & new.clear], new.residual[used & new.clear] ** 2)
        np.add.at(self.freedom, owner[used & new.clear], 1.0)

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

    def waiting(self) -> np.ndarray:
        """Taxels that are to be placed or estimated anew, the most urgent first."""
        info, counts = self.information, self.store.counts
        stale = (self.linearized_threshold - self.store.threshold) / (THRESHOLD_STEP * self.sigma)
        score = np.maximum(self.moved / TOLERANCE, np.where(info.placed, stale, 0.0))
        unsettled = (counts >= MIN_READINGS) & ~(info.placed & self.fits)
        score[unsettled] = np.where(counts >= GROWTH * self.tried, 1 / TOLERANCE, 0.0)[unsettled]
        rows = np.flatnonzero(score > 1)
        return rows[np.argsort(-score[rows], kind="stable")]

    def estimate_anew(self, rows: np.ndarray) -> None:
        """Estimate the taxels `rows` from all their readings, with s as it is."""
        if not len(rows):
            return
        info, placed = self.information, self.information.placed[rows]
        start = np.where(placed[:, None], info.points(rows), self.means[rows])
        hit = self.store.template.body.closest(start)
        rotations = np.where(
            placed[:, None, None], info.charts[rows].rotations, chart.frames(hit.normal)
        )
        part = self.store.part(rows, self.store.near(hit.point, self.reach))
        estimator = local_estimator(part, hit.point, rotations, info.nuisances(rows), info.s)
        estimator, misfits = without_outliers(estimator, self.scale)
        found = summary(estimator, misfits)
        info.put(rows, found.charts, found.nuisance, found.gradient, found.hessian)
        info.counted[rows] = self.fits[rows] = found.fits
        self.sector[rows] = open_sectors(estimator, found.charts.points)
        self.square[rows], self.freedom[rows] = found.square, found.freedom
        self.outlying[rows] = found.outlying
        self.moved[rows], self.tried[rows] = 0.0, self.store.counts[rows]
        self.linearized_threshold[rows] = self.store.threshold
        self.solve()

    def unexamined(self) -> np.ndarray:
        """Taxels with an open sector that were not examined since they had fewer readings, those
        with the most new readings first."""
        counts = self.store.counts
        due = self.open & self.fits & (counts > GROWTH * self.examined) & (self.moved < MAX_MOVE)
        rows = np.flatnonzero(due)
        return rows[np.argsort(self.examined[rows] / counts[rows], kind="stable")]

    def examine(self, rows: np.ndarray) -> None:
        """Look for other places of the taxels `rows`; a better one becomes their start."""
        if not len(rows):
            return
        self.estimate_anew(rows)
        rows = rows[self.open[rows] & self.fits[rows]]
        if not len(rows):
            return
        info = self.information
        near = self.store.near(info.charts.points[rows], 2 * self.reach)
        part = self.store.part(np.repeat(rows, basins.COPIES), near)
        covariance = info.covariance[rows, :2, :2]
        found = basins.examine(part, info.charts[rows], info.nuisance[rows], info.s, covariance)
        self.examined[rows] = self.store.counts[rows]
        self.unique[rows], self.spread[rows] = found.unique, found.spread
        better = np.isfinite(found.better[:, 0])
        if better.any():
            # the next examination is from there
            self._restart(rows[better], found.better[better])

    def _restart(self, rows: np.ndarray, points: Array) -> None:
        """Estimate taxels from other points (r, 3), m."""
        info = self.information
        moved = points - info.charts.points[rows]
        info.step[rows, :2] = np.einsum("rij,ri->rj", info.charts.tangents[rows], moved)
        self.estimate_anew(rows)
        self.examined[rows] = 0

    def settle(self) -> None:
        """Estimate anew all that waits, and examine what was not, until nothing moves."""
        for _ in range(MAX_ROUNDS):
            rows = self.waiting()
            for begin in range(0, len(rows), CHUNK):
                self.estimate_anew(rows[begin : begin + CHUNK])
            open_ = self.unexamined()
            for begin in range(0, len(open_), EXAMINED):
                self.examine(open_[begin : begin + EXAMINED])
            if not len(rows) and not len(open_):
                return

    def _near(self, points: Array, read: np.ndarray) -> np.ndarray:
        """Placed taxels, rising, within reach of contact points (B, 3), m, or among `read`."""
        placed = np.flatnonzero(self.information.placed)
        if not len(placed):
            return placed
        gap = self.information.points(placed)[:, None] - points
        close = (np.einsum("nbi,nbi->nb", gap, gap) < self.reach**2).any(axis=1)
        return placed[close | np.isin(placed, read)]

    def _measure(self, block: Measurements) -> None:
        """The sizes of the contacts, and how far the global parameters move them."""
        moved = LinearizedContacts(block, self.information.s)
        contacts = moved.at(self.information.s)
        shift = float(np.linalg.norm(contacts.points - block.points, axis=1).max())
        scale = float(np.median(contacts.radii / block.radii))
        rest = REACH_MARGIN + block.disc + 1.5 * shift
        self.radius = self.radius or float(np.median(block.radii))
        self.reach = max(self.reach, MAX_SLANT * (scale * float(block.longest.max()) + rest))
