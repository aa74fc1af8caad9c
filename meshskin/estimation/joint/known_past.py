"""Hysteresis of contacts that are localised: what their taxels were pressed with before is known.

The play operator of each taxel (electronics.py) is followed through the whole recording at the
recorded contacts. A contact whose place is sought then depends on the operator's state before it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.arrays import Array
from ..data.measurements import Measurements
from .contacts import LinearizedContacts
from .electronics import PAUSE, WIDTH, Electronics
from .likelihood import Likelihood, select


@dataclass(frozen=True)
class KnownPast:
    """States of the play operators of n taxels after each of k readings, sorted by taxel and
    contact."""

    data: Measurements
    """With hysteresis among its parameters."""
    key: np.ndarray
    """Taxel times m plus contact (k,), rising."""
    state: Array
    """(k,), in units of the noise."""

    @classmethod
    def of(
        cls,
        data: Measurements,
        live: np.ndarray,
        points: Array,
        normals: Array,
        nuisance: Array,
        s: Array,
    ) -> KnownPast | None:
        """Of the taxels `live` (rows of points (n, 3), m, and outward normals (n, 3)) with their
        nuisance parameters (n, q) and the global parameters s (ks,); None without hysteresis."""
        if "hysteresis" not in data.parameters.columns:
            return None
        every = np.ones(len(data.pressure)), np.ones(len(live))
        readings = select(data, live, points[live], normals[live], 0.0, *every)
        electronics, own = Electronics(data, readings, points[live]), live[readings.taxel]
        Likelihood(data, readings).predict(
            readings.contact, points[own], nuisance[own], LinearizedContacts(data, s).at(s),
            electronics,
        )  # fmt: skip
        key = own * len(data.points) + readings.contact
        order = np.argsort(key)
        return cls(data, key[order], electronics.lagging[order])

    def before(self, contact: np.ndarray, taxel: np.ndarray) -> History:
        """What pairs (k,) of contacts and taxels owe to earlier contacts."""
        data, m = self.data, len(self.data.points)
        last = np.searchsorted(self.key, taxel * m + contact) - 1
        found = (last >= 0) & (self.key[last] // m == taxel)
        earlier = np.where(found, self.key[last] % m, 0)
        frame = float(np.median(np.diff(data.time))) if m > 1 else 0.0
        pause = data.time[contact] - data.time[earlier] > PAUSE * frame
        released = found & ((contact - earlier > 1) | pause)
        return History(data, np.where(found, self.state[last], 0.0), released)


class History:
    """Hysteresis of k readings whose play operators' states before are known."""

    def __init__(self, data: Measurements, state: Array, released: np.ndarray) -> None:
        """state (k,): in units of the noise; released (k,) bool: since it was taken."""
        self.at = data.parameters.columns["hysteresis"].start
        self.peak = data.nominal_peak / data.sigma
        self.state, self.released = state, released
        self.source = np.arange(len(state))

    def apply(
        self,
        mu: Array,
        jacobian: Array,
        s: Array,
        scale: Array,
        gain: tuple[int, float],
        first: int,
    ) -> Array:
        """As Electronics.apply; the derivatives by the share and the width are left out."""
        share, (row, slope) = s[self.at], gain
        width = self.peak * WIDTH * np.exp(s[self.at + 1]) * scale
        state = np.where(self.released, np.minimum(self.state, width), self.state)
        lagging = np.clip(state, mu - width, mu + width)
        side = np.sign(lagging - mu) * (lagging != state)
        jacobian *= np.where(lagging == state, 1 - share, 1.0)
        jacobian[row] += share * slope * side * width
        return np.asarray(mu + share * (lagging - mu))
