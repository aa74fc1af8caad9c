"""The readings that inform about taxels: recorded ones within reach, silent and saturated ones."""

from __future__ import annotations

from dataclasses import dataclass, field, fields

import numpy as np

from ...contact.reading import same_sheet
from ...core.arrays import Array, ranges
from ..data.measurements import Measurements
from ..data.pairs import REACH_MARGIN, silent_pairs
from .pressure import CENSORED, OBSERVED, SATURATED

MISFIT_SIGMAS = 5.0
"""Pressure, relative to the noise, above which a reading out of reach is kept: noise does not
explain it. With an unknown offset, above what the taxel reads in most contacts."""


@dataclass(frozen=True)
class Readings:
    """k readings of n taxels, sorted by taxel."""

    contact: np.ndarray
    """Row (k,) of the contact."""
    taxel: np.ndarray
    """Row (k,) of the taxel, rising."""
    level: Array
    """Pressure, threshold or end of the range (k,), Pa."""
    kind: np.ndarray
    """OBSERVED, CENSORED or SATURATED (k,)."""
    source: np.ndarray
    """Row (k,) of the measurement; -1 for a silent reading."""
    weight: Array
    """Weight (k,); 0 removes a reading."""
    precision: Array
    """Precision (k,), relative to that of the noise (`Measurements.precision`)."""
    starts: np.ndarray
    """First reading (n + 1,) of each taxel, and k."""
    live: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=int))
    """Row (n,) of `Measurements.ids` that each taxel is; empty where that does not matter."""

    @classmethod
    def none(cls) -> Readings:
        """No readings of no taxels."""
        rows, values = np.empty(0, dtype=int), np.empty(0)
        return cls(rows, rows, values, rows, rows, values, values, np.zeros(1, dtype=int), rows)

    def without(self, left_out: np.ndarray) -> Readings:
        """These readings without those `left_out` (k,) bool."""
        starts = np.append(0, np.cumsum(~left_out))[self.starts]
        each = {f.name: getattr(self, f.name)[~left_out] for f in fields(self)[:-2]}
        return Readings(**each, starts=starts, live=self.live)

    def of(self, taxels: np.ndarray) -> np.ndarray:
        """Rows of the readings of some taxels, in their order."""
        count = self.starts[taxels + 1] - self.starts[taxels]
        return ranges(self.starts[taxels], count)


def select(
    data: Measurements,
    live: np.ndarray,
    points: Array,
    normals: Array,
    log_radius: float,
    weight: Array,
    silent_weight: Array,
) -> Readings:
    """The readings that inform about `live`: rows of data.ids, several times for copies of a taxel.

    points (n, 3), m, and outward normals (n, 3): of these taxels, as estimated.

    With known noise, silent readings in reach are censored, and readings out of reach that noise
    explains are left out; such readings of contacts on another sheet always. log_radius: logarithm
    of the patches' radii over the nominal ones; weight (k,): of the measurements; silent_weight
    (n,): of each taxel's silent readings.
    """
    order, starts = data.by_taxel
    count, scale = data.counts[live], float(np.exp(log_radius))
    mine, taxel = order[ranges(starts[live], count)], np.repeat(np.arange(len(live)), count)
    silent_contact = silent_taxel = np.empty(0, dtype=int)
    contact = data.contact[mine]
    offset = points[taxel] - data.points[contact]
    inside = same_sheet(offset, data.normals[contact], normals[taxel])
    if data.noise is not None:
        height = np.einsum("ki,ki->k", offset, data.normals[contact])
        across2 = np.einsum("ki,ki->k", offset, offset) - height**2
        inside &= across2 < (data.reach(scale)[contact] + REACH_MARGIN) ** 2
    rest = data.rest if "offset" in data.parameters.nuisance_names else np.zeros(len(data.ids))
    inside |= data.pressure[mine] > rest[data.taxel[mine]] + MISFIT_SIGMAS * data.sigma
    mine, taxel = mine[inside], taxel[inside]
    if data.noise is not None:
        silent_contact, silent_taxel = silent_pairs(data, live, points, normals, scale)
    none = np.full(len(silent_contact), -1)
    contact = np.concatenate([data.contact[mine], silent_contact])
    taxel = np.concatenate([taxel, silent_taxel])
    end = data.ends[data.taxel[mine]]
    kind = np.where(data.pressure[mine] < end, OBSERVED, SATURATED)
    level = np.append(np.minimum(data.pressure[mine], end), np.full(len(none), data.threshold))
    order = np.argsort(taxel, kind="stable")
    return Readings(
        contact=contact[order],
        taxel=taxel[order],
        level=level[order],
        kind=np.concatenate([kind, np.full(len(none), CENSORED)]).astype(np.int8)[order],
        source=np.concatenate([mine, none])[order],
        weight=np.concatenate([weight[mine], silent_weight[silent_taxel]])[order],
        precision=data.precision[contact[order]],
        starts=np.searchsorted(taxel[order], np.arange(len(live) + 1)),
        live=live,
    )
