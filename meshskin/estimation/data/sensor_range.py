"""What readings alone show of the sensors: taxels that never change, ends of their ranges, and
contacts that nothing answers.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from ...core.arrays import Array, sums_by_group
from ...core.errors import CalibrationError
from .measurements import Measurements

MIN_CONSTANT = 10
"""Equal readings of a taxel, at least, without another one, from which it never changes."""
MIN_AT_END, AT_END = 5, 3
"""Number of equal largest readings of a taxel from which its range ends there, and how often more
they are than any other value above half of it: counts repeat values by chance."""
SILENT, STRONG = 0.1, 0.9
"""Largest reading of a contact, relative to the taxels' typical largest one, up to which nothing
answers it, and from which a contact is in the middle of a taxel."""
BESIDE = 0.5
"""Distance, in contact radii, from such a contact, at which another one must be answered: Hertz'
pressure falls from STRONG to SILENT in 0.56 of them, and every smoother one more slowly."""
AS_LARGE = 0.9
"""Least radius of a contact, in that of an answered one beside it, at which it must be answered,
too: at lighter touches, as those of an approach, a taxel may lie beside the smaller patch. The
force that gives it is 0.73 times as large."""
SAME_SHEET = 0.5
"""Least cosine of the angle between normals of contacts on the same side of a plate."""
NO_EDGE = 0.97
"""Least cosine of the angle between normals of contacts that lie beside each other with no edge
between, 14 degrees: a taxel that answers one may face away from the other where it is less."""
MAX_UNANSWERED = 0.2
"""Fraction of unanswered contacts beside answered ones from which the log is refused: scatter of
the contact points of a quarter of their radius leaves it below 0.02."""

CERTAIN = 0.5
"""Least reading, relative to the largest one of its taxel and to that of the typical taxel, between
which a taxel answers: patches are convex."""
SURROUNDED, AROUND = 3, 0.5
"""Such readings, at least, within BESIDE of a contact, and the largest mean of the directions to
them, of length 1, with which they are on all sides of it."""
MAX_LOST = 0.02
"""Fraction of readings that are missing between others of their taxels from which no silence
informs: 0 in 33 worlds without any; contact points that scatter by 0.25 of their radius leave 0.004
to 0.011, by 0.4 of it 0.03."""
SAMPLE = 500
"""Taxels, about, whose lost readings are counted."""

LARGE_DISC = 1.5
"""Radius of a taxel's disc, in contact radii, from which `check_disc` looks at it."""
MIN_RESPONSE = 0.5
"""Least fraction of the contacts within the disc of a taxel that it responds to: half of the patch,
at least, presses it there."""


def constant_taxels(values: Array, taxel: np.ndarray, n: int) -> np.ndarray:
    """Taxels (n,) bool whose finite readings, of the `values` (k,) of taxels (k,), are all
    equal."""
    sound = np.isfinite(values)
    values, taxel = values[sound], taxel[sound]
    low, high = np.full(n, np.inf), np.full(n, -np.inf)
    np.minimum.at(low, taxel, values)
    np.maximum.at(high, taxel, values)
    return np.asarray((np.bincount(taxel, minlength=n) >= MIN_CONSTANT) & (low == high))


def ends_of_range(pressure: Array, taxel: np.ndarray, n: int) -> Array:
    """Upper end (n,), Pa, of the range of each taxel whose largest reading repeats, of readings
    (k,), Pa, of taxels (k,); infinite for the others."""
    ends, largest = np.full(n, np.inf), np.zeros(n)
    np.maximum.at(largest, taxel, pressure)
    high = pressure > largest[taxel] / 2
    order = np.lexsort((pressure[high], taxel[high]))
    owner, value = taxel[high][order], pressure[high][order]
    first = np.flatnonzero((np.diff(owner, prepend=-1) != 0) | (np.diff(value, prepend=-1.0) != 0))
    count = np.diff(np.append(first, len(owner)))
    owner, at_end = owner[first], value[first] == largest[owner[first]]
    top, other = np.zeros(n, dtype=int), np.zeros(n, dtype=int)
    top[owner[at_end]] = count[at_end]
    np.maximum.at(other, owner[~at_end], count[~at_end])
    found = (top >= MIN_AT_END) & (top >= AT_END * other) & (top < np.bincount(taxel, minlength=n))
    ends[found] = largest[found]
    return ends


def common_end(ends: Array, counts: np.ndarray) -> float:
    """The end of the range, Pa, that most taxels with readings have in common; else infinite."""
    own = ends[counts > 0]
    if not np.mean(np.isfinite(own)) > 0.5:
        return float("inf")
    level = float(np.median(own[np.isfinite(own)]))
    return level if np.mean(np.isclose(own, level)) > 0.5 else float("inf")


