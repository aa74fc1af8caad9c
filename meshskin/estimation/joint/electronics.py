"""Hysteresis, creep and crosstalk: what a reading owes to its taxel's past and to its neighbours.

A taxel under the pressure v, with p = v + c (sum of its neighbours' pressures), reads
(1 - h) q + h P[q] of q = (1 - r) p + r Q[p]. P is the play operator of half-width w, which follows
q at a distance of at most w:

    P_k = clip(P_(k-1), q_k - w, q_k + w),  P = 0 before the first contact.

Q follows p with a time constant. Between contacts that press a taxel its pressure is
zero. The shares h and r, ln w, logarithms of times, and c are global parameters. While P rests, a
reading depends on the errors of the contact that last moved it, too. The derivatives leave out
what a reading owes to the places of the neighbours, and by creep to the errors of earlier contacts.

Sources: Visintin, Differential Models of Hysteresis (1994), section III.1; Johnson, Contact
Mechanics (1985), section 6.5.
"""

from __future__ import annotations

from functools import cached_property
from itertools import pairwise

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from ...core.arrays import Array
from ..data.measurements import Measurements
from .reading_sums import CONTACT_SIZE, pairs_of_contacts
from .readings import Readings

WIDTH = 0.1
"""Half-width of the play operator, relative to the nominal peak, at a logarithm of 0."""
NEXT = 1.4
"""Distance of neighbours relative to a taxel's nearest one: in a square lattice the diagonal is
1.41, in a hexagonal one the second neighbour 1.73."""
FAR = 2.1
"""As NEXT, of taxels of which some may crosstalk: two rings of a lattice, beyond which few contacts
press both."""
PAUSE = 1.5
"""Interval between two contacts, in median ones, from which skin and taxels were released
between."""
HELD = 5.0
"""Longest frame, in median ones, in which a contact is held: in a longer one the robot moved
elsewhere."""
TIME = 1.0
"""Time constant, s, at a logarithm of 0: those of rubber and foam are 0.1 to 10 s."""


