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

PRESSED = 0.8
"""Distance of a contact from a taxel, in contact radii, within which it answers: at most that of an
answered contact, by Hertz' profile, and the way from there. No silence of 31,000 there in 37
recordings without lost readings, of 7 bodies (`lost_readings`)."""
WEAK = 0.25
"""Readings there above the threshold, relative to the largest one, up to which they are weak: 0 to
0.007 of them, to 0.08 where contact points scatter by 0.25 of their radius, and more of these than
silences."""
MAX_LOST = 0.02
"""Fraction of readings that are missing there from which no silence informs: contact points that
scatter by 0.25 of their radius leave 0 to 0.012."""
FAULTY = 0.1
"""Fraction of the taxels up to which these are faulty if they fail at times, and no readings are
lost on the way."""
CHANCE = 1e-3
"""Probability that any sound taxel of a recording is taken for one that answers no more."""

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


def lost_readings(data: Measurements) -> tuple[float, np.ndarray]:
    """Fraction of the readings that are missing where contacts press a taxel, and the taxels that
    answer no more from some contact on (`Measurements.ended`).

    The fraction is 0 up to MAX_LOST, where few taxels fail at times, and where more readings there
    are weak: what makes these so, noise or scatter of the contacts, brings others below the
    threshold. A taxel answers no more if its silences to the end are too many for those that are
    lost on the way, elsewhere or before another answer; where as many as MAX_LOST are, silences are
    shared or end again.
    """
    contact, taxel, level, least = _pressed(data)
    silent, n = level == 0, len(data.ids)
    last = np.full(n, -1)
    np.maximum.at(last, data.taxel, data.contact)
    after = (contact > last[taxel]) & np.isin(contact, data.contact)
    rate = (np.sum(silent & ~after) + 1) / (np.sum(~after) + 1)
    surprise = -np.log(rate) * np.bincount(taxel[after], minlength=n)
    ended = np.flatnonzero((surprise > np.log(n / CHANCE)) & (rate <= MAX_LOST))
    sound = ~np.isin(taxel, ended)
    lost, weak = silent & sound, ~silent & sound & (level < WEAK + least)
    many = lost.sum() > max(MAX_LOST * sound.sum(), weak.sum())
    to_the_end = (lost & after).sum() > lost.sum() / 2
    many &= to_the_end or len(np.unique(taxel[lost])) > FAULTY * n
    share = float(lost.sum() / sound.sum()) if many else 0.0
    return share, np.column_stack([ended, last[ended]])


def _pressed(data: Measurements) -> tuple[np.ndarray, np.ndarray, Array, float]:
    """Contacts (p,) that press taxels (p,), as PRESSED says of answered ones beside them, and what
    these read (p,), relative to the largest reading of the taxel or of the typical one, 0 where
    they are silent; and the threshold, relative to the latter."""
    m, by_taxel = len(data.points), np.zeros(len(data.ids))
    np.maximum.at(by_taxel, data.taxel, data.pressure)
    typical = float(np.median(by_taxel[data.counts > 0]))
    largest = np.maximum(by_taxel, typical)
    level = np.minimum(data.pressure / largest[data.taxel], 1.0)
    left = PRESSED - np.sqrt(1 - level**2)
    strong = np.flatnonzero(left > 0)
    at = data.contact[strong]
    near = data.contact_tree.query_ball_point(data.points[at], left[strong] * data.radii[at])
    contact = np.concatenate([*map(np.asarray, near), np.empty(0)]).astype(int)
    reading = np.repeat(strong, [len(rows) for rows in near])
    answered = data.contact[reading]
    other = (data.radii[contact] > AS_LARGE * data.radii[answered]) & (contact != answered)
    other &= np.einsum("pi,pi->p", data.normals[contact], data.normals[answered]) > NO_EDGE
    pair = np.unique(data.taxel[reading[other]] * m + contact[other])
    pair = pair[~np.isin(pair, data.corrupt[:, 1] * m + data.corrupt[:, 0])]
    known = data.taxel * m + data.contact
    order = np.argsort(known)
    row = order[np.searchsorted(known, pair, sorter=order) % len(order)]
    taxel, contact = np.divmod(pair, m)
    level = np.where(known[row] == pair, level[row], 0.0)
    return contact, taxel, level, data.threshold / typical


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
