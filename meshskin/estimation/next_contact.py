"""The next contacts: those that reduce the largest uncertainties most.

Each candidate contact near a taxel adds the expected information of its readings to all taxels in
reach. Contacts are chosen greedily, each to minimize the sum of the third powers of the taxels'
variances, which the largest dominate. Global parameters are taken as known.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
from scipy.spatial import cKDTree

from ..contact import AUTO, Patches
from ..core.arguments import check_integer
from ..core.arrays import Array
from ..core.errors import CalibrationError, ContactError
from ..core.notebook import AXES, Tabular
from ..core.progress import Progress, Stage
from ..core.value import Value
from ..geometry.surface.closest_point import Closest
from ..scene.belief import Belief
from . import chart
from .data.measurements import NOMINAL_NOISE
from .data.pairs import MAX_SLANT
from .data.patch_shape import over_edges
from .data.resolve_belief import contact_model, in_range, nominal_patches, with_valid_model
from .joint.contact_state import Contacts
from .joint.pressure import disc_means
from .uncertainty.observability import censored_information

if TYPE_CHECKING:
    from .calibration import Calibration

MAX_TARGETS = 200
"""Taxels, the most uncertain ones, about which candidates are placed: bounds the work."""
FEW_TARGETS = 4
"""The same for the next touch of an online calibration: 57 candidates about each."""
NEIGHBOURS = 3.0
"""Distance, in reaches of a contact, up to which taxels beside these profit from a touch."""
RINGS = (0.3, 0.5, 0.7, 0.85, 1.0, 1.15, 1.3)
"""Radii of the candidates about a taxel, in contact radii: a reading informs most where the
profile is steep, near the edge of the patch."""
DIRECTIONS = 8
"""Candidates on a ring: within 22.5 degrees of any direction."""
POWER = 3
"""Power of the variances in the objective: between their sum (1) and the largest (infinite), which
would not count contacts that serve all taxels but the worst."""


@dataclass(frozen=True, eq=False)
class NextContacts(Value, Tabular):
    """k contacts, the most useful first."""

    points: Array
    """(k, 3) on the body's surface, body frame, m."""
    normals: Array
    """Outward normals (k, 3)."""
    taxel: np.ndarray
    """Id (k,) of the taxel that gains most by each."""
    worst: Array
    """Expected standard deviation (k,), m, of the most uncertain taxel after each."""
    unreached: np.ndarray
    """Ids of taxels without any reading: where to touch for them is not known."""

    def __repr__(self) -> str:
        lost = f", {len(self.unreached)} taxels without a reading" if len(self.unreached) else ""
        taxels = ", ".join(map(str, self.taxel))
        return f"<NextContacts: {len(self.points)}, for taxels {taxels}{lost}>"

    def to_arrow(self) -> pa.Table:
        """One row a contact: x, y, z (m), nx, ny, nz, taxel, worst (m)."""
        numbers = dict(zip(AXES, [*self.points.T, *self.normals.T], strict=True))
        return pa.table(numbers | {"taxel": self.taxel, "worst": self.worst})


@dataclass(frozen=True, eq=False)
class NextTouch(Value):
    """The most useful next contact."""

    point: Array
    """(3,) on the body's surface, body frame, m."""
    normal: Array
    """Outward normal (3,)."""
    taxel: int
    """Id of the taxel that gains most."""
    sigma: float
    """Expected standard deviation, m, of that taxel's position afterwards."""