class Electronics:
    """Hysteresis and crosstalk of all readings at once."""

    def __init__(self, data: Measurements, readings: Readings, points: Array) -> None:
        """points (n, 3), m: of the taxels, about."""
        self.data, self.readings, self.points = data, readings, points
        self.columns = data.parameters.columns
        self.peak = data.nominal_peak / data.sigma
        self.source = np.arange(len(readings.taxel))
        """The reading (k,) on which each one's play operator rested when last applied; its own
        where it moved, or rested on none."""
        self.lagging = np.zeros(len(readings.taxel))
        """What the play operator followed the pressures (k,) with when last applied."""
        self.following = np.zeros(len(readings.taxel))
        """What crept after the pressures (k,) when last applied."""

    def apply(
        self,
        mu: Array,
        jacobian: Array,
        s: Array,
        scale: Array,
        gain: tuple[int, Array],
        first: int,
    ) -> Array:
        """Readings (k,) of the pressures mu (k,), both in units of the noise and with the taxels'
        gains; rewrites their derivatives `jacobian` (C, k).

        s (ks,): global parameters, whose derivatives begin in the row `first`; those in the errors
        of the reading's contact (3) follow, and where there are rows for them, those in the errors
        of the contact of the reading `source`; scale (k,): each taxel's gain; gain: the row of its
        logarithm, and that factor's derivative in it.
        """
        row, slope = gain
        if "crosstalk" in self.columns:
            at = self.columns["crosstalk"].start
            c, added = s[at], scale * (self.neighbours @ (mu / scale))
            for line in jacobian[first:]:
                line += c * scale * (self.neighbours @ (line / scale))
            jacobian[row] += slope * c * added
            jacobian[first + at] = added
            mu = mu + c * added
        if "creep" in self.columns:
            r, *times = s[self.columns["creep"]]
            at, last = first + self.columns["creep"].start, first + len(s)
            self.following = following = self.creep.follow(mu, *times)
            jacobian[last : last + CONTACT_SIZE] *= 1 - r * lacking(self.creep.frame, *times)
            jacobian[:last] += r * (self.creep.follow(jacobian[:last], *times) - jacobian[:last])
            jacobian[at] = following - mu
            jacobian[at + 1], jacobian[at + 2] = (
                r * slope for slope in self.creep.slopes(mu, following, *times)
            )
            mu = mu + r * (following - mu)
        if "hysteresis" in self.columns:
            at = self.columns["hysteresis"].start
            h, width = s[at], self.peak * WIDTH * np.exp(s[at + 1]) * scale
            lagging, source, side = self.play(mu, width)
            last, own = first + len(s), source == np.arange(len(mu))
            contact = jacobian[last : last + CONTACT_SIZE].copy()
            jacobian += h * (np.where(source >= 0, jacobian[:, source], 0.0) - jacobian)
            # an earlier contact's errors are not this one's
            jacobian[last : last + CONTACT_SIZE] = contact * np.where(own, 1, 1 - h)
            rests = ~own & (source >= 0)
            if len(jacobian) > last + CONTACT_SIZE:
                jacobian[last + CONTACT_SIZE :] = np.where(rests, h * contact[:, source], 0.0)
            self.source, self.lagging = np.where(rests, source, np.arange(len(mu))), lagging
            jacobian[row] += h * slope * side * width
            jacobian[first + at], jacobian[first + at + 1] = lagging - mu, h * side * width
            mu = mu + h * (lagging - mu)
        return mu

    def play(self, mu: Array, width: Array) -> tuple[Array, np.ndarray, Array]:
        """The play operator (k,) of half-widths (k,) on the pressures mu (k,) of each taxel
        in time; the reading (k,) that last moved it, -1 where a release did, or none; and the
        side -1, 0 or 1 on which it follows: mu[source] + side width."""
        lagging, source = np.zeros(width.shape), np.zeros(width.shape, dtype=np.intp)
        side, taxels = np.zeros(width.shape), len(self.readings.starts) - 1
        level, last, sign = np.zeros(taxels), np.full(taxels, -1), np.zeros(taxels)
        for rows, released in self.steps:
            own, half = self.readings.taxel[rows], width[rows]
            now = level[own]
            free = released & (half < now)
            now = np.where(free, half, now)
            low, high = mu[rows] - half, mu[rows] + half
            below, above = now < low, now > high
            moved = np.where(free, -1, last[own])
            turned = np.where(free, 1.0, sign[own])
            level[own] = lagging[rows] = np.clip(now, low, high)
            last[own] = source[rows] = np.where(below | above, rows, moved)
            turned = np.where(below, -1.0, np.where(above, 1.0, turned))
            sign[own] = side[rows] = turned
        return lagging, source, side

    @cached_property
    def creep(self) -> Creep:
        """The creep of the readings."""
        return Creep(self.data, self.readings, self.steps)

    @cached_property
    def steps(self) -> list[tuple[np.ndarray, np.ndarray]]:
        """The first, second, ... readings in time of all taxels that have them, and whether each
        taxel was released since the one before."""
        readings, time = self.readings, self.data.time
        order = np.lexsort((readings.contact, readings.taxel))
        contact = readings.contact[order]
        since = np.diff(contact, prepend=contact[:1])
        pause = np.diff(time[contact], prepend=time[contact[:1]])
        frame = float(np.median(np.diff(time))) if len(time) > 1 else 0.0
        released = (since != 1) | (pause > PAUSE * frame)
        rank = np.arange(len(order)) - readings.starts[readings.taxel[order]]
        by_rank = np.argsort(rank, kind="stable")
        ends = np.cumsum(np.bincount(rank))
        return [(order[rows], released[rows]) for rows in np.split(by_rank, ends[:-1]) if len(rows)]

    @cached_property
    def neighbours(self) -> sparse.csr_array:
        """The matrix (k, k) that sums, for each reading, those of the taxel's neighbours in its
        contact, or those of the taxels that leak into it."""
        readings, leaks, k = self.readings, self.data.leaks, len(self.readings.taxel)
        rows, columns = near_pairs(readings, self.points, NEXT if leaks is None else FAR)
        weight = np.ones(len(rows))
        if leaks is not None:
            weight = leaks.of(readings.taxel[rows] * len(self.points) + readings.taxel[columns])
            rows, columns, weight = (part[weight > 0] for part in (rows, columns, weight))
        return sparse.csr_array((weight, (rows, columns)), shape=(k, k))


