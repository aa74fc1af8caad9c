"""Contacts localized on the body from their readings alone, by a calibrated skin.

The likelihood of a contact's readings, silences and saturated readings included, is maximized over
the two surface coordinates of the contact; its force is as measured. The measurement function is
the one that the skin was calibrated with (joint/likelihood.py): positions, gains, offsets, E* or
learned response.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from ..core.arrays import Array, means_by_group, sums_by_group
from .calibration import Calibration
from .data.global_parameters import MOTION, MOVES, nuisance_unit
from .data.measurements import Measurements
from .data.pairs import answering, near_pairs
from .data.resolve_belief import contact_model
from .joint.contact_state import Contacts
from .joint.contacts import LinearizedContacts
from .joint.known_past import KnownPast
from .joint.likelihood import Likelihood
from .joint.pressure import CENSORED, OBSERVED, SATURATED, costs
from .joint.readings import Readings
from .learned.deviations import Deviations
from .learned.estimate import as_learned

Pairs = tuple[np.ndarray, np.ndarray, Array, np.ndarray]
"""Contact, taxel, level and kind of readings."""

LEAST = 3
"""Readings of a contact that is localized: of two, one is left to choose between the two places
that mirror each other across the line between both taxels."""
AT_REST = 5.0
"""Standard deviations above what a taxel reads at rest, from which it is pressed."""
AWAY = 10.0
"""Distance, in reaches, at which a taxel is not pressed."""
START = 0.5
"""Distance of the other four starts from the centroid of the taxels that read, in contact radii."""
STEP = 0.5
"""Longest step, in contact radii."""
ITERATIONS = 30
"""Largest number of steps; 6 to 10 are usual."""
CONVERGED = 1e-7
"""Length of a step, m, from which a contact is localized."""
FLOOR = 1e-9
"""Least damping, relative to the largest curvature of a contact: no taxel in reach has none."""


@dataclass(frozen=True)
class CalibratedSkin:
    """The measurement function of a calibration, for all contacts of a recording."""

    data: Measurements
    """All measurements; the contacts where the calibration puts them."""
    s: Array
    """Global parameters (ks,), but for those that move contacts."""
    live: np.ndarray
    """Rows of the determined taxels."""
    points: Array
    """Positions (n, 3), m; NaN where not determined."""
    normals: Array
    """Outward normals (n, 3)."""
    nuisance: Array
    """Gains and offsets (n, .) as `Likelihood.predict` takes them."""
    deviations: Deviations
    """Of the noise, of contact points and of forces."""
    covariances: Array
    """Of the positions (n, 3, 3), body frame, m^2."""
    past: KnownPast | None = None
    """What the taxels were pressed with before; None without hysteresis and creep."""

    @classmethod
    def of(cls, calibration: Calibration, data: Measurements) -> CalibratedSkin:
        """The skin of a calibration that has its belief, for the contacts of `data`."""
        belief = calibration.belief
        assert belief is not None
        if belief.contact != data.model.name:
            data = replace(data, belief=belief, model=contact_model(belief))
            data = data.at_contacts(data.body.closest(data.points))
        found = np.nan if calibration.fit is None else calibration.fit.noise
        noise = found / data.sigma if np.isfinite(found) and found > 0 else 1.0
        deviations = Deviations(noise, position=0.0, force=0.0)
        if (response := calibration.response) is not None:
            data = as_learned(data, response, calibration.unknowns, calibration.positions)
            deviations = Deviations(
                response.noise / (data.sigma * data.unit),
                response.noise_relative,
                position=response.contact_scatter,
                force=response.force_scatter,
            )
        data, nuisance = _with_taxel_unknowns(calibration, data)
        data, s = _in_place(data, _shared(calibration, data))
        rotation = calibration.poses[:, :3, :3]
        local = calibration.covariances[:, :3, :3]
        live = np.flatnonzero(np.isfinite(calibration.poses).all(axis=(1, 2)))
        covariances = np.zeros((len(data.ids), 3, 3))
        covariances[live] = rotation[live] @ local[live] @ np.swapaxes(rotation[live], 1, 2)
        return cls(
            past=KnownPast.of(data, live, calibration.positions, rotation[:, :, 2], nuisance, s),
            data=data,
            s=s,
            live=live,
            points=calibration.positions,
            normals=rotation[:, :, 2],
            nuisance=nuisance,
            deviations=deviations,
            covariances=covariances,
        )

    def read(self, contacts: np.ndarray) -> np.ndarray:
        """Rows of the readings of `contacts` by determined taxels, sorted by contact."""
        mine = np.zeros(len(self.data.points), dtype=bool)
        mine[contacts] = True
        determined = np.isfinite(self.points[self.data.taxel, 0])
        rows = np.flatnonzero(mine[self.data.contact] & determined)
        return rows[np.argsort(self.data.contact[rows], kind="stable")]

    def centroids(self, contacts: np.ndarray) -> Array:
        """Means (m, 3), m, of the positions of the taxels that read in `contacts`, weighted by
        their readings, on the surface; NaN for other contacts and those without readings."""
        return self._means(self.read(contacts))

    def _pressed(self, contacts: np.ndarray) -> np.ndarray:
        """Rows of the readings of `contacts` not of taxels at rest, by hysteresis, creep, drift."""
        data, rows = self.data, self.read(contacts)
        if self.past is None and "drift" not in data.parameters.nuisance_names:
            return rows
        contact, taxel = data.contact[rows], data.taxel[rows]
        where = LinearizedContacts(data, self.s).at(self.s)
        away = data.points[contact] + AWAY * data.reach()[contact, None] * where.directions[contact]
        mu = self._predict(data, contact, taxel, where, away)[0]
        limit = mu + AT_REST * self.deviations.noise_of(mu)
        return rows[data.pressure[rows] / data.sigma > limit]

    def _means(self, rows: np.ndarray) -> Array:
        """`centroids` of the readings `rows`, sorted by contact."""
        m = len(self.data.points)
        contact, weight = self.data.contact[rows], self.data.pressure[rows]
        mean = means_by_group(self.points[self.data.taxel[rows]], contact, m, weight)
        some = np.isfinite(mean[:, 0])
        mean[some] = self.data.body.closest(mean[some]).point
        return mean

    def localize(self, contacts: np.ndarray) -> Array:
        """Places (m, 3), m, of `contacts` (rows); NaN for others, and for those that fewer than
        LEAST taxels read."""
        data = self.data
        pressed = self._pressed(contacts)
        count = np.bincount(data.contact[pressed], minlength=len(data.points))
        contacts = contacts[count[contacts] >= LEAST]
        middle = self._means(self._pressed(contacts))[contacts]
        best, least = middle, np.full(len(contacts), np.inf)
        if not len(contacts):
            return np.full(data.points.shape, np.nan)
        hit = data.body.closest(middle)
        across, radius = np.cross(hit.normal, hit.direction), START * data.radii[contacts, None]
        for a, b in ((0, 0), (1, 0), (-1, 0), (0, 1), (0, -1)):
            start = middle + radius * (a * hit.direction + b * across)
            found, cost = self._climb(contacts, start)
            better = cost < least
            best = np.where(better[:, None], found, best)
            least = np.where(better, cost, least)
        out = np.full(data.points.shape, np.nan)
        out[contacts] = best
        return out

    def _climb(self, rows: np.ndarray, start: Array) -> tuple[Array, Array]:
        """Places (h, 3), m, of least cost near `start` (h, 3) of the contacts `rows`, and their
        costs (h,): Levenberg and Marquardt's method, on the surface."""
        pairs = self._pairs(rows, start)
        cost, *state = self._cost(rows, self._moved(rows, start), pairs)
        damping = np.full(len(rows), 1e-3)
        limit = STEP * self.data.radii[rows]
        for _ in range(ITERATIONS):
            place, sides, gradient, hessian = state
            diagonal = np.einsum("hii->hi", hessian)
            added = damping[:, None] * diagonal + FLOOR * (1 + diagonal.max())
            matrix = hessian + added[:, :, None] * np.eye(2)
            step = -np.linalg.solve(matrix, gradient[:, :, None])[:, :, 0]
            length = np.linalg.norm(step, axis=1)
            step *= np.minimum(1.0, limit / np.maximum(length, 1e-300))[:, None]
            trial = place + np.einsum("hai,ha->hi", sides, step)
            tried, *values = self._cost(rows, self._moved(rows, trial), pairs)
            lower = tried < cost
            cost = np.where(lower, tried, cost)
            for old, new in zip(state, values, strict=True):
                old[lower] = new[lower]
            damping = np.clip(np.where(lower, damping / 5, damping * 5), 1e-6, 1e9)
            if length.max() < CONVERGED:
                break
        return state[0], cost

    def _moved(self, rows: np.ndarray, places: Array) -> Measurements:
        """The measurements with the contacts `rows` at the closest surface points to `places`."""
        points = self.data.points.copy()
        points[rows] = places
        return self.data.at_contacts(self.data.body.closest(points))

    def _pairs(self, rows: np.ndarray, start: Array) -> Pairs:
        """Contact, taxel, level and kind of the readings of the contacts `rows`, and of the silent
        taxels within two reaches of `start` (h, 3)."""
        data, live, read = self.data, self.live, self.read(rows)
        reach = np.zeros(len(data.points))
        reach[rows] = 2 * data.reach()[rows]
        around = self._moved(rows, start)
        contact, taxel = near_pairs(around, self.points[live], self.normals[live], reach)
        number = live[taxel] * len(data.points) + contact
        known = np.concatenate([data.taxel, data.corrupt[:, 1]]) * len(data.points)
        known = known + np.concatenate([data.contact, data.corrupt[:, 0]])
        silent = ~np.isin(number, known) & answering(data, contact, live[taxel])
        contact, taxel = contact[silent], live[taxel[silent]]
        pressure = data.pressure[read]
        end = data.ends[data.taxel[read]]
        kind = np.where(pressure < end, OBSERVED, SATURATED)
        return (
            np.concatenate([data.contact[read], contact]),
            np.concatenate([data.taxel[read], taxel]),
            np.concatenate([np.minimum(pressure, end), np.full(len(contact), data.threshold)]),
            np.concatenate([kind, np.full(len(contact), CENSORED)]),
        )

    def _cost(
        self, rows: np.ndarray, at: Measurements, pairs: Pairs
    ) -> tuple[Array, Array, Array, Array, Array]:
        """Of the contacts `rows` of `at`: costs (h,), points (h, 3), principal directions
        (h, 2, 3), and along these gradients (h, 2) and Gauss-Newton Hessians (h, 2, 2)."""
        contact, taxel, level, kind = pairs
        contacts, m = LinearizedContacts(at, self.s).at(self.s), len(at.points)
        mu, jacobian = self._predict(at, contact, taxel, contacts)
        level = level / at.sigma
        spread = self.deviations.noise_of(np.where(kind == CENSORED, 0.0, level))
        cost, rate, curvature = costs(mu / spread, level / spread, kind)
        sides = np.stack([at.directions, np.cross(at.normals, at.directions)], axis=1)
        slopes = -np.einsum("ik,kai->ka", jacobian[:3], sides[contact]) / spread[:, None]
        squares = slopes[:, :, None] * slopes[:, None, :] * curvature[:, None, None]
        return (
            np.bincount(contact, cost, m)[rows],
            at.points[rows],
            sides[rows],
            sums_by_group(slopes * rate[:, None], contact, m)[rows],
            sums_by_group(squares, contact, m)[rows],
        )

    def _predict(
        self, at: Measurements, contact: np.ndarray, taxel: np.ndarray, contacts: Contacts,
        points: Array | None = None,
    ) -> tuple[Array, Array]:  # fmt: skip
        points = self.points[taxel] if points is None else points
        before = None if self.past is None else self.past.before(contact, taxel)
        likelihood, group = Likelihood(at, Readings.none()), at.groups[taxel]
        return likelihood.predict(contact, points, self.nuisance[taxel], contacts, group, before)

    def log_likelihoods(self, contacts: np.ndarray) -> tuple[Array, np.ndarray]:
        """Logarithms (m,) of the joint densities of the readings of `contacts` at their recorded
        places and forces, and the numbers (m,) of these readings; 0 for other contacts.

        The densities are normal, in the recorded unit, with the noise and the errors of contact
        points, forces and taxel positions that the calibration states. Saturated readings and
        silences are left out.
        """
        data, d = self.data, self.deviations
        rows = self.read(contacts)
        rows = rows[data.pressure[rows] < data.ends[data.taxel[rows]]]
        contact, taxel = data.contact[rows], data.taxel[rows]
        count = np.bincount(contact, minlength=len(data.points))
        errors = np.zeros((len(data.points), 3))
        where = LinearizedContacts(data, self.s).with_errors(self.s, errors)
        mu, jacobian = self._predict(data, contact, taxel, where)
        off = data.pressure[rows] / data.sigma - mu
        own = np.einsum("ik,kij,jk->k", jacobian[:3], self.covariances[taxel], jacobian[:3])
        variance = d.noise_of(mu) ** 2 + data.edge_variance[contact] + own
        last = 3 + self.nuisance.shape[1] + len(self.s)
        shared = jacobian[last : last + 3].T * [d.position, d.position, d.force]
        out, ends = np.zeros(len(data.points)), np.cumsum(count)
        for k in np.flatnonzero(count):
            part = slice(ends[k] - count[k], ends[k])
            covariance = np.diag(variance[part]) + shared[part] @ shared[part].T
            quadratic = off[part] @ np.linalg.solve(covariance, off[part])
            out[k] = -(quadratic + np.linalg.slogdet(2 * np.pi * covariance)[1]) / 2
        return out - count * np.log(data.sigma * data.unit), count


