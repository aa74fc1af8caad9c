"""The likelihood of all readings: its value, gradient and Gauss-Newton Hessian, taxel by taxel.

The unknowns of a taxel are its position x (3) in the body frame, its declared nuisance parameters
(gain and offset), and the global parameters. How x depends on coordinates in a chart or on a
module's pose is the parametrization's. Readings are sorted by taxel, and evaluated in blocks.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING

import numpy as np

from ...contact.learned import ProfileCorrection
from ...contact.reading import same_sheet
from ...core.arrays import Array, ranges
from ..data.measurements import Measurements
from ..data.pairs import REACH_MARGIN, silent_pairs
from .contacts import Contacts
from .pressure import CENSORED, OBSERVED, SATURATED, corrected_means, costs, disc_means

if TYPE_CHECKING:
    from .electronics import Electronics
    from .known_past import History

MISFIT_SIGMAS = 5.0
"""Pressure, relative to the noise, above which a reading out of reach is kept: noise does not
explain it. With an unknown offset, above what the taxel reads in most contacts."""
MIN_DENOMINATOR = 0.05
"""Least denominator of a compressed reading: an expansion by 20 is none of a sensor."""
BLOCK = 8192
"""Readings of a block: their derivatives, some 100 B each, stay in the cache."""


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

    @classmethod
    def none(cls) -> Readings:
        """No readings of no taxels."""
        rows, values = np.empty(0, dtype=int), np.empty(0)
        return cls(rows, rows, values, rows, rows, values, values, np.zeros(1, dtype=int))

    def without(self, left_out: np.ndarray) -> Readings:
        """These readings without those `left_out` (k,) bool."""
        starts = np.append(0, np.cumsum(~left_out))[self.starts]
        each = {f.name: getattr(self, f.name)[~left_out] for f in fields(self)[:-1]}
        return Readings(**each, starts=starts)

    def of(self, taxels: np.ndarray) -> np.ndarray:
        """Rows of the readings of some taxels, in their order."""
        count = self.starts[taxels + 1] - self.starts[taxels]
        return ranges(self.starts[taxels], count)


def select(
    data: Measurements, live: np.ndarray, points: Array, normals: Array, log_radius: float,
    weight: Array, silent_weight: Array,
) -> Readings:  # fmt: skip
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
        silent_contact, silent_taxel = silent_pairs(data, live, points, normals, scale)
    rest = data.rest if "offset" in data.parameters.nuisance_names else np.zeros(len(data.ids))
    inside |= data.pressure[mine] > rest[data.taxel[mine]] + MISFIT_SIGMAS * data.sigma
    mine, taxel = mine[inside], taxel[inside]
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
    )


@dataclass
class Moments:
    """Cost and derivatives of n taxels in C unknowns: x (3), nuisance and global parameters."""

    cost: Array
    """(n,)."""
    gradient: Array
    """(n, C)."""
    hessian: Array
    """(n, C, C)."""
    square: Array
    """Weighted sum of the squared residuals (n,) of observed readings."""

    @classmethod
    def zeros(cls, n: int, size: int) -> Moments:
        """Zeros for n taxels of `size` unknowns."""
        return cls(np.zeros(n), np.zeros((n, size)), np.zeros((n, size, size)), np.zeros(n))

    def put(self, rows: np.ndarray, other: Moments) -> None:
        """Replace those of the taxels `rows` by `other`."""
        self.cost[rows], self.gradient[rows] = other.cost, other.gradient
        self.hessian[rows], self.square[rows] = other.hessian, other.square

    def take(self, rows: np.ndarray) -> Moments:
        """The moments of the taxels `rows`."""
        return Moments(self.cost[rows], self.gradient[rows], self.hessian[rows], self.square[rows])


@dataclass(frozen=True)
class Likelihood:
    """The readings under the contact model; positions and contacts are given at each evaluation."""

    data: Measurements
    readings: Readings

    def moments(
        self, rows: np.ndarray, points: Array, nuisance: Array, contacts: Contacts
    ) -> Moments:
        """Of the taxels `rows`, at points (r, 3), m, and nuisance parameters (r, .)."""
        out = Moments.zeros(len(rows), 3 + nuisance.shape[1] + self.shared)
        count = self.readings.starts[rows + 1] - self.readings.starts[rows]
        ends, begin = np.cumsum(count), 0
        while begin < len(rows):
            before = ends[begin] - count[begin]
            end = max(int(np.searchsorted(ends, before + BLOCK, side="right")), begin + 1)
            read = begin + np.flatnonzero(count[begin:end])
            if len(read):
                out.put(read, self._block(rows[read], points[read], nuisance[read], contacts))
            begin = end
        for k, sigma in enumerate(self.nuisance_sigma):
            out.cost += (nuisance[:, k] / sigma) ** 2 / 2
            out.gradient[:, 3 + k] += nuisance[:, k] / sigma**2
            out.hessian[:, 3 + k, 3 + k] += sigma**-2
        return out

    @property
    def shared(self) -> int:
        """Global parameters in moments: none where contacts are given with their errors."""
        return len(self.data.parameters.sigma) if self.data.contact_errors is None else 0

    @property
    def nuisance_sigma(self) -> tuple[float, ...]:
        """Prior standard deviations of ln gain, and of offset and drift in units of the noise."""
        unit = {"gain": 1.0, "offset": self.data.sigma, "drift": self.data.sigma}
        p = self.data.parameters
        return tuple(s / unit[n] for n, s in zip(p.nuisance_names, p.nuisance_sigma, strict=True))

    def means(self, points: Array, nuisance: Array, contacts: Contacts) -> Array:
        """mu (k,), in units of the noise, of all readings; points (n, 3), nuisance (n, .)."""
        parts = [mu for _, mu, _ in self._each(points, nuisance, contacts)]
        return np.concatenate([np.empty(0), *parts])

    def derivatives(self, points: Array, nuisance: Array, contacts: Contacts) -> Array:
        """Derivatives (C, k) of mu in all unknowns; points (n, 3), nuisance (n, .)."""
        return np.concatenate([j for _, _, j in self._each(points, nuisance, contacts)], axis=1)

    def leverages(
        self, points: Array, nuisance: Array, contacts: Contacts, covariance: Array
    ) -> Array:
        """The leverage of each reading (k,), d mu / d reading: the diagonal of the hat matrix.

        covariance (n, C, C): of each taxel's unknowns and the global ones. Source: Cook, Weisberg,
        "Residuals and Influence in Regression" (1982).
        """
        read, parts = self.readings, [np.empty(0)]
        for part, mu, jacobian in self._each(points, nuisance, contacts):
            curvature = costs(mu, read.level[part] / self.data.sigma, read.kind[part])[2]
            jacobian = jacobian[: covariance.shape[1]]
            seen = np.einsum("kij,jk->ik", covariance[read.taxel[part]], jacobian)
            factor = read.weight[part] * read.precision[part] * curvature
            parts.append(factor * np.sum(jacobian * seen, axis=0))
        return np.concatenate(parts)

    def _each(
        self, points: Array, nuisance: Array, contacts: Contacts
    ) -> Iterator[tuple[slice, Array, Array]]:
        """Blocks of readings, their mu and its derivatives (C, k)."""
        for begin in range(0, len(self.readings.taxel), BLOCK):
            part = slice(begin, begin + BLOCK)
            own, contact = self.readings.taxel[part], self.readings.contact[part]
            yield part, *self.predict(contact, points[own], nuisance[own], contacts)

    def _block(
        self, rows: np.ndarray, points: Array, nuisance: Array, contacts: Contacts
    ) -> Moments:
        """Moments of the readings of the taxels `rows`, each of which has some; without priors."""
        read = self.readings
        k, count = read.of(rows), read.starts[rows + 1] - read.starts[rows]
        owner, starts = np.repeat(np.arange(len(rows)), count), np.cumsum(count) - count
        mu, jacobian = self.predict(read.contact[k], points[owner], nuisance[owner], contacts)
        jacobian = jacobian[: 3 + nuisance.shape[1] + self.shared]
        level, kind = read.level[k] / self.data.sigma, read.kind[k]
        weight = read.weight[k] * read.precision[k]
        cost, rate, curvature = costs(mu, level, kind)
        square = np.where(kind == OBSERVED, (mu - level) ** 2, 0.0)
        hessian = np.empty((len(rows), len(jacobian), len(jacobian)))
        scaled = jacobian * (weight * curvature)
        for r in range(len(jacobian)):
            lower = np.add.reduceat(scaled[: r + 1] * jacobian[r], starts, axis=1).T
            hessian[:, r, : r + 1] = lower
            hessian[:, :r, r] = lower[:, :r]
        return Moments(
            cost=np.add.reduceat(weight * cost, starts),
            gradient=np.add.reduceat(jacobian * (weight * rate), starts, axis=1).T,
            hessian=hessian,
            square=np.add.reduceat(weight * square, starts),
        )

    def predict(
        self,
        contact: np.ndarray,
        points: Array,
        nuisance: Array,
        contacts: Contacts,
        electronics: Electronics | History | None = None,
    ) -> tuple[Array, Array]:
        """mu (k,) in units of the noise, and its derivatives (C, k) in all unknowns, errors (3) of
        contacts that have them, and with hysteresis those of that of `electronics.source`.

        electronics: as of all readings, where `contact` is theirs; by default none.
        """
        data, names = self.data, self.data.parameters.nuisance_names
        lagging = electronics is not None and "hysteresis" in data.parameters.columns
        columns, first = data.parameters.columns, 3 + len(names)
        last = first + len(data.parameters.sigma)
        size = last + 3 * (bool(contacts.by_load) + lagging)
        jacobian, peak = np.zeros((size, len(contact))), contacts.peaks[contact] / data.sigma
        if "gain" in names:
            gain = nuisance[:, names.index("gain")]
            amplified = 1 + data.response_levels[0] * contacts.compression
            peak = peak * np.exp(amplified * gain)
        mu = self._pressures(contact, points - contacts.points[contact], peak, contacts, jacobian)
        if "gain" in names:
            jacobian[3 + names.index("gain")] = amplified * mu
        if electronics is not None:
            row, scale = 3 + names.index("gain"), np.exp(amplified * gain)
            mu = electronics.apply(mu, jacobian, contacts.s, scale, (row, amplified), first)
        if "compression" in columns:
            row = first + columns["compression"].start
            if "gain" in names:
                jacobian[row] += data.response_levels[0] * gain * mu
            if contacts.by_load:
                level = data.response_levels[1]
                load = level * contacts.load_errors[contact] / (1 + level * contacts.compression)
                jacobian[row] += load * jacobian[last + 2]
                if electronics is not None and lagging:
                    jacobian[row] += load[electronics.source] * jacobian[last + 5]
            mu = self._compressed(mu, jacobian, contacts.compression, first)
        if "offset_drift" in columns:
            at, drifts = columns["offset_drift"], data.drifts[contact] * data.nominal_peak
            jacobian[first + at.start : first + at.stop] = drifts.T / data.sigma
            mu = mu + drifts @ contacts.s[at] / data.sigma
        for row, name in enumerate(names):
            if name != "gain":
                added = data.phase[contact] if name == "drift" else np.ones(len(mu))
                mu, jacobian[3 + row] = mu + added * nuisance[:, row], added
        return mu, jacobian

    def _pressures(
        self, contact: np.ndarray, offset: Array, peak: Array, contacts: Contacts, jacobian: Array
    ) -> Array:
        """Readings (k,) before the electronics, of taxels `offset` (k, 3), m, from their contacts,
        at peak pressures (k,) in units of the noise; writes their derivatives in points, global
        parameters and errors of the contacts into `jacobian`."""
        data, parameters, features = self.data, self.data.parameters, None
        means = disc_means(data.model.name, offset, contact, contacts, data.disc)
        if "profile" in parameters.columns:
            profile = ProfileCorrection(data.profile_extent)
            features, means = corrected_means(means, profile, offset, contact, contacts)
        mean, by_point, by_shape = means
        mu, jacobian[:3] = peak * mean, peak * by_point.T
        by_shape = tuple(peak * by for by in by_shape)
        if contacts.moves is not None:  # a motion of the contact's frame is the taxel's, reversed
            wrench = np.concatenate([by_point, np.cross(offset, by_point)], 1) * peak[:, None]
        first, at = (
            3 + len(parameters.nuisance_names),
            parameters.columns.get("profile", slice(0, 0)),
        )
        for row in np.setdiff1d(np.arange(self.shared), np.arange(at.start, at.stop)):
            jacobian[first + row] = mu * contacts.log_peak[contact, row]
            for by, slope in zip(by_shape, contacts.shape, strict=True):
                jacobian[first + row] += by * slope[contact, row]
            if (moves := contacts.moves) is not None:
                jacobian[first + row] -= np.einsum("ki,ki->k", wrench, moves[contact, :, row])
        if features is not None and self.shared:
            jacobian[first + at.start : first + at.stop] = peak * features.T
        if contacts.by_load:
            last = first + len(parameters.sigma)
            for row, side in enumerate((contacts.directions, contacts.across), last):
                jacobian[row] = -np.einsum("ik,ki->k", jacobian[:3], side[contact])
            *slopes, by_peak = (slope[contact] for slope in contacts.by_load)
            by_axes = sum(by * slope for by, slope in zip(by_shape, slopes, strict=True))
            jacobian[last + 2] = mu * by_peak + by_axes
        return mu

    def _compressed(self, mu: Array, jacobian: Array, compression: float, first: int) -> Array:
        """Compressed readings y / (1 + c y / p), p being the nominal peak; rescales `jacobian`."""
        row = first + self.data.parameters.columns["compression"].start
        relative = mu * (self.data.sigma / self.data.nominal_peak)
        scale = 1 / np.maximum(1 + compression * relative, MIN_DENOMINATOR)
        jacobian *= scale**2
        jacobian[row] -= mu * relative * scale**2
        return np.asarray(mu * scale)
