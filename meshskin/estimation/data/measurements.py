"""Readings beside the contacts they belong to, in the numbers of the believed contact model."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np

from ... import contact
from ...contact.disc import disc_slope, invert_disc_mean
from ...core.errors import CalibrationError, RecordingError
from ...core.se3 import Array
from . import unit_checks
from .global_parameters import MODULUS, GlobalParameters, declared
from .resolve_belief import resolve_belief, valid_contacts

if TYPE_CHECKING:
    from ...geometry.surface.closest_point import Closest
    from ...recording.recording import Recording
    from ...scene.belief import Belief

NOMINAL_NOISE = 0.01
"""Standard deviation that weights the readings when none is known, relative to the median peak."""


@dataclass(frozen=True)
class Measurements:
    """m contacts and k readings of n taxels; everything that an estimator needs of a recording."""

    ids: np.ndarray
    """Taxel ids (n,), in the belief's order."""
    points: Array
    """Contact points (m, 3), body frame, m."""
    normals: Array
    """Outward normals (m, 3) of the believed body at the contact points."""
    directions: Array
    """Unit tangents (m, 3) along the first principal curvature there."""
    curvature: Array
    """Principal curvatures (m, 2) there, 1/m."""
    patches: contact.Patches
    """The contacts' patches at the nominal E*; `first` lies along `directions`."""
    model: contact.ContactModel
    """The believed contact model."""
    indenter_radius: float
    """m."""
    modulus: float
    """Nominal E*, Pa."""
    disc: float
    """Disc radius of a taxel, m."""
    contact: np.ndarray
    """Contact (k,) of each reading, a row of `points`."""
    taxel: np.ndarray
    """Taxel (k,) of each reading, a row of `ids`."""
    pressure: Array
    """Pressure (k,), Pa."""
    noise: float | None
    """Known standard deviation of a reading, Pa, or None."""
    threshold: float
    """Pressures up to this are silent, Pa."""
    force: Array
    """Measured forces (m,), N."""
    saturation: float = np.inf
    """Readings of this and more are at the end of the sensor's range, Pa."""
    shared: GlobalParameters = MODULUS
    """What is unknown beside the taxels."""
    headings: Array | None = None
    """World from body rotations (m, 3, 3), where known."""
    slots: Array | None = None
    """Places (slots, 3), m, of the taxels of rigid modules, in the module's frame."""
    left_out: int = 0
    """Contacts in which the contact model does not hold; none of them is in here."""

    @property
    def sigma(self) -> float:
        """Standard deviation, Pa, that weights the readings."""
        return self.noise or NOMINAL_NOISE * float(np.median(self.peaks))

    @cached_property
    def radii(self) -> Array:
        """Contact radii (m,), m, at the nominal E*: of the circles of the patches' areas."""
        return np.asarray(np.sqrt(self.patches.first * self.patches.second))

    @cached_property
    def longest(self) -> Array:
        """The longer semi-axes (m,), m, at the nominal E*."""
        return np.asarray(np.maximum(self.patches.first, self.patches.second))

    @property
    def peaks(self) -> Array:
        """Peak pressures p_0 (m,), Pa, at the nominal E*."""
        return np.asarray(self.patches.peak)

    @property
    def height(self) -> Array:
        """Height (m,) of the indenter's centre over the contact point, m."""
        return np.asarray(self.indenter_radius - self.patches.depth)

    def on(self, hit: Closest) -> Measurements:
        """The same with the contacts at the points `hit` of the body."""
        patches = self.model.patches(
            force=self.force,
            curvature=hit.curvature,
            indenter_radius=self.indenter_radius,
            effective_modulus=self.modulus,
        )
        return replace(
            self,
            points=hit.point,
            normals=hit.normal,
            directions=hit.direction,
            curvature=hit.curvature,
            patches=patches,
        )

    @cached_property
    def counts(self) -> np.ndarray:
        """Readings (n,) of each taxel."""
        return np.bincount(self.taxel, minlength=len(self.ids))

    @cached_property
    def rest(self) -> Array:
        """What each taxel (n,) reads in most contacts, Pa; the threshold where it is silent."""
        order, middle = np.lexsort((-self.pressure, self.taxel)), len(self.points) // 2
        often = self.counts > middle
        starts = np.cumsum(self.counts) - self.counts
        level = np.full(len(self.ids), self.threshold)
        level[often] = self.pressure[order[starts[often] + middle]]
        return level

    @cached_property
    def distance(self) -> Array:
        """Distance (k,), m, from contact to taxel that each reading says (paper, eq. 15), under
        circular patches.
        """
        a = self.radii[self.contact]
        return a * invert_disc_mean(self.pressure / self.peaks[self.contact], self.disc / a)

    @cached_property
    def slope(self) -> Array:
        """|dp/dr| (k,), Pa/m, at that distance; 0 at the patch's centre and at its edge."""
        a = self.radii[self.contact]
        slope = disc_slope(self.distance / a, self.disc / a)
        return np.abs(slope) * self.peaks[self.contact] / a


