"""Creep: the reading of a taxel under a held pressure rises, or falls, with a time constant.

The pressure p of each taxel is held until it is read, from the frame before on but for a time,
`lift` times tau, in which the indenter is lifted, and zero between its readings. What follows it,
dQ/dt = (p - Q) / tau, Q = 0 before the first contact, is at the k-th reading of the taxel

    Q_k = (1 - exp(lift - frame / tau)) p_k + exp(-since / tau) Q_(k-1).

Source: Johnson, Contact Mechanics (1985), section 6.5 (standard linear solid).
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from ...core.arrays import Array
from ..data.measurements import Measurements
from .readings import Readings

HELD = 5.0
"""Longest frame, in median ones, in which a contact is held: in a longer one the robot moved
elsewhere."""
TIME = 1.0
"""Time constant, s, at a logarithm of 0: those of rubber and foam are 0.1 to 10 s."""


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
    """What follows the pressures of all readings at once."""

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
