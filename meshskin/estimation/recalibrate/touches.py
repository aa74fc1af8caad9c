"""The touches of a recording as the earlier map predicts them, and the readings' likelihood.

A taxel at x reads mu(x - c) under the contact at c. The touch is displaced by an error of standard
deviation tau along each tangent, a taxel by its uncertainty in the map, each reading has an error
sigma and one rho mu of its own, and the size of the patches and the scale of the readings have
errors common to all. Errors of places act through a fit of mu at five points, sqrt(3) standard
deviations apart (Gauss-Hermite), so that the edge of a patch is not taken for a straight slope.
The readings of a unit are then normal with the covariance

    C = sigma^2 + rho^2 mu^2 + bend + tau^2 [same contact] A A^T + A S_i A^T [same taxel] + common,

A (k, 3) being the slopes of mu; silent ones are below the threshold, given the others.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from scipy.special import log_ndtr

from ...contact import Patches
from ...contact.reading import same_sheet
from ...core.arrays import Array
from ..data.measurements import Measurements
from ..joint.contacts import Contacts
from ..joint.pressure import disc_means
from .hypotheses import Hypothesis

MARGIN = 2e-3
"""Distance beyond reach, m, within which a taxel may answer by the errors of places."""
MAX_STEP = 1.5e-3
"""Largest standard deviation of a place, m, over which mu is fitted: a third of a usual patch."""
E_STEP = 0.02
"""Step of ln E* in the difference that gives the slope of mu: small against its uncertainty."""
LOG_2PI = float(np.log(2 * np.pi))


@dataclass(frozen=True)
class Errors:
    """Standard deviations of the errors of readings, and the common errors."""

    sigma: float
    """Of each reading, relative to the typical peak."""
    tau: float
    """Of the contact points along each tangent, m."""
    rho: float
    """Of each reading, relative to itself."""
    log_modulus: float = 0.0
    """ln of E* relative to the map's."""
    log_scale: float = 0.0
    """ln of the scale of all readings."""
    common: tuple[tuple[float, float], tuple[float, float]] = ((0.0, 0.0), (0.0, 0.0))
    """Covariance of the last two."""


@dataclass(frozen=True)
class Block:
    """The readings of a unit under a hypothesis: q pairs of a contact and a taxel."""

    contact: np.ndarray
    taxel: np.ndarray
    """Taxel (q,) of the unit, counted in it."""
    level: Array
    """Reading (q,) relative to the typical peak; NaN where silent."""
    mean: Array
    """mu (q,)."""
    slope: Array
    """A (q, 3), 1/m."""
    bend: Array
    """Variance (q,) by the curvature of mu."""
    by_modulus: Array
    """d mu / d ln E* (q,)."""

    @property
    def read(self) -> np.ndarray:
        """Whether the pairs (q,) gave a reading."""
        return np.isfinite(self.level)


