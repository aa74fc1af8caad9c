"""The Cramér-Rao bound of a world's noise, for who knows everything of it but the unknowns.

Unknown are the places of the taxels and, where they vary, gains and offsets of the taxels, and
offsets and forces of the contacts, with the distributions of the world as priors; known are profile
and response. Derivatives are central differences of the world's own readings; a reading under the
threshold counts by the information of a censored normal.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.special import log_ndtr, ndtr

from . import sphere
from .electronics import FULL_SCALE
from .profiles import Array
from .world import Radial, Sample, World

STEP = 2e-6
"""Step of the differences, m."""
RELATIVE_STEP = 1e-3
"""Step of ln gain and ln force."""


def bound(world: World, sample: Sample) -> float:
    """Root mean square error, m, that no unbiased estimate of the places beats; NaN where unknown.

    It is not computed where pressures are not radial, where taxels read each other's pressure
    (crosstalk) or are read one by one, where the offset drifts, and where hysteresis carries the
    error of a contact into later ones.
    """
    e = world.electronics
    memory = e.hysteresis and (world.scatter or world.force_error or world.nominal_force)
    if e.crosstalk or e.drift or memory or world.skew or not isinstance(world.pressures, Radial):
        return float("nan")
    taxel, taxel_prior = _taxel_columns(world, sample)
    contact, contact_prior = _contact_columns(world, sample)
    weight = _information(world, sample)
    own = np.einsum("mn,pmn,qmn->npq", weight, taxel, taxel) + np.diag(taxel_prior)
    n, q = own.shape[:2]
    normal = np.zeros((n, q, n, q))
    normal[np.arange(n), :, np.arange(n), :] = own
    if len(contact):
        shared = np.einsum("mn,cmn,dmn->mcd", weight, contact, contact) + np.diag(contact_prior)
        cross = np.einsum("mn,pmn,cmn->mcnp", weight, taxel, contact)
        m, c = cross.shape[:2]
        solved = np.linalg.solve(shared, cross.reshape(m, c, n * q))
        normal -= (cross.reshape(m * c, n * q).T @ solved.reshape(m * c, n * q)).reshape(n, q, n, q)
    variance = np.diag(np.linalg.inv(normal.reshape(n * q, n * q))).reshape(n, q)
    return float(np.sqrt(variance[:, :2].sum(axis=1).mean()))


def _taxel_columns(world: World, sample: Sample) -> tuple[Array, Array]:
    """Derivatives (q, m, n) of the readings by the unknowns of their taxels, and prior precisions.

    The first two are its place along two tangents, m.
    """
    e, columns, prior = world.electronics, [], [0.0, 0.0]
    for along in sphere.tangents(sample.positions):
        ends = [sphere.moved(sample.positions, along, s * STEP) for s in (1, -1)]
        high, low = (sample.exact(world, positions=end) for end in ends)
        columns.append((high - low) / (2 * STEP))
    if e.gain:
        ends = []
        for s in (1, -1):
            sensors = replace(sample.sensors)
            sensors.__dict__["gains"] = sample.sensors.gains * np.exp(s * RELATIVE_STEP)
            ends.append(replace(sample, sensors=sensors).exact(world))
        columns.append((ends[0] - ends[1]) / (2 * RELATIVE_STEP))
        prior.append(e.gain**-2)
    if e.offset:
        columns.append(np.full_like(columns[0], e.unit(sample.sensors.peak)))
        prior.append(e.offset**-2)
    return np.array(columns), np.array(prior)


def _contact_columns(world: World, sample: Sample) -> tuple[Array, Array]:
    """Derivatives (c, m, n) of the readings by the unknowns of their contacts, prior precisions."""
    touch, columns, prior = sample.touch, [], []
    if world.scatter:
        for along in sphere.tangents(touch.points):
            ends = [replace(touch, points=sphere.moved(touch.points, along, s * STEP))
                    for s in (1, -1)]  # fmt: skip
            high, low = (sample.exact(world, touch=end) for end in ends)
            columns.append((high - low) / (2 * STEP))
            prior.append(world.scatter**-2)
    if world.force_error or world.nominal_force:
        ends = [replace(touch, force=touch.force * np.exp(s * RELATIVE_STEP)) for s in (1, -1)]
        high, low = (sample.exact(world, touch=end) for end in ends)
        columns.append((high - low) / (2 * RELATIVE_STEP))
        measured = 0.0 if world.nominal_force else world.force_error**-2
        prior.append(sphere.FORCE_SPREAD**-2 + measured)
    return np.array(columns), np.array(prior)


def _information(world: World, sample: Sample) -> Array:
    """Fisher information (m, n) of each reading about its mean, in its own unit.

    That of a normal that is censored below the threshold; counting adds the variance of rounding.
    """
    e, unit = world.electronics, world.electronics.unit(sample.sensors.peak)
    threshold, variance = sample.threshold, (e.noise * unit) ** 2
    if e.counts:
        threshold *= unit / FULL_SCALE
        variance += (unit / FULL_SCALE) ** 2 / 12
    z = (sample.exact(world) - threshold) / np.sqrt(variance)
    density = np.exp(-0.5 * z**2) / np.sqrt(2 * np.pi)
    hazard = np.exp(-0.5 * z**2 - 0.5 * np.log(2 * np.pi) - log_ndtr(-z))
    information = ndtr(z) - z * density + density * hazard
    return np.where(z > 8, 1.0, np.maximum(information, 0.0)) / variance