def near_pairs(readings: Readings, points: Array, most: float) -> tuple[np.ndarray, np.ndarray]:
    """Rows (p,) of readings, and (p,) of others in the same contacts, whose taxels, at points
    (n, 3), m, are closer than `most` times the distance of the first one's nearest."""
    first, second = pairs_of_contacts(readings.contact)
    own, other, near = readings.taxel[first], readings.taxel[second], most * nearest(points)
    apart = np.linalg.norm(points[own] - points[other], axis=1)
    there, back = (apart < near[taxel] for taxel in (own, other))
    return (
        np.concatenate([first[there], second[back]]),
        np.concatenate([second[there], first[back]]),
    )


def nearest(points: Array) -> Array:
    """Distance (n,), m, of each point from its nearest one; infinite without any."""
    return np.asarray(cKDTree(points).query(points, k=2)[0][:, 1])


def frames(time: Array) -> Array:
    """Times (m,), s, from the frame before to each contact at the times (m,), s; no longer than
    HELD."""
    interval = np.diff(time)
    frame = float(np.median(interval)) if len(interval) else 0.0
    return np.append(frame, np.minimum(interval, HELD * frame))[: len(time)]


def lacking(frame: Array, log_time: float, lift: float = 0.0) -> Array:
    """Part (k,) of its own pressure that Q lacks after frames (k,), s; log_time: logarithm of tau
    in units of TIME; lift: in units of tau."""
    return np.asarray(np.exp(lift - frame / (TIME * np.exp(log_time))))


class Creep:
    """What follows the pressures of all readings at once.

    The pressure p of each taxel is held until it is read, from the frame before on but for a time,
    `lift` times tau, in which the indenter is lifted, and zero between its readings. What follows
    it, dQ/dt = (p - Q) / tau, Q = 0 before the first contact, is at the k-th reading of the taxel

        Q_k = (1 - exp(lift - frame / tau)) p_k + exp(-since / tau) Q_(k-1).
    """

    def __init__(
        self, data: Measurements, readings: Readings, steps: list[tuple[np.ndarray, np.ndarray]]
    ) -> None:
        """steps: as `Electronics.steps`."""
        time, taxel = data.time, readings.taxel
        self.frame = frames(time)[readings.contact]
        """Times (k,), s, since the frame before each reading."""
        self.since, last = np.full(len(taxel), np.inf), np.full(len(readings.starts) - 1, -np.inf)
        """Times (k,), s, since the reading of the taxel before."""
        for rows, _ in steps:
            self.since[rows] = time[readings.contact[rows]] - last[taxel[rows]]
            last[taxel[rows]] = time[readings.contact[rows]]
        # of every step in the same order of taxels, those with most readings first
        place = np.argsort(np.argsort(-np.bincount(taxel), kind="stable"))
        self.order = np.concatenate([rows[np.argsort(place[taxel[rows]])] for rows, _ in steps])
        """Readings (k,), step by step, where those of a step follow the first of the last step."""
        self.ends = np.cumsum([len(rows) for rows, _ in steps])

    def follow(self, pressure: Array, log_time: float, lift: float = 0.0) -> Array:
        """Q (..., k) of pressures (..., k); log_time and lift as `lacking`."""
        return self._sums((1 - lacking(self.frame, log_time, lift)) * pressure, log_time)

    def slopes(
        self, pressure: Array, following: Array, log_time: float, lift: float
    ) -> tuple[Array, Array]:
        """The derivatives (k,) of `following`, Q (k,) of pressures (k,), in log_time and lift."""
        lost = lacking(self.frame, log_time, lift) * pressure
        since = np.where(np.isfinite(self.since), self.since, 0.0)
        moved = since * (following - pressure + lost) - self.frame * lost
        constant = TIME * np.exp(log_time)
        return self._sums(moved / constant, log_time), self._sums(-lost, log_time)

    def _sums(self, added: Array, log_time: float) -> Array:
        """Sums (..., k) over the readings of each taxel before, which decay, of what is `added`."""
        decay = np.exp(-self.since[self.order] / (TIME * np.exp(log_time)))
        sums, before = added[..., self.order], 0
        for begin, end in pairwise(self.ends):
            sums[..., begin:end] += decay[begin:end] * sums[..., before : before + end - begin]
            before = begin
        out = np.empty_like(sums)
        out[..., self.order] = sums
        return out