def next_contacts(
    calibration: Calibration, belief: Belief, k: int = 1, progress: Progress | None = None
) -> NextContacts:
    """The k most informative contacts under the reference force.

    progress("next contacts", done, total): called after the candidates' information, and after
    each contact.

    Raises CalibrationError if no taxel was read, the belief has no reference force, or k is not
    positive; ContactError where no contact model holds.
    """
    k = check_integer("number of next contacts", k, least=1, error=CalibrationError)
    belief = _resolved(calibration, belief)
    modulus = calibration.modulus or belief.material.effective_modulus
    radius = float(reference_patches(belief, np.zeros((1, 2)), modulus).first[0])
    points, covariance = _known(calibration, belief, radius)
    near = np.flatnonzero(np.isfinite(points[:, 0]))
    ids, charts = calibration.ids[near], chart.charts_at(belief.body, points[near])
    axes = calibration.poses[near, :3, :2]
    turn = np.einsum("nik,nil->nkl", charts.tangents, axes)  # to the charts' tangents
    turn = np.where(np.isfinite(axes[:, :1, :1]), turn, np.eye(2))
    covariance = turn @ covariance[near] @ np.swapaxes(turn, 1, 2)
    worst_first = np.argsort(-np.trace(covariance, axis1=1, axis2=2), kind="stable")
    candidates = candidates_around(charts[worst_first[:MAX_TARGETS]], radius, RINGS)
    hit = valid_contacts(candidates, belief, modulus)
    if not len(hit.point):
        raise ContactError(
            "the contact model does not hold about the most uncertain taxels",
            remedy="use a smaller indenter or a smaller force",
        )
    stage = Stage(progress, "next contacts", k + 1)
    contact, taxel, slope = expected_slopes(charts, hit, belief, modulus)
    stage.step()
    chosen, served, worst = [], [], []
    for _ in range(k):
        best, mine, most, _ = _best_contact(covariance, contact, taxel, slope, len(hit.point))
        served.append(taxel[most])
        for p in mine:
            g = covariance[taxel[p]] @ slope[p]
            covariance[taxel[p]] -= np.outer(g, g) / (1 + slope[p] @ g)
        chosen.append(best)
        worst.append(float(np.sqrt(np.trace(covariance, axis1=1, axis2=2).max())))
        stage.step()
    unreached = np.setdiff1d(calibration.ids, ids)
    return NextContacts(
        hit.point[chosen], hit.normal[chosen], ids[served], np.array(worst), unreached
    )


def next_touch(
    ids: np.ndarray, points: Array, covariance: Array, belief: Belief, modulus: float, radius: float
) -> NextTouch | None:
    """The best touch for n taxels at points (n, 3), m, with covariances (n, 3, 3), m^2, in space.

    As `next_contacts`, about few taxels only. None where the contact model holds nowhere about the
    most uncertain taxels. modulus: E*, Pa; radius: of a contact, m.
    """
    variance = np.trace(covariance, axis1=1, axis2=2)
    worst = np.argsort(-variance, kind="stable")[:FEW_TARGETS]
    limit = NEIGHBOURS * (radius + belief.disc_radius)
    gap = np.linalg.norm(points[:, None] - points[worst], axis=2).min(axis=1)
    near = np.flatnonzero(gap < limit)
    charts = chart.charts_at(belief.body, points[near])
    flat = np.swapaxes(charts.tangents, 1, 2) @ covariance[near] @ charts.tangents
    worst = np.argsort(-np.trace(flat, axis1=1, axis2=2), kind="stable")[:FEW_TARGETS]
    hit = valid_contacts(candidates_around(charts[worst], radius, RINGS), belief, modulus)
    if not len(hit.point):
        return None
    contact, taxel, slope = expected_slopes(charts, hit, belief, modulus)
    if not len(contact):
        return None
    best, _, most, gain = _best_contact(flat, contact, taxel, slope, len(hit.point))
    sigma = float(np.sqrt(np.trace(flat[taxel[most]]) - gain[most]))
    return NextTouch(hit.point[best], hit.normal[best], int(ids[near[taxel[most]]]), sigma)


def _best_contact(
    covariance: Array, contact: np.ndarray, taxel: np.ndarray, slope: Array, count: int
) -> tuple[int, np.ndarray, int, Array]:
    """The contact, of `count`, that reduces the objective most by its pairs with taxels (p,); rows
    of its pairs, and the one of these that gains most; and by how much each pair (p,) reduces its
    taxel's variance, m^2. covariance (n, 2, 2), m^2, of the taxels; slope (p, 2), 1/m."""
    along = np.einsum("pij,pj->pi", covariance[taxel], slope)
    gain = np.einsum("pi,pi->p", along, along) / (1 + np.einsum("pi,pi->p", slope, along))
    before = np.trace(covariance, axis1=1, axis2=2)
    scale = before.max()
    change = ((before[taxel] - gain) / scale) ** POWER - (before[taxel] / scale) ** POWER
    best = int(np.argmin(np.bincount(contact, change, count)))
    mine = np.flatnonzero(contact == best)
    return best, mine, int(mine[np.argmin(change[mine])]), gain


