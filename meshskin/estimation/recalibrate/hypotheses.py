"""What may have become of a unit: hypotheses, and what each leaves open.

A move and a change of gain are continuous: each is a mixture of normal components that cover its
range, so that no component has to hit the value.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from scipy.special import logsumexp

from ...core import se3
from ...core.arrays import Array
from ...geometry.body import Body
from .skin_map import SkinMap, turns

if TYPE_CHECKING:
    from .touches import Touches

CONFIRMED, MOVED, TURNED, EXCHANGED, DEAD, GAIN, NOT_TOUCHED, UNDECIDED = STATES = (
    "confirmed", "moved", "turned", "exchanged", "dead", "gain changed", "not touched", "undecided",
)  # fmt: skip
"""States of a unit or taxel. "undecided": touched, but the readings fit a change, too."""
MAX_SHIFT = 6e-3
"""Longest move of a unit, m, that is a hypothesis: about the pitch of the taxels of iCub; further
ones look like an exchange."""
SHIFT_PITCH = 0.8e-3
"""Distance of the components of a move, m."""
SHIFT_SIGMA = 0.5e-3
"""Standard deviation of a component of a move, m, along each tangent: neighbouring components
overlap, and a patch of 4 mm is nearly straight over it."""
MOVE = 2e-3
"""Move, m, that is usual, that the text says of each unit whether it is excluded, and that touches
are planned to show: a quarter of a usual pitch, below which the map still tells which taxel is
pressed."""
KINDS = {
    (MOVED, False): 8.0, (GAIN, True): 4.0, (DEAD, True): 4.0, (GAIN, False): 1.0,
    (DEAD, False): 1.0, (TURNED, False): 1.0, (EXCHANGED, False): 1.0,
}  # fmt: skip
"""Prior odds of the kinds of change, of a unit as a whole or of one of its taxels. Chosen: the
readings of one touch often show the first three just so; the others they show by far."""
NARROW, PARTS = 0.15e-3, 4
"""Standard deviation, m, of the components into which the uncertainty of a single taxel's place is
split, or that of the place divided by PARTS where this is more: a reading bends by less than 1 % of
the peak over it."""
COMPONENT_PITCH, REACHED = 1.6, 5.0
"""Distance of these components, in their standard deviations, at which their sum is smooth to
0.1 %, and the farthest, in those of the place: 1 in 300,000 is beyond."""
MIN_EXPECTED = 1e-3
"""Added to the expected readings, relative to the peak, by which changes of single taxels are
weighted: less than any threshold."""
GAIN_PITCH, GAIN_SIGMA, MAX_GAIN = 0.25, 0.15, 1.5
"""Distance and standard deviation of the components of a change of ln gain, and the largest one: a
factor of 4.5."""


@dataclass(frozen=True)
class Hypothesis:
    """The places and gains of a unit's k taxels, if it is in a state."""

    state: str
    points: Array
    """(k, 3), m."""
    normals: Array
    """(k, 3)."""
    log_gain: Array
    """ln (k,) of the factor of each level; -inf: dead."""
    covariance: Array
    """Covariances (k, 3, 3) of the points, m^2."""
    taxel: int = -1
    """The taxel, counted in the unit, that changed alone; -1: all of them."""
    value: float = 0.0
    """The angle of a turn, rad, or the number of the unit whose place it has."""
    shift: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """The move, m."""
    change: float = 0.0
    """The change of ln gain."""
    shift_sigma: float = 0.0
    """Standard deviation of what is left open of a move, m."""
    gain_sigma: float = 0.0
    """Standard deviation of what is left open of ln gain."""


def unchanged(known: SkinMap, unit: int) -> Hypothesis:
    """The hypothesis that a unit is as the map says."""
    rows = known.units[unit]
    points, normals = known.points[rows], known.poses[rows, :3, 2]
    return Hypothesis(CONFIRMED, points, normals, known.log_gain[rows, 0], known.covariance[rows])


def dead(base: Hypothesis) -> Hypothesis:
    """The unit with all of its taxels dead."""
    return replace(base, state=DEAD, log_gain=base.log_gain - np.inf)


def discrete(touches: Touches, unit: int, base: Hypothesis) -> list[Hypothesis]:
    """Turns, exchanges, and taxels that are dead, of a unit that is as `base` says."""
    found = [dead(base)]
    if touches.known.slots is not None:
        found += [_alone(base, DEAD, k, -np.inf) for k in range(len(base.points))]
    if base.state == CONFIRMED:
        found += turned(touches.known, unit, base) + _exchanged(touches, unit, base)
    return found


def _alone(base: Hypothesis, state: str, k: int, change: float, sigma: float = 0.0) -> Hypothesis:
    log_gain = base.log_gain.copy()
    log_gain[k] += change
    return replace(base, state=state, log_gain=log_gain, taxel=k, change=change, gain_sigma=sigma)


def turned(known: SkinMap, unit: int, base: Hypothesis) -> list[Hypothesis]:
    """A module at the turns of its layout's own symmetry."""
    if known.slots is None:
        return []
    slot = known.slot(known.units[unit])
    if len(slot) < 3:
        return []
    pose = se3.align(known.slots[slot], base.points)
    points = se3.transform_points(pose, known.slots)  # of slots that the map does not have
    normals = np.tile(pose[:3, 2], (len(points), 1))
    points[slot], normals[slot] = base.points, base.normals
    used = np.unique(known.slot(np.concatenate(known.units)))
    return [
        replace(base, state=TURNED, value=angle, points=points[i[slot]], normals=normals[i[slot]])
        for angle, i in turns(known.slots, used).items()
    ]