class Touches:
    """Measurements of the touches, relative to the median of the peaks."""

    def __init__(self, data: Measurements) -> None:
        self.data, self.unit = data, float(np.median(data.peaks))
        self.threshold = data.threshold / self.unit
        m, n = len(data.points), len(data.ids)
        self.level = np.full((m, n), np.nan)
        self.level[data.contact, data.taxel] = data.pressure / self.unit
        self.void = np.zeros((m, n), dtype=bool)
        self.void[data.corrupt[:, 0], data.corrupt[:, 1]] = True
        self.across = np.cross(data.normals, data.directions)
        self._patches: dict[float, Patches] = {}

    def blocks(
        self, rows: np.ndarray, covariance: Array, hypotheses: list[Hypothesis], errors: Errors
    ) -> list[Block]:
        """The block of each hypothesis about the taxels `rows` (k,), whose places have the
        covariances (k, 3, 3), m^2."""
        points = np.stack([h.points for h in hypotheses])
        normals = np.stack([h.normals for h in hypotheses])
        reach = self.data.reach(float(np.exp(-errors.log_modulus / 3))) + MARGIN
        offset = points[:, :, None] - self.data.points
        near = np.einsum("hkmi,hkmi->hkm", offset, offset) < (1.25 * reach) ** 2
        which, taxel, contact = np.nonzero(near)
        near[which, taxel, contact] = same_sheet(
            offset[which, taxel, contact], self.data.normals[contact], normals[which, taxel]
        )
        read = np.isfinite(self.level[:, rows]).T
        which, taxel, contact = np.nonzero((near | read) & ~self.void[:, rows].T)
        spread = np.trace(covariance, axis1=1, axis2=2)[taxel] / 2 + errors.tau**2
        spread += np.array([h.shift_sigma for h in hypotheses])[which] ** 2
        predicted = self._predict(
            offset[which, taxel, contact], contact, np.sqrt(spread).clip(max=MAX_STEP), errors
        )
        gain = np.exp(np.stack([h.log_gain for h in hypotheses]))[which, taxel]
        powers = (1, 1, 2, 1)
        scaled = [
            x * (gain**p).reshape(-1, *[1] * (x.ndim - 1))
            for x, p in zip(predicted, powers, strict=True)
        ]
        level = self.level[contact, rows[taxel]]
        ends = np.searchsorted(which, np.arange(len(hypotheses) + 1))
        return [
            Block(contact[a:b], taxel[a:b], level[a:b], *(x[a:b] for x in scaled))
            for a, b in pairwise(ends)
        ]

    def _predict(
        self, offset: Array, contact: np.ndarray, step: Array, errors: Errors
    ) -> tuple[Array, Array, Array, Array]:
        """mu (q,), its slopes (q, 3), its bend (q,) and its slope (q,) in ln E*."""
        along, across = self.data.directions[contact], self.across[contact]
        h = np.sqrt(3.0) * step[:, None]
        moves = np.stack([0 * along, h * along, -h * along, h * across, -h * across])
        q = len(offset)
        around = self._means(
            (offset + moves).reshape(-1, 3), np.tile(contact, 5), errors.log_modulus
        ).reshape(5, q)
        stiffer = self._means(offset, contact, errors.log_modulus + E_STEP)
        slope = ((around[1] - around[2]) / (2 * h[:, 0]))[:, None] * along
        slope += ((around[3] - around[4]) / (2 * h[:, 0]))[:, None] * across
        curve = [(around[k] + around[k + 1] - 2 * around[0]) / 6 for k in (1, 3)]
        scale = float(np.exp(errors.log_scale))
        mean, bend = around[0] + curve[0] + curve[1], 2 * (curve[0] ** 2 + curve[1] ** 2)
        by_modulus = (stiffer - around[0]) / E_STEP
        return scale * mean, scale * slope, scale**2 * bend, scale * by_modulus

    def _means(self, offset: Array, contact: np.ndarray, log_modulus: float) -> Array:
        """Readings (q,) of taxels `offset` (q, 3), m, from their contacts."""
        data, none = self.data, np.zeros((len(self.data.points), 0))
        if log_modulus not in self._patches:
            self._patches[log_modulus] = data.model.patches(
                force=data.force,
                curvature=data.curvature,
                indenter_radius=data.belief.indenter.radius,
                effective_modulus=data.modulus * np.exp(log_modulus),
            )
        patches = self._patches[log_modulus]
        contacts = Contacts(data.points, data.normals, data.directions, patches, (), none, None)
        mean = disc_means(data.model.name, offset, contact, contacts, data.disc)[0]
        return np.asarray(np.maximum(mean, 0.0) * patches.peak[contact] / self.unit)


def covariance_of(
    block: Block, errors: Errors, places: Array, hypothesis: Hypothesis | None = None
) -> Array:
    """C (q, q) of the readings, silent ones included; places (k, 3, 3), m^2: covariances of the
    taxels' places. With a hypothesis, what it leaves open is included."""
    a, mean = block.slope, block.mean
    same_contact = block.contact[:, None] == block.contact
    same_taxel = block.taxel[:, None] == block.taxel
    out = (a @ a.T) * errors.tau**2 * same_contact
    out += np.einsum("qi,qij,pj->qp", a, places[block.taxel], a) * same_taxel
    by = np.stack([block.by_modulus, mean], axis=1)
    out += by @ np.array(errors.common) @ by.T
    if (
        hypothesis is not None
        and (open_ := hypothesis.open_slopes(block.taxel, a, mean)) is not None
    ):
        out += open_ @ open_.T
    out[np.diag_indices(len(a))] += errors.sigma**2 + (errors.rho * mean) ** 2 + block.bend
    return np.asarray(out)


def log_likelihood(block: Block, c: Array, errors: Errors, threshold: float) -> float:
    """ln of the likelihood of the readings, relative to that of silent taxels far away."""
    read = block.read
    own, silent = np.flatnonzero(read), np.flatnonzero(~read)
    total, mean, variance = 0.0, block.mean[silent], np.diag(c)[silent]
    if len(own):
        inverse = np.linalg.inv(c[np.ix_(own, own)])
        r = block.level[own] - block.mean[own]
        total -= 0.5 * float(r @ inverse @ r) + 0.5 * len(own) * LOG_2PI
        total += 0.5 * float(np.linalg.slogdet(inverse)[1])
        total -= len(own) * float(log_ndtr(threshold / errors.sigma))
        if len(silent):
            gain = c[np.ix_(silent, own)] @ inverse
            mean = mean + gain @ r
            variance = variance - np.einsum("so,so->s", gain, c[np.ix_(silent, own)])
    below = (threshold - mean) / np.sqrt(np.maximum(variance, errors.sigma**2))
    return total + float(np.sum(log_ndtr(below) - log_ndtr(threshold / errors.sigma)))
