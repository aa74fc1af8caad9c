"""The likelihood of all readings: its value, gradient and Gauss-Newton Hessian, taxel by taxel.

The unknowns of a taxel are its position x (3) in the body frame, its declared nuisance parameters
(gain and offset), and the global parameters. How x depends on coordinates in a chart or on a
module's pose is the parametrization's. Readings are sorted by taxel, and evaluated in blocks.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ...contact.learned import ProfileCorrection
from ...core.arrays import Array
from ..data.global_parameters import nuisance_unit
from ..data.measurements import Measurements
from .contact_state import Contacts
from .electronics import Electronics
from .pressure import OBSERVED, corrected_means, costs, disc_means
from .readings import Readings

if TYPE_CHECKING:
    from .known_past import History

MIN_DENOMINATOR = 0.05
"""Least denominator of a compressed reading: no sensor expands readings by more than 20."""
BLOCK = 8192
"""Readings of a block: their derivatives, some 100 B each, stay in the cache."""


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
        """Prior standard deviations of NUISANCE; of pressures in units of the noise."""
        p, unit = self.data.parameters, self.data.sigma
        both = zip(p.nuisance_names, p.nuisance_sigma, strict=True)
        return tuple(sigma / nuisance_unit(name, unit) for name, sigma in both)

    def groups(self, taxels: np.ndarray) -> np.ndarray | int:
        """Groups of some taxels, as `Measurements.groups`; 0 where there is one."""
        if self.data.parameters.groups == 1:
            return 0
        return np.asarray(self.data.groups[self.readings.live[taxels]])

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
            weight = read.weight[part] * read.precision[part]
            parts.append(weight * curvature * np.sum(jacobian * seen, axis=0))
        return np.concatenate(parts)

    def _each(
        self, points: Array, nuisance: Array, contacts: Contacts
    ) -> Iterator[tuple[slice, Array, Array]]:
        """Blocks of readings, their mu and its derivatives (C, k)."""
        for begin in range(0, len(self.readings.taxel), BLOCK):
            part = slice(begin, begin + BLOCK)
            own, contact = self.readings.taxel[part], self.readings.contact[part]
            group = self.groups(own)
            yield part, *self.predict(contact, points[own], nuisance[own], contacts, group)

    def _block(
        self, rows: np.ndarray, points: Array, nuisance: Array, contacts: Contacts
    ) -> Moments:
        """Moments of the readings of the taxels `rows`, each of which has some; without priors."""
        read = self.readings
        k, count = read.of(rows), read.starts[rows + 1] - read.starts[rows]
        owner, starts = np.repeat(np.arange(len(rows)), count), np.cumsum(count) - count
        mu, jacobian = self.predict(
            read.contact[k], points[owner], nuisance[owner], contacts, self.groups(rows[owner])
        )
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
        group: np.ndarray | int = 0,
        electronics: Electronics | History | None = None,
    ) -> tuple[Array, Array]:
        """mu (k,) in units of the noise, and its derivatives (C, k) in all unknowns, errors (3) of
        contacts that have them, and with hysteresis those of that of `electronics.source`.

        group (k,): of the taxels, where groups of them have responses of their own; electronics: as
        of all readings, where `contact` is theirs; by default none.
        """
        data, names = self.data, self.data.parameters.nuisance_names
        columns, first = data.parameters.columns, 3 + len(names)
        lagging = electronics is not None and "hysteresis" in columns
        last = first + len(data.parameters.sigma)
        jacobian = np.zeros((last + 3 * (bool(contacts.by_load) + lagging), len(contact)))
        if not contacts.others:
            mu, group = self._levels(contact, points, nuisance, contacts, jacobian), 0
        else:
            mu = np.empty(len(contact))
            for felt in contacts.each:
                rows = np.flatnonzero(np.broadcast_to(group, len(contact)) == felt.group)
                part = jacobian[:, rows]
                mu[rows] = self._levels(contact[rows], points[rows], nuisance[rows], felt, part)
                jacobian[:, rows] = part
        compression = np.array([x.compression for x in contacts.each])[group]
        amplified = 1 + data.response_levels[0] * compression
        if electronics is not None:
            row = 3 + names.index("gain")
            scale = np.exp(amplified * nuisance[:, names.index("gain")])
            mu = electronics.apply(mu, jacobian, contacts.s, scale, (row, amplified), first)
        if "compression" in columns:
            own = first + columns["compression"].start + group, np.arange(len(mu))
            if "gain" in names:
                gain = nuisance[:, names.index("gain")]
                jacobian[own] += data.response_levels[0] * gain * mu
            if contacts.by_load:  # the errors are those of the first group's readings
                level, row = data.response_levels[1], first + columns["compression"].start
                load = level * contacts.load_errors[contact] / (1 + level * contacts.compression)
                jacobian[row] += load * jacobian[last + 2]
                if electronics is not None and lagging:
                    jacobian[row] += load[electronics.source] * jacobian[last + 5]
            mu = self._compressed(mu, jacobian, compression, own)
        if "offset_drift" in columns:
            at, drifts = columns["offset_drift"], data.drifts[contact] * data.nominal_peak
            jacobian[first + at.start : first + at.stop] = drifts.T / data.sigma
            mu = mu + drifts @ contacts.s[at] / data.sigma
        for row, name in enumerate(names):
            if name in ("offset", "drift"):
                added = data.phase[contact] if name == "drift" else np.ones(len(mu))
                mu, jacobian[3 + row] = mu + added * nuisance[:, row], added
        return mu, jacobian

    def _levels(
        self, contact: np.ndarray, points: Array, nuisance: Array, contacts: Contacts, out: Array
    ) -> Array:
        """Levels (k,) before electronics and compression, in units of the noise, with the response
        of one group; writes their derivatives into `out`, as of `predict`."""
        data, names = self.data, self.data.parameters.nuisance_names
        offset = points - contacts.points[contact]
        if "skew" in names:
            offset = offset + nuisance[:, [names.index("skew")]] * data.headway[contact]
        columns, first = data.parameters.columns_of(contacts.group), 3 + len(names)
        means, features = disc_means(data.model.name, offset, contact, contacts, data.disc), None
        if "profile" in columns:
            correction = ProfileCorrection(data.profile_extent)
            features, means = corrected_means(means, correction, offset, contact, contacts)
        mean, by_point, by_shape = means
        peak = contacts.peaks[contact] / data.sigma
        if "gain" in names:
            gain = nuisance[:, names.index("gain")]
            amplified = 1 + data.response_levels[0] * contacts.compression
            peak = peak * np.exp(amplified * gain)
            out[3 + names.index("gain")] = amplified * peak * mean
        mu = peak * mean
        out[:3] = peak * by_point.T
        if "skew" in names:
            along = np.einsum("ik,ki->k", out[:3], data.headway[contact])
            out[3 + names.index("skew")] = along
        by_shape = tuple(peak * by for by in by_shape)
        if contacts.moves is not None:  # a motion of the contact's frame is the taxel's, reversed
            wrench = np.concatenate([by_point, np.cross(offset, by_point)], 1) * peak[:, None]
        profile = data.parameters.columns.get("profile", slice(0, 0))
        for row in np.setdiff1d(np.arange(self.shared), np.arange(profile.start, profile.stop)):
            out[first + row] = mu * contacts.log_peak[contact, row]
            for by, slope in zip(by_shape, contacts.shape, strict=True):
                out[first + row] += by * slope[contact, row]
            if (moves := contacts.moves) is not None:
                out[first + row] -= np.einsum("ki,ki->k", wrench, moves[contact, :, row])
        if features is not None and self.shared:
            at = columns["profile"]
            out[first + at.start : first + at.stop] = peak * features.T
        if contacts.by_load:
            last = first + len(data.parameters.sigma)
            for row, side in enumerate((contacts.directions, contacts.across), last):
                out[row] = -np.einsum("ik,ki->k", out[:3], side[contact])
            *slopes, by_peak = (slope[contact] for slope in contacts.by_load)
            by_axes = sum(by * slope for by, slope in zip(by_shape, slopes, strict=True))
            out[last + 2] = mu * by_peak + by_axes
        return np.asarray(mu)

    def _compressed(
        self,
        mu: Array,
        jacobian: Array,
        compression: Array,
        own: tuple[np.ndarray | int, np.ndarray],
    ) -> Array:
        """Compressed readings y / (1 + c y / p), p being the nominal peak; rescales `jacobian`,
        whose entries `own` are the derivatives in c."""
        relative = mu * (self.data.sigma / self.data.nominal_peak)
        scale = 1 / np.maximum(1 + compression * relative, MIN_DENOMINATOR)
        jacobian *= scale**2
        jacobian[own] -= mu * relative * scale**2
        return np.asarray(mu * scale)