def _with_taxel_unknowns(
    calibration: Calibration, data: Measurements
) -> tuple[Measurements, Array]:
    """The measurements with the parameters of single taxels that a calibration estimated, and their
    values (n, .) as `Likelihood.predict` takes them."""
    if calibration.taxel_unknowns:
        p = data.parameters.with_nuisance(data.nominal_peak, calibration.taxel_unknowns)
        data = replace(data, parameters=p)
    none, pressure = np.zeros((len(data.ids), 2)), data.sigma * data.unit
    columns = [
        np.nan_to_num(values[:, 0] / nuisance_unit(name, pressure))
        for name in data.parameters.nuisance_names
        for values in [calibration.taxel_unknowns.get(name, none)]
    ]
    return data, np.stack(columns, axis=1) if columns else none[:, :0]


def _shared(calibration: Calibration, data: Measurements) -> Array:
    """The global parameters (ks,) of a calibration; those that it did not estimate are zero."""
    labels, columns = data.parameters.labels, data.parameters.columns
    s = np.array([calibration.unknowns.get(label, (0.0, 0.0))[0] for label in labels])
    if calibration.response is not None:
        s[columns["profile"]] = np.concatenate([r.coefficients for r in calibration.response.each])
    if (motion := data.parameters.motion) is not None:
        found = np.array([calibration.unknowns[label][0] for label in motion.labels])
        s[columns[MOTION]] = np.linalg.pinv(motion.root) @ (found - motion.mean)
    return s


def _in_place(data: Measurements, s: Array) -> tuple[Measurements, Array]:
    """The measurements with the contacts where s (ks,) puts them, and the rest of s."""
    if not data.parameters.move_contacts:
        return data, s
    data = data.at_contacts(data.body.closest(LinearizedContacts(data, s).at(s).points))
    still, rows = data.parameters.without(MOVES)
    return replace(data, parameters=still), s[rows]
