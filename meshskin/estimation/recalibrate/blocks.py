"""The readings of a unit under a hypothesis, and their likelihood: the normal distribution of
touches.py, of readings above the threshold and of silent ones below it.

Readings of one taxel alone have no contact in common. Their covariance is a diagonal plus U U^T of
few columns, by which the likelihoods of many hypotheses follow at once (Woodbury's identity).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import log_ndtr

from ...core.arrays import Array
from .hypotheses import Hypothesis

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
    force: float = 0.0
    """Of ln force of each contact."""
    log_modulus: float = 0.0
    """ln of E* relative to the map's."""
    log_scale: float = 0.0
    """ln of the scale of all readings."""
    common: tuple[tuple[float, float], tuple[float, float]] = ((0.0, 0.0), (0.0, 0.0))
    """Covariance of the last two."""


@dataclass(frozen=True)
class Block:
    """The readings of a unit under a hypothesis: q pairs of a contact and a taxel."""

    hypothesis: Hypothesis
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
    """Variance (q,) by the curvature of mu, and by edges of the body."""
    by_modulus: Array
    """d mu / d ln E* (q,)."""
    by_scale: Array
    """d mu / d ln of the level (q,): mu, but for compression and offset."""
    log_gain_sigma: Array
    """Standard deviation (q,) of the taxel's ln gain."""
    offset_sigma: Array
    """Standard deviation (q,) of the taxel's offset."""

    @property
    def read(self) -> np.ndarray:
        """Whether the pairs (q,) gave a reading."""
        return np.isfinite(self.level)

    @property
    def open_slopes(self) -> Array | None:
        """Derivatives (q, d) of the readings in what the hypothesis leaves open, whitened; None:
        nothing is."""
        h = self.hypothesis
        mine = (self.taxel == h.taxel) | (h.taxel < 0)
        if h.shift_sigma:
            return np.asarray(h.shift_sigma * self.slope * mine[:, None])
        if h.gain_sigma:
            return np.asarray(h.gain_sigma * (self.by_scale * mine)[:, None])
        return None

    def covariance(self, errors: Errors) -> Array:
        """C (q, q) of the readings, silent ones and what the hypothesis leaves open included."""
        a, by = self.slope, np.stack([self.by_modulus, self.by_scale], axis=1)
        load = errors.force * (self.by_scale - self.by_modulus)  # the patch depends on F / E*
        touch = np.column_stack([errors.tau * a, load])
        own = np.column_stack([self.log_gain_sigma * self.by_scale, self.offset_sigma])
        places = np.einsum("qi,qij->qj", a, self.hypothesis.covariance[self.taxel])
        out = (touch @ touch.T) * (self.contact[:, None] == self.contact)
        out += (places @ a.T + own @ own.T) * (self.taxel[:, None] == self.taxel)
        out += by @ np.array(errors.common) @ by.T
        if (open_ := self.open_slopes) is not None:
            out += open_ @ open_.T
        out[np.diag_indices(len(a))] += errors.sigma**2 + (errors.rho * self.mean) ** 2 + self.bend
        return np.asarray(out)

    def displacements(self, errors: Errors) -> tuple[Array, Array]:
        """Where the taxels (k, 3), m, most probably are off their points by the readings, and the
        covariances (k, 3, 3), m^2, that these leave."""
        read, places = np.flatnonzero(self.read), self.hypothesis.covariance
        own = self.taxel[read, None] == np.arange(len(places))
        by = np.einsum("kij,qj,qk->qki", places, self.slope[read], own).reshape(len(read), -1)
        solved = np.linalg.solve(self.covariance(errors)[np.ix_(read, read)], by)
        shift = (self.level - self.mean)[read] @ solved
        taken = np.einsum("qki,qkj->kij", *(x.reshape(-1, *places.shape[:2]) for x in (by, solved)))
        return shift.reshape(-1, 3), places - taken

    def log_likelihood(self, errors: Errors, threshold: float) -> float:
        """ln of the likelihood of the readings, relative to that of silent taxels far away."""
        c = self.covariance(errors)[None]
        return float(log_likelihoods(self.level, self.mean[None], c, errors, threshold)[0])