def unanswered_contacts(data: Measurements) -> tuple[np.ndarray, np.ndarray]:
    """Contacts (m,) bool beside one in the middle of a taxel, and which of them nothing answers."""
    m = len(data.points)
    strongest, by_taxel = np.zeros(m), np.zeros(len(data.ids))
    np.maximum.at(strongest, data.contact, data.pressure)
    np.maximum.at(by_taxel, data.taxel, data.pressure)
    typical = float(np.median(by_taxel[data.counts > 0]))
    strong, rest = np.flatnonzero(strongest > STRONG * typical), strongest <= STRONG * typical
    beside = strongest > STRONG * typical
    if len(strong):
        gap, nearest = cKDTree(data.points[strong]).query(data.points[rest])
        nearest = strong[nearest]
        cosine = np.einsum("mi,mi->m", data.normals[rest], data.normals[nearest])
        radius = data.radii[rest]
        near = (gap < BESIDE * radius) & (radius > AS_LARGE * data.radii[nearest])
        beside[rest] = near & (cosine > NO_EDGE)
    return beside, beside & (strongest < SILENT * typical)


def check_answered(data: Measurements) -> None:
    """Refuse contacts of which many are unanswered. Raises CalibrationError."""
    beside, unanswered = unanswered_contacts(data)
    if unanswered.sum() > max(MAX_UNANSWERED * beside.sum(), MIN_AT_END):
        raise CalibrationError(
            "contacts have a force where nothing is pressed",
            value=f"no taxel answers {unanswered.sum()} of {beside.sum()} contacts, though one "
            f"within {BESIDE:g} contact radii is answered strongly",
            limit=f"{MAX_UNANSWERED:.0%}",
            remedy="record the measured force, 0 between contacts, or leave these frames out",
        )


def lost_readings(data: Measurements) -> float:
    """Fraction of the readings that are missing between strong ones of their taxels, in contacts
    that those of these surround; 0 up to MAX_LOST, and where as many readings there are weak: what
    makes these so, noise or scatter of the contacts, brings others below the threshold.
    """
    by_taxel = np.zeros(len(data.ids))
    np.maximum.at(by_taxel, data.taxel, data.pressure)
    largest = np.maximum(by_taxel, np.median(by_taxel[data.counts > 0]))
    few = data.taxel % max(len(data.ids) // SAMPLE, 1) == 0
    strong = np.flatnonzero(few & (data.pressure > CERTAIN * largest[data.taxel]))
    at = data.contact[strong]
    near = data.contact_tree.query_ball_point(data.points[at], BESIDE * data.radii[at])
    contact = np.concatenate([*map(np.asarray, near), np.empty(0)]).astype(int)
    reading = np.repeat(strong, [len(rows) for rows in near])
    answered = data.contact[reading]
    other = data.radii[contact] > AS_LARGE * data.radii[answered]
    other &= np.einsum("pi,pi->p", data.normals[contact], data.normals[answered]) > SAME_SHEET
    away = data.points[answered] - data.points[contact]
    length = np.linalg.norm(away, axis=1)
    other &= length > 0
    contact, reading, away = contact[other], reading[other], away[other] / length[other, None]
    pair, row = np.unique(data.taxel[reading] * len(data.points) + contact, return_inverse=True)
    count = np.bincount(row, minlength=len(pair))
    mean = sums_by_group(away, row, len(pair)) / count[:, None]
    pair = pair[(count >= SURROUNDED) & (np.linalg.norm(mean, axis=1) < AROUND)]
    known = data.taxel * len(data.points) + data.contact
    left_out = data.corrupt[:, 1] * len(data.points) + data.corrupt[:, 0]
    lost = ~np.isin(pair, np.concatenate([known, left_out]))
    weak = ~lost & ~np.isin(pair, known[strong])
    share = float(lost.mean()) if len(pair) else 0.0
    return share if share > MAX_LOST and np.sum(lost) > np.sum(weak) else 0.0


def check_disc(data: Measurements) -> None:
    """Refuse a disc radius at which taxels are silent in most contacts that lie within their discs.
    Raises CalibrationError."""
    if data.disc < LARGE_DISC * float(np.median(data.radii)):
        return
    weight, n = data.pressure**2, len(data.ids)
    own = np.flatnonzero(data.counts)
    total = np.bincount(data.taxel, weight, n)[own, None]
    centre, normal = (
        sums_by_group(weight[:, None] * values[data.contact], data.taxel, n)[own] / total
        for values in (data.points, data.normals)
    )
    pairs = cKDTree(centre).sparse_distance_matrix(
        data.contact_tree, data.disc, output_type="ndarray"
    )
    same = np.einsum("ki,ki->k", normal[pairs["i"]], data.normals[pairs["j"]]) > SAME_SHEET
    number = own[pairs["i"][same]] * len(data.points) + pairs["j"][same]
    responds = np.isin(number, data.taxel * len(data.points) + data.contact)
    if len(number) and np.mean(responds) < MIN_RESPONSE:
        raise CalibrationError(
            "the disc radius does not agree with the readings",
            value=f"{1e3 * data.disc:.3g} mm, but taxels respond to {np.mean(responds):.0%} of the "
            "contacts within it",
            limit=f"{MIN_RESPONSE:.0%}",
            remedy="give the radius of the area in which a taxel senses (belief.disc_radius, "
            "--disc-radius-mm)",
        )