def gather(recording: Recording, belief: Belief) -> Measurements:
    """The measurements of a recording under a belief.

    Contacts without force (approach) have no patch and are left out, with their readings.
    Raises RecordingError for values that are not finite or there twice, CalibrationError for no
    readings or taxel ids that the belief does not know, ContactError where the contact model leaves
    its range.
    """
    _check_finite(recording)
    index = _taxel_index(recording.reading_taxel, np.asarray(belief.taxel_ids))
    _check_once(recording, index, len(belief.taxel_ids))
    hit = belief.body.closest(recording.points)
    unit_checks.check_place(belief.body, recording.points, hit.distance)
    belief = resolve_belief(belief, recording)
    pressed = recording.force > 0
    heard = pressed[recording.reading_contact] & (recording.pressure > 0)
    _require(heard, recording, pressed)
    reference = belief.force_reference or 1.0
    unit_checks.check_force(recording.force[pressed], reference)
    holds = valid_contacts(recording.force[pressed], hit.curvature[pressed], belief)
    pressed[pressed] = holds
    heard &= pressed[recording.reading_contact]
    hit, force, row = hit.take(pressed), recording.force[pressed], np.cumsum(pressed) - 1
    headings = recording.headings if belief.headings is None else belief.headings
    if headings is not None and len(headings) != len(recording.time):
        raise CalibrationError(
            "belief.headings must have one rotation for each contact of the recording",
            value=len(headings),
            limit=len(recording.time),
        )
    material = belief.material
    model = contact.ContactModel(belief.contact, material.poisson, material.thickness)
    patches = model.patches(
        force=force,
        curvature=hit.curvature,
        indenter_radius=belief.indenter.radius,
        effective_modulus=material.effective_modulus,
    )
    unit_checks.check_pressure(recording.pressure[heard], index[heard], patches.peak)
    heard &= recording.pressure > belief.threshold
    _require(heard, recording, pressed)
    return Measurements(
        ids=np.asarray(belief.taxel_ids),
        points=recording.points[pressed],
        normals=hit.normal,
        directions=hit.direction,
        curvature=hit.curvature,
        patches=patches,
        model=model,
        indenter_radius=belief.indenter.radius,
        modulus=material.effective_modulus,
        disc=belief.disc_radius,
        contact=row[recording.reading_contact][heard],
        taxel=index[heard],
        pressure=recording.pressure[heard],
        noise=belief.noise_sigma,
        threshold=belief.threshold,
        force=force,
        saturation=belief.saturation or np.inf,
        shared=declared(belief.unknown, belief.priors, reference, float(np.median(patches.peak))),
        slots=belief.module_slots,
        headings=None if headings is None else np.asarray(headings)[pressed],
        left_out=int(np.sum(~holds)),
    )


def _require(heard: np.ndarray, recording: Recording, pressed: np.ndarray) -> None:
    if not np.any(pressed) and len(recording.force):
        raise CalibrationError(
            "no contact is pressed",
            value=f"{len(recording.force)} forces of at most {recording.force.max():.4g} N",
            limit="above 0 N",
            remedy="a force is positive where it presses: check its sign",
        )
    if not np.any(heard):
        raise CalibrationError(
            "the recording has no readings of a pressed contact",
            value=f"{len(recording.pressure)} readings of at most "
            f"{recording.pressure.max(initial=0.0):.4g} Pa, {np.sum(pressed)} pressed contacts",
            remedy="check the threshold and the skin's wiring",
        )


def _check_finite(recording: Recording) -> None:
    columns = {
        "contact point": recording.points.sum(axis=1),
        "force": recording.force,
        "pressure": recording.pressure,
    }
    for what, values in columns.items():
        bad = np.flatnonzero(~np.isfinite(values))
        if len(bad):
            table = "readings" if what == "pressure" else "contacts"
            raise RecordingError(
                f"a {what} is not finite",
                value=f"{values[bad[0]]} in row {bad[0]} of {table}, {len(bad)} in all",
                remedy="drop those rows or repair the log",
            )


def _check_once(recording: Recording, index: np.ndarray, taxels: int) -> None:
    """Refuse a taxel that is read twice in one contact: a copy would count as other noise."""
    number = recording.reading_contact * taxels + index
    if np.all(np.diff(number) > 0):
        return
    _, first, count = np.unique(number, return_index=True, return_counts=True)
    if len(first) < len(number):
        k = int(first[np.argmax(count > 1)])
        raise RecordingError(
            "a taxel is read twice in one contact",
            value=f"taxel {recording.reading_taxel[k]} at "
            f"{recording.time[recording.reading_contact[k]]:g} s, {np.sum(count > 1)} in all",
            remedy="drop the copies",
        )


def _taxel_index(taxels: np.ndarray, ids: np.ndarray) -> np.ndarray:
    """Row in `ids` of each taxel id."""
    order = np.argsort(ids, kind="stable")
    place = np.minimum(np.searchsorted(ids[order], taxels), len(ids) - 1)
    index = order[place]
    unknown = np.unique(taxels[ids[index] != taxels])
    if len(unknown):
        raise CalibrationError(
            "the recording has taxels that the belief does not know",
            value=f"ids {', '.join(map(str, unknown[:5]))}{' ...' if len(unknown) > 5 else ''}",
            limit=f"{len(ids)} ids from {ids.min()} to {ids.max()}",
            remedy="use the skin that was recorded",
        )
    return index


def reach(data: Measurements, stretch: float = 1.0) -> Array:
    """Distance (m,), m, across the contact beyond which patch and disc have parted.

    `stretch`: contact radii relative to those at nominal E*.
    """
    return np.asarray(stretch * data.longest + data.disc)
