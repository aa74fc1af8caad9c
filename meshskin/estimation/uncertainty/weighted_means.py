"""Positions against the pressure-weighted means of contact points, which need no contact model."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import numpy as np

from ...core.arrays import Array, sums_by_group
from .. import chart
from ..calibration import Calibration
from ..data.measurements import Measurements
from ..data.pairs import near_pairs
from ..joint.departures import MIN_SCORE
from ..result import OTHER_RESPONSE
from .verdict import PASS, Finding, level_of

MEAN_SIGMAS = 4.0, 12.0
"""Median distance of the positions from the weighted means of contact points, in standard
deviations of both: a doubt, a failure. By theory it is 1.18."""
SECTORS = 6
"""Number of sectors about a taxel; its weighted mean is compared if each has contacts."""
RING = 0.7, 1.5
"""Distances of these contacts, in reaches of a contact: a taxel reads little there, so that its
mean does not depend on where contacts end further out."""
STEEPNESS = 1, 5
"""Exponents k of the profile (1 - (distance / reach)^2)^k of a squared reading: 1 of a point in a
Hertz patch, 5 of a taxel as large as the patch (by quadrature, from 0.3 to 0.7 reaches: 4.6 to
5.4)."""


def findings(data: Measurements, calibration: Calibration) -> Iterator[Finding]:
    """Positions against the pressure-weighted mean of contact points, over all taxels.

    The mean is compared with that of a round profile about the position, over the contacts that
    were made: of lanes that are far apart, it lies towards the nearest one.
    """
    found = _Compared.of(data, calibration)
    if not len(found.rows):
        return
    apart = np.linalg.norm(found.apart, axis=1)
    typical = float(np.median(apart / np.hypot(found.sigma, found.own)))
    level = level_of(typical, MEAN_SIGMAS)
    if level == PASS:
        return
    words = (
        f"positions are {1e3 * np.median(apart):.2g} mm from the pressure-weighted means of "
        f"their contact points, {typical:.2g} times what both standard deviations allow (limit "
        f"{MEAN_SIGMAS[0]:g}): check the contact model and the scale of pressures and forces"
    )
    yield level, words


def widened(
    data: Measurements, calibration: Calibration, departures: Mapping[str, float]
) -> Calibration:
    """The calibration with the distances from these means in the variances, where a learned
    response leaves groups of taxels that respond otherwise: errors of the response displace whole
    groups, and not their means. departures: scores by name."""
    other = OTHER_RESPONSE.partition("{")[0]
    shown = any(name.startswith(other) and departures[name] > MIN_SCORE for name in departures)
    if not shown or calibration.response is None:
        return calibration
    found = _Compared.of(data, calibration)
    covariances, turned = calibration.covariances.copy(), calibration.poses[found.rows, :3, :3]
    apart = np.einsum("nji,nj->ni", turned, found.apart)
    covariances[found.rows, :3, :3] += apart[:, :, None] * apart[:, None]
    return replace(calibration, covariances=covariances)


@dataclass(frozen=True)
class _Compared:
    """Taxels whose weighted means are compared with those that contacts about them have; none if
    these are fewer than 3."""

    rows: np.ndarray
    """(q,)."""
    apart: Array
    """Expected means less the actual ones (q, 3), m."""
    sigma: Array
    """Their standard deviations (q,), m, by chance."""
    own: Array
    """What the shape of the profile leaves open (q,), m."""

    @classmethod
    def of(cls, data: Measurements, calibration: Calibration) -> _Compared:
        """Those with contacts all around."""
        none = cls(np.empty(0, dtype=int), np.empty((0, 3)), np.empty(0), np.empty(0))
        n, means = len(data.ids), calibration.contact_centroids
        if means is None:
            return none
        weight = data.pressure**2
        total = np.maximum(np.bincount(data.taxel, weight, n), 1e-300)
        off = data.points[data.contact] - means[data.taxel]
        near = np.linalg.norm(off, axis=1) < 1.5 * data.reach()[data.contact]
        square = np.where(near, (weight / total[data.taxel]) ** 2 * np.sum(off**2, axis=1), 0.0)
        spread = np.bincount(data.taxel, square, n)
        sigma = np.sqrt((spread + calibration.position_sigma**2) / 2)
        seen = np.isfinite(means + calibration.positions).all(axis=1) & np.isfinite(sigma)
        rows = np.flatnonzero(seen & (data.counts >= 5) & (sigma > 0))
        rows = rows[surrounded(data, means[rows])] if len(rows) else rows
        if len(rows) < 3:
            return none
        flat, steep = (_expected_means(data, calibration.positions[rows], k) for k in STEEPNESS)
        apart, own = (flat + steep) / 2 - means[rows], np.linalg.norm(steep - flat, axis=1) / 2
        return cls(rows, apart, sigma[rows], own)


def _expected_means(data: Measurements, points: Array, steepness: int) -> Array:
    """The weighted means (n, 3), m, of the contact points about taxels at `points` (n, 3), m.

    The weight is a round profile that ends at the reach of a contact, whatever the contact model.
    The mean is the point itself where no contact reaches it.
    """
    reach, n = data.reach(), len(points)
    contact, own = near_pairs(data, points, data.body.closest(points).normal, reach)
    off = data.points[contact] - points[own]
    weight = np.maximum(1.0 - np.sum(off**2, axis=1) / reach[contact] ** 2, 0.0) ** steepness
    total = np.maximum(np.bincount(own, weight, n), 1e-300)
    return np.asarray(points + sums_by_group(weight[:, None] * off, own, n) / total[:, None])


def surrounded(data: Measurements, means: Array) -> np.ndarray:
    """Whether (n,) contacts lie in all SECTORS about points `means` (n, 3), m, at RING reaches.
    Where contacts end before, a weighted mean of contact points is biased."""
    normals, reach = data.body.closest(means).normal, data.reach()
    contact, own = near_pairs(data, means, normals, RING[1] * reach)
    offset = np.einsum("kij,ki->kj", chart.frames(normals)[own], data.points[contact] - means[own])
    angle = np.arctan2(offset[:, 1], offset[:, 0]) / (2 * np.pi) + 0.5
    sector = np.minimum((SECTORS * angle).astype(int), SECTORS - 1)
    far = np.hypot(offset[:, 0], offset[:, 1]) > RING[0] * reach[contact]
    met = np.zeros((len(means), SECTORS), dtype=bool)
    met[own[far], sector[far]] = True
    return np.asarray(met.all(axis=1))