class Stack:
    """Blocks (h,) of single taxels, filled up to q pairs each."""

    def __init__(self, blocks: Sequence[Block], errors: Errors) -> None:
        self.sigma, sizes = errors.sigma, np.array([len(b.mean) for b in blocks])
        which = np.repeat(np.arange(len(blocks)), sizes)
        at = which, np.arange(len(which)) - np.repeat(np.cumsum(sizes) - sizes, sizes)
        shape = len(blocks), int(sizes.max(initial=0))

        def column(name: str) -> Array:
            return np.concatenate([getattr(b, name) for b in blocks])

        mean, slope, by_scale = column("mean"), column("slope"), column("by_scale")
        by = np.stack([column("by_modulus"), by_scale], axis=1)
        states = [b.hypothesis for b in blocks]
        places = _root(np.stack([h.covariance[0] for h in states]))[which]
        shift, gain = np.array([(h.shift_sigma, h.gain_sigma) for h in states]).T[:, which]
        load = errors.force * (by[:, 1] - by[:, 0])
        self.present = np.zeros(shape, dtype=bool)
        self.present[at] = True
        self.level, self.mean, self.alone = np.full(shape, np.nan), np.zeros(shape), np.ones(shape)
        """Readings, mu, and the diagonal."""
        self.level[at], self.mean[at] = column("level"), mean
        self.alone[at] = errors.sigma**2 + (errors.rho * mean) ** 2 + column("bend") + load**2
        self.alone[at] += errors.tau**2 * np.sum(slope**2, axis=1)
        parts = (
            np.einsum("qi,qij->qj", slope, places), by @ _root(np.array(errors.common)),
            column("log_gain_sigma") * by_scale, column("offset_sigma"),
            shift[:, None] * slope, gain * by_scale,
        )  # fmt: skip
        columns = np.column_stack(parts)
        self.shared = np.zeros((*shape, columns.shape[1]))
        """U (h, q, r)."""
        self.shared[at] = columns

    def log_likelihoods(self, threshold: float, level: Array | None = None) -> Array:
        """As the function below (h,), of their own readings or of `level` (q,) for all."""
        level = self.level if level is None else level
        read, u = self.present & np.isfinite(level), self.shared
        far = float(log_ndtr(threshold / self.sigma))
        weight = read / self.alone
        r = np.where(read, level - self.mean, 0.0)
        transposed = np.swapaxes(u, 1, 2)
        inner = np.eye(u.shape[2]) + transposed @ (weight[:, :, None] * u)
        inverse = np.linalg.inv(inner)
        by = (transposed @ (weight * r)[:, :, None])[:, :, 0]
        centre = (inverse @ by[:, :, None])[:, :, 0]
        square = np.sum(weight * r**2, axis=1) - np.sum(by * centre, axis=1)
        log_det = np.sum(read * np.log(self.alone), axis=1) + np.linalg.slogdet(inner)[1]
        total = -0.5 * (log_det + square) - read.sum(axis=1) * (0.5 * LOG_2PI + far)
        middle = self.mean + (u @ centre[:, :, None])[:, :, 0]
        variance = self.alone + np.sum((u @ inverse) * u, axis=2)
        below = (threshold - middle) / np.sqrt(np.maximum(variance, self.sigma**2))
        silent, tail = self.present & ~read, np.zeros(read.shape)
        tail[silent] = log_ndtr(below[silent]) - far
        return np.asarray(total + tail.sum(axis=1))


def _root(covariance: Array) -> Array:
    """R (..., d, d) with R R^T = covariance (..., d, d), of any rank."""
    variance, axes = np.linalg.eigh(covariance)
    return np.asarray(axes * np.sqrt(np.maximum(variance, 0.0))[..., None, :])


def all_log_likelihoods(blocks: Sequence[Block], errors: Errors, threshold: float) -> Array:
    """ln (h,) of the likelihoods of the blocks."""
    if len(blocks) > 1 and all(len(b.hypothesis.points) == 1 for b in blocks):
        return Stack(blocks, errors).log_likelihoods(threshold)
    return np.array([b.log_likelihood(errors, threshold) for b in blocks])


def log_likelihoods(level: Array, mean: Array, c: Array, errors: Errors, threshold: float) -> Array:
    """ln (h,) of the likelihoods of readings (q,), NaN where silent, with the means (h, q) and the
    covariances (h, q, q), relative to that of silent taxels far away."""
    read = np.isfinite(level)
    own, silent = np.flatnonzero(read), np.flatnonzero(~read)
    far = float(log_ndtr(threshold / errors.sigma))
    total, middle = np.zeros(len(mean)), mean[:, silent]
    variance = np.diagonal(c, axis1=1, axis2=2)[:, silent]
    if len(own):
        inverse = np.linalg.inv(c[:, own[:, None], own])
        r = level[own] - mean[:, own]
        scaled = np.einsum("hij,hj->hi", inverse, r)
        total += 0.5 * (np.linalg.slogdet(inverse)[1] - np.einsum("hi,hi->h", r, scaled))
        total -= len(own) * (0.5 * LOG_2PI + far)
        if len(silent):
            across = c[:, silent[:, None], own]
            middle = middle + np.einsum("hso,ho->hs", across, scaled)
            variance = variance - np.einsum("hso,hso->hs", across @ inverse, across)
    below = (threshold - middle) / np.sqrt(np.maximum(variance, errors.sigma**2))
    return total + np.sum(log_ndtr(below) - far, axis=1)
