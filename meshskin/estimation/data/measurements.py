"""Readings with the contacts they belong to, in the terms of the believed contact model."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from scipy.spatial import cKDTree

from ... import contact
from ...contact.disc import disc_slope, invert_disc_mean
from ...core.arrays import Array
from ...geometry.body import Body
from ...geometry.surface.closest_point import Closest
from ...scene.belief import Belief
from .global_parameters import DRIFT_SIZE, MODULUS, GlobalParameters
from .headway import headway
from .patch_shape import alike_contacts, over_patches, patch_shifts, typical_radius, unevenness
from .resolve_belief import in_range, nominal_patches

if TYPE_CHECKING:
    from ..joint.leaks import Leaks

NOMINAL_NOISE = 0.01
"""Standard deviation that weights the readings when none is known, relative to the median peak.
Without a known noise the covariance is scaled by the residuals, so that it cancels there."""


@dataclass(frozen=True)
class Measurements:
    """m contacts and k readings of n taxels; everything that an estimator needs of a recording."""

    belief: Belief
    """With a reference force and a contact model (`resolve_belief`)."""
    points: Array
    """Contact points (m, 3), body frame, m."""
    normals: Array
    """Outward normals (m, 3) of the believed body at the contact points."""
    directions: Array
    """Unit tangents (m, 3) along the first principal curvature there."""
    curvature: Array
    """Principal curvatures (m, 2) there, 1/m."""
    force: Array
    """Measured forces (m,), N."""
    patches: contact.Patches
    """The contacts' patches at the nominal E*; `first` lies along `directions`."""
    model: contact.ContactModel
    """The believed contact model."""
    contact: np.ndarray
    """Contact (k,) of each reading, a row of `points`."""
    taxel: np.ndarray
    """Taxel (k,) of each reading, a row of `ids`."""
    pressure: Array
    """Pressure (k,), Pa."""
    noise: float | None
    """Standard deviation of a reading, Pa, known or estimated; None: not yet."""
    noise_pairs: int = 0
    """Pairs of readings that `noise` was estimated from; 0: it is known, or None."""
    threshold: float = 0.0
    """Pressures up to this are silent, Pa: as believed, or the smallest reading if that is more."""
    saturation: float = np.inf
    """Upper end of the sensors' range, Pa."""
    ends: Array = field(default_factory=lambda: np.empty(0))
    """Upper end (n,), Pa, of each taxel's range: readings of this and more are saturated."""
    constant: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=bool))
    """Taxels (n,) bool whose recorded readings never change."""
    force_measured: bool = True
    """Whether the forces were measured; else all are a reference force."""
    falling: bool = False
    """Whether the recorded readings fall with pressure: raw ones that were turned."""
    parameters: GlobalParameters = MODULUS
    """What is unknown beside the taxels' poses."""
    headings: Array | None = None
    """Rotations (m, 3, 3), world from body, where known."""
    profile_extent: float = 2.5
    """Distance, in semi-axes, up to which a learned profile differs from the model's."""
    learned: bool = False
    """Whether the response is learned: the contact model is only its mean."""
    unit: float = 1.0
    """Recorded unit per Pa: of raw readings that were scaled to the believed peak pressures."""
    leaks: Leaks | None = None
    """Which taxels crosstalk; None: all neighbours."""
    response_levels: tuple[float, float] = (0.5, 0.5)
    """Levels of readings, relative to the nominal peak, at which a learned compression leaves the
    effects of a taxel's gain and of an error of ln F as they are: those that determine both."""
    references: tuple[float, float] | None = None
    """Relative curvature, 1/m, and peak pressure, Pa, that a learned response refers to; None: the
    medians of the contacts."""
    contact_errors: Array | None = None
    """Estimated errors (m, 3) of the contacts, along the semi-axes, m, and of ln F; None: none."""
    heights: Array | None = None
    """Heights (n,) of the taxels over the surface in their modules, m; None: not known, or zero."""
    unevenness: Array = field(default_factory=lambda: np.empty(0))
    """Parts (m,) of the peak pressures by which those of the contacts differ over edges
    (`patch_shape.over_edges`); empty: none, or the response is yet to be learned."""
    edge_error: float | None = None
    """`LearnedResponse.edge_error`; None: not learned."""
    time: Array = field(default_factory=lambda: np.empty(0))
    """Times (m,), s, of the contacts."""
    recorded: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=int))
    """Rows (m,) of the contacts in the recording."""
    strays: int = 0
    """Number of contacts left out because they are single ones that are not on the surface."""
    left_out: int = 0
    """Number of contacts left out because the contact model does not hold in them."""
    corrupt: np.ndarray = field(default_factory=lambda: np.empty((0, 2), dtype=int))
    """Contact and taxel (c, 2) of readings that were left out as negative or corrupt: rows of
    `points` and of `ids`. They are not silences."""
    misfitting: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=int))
    """Contacts, rows of `points`, left out because their readings misfit; they have no silences."""
    delay: int = 0
    """Frames by which the readings were recorded too late; they have been moved."""
    delays: tuple[tuple[float, int], ...] = ()
    """Parts of the contacts from which on the delay is another, and that; empty: it is not."""
    unread: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=int))
    """Contacts, rows of `points`, whose readings came outside the recording: without silences."""
    lost: float = 0.0
    """Fraction of the readings that were lost; where some were, no silence informs."""
    ended: np.ndarray = field(default_factory=lambda: np.empty((0, 2), dtype=int))
    """Taxels that answer no more, and the last contact of each that they answer (e, 2): rows of
    `ids` and of `points`. Later silences of theirs do not inform."""

    @cached_property
    def ids(self) -> np.ndarray:
        """Taxel ids (n,), in the belief's order."""
        return np.asarray(self.belief.taxel_ids)

    @cached_property
    def groups(self) -> np.ndarray:
        """Group (n,) of taxels with a response of its own that each one belongs to."""
        found = np.zeros(len(self.ids), dtype=int)
        for number, ids in enumerate(self.belief.response_groups, 1):
            found[np.isin(self.ids, ids)] = number
        return found

    @property
    def body(self) -> Body:
        """The believed body."""
        return self.belief.body

    @property
    def disc(self) -> float:
        """Disc radius of a taxel, m."""
        return self.belief.disc_radius

    @property
    def modulus(self) -> float:
        """Nominal E*, Pa."""
        return self.belief.material.effective_modulus

    @property
    def sigma(self) -> float:
        """Standard deviation, Pa, that weights the readings."""
        return self.noise or NOMINAL_NOISE * self.nominal_peak

    @cached_property
    def radii(self) -> Array:
        """Contact radii (m,), m, at the nominal E*: of the circles of the patches' areas."""
        return np.asarray(np.sqrt(self.patches.first * self.patches.second))

    @cached_property
    def headway(self) -> Array:
        """Tangents (m, 3) along which the contacts move (`headway.headway`)."""
        return headway(self.points, self.normals, self.time)

    @cached_property
    def longest(self) -> Array:
        """The longer semi-axes (m,), m, at the nominal E*."""
        return np.asarray(np.maximum(self.patches.first, self.patches.second))

    @property
    def peaks(self) -> Array:
        """Peak pressures p_0 (m,), Pa, at the nominal E*."""
        return np.asarray(self.patches.peak)

    @cached_property
    def nominal_peak(self) -> float:
        """Peak pressure, Pa, that a learned response refers to: the median at the nominal E*."""
        return float(np.median(self.peaks)) if self.references is None else self.references[1]

    @cached_property
    def relative_curvature(self) -> Array:
        """Mean curvatures (m,) of body and indenter together, 1/m."""
        return np.asarray(self.curvature.mean(axis=1) + 1 / self.belief.indenter.radius)

    @cached_property
    def indentation(self) -> float:
        """Typical depth of the indentation, m."""
        return float(np.median(self.radii**2 * self.relative_curvature))

    @cached_property
    def typical_curvature(self) -> float:
        """Median of `relative_curvature`, 1/m: a learned response refers to it."""
        median = np.median(self.relative_curvature)
        return float(median) if self.references is None else self.references[0]

    @cached_property
    def contact_tree(self) -> cKDTree:
        """The contact points, for queries by distance."""
        return cKDTree(self.points)

    def reach(self, scale: float = 1.0) -> Array:
        """Distance (m,), m, across the contact at which a taxel's disc leaves the patch; scale: its
        contact radii relative to those at nominal E*."""
        return np.asarray(scale * self.longest + self.disc)

    def select(self, rows: np.ndarray) -> Measurements:
        """These measurements with the readings `rows` only (indices or bool)."""
        part = replace(
            self, contact=self.contact[rows], taxel=self.taxel[rows], pressure=self.pressure[rows]
        )
        if self.model.name == "hertz":  # each reading's is independent of the others
            part.__dict__["distance"] = self.distance[rows]
            part.__dict__["slope"] = self.slope[rows]
        return part

    def without_contacts(self, rows: np.ndarray) -> Measurements:
        """These measurements without the readings and silences of the contacts `rows`."""
        return replace(self.select(~np.isin(self.contact, rows)), misfitting=rows)

    def referred_to(self, references: tuple[float, ...]) -> Measurements:
        """These measurements with `LearnedResponse.references`; as they are without any."""
        if not references:
            return self
        force, curvature, peak, _ = references
        belief = replace(self.belief, force_reference=force)
        return replace(self, belief=belief, references=(curvature, peak))

    @property
    def excluded(self) -> tuple[str, ...]:
        """Which contacts were left out, and why, in words."""
        bad = len(self.misfitting)
        why = (
            (self.left_out, "in which the contact model does not hold"),
            (self.strays, "off the believed surface"),
            (bad, "whose readings fit no others: bumps, jumps of the curvature, wrong points"),
        )
        return tuple(f"without {n} contact{'s' * (n > 1)} {words}" for n, words in why if n)

    def at_contacts(self, hit: Closest) -> Measurements:
        """These measurements with the contacts at the points `hit` (m) of the body.

        Where the contact model does not hold there, as at a crease or a hollow of a mesh, they keep
        the curvatures that they have, which are known to be in its range.
        """
        if self.learned:
            hit = over_patches(self.belief, hit, self.force)
        else:
            valid = in_range(self.model, self.belief, self.force, hit.curvature)
            hit = replace(hit, curvature=np.where(valid[:, None], hit.curvature, self.curvature))
        return replace(
            self,
            points=hit.point,
            normals=hit.normal,
            directions=hit.direction,
            curvature=hit.curvature,
            patches=nominal_patches(self.model, self.belief, self.force, hit.curvature),
        )

    @cached_property
    def phase(self) -> Array:
        """Times (m,) since the first contact, relative to all: drifts begin at offset zero."""
        length = float(np.ptp(self.time)) or 1.0
        return np.asarray((self.time - self.time[0]) / length)

    @cached_property
    def drifts(self) -> Array:
        """Legendre polynomials (m, DRIFT_SIZE) of the time, from the first degree on."""
        return np.asarray(np.polynomial.legendre.legvander(2 * self.phase - 1, DRIFT_SIZE)[:, 1:])

    @cached_property
    def uneven(self) -> Array:
        """Pressures (m,), in units of sigma, by which those of a contact may differ from the
        model's, for no quadric describes the body within its patch."""
        radius = typical_radius(self.belief, self.force)
        return unevenness(self.belief, self._hit, radius) * self.peaks / self.sigma

    @cached_property
    def patch_shifts(self) -> Array:
        """`patch_shape.patch_shifts` (m, 3), m, of the contacts."""
        return patch_shifts(self.belief, self._hit, self.radii)

    @cached_property
    def _hit(self) -> Closest:
        """The contact points on the body, with the curvatures over the patches."""
        hit = self.body.closest(self.points)
        return replace(hit, curvature=self.curvature, direction=self.directions)

    @property
    def edges(self) -> int:
        """Number of contacts over edges of the body."""
        return int(np.count_nonzero(self.unevenness))

    @cached_property
    def edge_variance(self) -> Array:
        """Variances (m,) by edges of the readings of one contact, relative to that of the noise."""
        if not len(self.unevenness):
            return np.zeros(len(self.points))
        return np.asarray((self.unevenness * self.peaks / self.sigma) ** 2)

    @cached_property
    def alike(self) -> Array:
        """Contacts (m,) that share the error of each (`patch_shape.alike_contacts`); 1 under a
        learned response, which has a factor of its own (`LearnedResponse.alike_contacts`)."""
        if self.learned or not self.edges:
            return np.ones(len(self.points))
        return alike_contacts(self.points, self.unevenness > 0, self.radii)

    @cached_property
    def precision(self) -> Array:
        """Precisions (m,) of a contact's readings, relative to the noise's: less over edges."""
        return np.asarray(1 / (1 + self.alike * self.edge_variance))

    @property
    def spread(self) -> Array:
        """Standard deviations (m,), Pa, of the contacts' readings."""
        return np.asarray(self.sigma / np.sqrt(self.precision))

    @cached_property
    def counts(self) -> np.ndarray:
        """Readings (n,) of each taxel."""
        return np.bincount(self.taxel, minlength=len(self.ids))

    @cached_property
    def by_taxel(self) -> tuple[np.ndarray, np.ndarray]:
        """Rows (k,) of the readings, sorted by taxel, and the first (n,) of each taxel there."""
        return np.argsort(self.taxel, kind="stable"), np.cumsum(self.counts) - self.counts

    @cached_property
    def rest(self) -> Array:
        """What each taxel (n,) reads in most contacts, Pa; the threshold where it is silent."""
        order, middle = np.lexsort((-self.pressure, self.taxel)), len(self.points) // 2
        often, level = self.counts > middle, np.full(len(self.ids), self.threshold)
        level[often] = self.pressure[order[self.by_taxel[1][often] + middle]]
        return level

    @cached_property
    def distance(self) -> Array:
        """Distance (k,), m, from contact to taxel by each reading (paper, eq. 15), in circles."""
        a = self.radii[self.contact]
        return a * invert_disc_mean(self.pressure / self.peaks[self.contact], self.disc / a)

    @cached_property
    def slope(self) -> Array:
        """|dp/dr| (k,), Pa/m, at that distance; 0 at the patch's centre and at its edge."""
        a = self.radii[self.contact]
        return np.abs(disc_slope(self.distance / a, self.disc / a)) * self.peaks[self.contact] / a