def _resolved(calibration: Calibration, belief: Belief) -> Belief:
    """The belief with a contact model that holds under its reference force at the taxels.

    Raises CalibrationError if it has no reference force or no taxel was read.
    """
    if belief.force_reference is None:
        raise CalibrationError(
            "next contacts need a reference force",
            value="belief.force_reference = None",
            remedy="give the belief a force_reference",
        )
    points = calibration.positions
    if calibration.contact_centroids is not None:
        points = np.where(np.isfinite(points), points, calibration.contact_centroids)
    points = points[np.isfinite(points[:, 0])]
    if not len(points):
        raise CalibrationError(
            "no taxel was read, so that no contact can be aimed at one",
            remedy="sweep the whole skin first",
        )
    if belief.contact != AUTO:
        return belief
    curvature = belief.body.closest(points).curvature
    return with_valid_model(belief, np.full(len(points), belief.force_reference), curvature)


def _known(calibration: Calibration, belief: Belief, radius: float) -> tuple[Array, Array]:
    """Points (n, 3) and covariances (n, 2, 2) along the surface; of a taxel that was read but is
    not determined, the centroid of its contacts, with the reach of a contact.
    """
    points, covariance = calibration.positions.copy(), calibration.covariances[:, :2, :2].copy()
    centroids = calibration.contact_centroids
    unknown = ~calibration.observed[:, :2].all(axis=1)
    points[unknown] = np.nan if centroids is None else centroids[unknown]
    covariance[unknown] = np.eye(2) * (radius + belief.disc_radius) ** 2
    return points, covariance


def candidates_around(charts: chart.Charts, radius: float, rings: Sequence[float]) -> Array:
    """Points (c, 3), m, at the origin of each chart and on circles of `rings`, in units of `radius`
    (m), about it."""
    angle = 2 * np.pi * np.arange(DIRECTIONS) / DIRECTIONS
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    offsets = radius * np.concatenate([[[0.0, 0.0]], *(ring * circle for ring in rings)])
    count = len(charts.points)
    return charts[np.repeat(np.arange(count), len(offsets))].at(np.tile(offsets, (count, 1)))


def valid_contacts(points: Array, belief: Belief, modulus: float) -> Closest:
    """The points of the body nearest to `points` (m, 3), m, where its contact model holds."""
    hit, force = belief.body.closest(points), np.asarray(belief.force_reference or 0.0)
    return hit.take(in_range(contact_model(belief), belief, force, hit.curvature, modulus))


def expected_slopes(
    charts: chart.Charts, hit: Closest, belief: Belief, modulus: float
) -> tuple[np.ndarray, np.ndarray, Array]:
    """Pairs of contacts (p,) at the points `hit` and taxels (p,) in reach, and the square roots
    (p, 2), 1/m, of their expected information: derivatives of the reading in units of its noise,
    weighted for censoring at the threshold, and over edges of the body as in the estimate.
    """
    patches = reference_patches(belief, hit.curvature, modulus)
    sigma = belief.noise_sigma
    if sigma is None:
        sigma = NOMINAL_NOISE * float(np.median(patches.peak))
    longest = np.maximum(patches.first, patches.second)
    reach = MAX_SLANT * float(longest.max() + belief.disc_radius)
    pairs = cKDTree(hit.point).sparse_distance_matrix(
        cKDTree(charts.points), reach, output_type="ndarray"
    )
    contact, taxel = pairs["i"], pairs["j"]
    offset = charts.points[taxel] - hit.point[contact]
    none = np.zeros((len(hit.point), 0))
    contacts = Contacts(hit.point, hit.normal, hit.direction, patches, (), none, None)
    mean, slope, _ = disc_means(belief.contact, offset, contact, contacts, belief.disc_radius)
    scale = patches.peak[contact] / sigma
    edge = over_edges(belief, hit, np.full(len(hit.point), belief.force_reference or 0.0))
    weight = censored_information(belief.threshold / sigma - scale * mean)
    weight = weight / (1 + (edge[contact] * scale) ** 2)
    along = np.einsum("pi,pij->pj", slope, charts.tangents[taxel])
    return contact, taxel, (np.sqrt(weight) * scale)[:, None] * along


def reference_patches(belief: Belief, curvature: Array, modulus: float) -> Patches:
    """Patches under the reference force at curvatures (m, 2), 1/m, and E*, Pa."""
    force = np.full(len(curvature), belief.force_reference)
    return nominal_patches(contact_model(belief), belief, force, curvature, modulus)
