"""The touches of a recording as the earlier map predicts them, and the readings' likelihood.

A taxel at x reads mu(x - c) under the contact at c. The touch is displaced by an error of standard
deviation tau along each tangent, a taxel by its uncertainty in the map, each reading has an error
sigma and one rho mu of its own, and the size of the patches and the scale of the readings have
errors common to all. Errors of places act through a fit of mu at five points, sqrt(3) standard
deviations apart (Gauss-Hermite), so that the edge of a patch is not taken for a straight slope.
The readings of a unit are then normal with the covariance

    C = sigma^2 + rho^2 mu^2 + bend + edge
        + tau^2 [same contact] A A^T + A S_i A^T [same taxel] + common,

A (k, 3) being the slopes of mu, and edge the variance of readings in contacts over edges of the
body; silent ones are below the threshold, given the others. Errors of the forces, gains and offsets
that the map states enter likewise. Where the calibration of the map learned the response, mu is
that response.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np

from ...contact.reading import same_sheet
from ...core.arrays import Array
from ..data.measurements import Measurements
from ..data.resolve_belief import nominal_patches
from ..joint.contact_state import Contacts
from ..joint.contacts import LinearizedContacts
from ..joint.likelihood import MIN_DENOMINATOR, Likelihood
from ..joint.pressure import disc_means
from ..joint.readings import Readings
from ..localization import CalibratedSkin
from .blocks import Block, Errors
from .hypotheses import Hypothesis
from .skin_map import SkinMap

MARGIN = 2e-3
"""Distance beyond reach, m, within which a taxel may answer by the errors of places."""
MAX_STEP = 1.5e-3
"""Largest standard deviation of a place, m, over which mu is fitted: a third of a usual patch."""
E_STEP = 0.02
"""Step of ln E* in the difference that gives the slope of mu: small against its uncertainty."""
STEPS = 2
"""Gauss-Newton steps to where the readings place a taxel."""


class Touches:
    """Measurements of the touches, relative to the median of the peaks."""

    def __init__(
        self, data: Measurements, known: SkinMap, skin: CalibratedSkin | None = None
    ) -> None:
        """skin: the response that the map's calibration learned; None: the contact model's."""
        self.data, self.known, self.skin = data, known, skin
        self.unit = float(np.median(data.peaks))
        self.force_scatter, self.log_modulus = 0.0, 0.0
        self.compression, self.groups = np.zeros(1), np.zeros(len(data.ids), dtype=int)
        """Compression of each group of responses, and group (n,) of each taxel."""
        if skin is not None:
            self.force_scatter, at = skin.deviations.force, skin.data.parameters.columns
            self.compression = skin.s[at["compression"]] * self.unit / skin.data.nominal_peak
            self.log_modulus = float(skin.s[at["modulus"]].min())  # of the widest patches
            self.groups = skin.data.groups
        self.threshold = data.threshold / self.unit
        self.edges = data.edge_variance * (data.sigma / self.unit) ** 2
        """Variance (m,) of readings by edges of the body under the contacts."""
        m, n = len(data.points), len(data.ids)
        self.level = np.full((m, n), np.nan)
        self.level[data.contact, data.taxel] = data.pressure / self.unit
        self.void = np.zeros((m, n), dtype=bool)
        self.void[data.corrupt[:, 0], data.corrupt[:, 1]] = True
        saturated = data.pressure >= data.ends[data.taxel]
        self.void[data.contact[saturated], data.taxel[saturated]] = True
        self.across = np.cross(data.normals, data.directions)
        self._contacts: dict[float, Contacts] = {}

    def blocks(
        self, unit: int, hypotheses: list[Hypothesis], errors: Errors, same_pairs: bool = False,
        level: Array | None = None,
    ) -> list[Block]:  # fmt: skip
        """The block of each hypothesis about a unit of k taxels. same_pairs: whether all have the
        pairs of all of them. level: readings (m, k), NaN where silent, in place of its own."""
        rows = self.known.units[unit]
        level = self.level[:, rows] if level is None else level
        points = np.stack([h.points for h in hypotheses])
        normals = np.stack([h.normals for h in hypotheses])
        reach = self.reach(errors.log_modulus) + MARGIN
        offset = points[:, :, None] - self.data.points
        near = np.einsum("hkmi,hkmi->hkm", offset, offset) < (1.25 * reach) ** 2
        which, taxel, contact = np.nonzero(near)
        near[which, taxel, contact] = same_sheet(
            offset[which, taxel, contact], self.data.normals[contact], normals[which, taxel]
        )
        read = np.isfinite(level).T
        own = (near | read) & ~self.void[:, rows].T
        pairs = np.broadcast_to(own.any(axis=0), own.shape) if same_pairs else own
        which, taxel, contact = np.nonzero(pairs)
        covariance = np.stack([h.covariance for h in hypotheses])
        spread = np.trace(covariance, axis1=2, axis2=3)[which, taxel] / 2 + errors.tau**2
        spread += np.array([h.shift_sigma for h in hypotheses])[which] ** 2
        group = self.groups[rows][taxel]
        predicted = self._predict(
            offset[which, taxel, contact], contact, group,
            np.sqrt(spread).clip(max=MAX_STEP), errors,
        )  # fmt: skip
        gain = np.exp(np.stack([h.log_gain for h in hypotheses]))[which, taxel]
        gain = np.where(own[which, taxel, contact], gain, 0.0)
        scale, known = self.unit * self.data.unit, self.known
        columns = (
            *self._read(gain, group, *predicted),
            known.log_gain[rows, 1][taxel],
            known.offset[rows, 1][taxel] / scale,
        )
        columns[0][:] += known.offset[rows, 0][taxel] / scale
        level = level[contact, taxel]
        ends = np.searchsorted(which, np.arange(len(hypotheses) + 1))
        return [
            Block(h, contact[a:b], taxel[a:b], level[a:b], *(x[a:b] for x in columns))
            for h, (a, b) in zip(hypotheses, pairwise(ends), strict=True)
        ]

    def straight(
        self, unit: int, state: Hypothesis, errors: Errors, level: Array | None = None
    ) -> Block:
        """The block of a state of a unit, linearized where its readings place the taxels, and not
        over all that the map leaves open: `bend` is then that of what they leave open. level: as
        in `blocks`."""
        (block,) = self.blocks(unit, [state], errors, level=level)
        for _ in range(STEPS if block.read.any() else 0):
            shift, covariance = block.displacements(errors)
            there = replace(state, points=state.points + shift, covariance=covariance)
            (block,) = self.blocks(unit, [there], errors, level=level)
            back = np.einsum("qi,qi->q", block.slope, shift[block.taxel])
            block = replace(block, hypothesis=state, mean=block.mean - back)
        return block

    def reach(self, log_modulus: float = 0.0) -> Array:
        """Distance (m,), m, across each contact at which a taxel's disc leaves the patch, under E*
        times exp(log_modulus)."""
        scale = float(np.exp(-(log_modulus + self.log_modulus) / 3))
        extent = 1.0 if self.skin is None else max(self.skin.data.profile_extent, 1.0)
        return np.asarray(scale * extent * self.data.longest + self.data.disc)

    def _read(
        self, gain: Array, group: np.ndarray, mean: Array, slope: Array, bend: Array,
        by_modulus: Array,
    ) -> tuple[Array, ...]:  # fmt: skip
        """mu (q,) with its slopes (q, 3), bend (q,), and slopes (q,) in ln E* and ln gain, of
        levels times `gain` (q,), compressed as those of a group (q,)."""
        mean = gain * mean
        kept = 1 / np.maximum(1 + self.compression[group] * mean, MIN_DENOMINATOR)
        factor = gain * kept**2
        return (
            mean * kept, factor[:, None] * slope, factor**2 * bend, factor * by_modulus,
            mean * kept**2,
        )  # fmt: skip

    def _predict(
        self, offset: Array, contact: np.ndarray, group: np.ndarray, step: Array, errors: Errors
    ) -> tuple[Array, Array, Array, Array]:
        """mu (q,) of taxels of a group (q,), its slopes (q, 3), its bend (q,) and its slope (q,) in
        ln E*."""
        along, across = self.data.directions[contact], self.across[contact]
        h = np.sqrt(3.0) * step[:, None]
        moves = np.stack([0 * along, h * along, -h * along, h * across, -h * across])
        q = len(offset)
        around = self._means(
            (offset + moves).reshape(-1, 3), np.tile(contact, 5), errors.log_modulus,
            np.tile(group, 5),
        ).reshape(5, q)  # fmt: skip
        stiffer = self._means(offset, contact, errors.log_modulus + E_STEP, group)
        slope = ((around[1] - around[2]) / (2 * h[:, 0]))[:, None] * along
        slope += ((around[3] - around[4]) / (2 * h[:, 0]))[:, None] * across
        curve = [(around[k] + around[k + 1] - 2 * around[0]) / 6 for k in (1, 3)]
        scale = float(np.exp(errors.log_scale))
        mean, bend = around[0] + curve[0] + curve[1], 2 * (curve[0] ** 2 + curve[1] ** 2)
        by_modulus = (stiffer - around[0]) / E_STEP
        bend = scale**2 * bend + self.edges[contact]
        return scale * mean, scale * slope, bend, scale * by_modulus

    def _means(
        self, offset: Array, contact: np.ndarray, log_modulus: float, group: np.ndarray | int = 0
    ) -> Array:
        """Levels (q,) of taxels of a group (q,), `offset` (q, 3), m, from their contacts."""
        contacts = self._contacts.get(log_modulus)
        if contacts is None:
            contacts = self._contacts[log_modulus] = self._contacts_at(log_modulus)
        found = np.zeros(len(contact))
        rows = np.flatnonzero(self._is_pressed(offset, contact, contacts))
        offset, contact = offset[rows], contact[rows]
        if (skin := self.skin) is None:
            mean = disc_means(self.data.model.name, offset, contact, contacts, self.data.disc)[0]
            level = np.maximum(mean, 0.0) * contacts.patches.peak[contact]
        else:  # before gain, compression and offset
            given = replace(skin.data, contact_errors=contacts.points)  # no derivatives in them
            likelihood, points = Likelihood(given, Readings.none()), contacts.points[contact]
            nuisance = np.zeros((len(contact), skin.nuisance.shape[1]))
            group = np.broadcast_to(group, len(found))[rows]
            mean = likelihood.predict(contact, points + offset, nuisance, contacts, group)[0]
            level = np.maximum(mean * skin.data.sigma, 0.0)
        found[rows] = level / self.unit
        return found

    def _is_pressed(self, offset: Array, contact: np.ndarray, contacts: Contacts) -> np.ndarray:
        """Whether the disc of a taxel `offset` (q, 3), m, meets the patch: levels are zero beyond,
        but for drifts."""
        if self.skin is not None and "offset_drift" in self.skin.data.parameters.columns:
            return np.ones(len(offset), dtype=bool)
        axes = [np.maximum(x.patches.first, x.patches.second) for x in contacts.each]
        longest = np.max(axes, axis=0)
        extent = 1.0 if self.skin is None else self.skin.data.profile_extent
        reach = np.maximum(extent * longest, longest + self.data.disc)[contact]
        along = np.einsum("qi,qi->q", offset, contacts.normals[contact])
        return np.asarray(np.einsum("qi,qi->q", offset, offset) - along**2 <= reach**2)

    def _contacts_at(self, log_modulus: float) -> Contacts:
        """The contacts under E* times exp(log_modulus)."""
        data = self.data
        if self.skin is None:
            modulus = data.modulus * np.exp(log_modulus)
            patches = nominal_patches(data.model, data.belief, data.force, data.curvature, modulus)
            none = np.zeros((len(data.points), 0))
            return Contacts(data.points, data.normals, data.directions, patches, (), none, None)
        s = self.skin.s.copy()
        s[self.skin.data.parameters.columns["modulus"]] += log_modulus
        each = LinearizedContacts(self.skin.data, s).at(s).each
        first, *others = (replace(x, compression=0.0, by_load=(), moves=None) for x in each)
        return replace(first, others=tuple(others))
