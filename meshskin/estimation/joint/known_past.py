"""Hysteresis and creep of contacts that are localized, whose taxels' past is known.

The play operator and the creep of each taxel (electronics.py) are followed through the whole
recording at the recorded contacts. A contact whose place is sought then depends on their state
before it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.arrays import Array
from ..data.measurements import Measurements
from .contacts import LinearizedContacts
from .electronics import PAUSE, TIME, WIDTH, Electronics, frames, lacking
from .likelihood import Likelihood
from .readings import select


@dataclass(frozen=True)
class KnownPast:
    """States of the play operators and the creep of n taxels after each of k readings, sorted by
    taxel and contact."""

    data: Measurements
    """The measurements, with hysteresis or creep among the parameters."""
    key: np.ndarray
    """Key (k,) of each reading, taxel times m plus contact, ascending."""
    state: Array
    """States (k,) of the play operators, in units of the noise."""
    crept: Array
    """States (k,) of the creep."""

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
        nuisance parameters (n, q) and the global parameters s (ks,); None without hysteresis
        and creep."""
        if not {"hysteresis", "creep"} & set(data.parameters.names):
            return None
        every = np.ones(len(data.pressure)), np.ones(len(live))
        readings = select(data, live, points[live], normals[live], 0.0, *every)
        electronics, own = Electronics(data, readings, points[live]), live[readings.taxel]
        Likelihood(data, readings).predict(
            readings.contact, points[own], nuisance[own], LinearizedContacts(data, s).at(s),
            data.groups[own], electronics,
        )  # fmt: skip
        key = own * len(data.points) + readings.contact
        order = np.argsort(key)
        return cls(data, key[order], electronics.lagging[order], electronics.following[order])

    def before(self, contact: np.ndarray, taxel: np.ndarray) -> History:
        """Part of the readings of pairs (k,) of contacts and taxels that is due to earlier
        contacts."""
        data, m = self.data, len(self.data.points)
        last = np.searchsorted(self.key, taxel * m + contact) - 1
        found = (last >= 0) & (self.key[last] // m == taxel)
        earlier = np.where(found, self.key[last] % m, 0)
        since = np.where(found, data.time[contact] - data.time[earlier], np.inf)
        frame = frames(data.time)
        released = found & ((contact - earlier > 1) | (since > PAUSE * np.median(frame)))
        state, crept = (np.where(found, x[last], 0.0) for x in (self.state, self.crept))
        return History(data, state, released, crept, since, frame[contact])


class History:
    """Hysteresis and creep of k readings whose taxels' states before are known."""

    def __init__(
        self, data: Measurements, state: Array, released: np.ndarray, crept: Array, since: Array,
        frame: Array,
    ) -> None:  # fmt: skip
        """state, crept (k,): in units of the noise; since (k,), s, when they were taken; released
        (k,) bool: since then; frame (k,): as of electronics.frames."""
        self.columns, self.peak = data.parameters.columns, data.nominal_peak / data.sigma
        self.state, self.released, self.crept = state, released, crept
        self.since, self.frame, self.source = since, frame, np.arange(len(state))

    def apply(
        self,
        mu: Array,
        jacobian: Array,
        s: Array,
        scale: Array,
        gain: tuple[int, Array],
        first: int,
    ) -> Array:
        """As Electronics.apply; derivatives by gains and by its global parameters are left out."""
        if "creep" in self.columns:
            share, log_time, lift = s[self.columns["creep"]]
            earlier = self.crept * np.exp(-self.since / (TIME * np.exp(log_time)))
            kept = 1 - share * lacking(self.frame, log_time, lift)
            jacobian *= kept
            mu = kept * mu + share * earlier
        if "hysteresis" not in self.columns:
            return mu
        share, log_width = s[self.columns["hysteresis"]]
        width = self.peak * WIDTH * np.exp(log_width) * scale
        state = np.where(self.released, np.minimum(self.state, width), self.state)
        lagging = np.clip(state, mu - width, mu + width)
        jacobian *= np.where(lagging == state, 1 - share, 1.0)
        return np.asarray(mu + share * (lagging - mu))
