"""What to touch next: the contacts that reduce the worst taxels' uncertainty most.

Each candidate contact about a taxel adds the expected information of its readings to all taxels in
reach; contacts are chosen one by one, each against the sum of the third powers of the taxels'
variances, which the worst dominate. Shared unknowns are taken as known.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..contact import ContactModel, Patches
from ..core.errors import CalibrationError
from ..core.se3 import Array
from . import chart
from .data.measurements import NOMINAL_NOISE
from .data.pairs import SLANT
from .joint.contacts import Contacts
from .joint.patches import DISC_MEANS
from .uncertainty.observability import censored_information

if TYPE_CHECKING:
    from ..geometry.surface.closest_point import Closest
    from ..scene.belief import Belief
    from .calibration import Calibration

WORST = 200
"""Taxels about which candidates are laid."""
RINGS = (0.3, 0.5, 0.7, 0.85, 1.0, 1.15, 1.3)
"""Radii of the candidates about a taxel, in contact radii."""
DIRECTIONS = 8
"""Candidates on a ring."""
POWER = 3
"""Power of the variances in what is minimised."""


@dataclass(frozen=True)
class NextContacts:
    """k contacts, the most useful first."""

    points: Array
    """(k, 3) on the body's surface, body frame, m."""
    normals: Array
    """Outward normals (k, 3)."""
    taxel: np.ndarray
    """Id (k,) of the taxel that gains most by each."""
    worst: Array
    """Standard deviation (k,), m, of the worst taxel that is to be expected after each."""
    unreached: np.ndarray
    """Ids of taxels of which nothing is known, not even where to touch: they need a sweep."""


def next_contacts(calibration: Calibration, belief: Belief, k: int = 1) -> NextContacts:
    """The k contacts under the reference force that promise most.

    Raises CalibrationError if no taxel was read at all, or k is not positive.
    """
    if k < 1:
        raise CalibrationError("the number of contacts must be positive", value=k, limit=">= 1")
    modulus = calibration.modulus or belief.material.effective_modulus
    radius = float(_patches(np.zeros((1, 2)), belief, modulus).first[0])
    points, covariance = _known(calibration, belief, radius)
    near = np.flatnonzero(np.isfinite(points[:, 0]))
    if not len(near):
        raise CalibrationError(
            "no taxel was read, so none can be aimed at", remedy="sweep the whole skin first"
        )
    points, covariance, ids = points[near], covariance[near], calibration.ids[near]
    charts = chart.charts_at(belief.body, points)
    covariance = _turned(calibration, near, charts, covariance)
    candidates = _candidates(charts, np.trace(covariance, axis1=1, axis2=2), radius)
    hit = belief.body.closest(candidates)
    contact, taxel, slope = slopes(charts, hit, belief, modulus)
    chosen, served, worst = [], [], []
    for _ in range(k):
        along = np.einsum("pij,pj->pi", covariance[taxel], slope)
        gain = np.einsum("pi,pi->p", along, along) / (1 + np.einsum("pi,pi->p", slope, along))
        before = np.trace(covariance, axis1=1, axis2=2)
        scale = before.max()
        change = ((before[taxel] - gain) / scale) ** POWER - (before[taxel] / scale) ** POWER
        best = int(np.argmin(np.bincount(contact, change, len(candidates))))
        mine = np.flatnonzero(contact == best)
        served.append(taxel[mine[np.argmin(change[mine])]])
        for p in mine:
            g = covariance[taxel[p]] @ slope[p]
            covariance[taxel[p]] -= np.outer(g, g) / (1 + slope[p] @ g)
        chosen.append(best)
        worst.append(float(np.sqrt(np.trace(covariance, axis1=1, axis2=2).max())))
    lost = np.setdiff1d(calibration.ids, ids)
    return NextContacts(hit.point[chosen], hit.normal[chosen], ids[served], np.array(worst), lost)


def _known(calibration: Calibration, belief: Belief, radius: float) -> tuple[Array, Array]:
    """Points (n, 3) and covariances (n, 2, 2) along the surface; of a taxel that was read but is
    not determined, the middle of its contacts, known to within the reach of one.
    """
    points, covariance = calibration.positions.copy(), calibration.covariances[:, :2, :2].copy()
    rough = calibration.contact_centroids
    open_ = ~calibration.observed[:, :2].all(axis=1)
    points[open_] = np.nan if rough is None else rough[open_]
    covariance[open_] = np.eye(2) * (radius + belief.disc_radius) ** 2
    return points, covariance


def _turned(
    calibration: Calibration, rows: np.ndarray, charts: chart.Charts, covariance: Array
) -> Array:
    """The covariances (n, 2, 2) from the taxels' frames into the charts' tangents."""
    axes = calibration.poses[rows, :3, :2]
    turn = np.einsum("nik,nil->nkl", charts.tangents, axes)
    turn = np.where(np.isfinite(axes[:, :1, :1]), turn, np.eye(2))
    return np.asarray(turn @ covariance @ np.swapaxes(turn, 1, 2))


def _candidates(charts: chart.Charts, variance: Array, radius: float) -> Array:
    """Candidate points (c, 3) about the worst taxels."""
    worst = np.argsort(-variance, kind="stable")[:WORST]
    angle = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    offsets = radius * np.concatenate([[[0.0, 0.0]], *(ring * circle for ring in RINGS)])
    owner = np.repeat(worst, len(offsets))
    return charts[owner].at(np.tile(offsets, (len(worst), 1)))


def slopes(
    charts: chart.Charts, hit: Closest, belief: Belief, modulus: float
) -> tuple[np.ndarray, np.ndarray, Array]:
    """Contacts (p,) and taxels (p,) in reach, and the derivative (p, 2), 1/m, of each reading, in
    units of its noise and as far as it is expected to be heard.
    """
    from scipy.spatial import cKDTree

    patches = _patches(hit.curvature, belief, modulus)
    sigma = belief.noise_sigma or NOMINAL_NOISE * float(np.median(patches.peak))
    longest = np.maximum(patches.first, patches.second)
    reach = SLANT * float(longest.max() + belief.disc_radius)
    pairs = cKDTree(hit.point).sparse_distance_matrix(
        cKDTree(charts.points), reach, output_type="ndarray"
    )
    contact, taxel = pairs["i"], pairs["j"]
    offset = charts.points[taxel] - hit.point[contact]
    none = np.zeros((len(hit.point), 0))
    contacts = Contacts(hit.point, hit.normal, hit.direction, patches, (), none, None)
    mean, slope, _ = DISC_MEANS[belief.contact](offset, contact, contacts, belief.disc_radius)
    scale = patches.peak[contact] / sigma
    weight = censored_information(belief.threshold / sigma - scale * mean)
    along = np.einsum("pi,pij->pj", slope, charts.tangents[taxel])
    return contact, taxel, (np.sqrt(weight) * scale)[:, None] * along


def _patches(curvature: Array, belief: Belief, modulus: float) -> Patches:
    """Patches under the reference force at curvatures (m, 2), 1/m.

    Raises CalibrationError if the belief has none.
    """
    if belief.force_reference is None:
        raise CalibrationError(
            "next contacts need to know how hard they press",
            value="belief.force_reference = None",
            remedy="give the belief a force_reference",
        )
    material = belief.material
    model = ContactModel(belief.contact, material.poisson, material.thickness)
    return model.patches(
        force=np.full(len(curvature), belief.force_reference),
        curvature=curvature,
        indenter_radius=belief.indenter.radius,
        effective_modulus=modulus,
    )
