"""Errors of contacts that their neighbours share, in an estimate with a learned response.

The estimate takes the errors of contact points and forces as independent. Where neighbouring
contacts err alike, many contacts tell less than they seem to.
"""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from .deviations import FLOOR
from .random_effects import RandomEffects

MAX_CORRELATION, LARGEST_CORRELATION = 0.4, 0.95
"""Correlation of the displacements of neighbouring contacts above which they are no scatter:
independent ones have -0.1 to 0.15, by the taxels that they share; and the largest one that tells
how many contacts they stand for."""
FORCE_BINS = 16
"""Bins of the correlogram of force errors, up to two reaches of a contact."""
FORCE_CORRELATION = 0.05, 5.0
"""Least correlation of the force errors within half a reach that is no chance, and in standard
errors of independent ones; the taxels that contacts share make it -0.04 to -0.1 where the forces
scatter. A skin whose stiffness varies by 8 % over 2 mm has 0.19 to 0.24 with 3,000 contacts."""
CENTRES = 2000
"""Contacts, about, whose neighbours are compared: more change the correlogram little."""
MIN_CONTACTS = 20
"""Contacts, at least, whose displacements are compared."""


def fewer_contacts(correlation: float) -> float:
    """Factor of the variances where displacements of neighbouring contacts correlate, for they are
    taken as independent: that of a mean in a first-order autoregressive sequence."""
    if correlation <= MAX_CORRELATION:
        return 1.0
    return (1 + correlation) / (1 - min(correlation, LARGEST_CORRELATION))


def neighbour_correlation(effects: RandomEffects) -> float:
    """Correlation of the displacements of contacts with those of their nearest neighbours.

    Errors of a kinematic model or of the clocks change slowly over the body or the path; scatter
    does not.
    """
    contacts, errors = effects.linearized.at(effects.unknowns.s), effects.unknowns.errors
    used = np.flatnonzero(effects.probes.touched)
    if len(used) < MIN_CONTACTS or effects.deviations.position <= FLOOR["position"]:
        return 0.0
    across = np.cross(contacts.normals, contacts.directions)
    moved = errors[:, :1] * contacts.directions + errors[:, 1:2] * across
    points, moved = effects.data.points[used], moved[used]
    nearest = cKDTree(points).query(points, k=2)[1][:, 1]
    power = float(np.sum(moved**2))
    return float(np.sum(moved * moved[nearest])) / power if power > 0 else 0.0


def alike_forces(effects: RandomEffects) -> tuple[float, float]:
    """Correlation of the errors of ln force of neighbouring contacts, and how many contacts one
    stands for by it; (0, 1) where chance explains it.

    Errors of a sensor differ from contact to contact. Those that contacts at one place share are
    the skin's: a foam whose thickness or stiffness varies. They displace the taxels there, however
    many contacts there are: of independent errors with variance v the mean of n has v / n, of these
    v / n times the sum of the correlogram over all contacts. What the readings of a contact tell of
    its error displaces nothing: only the rest of the variance counts.
    """
    used, data = np.flatnonzero(effects.probes.touched), effects.data
    if len(used) < MIN_CONTACTS or effects.deviations.force <= FLOOR["force"]:
        return 0.0, 1.0
    points, error = data.points[used], effects.unknowns.errors[used, 2]
    open_share = 1.0 - min(float(np.mean(error**2)) / effects.deviations.force**2, 1.0)
    error = (error - error.mean()) / max(float(error.std()), 1e-300)
    tree, far = cKDTree(points), 2.0 * float(np.median(data.reach()[used]))
    centres = np.arange(len(used))[:: max(len(used) // CENTRES, 1)]
    found = tree.query_ball_point(points[centres], far)
    first = np.repeat(centres, [len(near) for near in found])
    second = np.concatenate([np.asarray(near, dtype=int) for near in found])
    first, second = first[first != second], second[first != second]
    distance = np.linalg.norm(points[first] - points[second], axis=1)
    ring = np.minimum((FORCE_BINS * distance / far).astype(int), FORCE_BINS - 1)
    count = np.bincount(ring, minlength=FORCE_BINS)
    total = np.bincount(ring, error[first] * error[second], FORCE_BINS)
    pairs = max(int(count[: FORCE_BINS // 4].sum()), 1)
    correlation = float(total[: FORCE_BINS // 4].sum()) / pairs
    least, errors = FORCE_CORRELATION
    if correlation < max(least, errors / np.sqrt(pairs * len(used) / len(centres) / 2)):
        return 0.0, 1.0
    end = np.flatnonzero((total <= 0) & (count > 0))
    alike = float(total[: end[0] if len(end) else None].sum()) / len(centres)
    return correlation, 1.0 + open_share * alike
