"""The next best touch of an online calibration: as `next_contacts`, about few taxels only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ...core.arrays import Array
from ...core.value import Value
from ...scene.belief import Belief
from .. import chart
from ..next_contact import POWER, candidates_about, expected_slopes, valid_contacts

TARGETS = 4
"""Taxels, the most uncertain ones, about which candidates are placed: 57 each."""
NEIGHBOURS = 3.0
"""Distance, in reaches of a contact, up to which taxels beside these profit from a candidate."""


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


def next_touch(
    ids: np.ndarray, points: Array, covariance: Array, belief: Belief, modulus: float, radius: float
) -> NextTouch | None:
    """The best touch for n taxels at points (n, 3), m, with covariances (n, 3, 3), m^2, in space.

    None where the contact model holds nowhere about the most uncertain taxels. modulus: E*, Pa;
    radius: of a contact, m.
    """
    variance = np.trace(covariance, axis1=1, axis2=2)
    worst = np.argsort(-variance, kind="stable")[:TARGETS]
    limit = NEIGHBOURS * (radius + belief.disc_radius)
    gap = np.linalg.norm(points[:, None] - points[worst], axis=2).min(axis=1)
    near = np.flatnonzero(gap < limit)
    charts = chart.charts_at(belief.body, points[near])
    flat = np.swapaxes(charts.tangents, 1, 2) @ covariance[near] @ charts.tangents
    before = np.trace(flat, axis1=1, axis2=2)
    hit = valid_contacts(candidates_about(charts, before, radius, TARGETS), belief, modulus)
    if not len(hit.point):
        return None
    contact, taxel, slope = expected_slopes(charts, hit, belief, modulus)
    if not len(contact):
        return None
    along = np.einsum("pij,pj->pi", flat[taxel], slope)
    gain = np.einsum("pi,pi->p", along, along) / (1 + np.einsum("pi,pi->p", slope, along))
    scale = before.max()
    change = ((before[taxel] - gain) / scale) ** POWER - (before[taxel] / scale) ** POWER
    best = int(np.argmin(np.bincount(contact, change, len(hit.point))))
    mine = np.flatnonzero(contact == best)
    most = mine[np.argmin(change[mine])]
    return NextTouch(
        point=hit.point[best],
        normal=hit.normal[best],
        taxel=int(ids[near[taxel[most]]]),
        sigma=float(np.sqrt(before[taxel[most]] - gain[most])),
    )