def _exchanged(touches: Touches, unit: int, base: Hypothesis) -> list[Hypothesis]:
    """The unit at the places of the others of the same slots, as far as they were touched where
    this unit answered: elsewhere it has no readings to explain."""
    known, found = touches.known, []
    rows = known.units[unit]
    contacts = np.flatnonzero(np.isfinite(touches.level[:, rows]).any(axis=1))
    if not len(contacts):
        return []
    reach = float(touches.reach().max()) + MAX_SHIFT / 2
    gap = np.linalg.norm(known.points[:, None] - touches.data.points[contacts], axis=2)
    close = gap.min(axis=1) < reach
    for other, places in enumerate(known.units):
        same = np.array_equal(known.slot(places), known.slot(rows))
        if other != unit and same and close[places].any():
            found.append(
                replace(
                    base, state=EXCHANGED, value=float(known.numbers[other]),
                    points=known.points[places], normals=known.poses[places, :3, 2],
                )
            )  # fmt: skip
    return found


def grid() -> Array:
    """Moves (g, 2), m, that cover the disc of the longest one."""
    most = np.ceil(MAX_SHIFT / SHIFT_PITCH)
    steps = SHIFT_PITCH * np.arange(-most, most + 1)
    flat = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    return np.asarray(flat[np.linalg.norm(flat, axis=1) <= MAX_SHIFT])


def ring() -> Array:
    """Moves (8, 2) by MOVE, m, in eight directions."""
    angle = np.pi / 4 * np.arange(8)
    return MOVE * np.stack([np.cos(angle), np.sin(angle)], axis=1)


def moved(base: Hypothesis, body: Body, flat: Array) -> list[Hypothesis]:
    """A unit moved over the body by `flat` (g, 2), m, along two tangents."""
    up = base.normals.mean(axis=0)
    up /= np.linalg.norm(up)
    shifts = flat @ se3.orthonormal_basis(up, -se3.perpendicular(up))[:, :2].T.copy()
    hit = body.closest((base.points + shifts[:, None]).reshape(-1, 3))
    points = hit.point.reshape(len(shifts), -1, 3)
    normals = hit.normal.reshape(points.shape)
    return [
        replace(
            base, state=MOVED, points=p, normals=n, shift=tuple(s), shift_sigma=SHIFT_SIGMA
        )
        for p, n, s in zip(points, normals, shifts, strict=True)
    ]  # fmt: skip


def dispersed(base: Hypothesis, body: Body) -> tuple[list[Hypothesis], Array]:
    """A single taxel where its covariance allows it to be: narrow components, over each of which a
    reading is straight, and ln of their weights. Their mixture has that covariance."""
    up = base.normals[0]
    tangents = se3.orthonormal_basis(up, -se3.perpendicular(up))[:, :2]
    variance, axes = np.linalg.eigh(tangents.T @ base.covariance[0] @ tangents)
    sigma = np.sqrt(np.maximum(variance, 0.0))
    narrow = np.minimum(sigma, np.maximum(NARROW, sigma / PARTS))
    spread, pitch = np.sqrt(sigma**2 - narrow**2), COMPONENT_PITCH * narrow
    steps = []
    for most, step in zip(REACHED * spread, pitch, strict=True):
        count = int(most / step) if most > 0 else 0
        steps.append(step * np.arange(-count, count + 1))
    flat = np.stack(np.meshgrid(*steps), axis=-1).reshape(-1, 2)
    square = np.sum((flat / np.where(spread > 0, spread, 1.0)) ** 2, axis=1)
    flat, square = flat[square <= REACHED**2], square[square <= REACHED**2]
    root = tangents @ axes * narrow
    parts = [
        replace(base, points=h.points, normals=h.normals, covariance=(root @ root.T)[None])
        for h in moved(base, body, flat @ axes.T)
    ]
    return parts, -0.5 * square - logsumexp(-0.5 * square)


def regained(base: Hypothesis, single: bool) -> list[Hypothesis]:
    """Changes of the gain of a whole unit, and of each of its taxels unless it is `single`."""
    steps = np.arange(-MAX_GAIN, MAX_GAIN + 1e-9, GAIN_PITCH)
    found = [
        replace(base, state=GAIN, log_gain=base.log_gain + x, change=x, gain_sigma=GAIN_SIGMA)
        for x in steps
    ]
    if not single:
        found += [
            _alone(base, GAIN, k, x, GAIN_SIGMA) for k in range(len(base.points)) for x in steps
        ]
    return found


def log_prior(hypotheses: list[Hypothesis], units: int, expected: Array, single: bool) -> Array:
    """ln of the prior probabilities (h,) of the hypotheses, which no reading enters.

    single: whether the unit is a single taxel, which neither turns nor has taxels of its own.
    Within a kind of change (KINDS), moves are normal with the standard deviation MOVE; changes of
    one taxel are as probable as its largest `expected` reading (k,) is large, as nothing is seen of
    those that no touch reaches; those of an exchange are shared with the units that were not tried,
    and those of all kinds with the kinds that were not tried.
    """
    kinds = [(h.state, h.taxel >= 0) for h in hypotheses]
    possible = [kind for kind in KINDS if not (single and (kind[1] or kind[0] == TURNED))]
    every = sum(KINDS[kind] for kind in possible)
    share = np.array([
        np.exp(-0.5 * np.sum(np.square(h.shift)) / MOVE**2) if h.state == MOVED
        else expected[h.taxel] + MIN_EXPECTED if h.taxel >= 0 else 1.0
        for h in hypotheses
    ])  # fmt: skip
    for kind in set(kinds):
        mine = np.array([k == kind for k in kinds])
        total = max(units - 1, 1) if kind == (EXCHANGED, False) else share[mine].sum()
        share[mine] *= KINDS[kind] / (every * total)
    return np.log(share)
