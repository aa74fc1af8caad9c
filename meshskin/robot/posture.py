"""Postures along a contact path: joint angles, spin about the normal, and where to regrasp.

At every sample of the path the body may be turned about the contact's normal, and the arm may reach
each pose in several postures. All postures on a grid of spins are nodes. Where none of them is
within the limits, the spin is solved with the joint angles; these nodes belong to the nearest spin
of the grid. Two nodes of consecutive samples are connected if no joint jumps between them. The
cheapest chain, by dynamic programming, keeps away from the joint limits, moves the joints little,
and is broken (the arm lifts off and takes another posture) only where it must be.

Source: Descartes, "Cartesian path planning" of ROS-Industrial (ladder graph); Bellman (1957).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import Array
from .arm import Arm
from .inverse_kinematics import TOLERANCE, pose_rows, unwrapped
from .whole_turns import endless_joints, used_first, with_whole_turns

SPINS = 24
"""Spins about the normal that are tried at every sample: every 15 degrees, within the largest step
of a joint."""
SPIN_STEP = 2 * np.pi / SPINS
"""Angle from spin to spin, rad."""
SPIN_STRIDE = 4
"""Every so many spins are solved from random starts; the others are followed from these."""
ANCHOR_SPACING = 25
"""Largest number of samples between two that are solved from random starts."""
RANDOM_STARTS = 48
"""Random starts of each solution: six for each posture that is kept."""
MAX_POSTURES = 8
"""Most postures kept for a pose, whole turns apart: an arm with a spherical wrist has eight (two
each of shoulder, elbow and wrist)."""
START_ITERATIONS, NEIGHBOUR_ITERATIONS = 40, 5
"""Newton iterations from a random start, and from a neighbour."""
MIN_MARGIN = 0.03
"""Least distance from every joint limit, rad: room for the smoothing of the spin, and for the
closed loop's errors."""
LIMIT_RANGE = 0.3
"""Distance from a joint limit below which a posture costs, rad."""
LIMIT_COST, MOVE_COST, SPIN_COST, BREAK_COST = 0.05, 1.0, 0.002, 10.0
"""Cost of a joint at its limit, of one rad^2 of joint motion, of one step of the spin, and of a
regrasp. Chosen: a regrasp costs as much as 100 steps of 0.3 rad, as it takes seconds."""
MAX_STEP = 0.3
"""Largest motion of a joint from sample to sample, rad: more, at samples 3 mm apart, means that the
posture changes its branch."""
SAME = 1e-3
"""Largest difference of two postures that count as one, rad: solutions are exact to 1e-10."""


@dataclass(frozen=True)
class Nodes:
    """Postures of m samples at s spins, b of each; entries beyond the last are not `solved`."""

    q: Array
    """(m, s, b, n), rad."""
    solved: NDArray[np.bool_]
    """(m, s, b): the pose is reached."""
    margin: Array
    """(m, s, b) distance to the nearest joint limit, rad; negative beyond it."""
    joint: NDArray[np.intp]
    """(m, s, b) the joint nearest to its limit."""
    offset: Array
    """(m, s, b) spin of the posture beyond that of its place on the grid, rad."""

    @property
    def within_limits(self) -> NDArray[np.bool_]:
        """(m, s, b): the pose is reached within the joint limits."""
        return np.asarray(self.solved & (self.margin >= MIN_MARGIN))

    def take(self, rows: NDArray[np.intp]) -> Nodes:
        """The nodes of some samples."""
        return Nodes(*(getattr(self, f.name)[rows] for f in fields(self)))

    def joined(self, others: Nodes) -> Nodes:
        """The nodes of these samples and, after them, of others."""
        width = max(self.q.shape[2], others.q.shape[2])
        blank = {"q": np.nan, "solved": False, "margin": -np.inf, "joint": 0, "offset": 0.0}
        columns: dict[str, Any] = {
            name: np.concatenate([widened(getattr(x, name), width, value) for x in (self, others)])
            for name, value in blank.items()
        }
        return Nodes(**columns)

    def replaced(self, rows: NDArray[np.intp], others: Nodes) -> Nodes:
        """These nodes with those of some samples replaced by `others`."""
        source = np.arange(len(self.q))
        source[rows] = len(source) + np.arange(len(rows))
        return self.joined(others).take(source)

    @classmethod
    def of(cls, arm: Arm, q: Array, offset: Array | None = None) -> Nodes:
        """The nodes of joint angles `q` (m, s, b, n) with NaN where there is no posture."""
        margin = np.minimum(q - arm.lower, arm.upper - q)
        margin = np.where(np.isnan(margin), -np.inf, margin)
        offset = np.zeros(q.shape[:-1]) if offset is None else offset
        return cls(q, np.isfinite(q[..., 0]), margin.min(axis=-1), margin.argmin(axis=-1), offset)


def widened(x: NDArray[Any], width: int, value: Any) -> NDArray[Any]:
    """`x` (m, s, b, ...) with `width` entries along b, the new ones with a value."""
    grown = [(0, 0), (0, 0), (0, width - x.shape[2]), *[(0, 0)] * (x.ndim - 3)]
    return np.pad(x, grown, constant_values=value)


def solve_nodes(
    arm: Arm,
    targets: Array,
    anchor_spacing: int = ANCHOR_SPACING,
    starts: NDArray[np.bool_] | None = None,
) -> Nodes:
    """The postures for poses T_w_tip `targets` (m, s, 4, 4).

    Every `anchor_spacing` samples one is solved from random starts, the others from their
    neighbours, which must be near. starts (m,): samples that are not near those before them.
    """
    m, s = targets.shape[:2]
    rows = pose_rows(targets).reshape(m, s, 12)
    n = len(arm.joint_names)
    q = np.full((m, s, MAX_POSTURES, n), np.nan)
    first = np.unique([0, *np.flatnonzero(starts)] if starts is not None else [0])
    pieces = zip(first, [*first[1:], m], strict=True)
    anchors = np.concatenate([np.arange(one, end, anchor_spacing) for one, end in pieces])
    rng = np.random.default_rng(0)
    for k in anchors:
        q[k] = _solve_anchor(arm, rows[k], rng)
    after = np.append(anchors[1:], m)
    both = ~np.isin(after, [*first, m])  # the next anchor is near, too
    middles = np.where(both, (anchors + after) // 2, after - 1)
    for away in range(1, anchor_spacing):  # from all anchors at once
        on, back = anchors + away, after - away
        on, back = on[on <= middles], back[both & (back > middles)]
        here, there = np.concatenate([on, back]), np.concatenate([on - 1, back + 1])
        if len(here):
            moved = _follow(arm, q[there].reshape(-1, MAX_POSTURES, n), rows[here].reshape(-1, 12))
            q[here] = moved.reshape(-1, s, MAX_POSTURES, n)
    return Nodes.of(arm, with_whole_turns(arm, q))


def solve_spins(
    arm: Arm,
    turned: Arm,
    targets: Array,
    anchor_spacing: int,
    starts: NDArray[np.bool_] | None = None,
) -> Nodes:
    """The postures for poses T_w_tip `targets` (m, 4, 4) that may turn about the normal.

    turned: the arm on a turntable about the indenter's axis; the others as in `solve_nodes`. Where
    the arm has joints to spare, the
    postures are single ones of many, which random starts and the joint limits choose.
    """
    found = solve_nodes(turned, targets[:, None], anchor_spacing, starts).q[:, 0]
    spin = -found[..., 0]
    place = np.round(np.where(np.isnan(spin), 0.0, spin) / SPIN_STEP).astype(int)
    m, b = spin.shape
    q = np.full((m, SPINS, b, len(arm.joint_names)), np.nan)
    offset = np.zeros(q.shape[:-1])
    at = np.arange(m)[:, None], place % SPINS, np.arange(b)
    q[at], offset[at] = found[..., 1:], spin - SPIN_STEP * place
    return Nodes.of(arm, q, offset)


def _solve_anchor(arm: Arm, rows: Array, rng: np.random.Generator) -> Array:
    """Postures (s, b, n) of one sample at all spins, solved from random starts."""
    s, n = len(rows), len(arm.joint_names)
    low = np.where(np.isfinite(arm.lower), arm.lower, -math.pi)
    high = np.where(np.isfinite(arm.upper), arm.upper, math.pi)
    out = np.full((s, MAX_POSTURES, n), np.nan)
    some = np.arange(0, s, SPIN_STRIDE)
    start = rng.uniform(low, high, (len(some) * RANDOM_STARTS, n))
    found = _newton(arm, start, np.repeat(rows[some], RANDOM_STARTS, axis=0), START_ITERATIONS)
    for k, mine in zip(some, found.reshape(len(some), RANDOM_STARTS, n), strict=True):
        mine = mine[np.isfinite(mine[:, 0])]
        distinct = _distinct(arm, unwrapped(arm, mine))
        out[k, : len(distinct)] = distinct
    for shift in range(1, SPIN_STRIDE // 2 + 1):
        for sign in (1, -1):
            here = (some + sign * shift) % s
            there = (some + sign * (shift - 1)) % s
            empty = np.isnan(out[here]).all(axis=(1, 2))
            here, there = here[empty], there[empty]
            if len(here):
                out[here] = _follow(arm, out[there], rows[here])
    return out


def _follow(arm: Arm, q: Array, rows: Array) -> Array:
    """Postures (s, b, n) at `rows` (s, 12), followed from near ones; NaN where lost."""
    b = q.shape[1]
    out = np.full(q.shape, np.nan)
    live = np.isfinite(q[..., 0])
    targets = np.repeat(rows[:, None], b, axis=1)
    moved = _newton(arm, q[live], targets[live], NEIGHBOUR_ITERATIONS)
    jumped = np.abs(moved - q[live]).max(axis=-1, initial=0.0) > 3.0 * MAX_STEP
    out[live] = np.where(jumped[:, None], np.nan, moved)
    return out


def _newton(arm: Arm, q: Array, targets: Array, iterations: int) -> Array:
    """Newton's method from `q` (k, n) to `targets` (k, 12); NaN where it did not converge."""
    q, residual = arm.newton.iterate(q, targets, iterations + 1)
    q[residual >= TOLERANCE] = np.nan
    return q


def _distinct(arm: Arm, q: Array) -> Array:
    """The distinct rows of `q` (k, n); of more than MAX_POSTURES those farthest from all limits."""
    same = np.abs(q[:, None] - q).max(axis=2) <= SAME
    distinct = np.asarray(q[~np.tril(same, -1).any(axis=1)])
    if len(distinct) > MAX_POSTURES:
        margin = np.minimum(distinct - arm.lower, arm.upper - distinct).min(axis=1)
        distinct = distinct[np.argsort(-margin, kind="stable")[:MAX_POSTURES]]
    return distinct


@dataclass(frozen=True)
class Chain:
    """The cheapest chain of postures over m samples."""

    q: Array
    """(m, n), rad."""
    spin: Array
    """(m,) spins, rad, continued over whole turns."""
    breaks: NDArray[np.bool_]
    """(m,) True where a new segment begins."""


def cheapest_chain(
    arm: Arm, found: Nodes, usable: NDArray[np.bool_], starts: NDArray[np.bool_]
) -> Chain:
    """The cheapest chain over nodes that are `usable` (m, s, b), at least one for each sample.

    starts (m,): samples at which a new segment begins in any case.
    """
    q, spins = found.q, found.q.shape[1]
    node_cost = LIMIT_COST * np.maximum(0.0, 1.0 - found.margin / LIMIT_RANGE) ** 2
    node_cost = np.where(usable, node_cost, np.inf)
    first = used_first(np.isfinite(node_cost))
    q = np.take_along_axis(q, first[..., None], axis=2)
    offset, node_cost = (np.take_along_axis(x, first, axis=2) for x in (found.offset, node_cost))
    endless, width = endless_joints(arm), node_cost.shape[2]
    cost = node_cost[0]
    parents: NDArray[np.intp] = np.zeros(node_cost.shape, dtype=np.intp)
    restarts = np.ones(node_cost.shape, dtype=bool)
    turns = np.array([-1, 0, 1])
    rows = (np.arange(spins)[:, None] - turns) % spins  # (s, 3): the spins that one is turned from
    sources = (rows[:, :, None] * width + np.arange(width)).reshape(spins, -1)  # (s, 3 b): nodes
    spun = np.repeat(SPIN_COST * np.abs(turns), width)
    for k in range(1, len(q)):
        best = np.full(cost.shape, cost.min() + (0.0 if starts[k] else BREAK_COST))
        parents[k] = int(np.argmin(cost))
        if not starts[k]:
            there = q[k - 1, rows].reshape(spins, 3 * width, -1)
            total = cost.ravel()[sources][:, None] + _move_cost(q[k], there, endless) + spun
            from_ = np.argmin(total, axis=2)
            least = np.take_along_axis(total, from_[:, :, None], axis=2)[:, :, 0]
            restarts[k] = least >= best
            best = np.minimum(best, least)
            before = np.take_along_axis(sources, from_, axis=1)
            parents[k] = np.where(restarts[k], parents[k], before)
        cost = best + node_cost[k]
    return _backtrack(q, offset, cost, parents, restarts)


def _move_cost(here: Array, there: Array, endless: NDArray[np.bool_]) -> Array:
    """Cost (s, b, c) of moving from postures `there` (s, c, n) to `here` (s, b, n)."""
    # joint by joint in memory, so that sums over the joints run along the pairs
    here, there = (np.ascontiguousarray(np.moveaxis(x, -1, 0)) for x in (here, there))
    move = np.abs(here[:, :, :, None] - there[:, :, None, :])
    turns = np.rint(move[endless] / (2 * math.pi))
    move[endless] = np.abs(move[endless] - 2 * math.pi * turns)
    node_cost = MOVE_COST * np.square(move).sum(axis=0)
    return np.where(move.max(axis=0) <= MAX_STEP, node_cost, np.inf)


def _backtrack(
    q: Array, offset: Array, cost: Array, parents: NDArray[np.intp], restarts: NDArray[np.bool_]
) -> Chain:
    """The chain that ends in the cheapest node, by its parents."""
    count, spins = len(parents), cost.shape[0]
    at = int(np.argmin(cost))
    node = np.empty(count, dtype=np.intp)
    breaks = np.zeros(count, dtype=bool)
    for k in range(count - 1, -1, -1):
        node[k] = at
        s, b = divmod(at, cost.shape[1])
        breaks[k] = restarts[k, s, b]
        at = int(parents[k, s, b])
    s, b = node // cost.shape[1], node % cost.shape[1]
    spin = s.copy()
    for k in range(1, count):
        step = (s[k] - s[k - 1] + spins // 2) % spins - spins // 2
        spin[k] = s[k] if breaks[k] else spin[k - 1] + step
    rows = np.arange(count)
    return Chain(q[rows, s, b], SPIN_STEP * spin + offset[rows, s, b], breaks)


def nearest_postures(
    found: Nodes, usable: NDArray[np.bool_], rows: NDArray[np.intp]
) -> tuple[Array, Array]:
    """Spins (k,), rad, and joint angles (k, n) at some samples, each near the one before and far
    from the joint limits. Between the samples the arm moves through the air.
    """
    spins, joints = np.empty(len(rows)), np.empty((len(rows), found.q.shape[-1]))
    node_cost = np.where(usable, np.maximum(0.0, 1.0 - found.margin / LIMIT_RANGE) ** 2, np.inf)
    for k, row in enumerate(rows):
        cost = node_cost[row]
        if k:
            move = np.abs(found.q[row] - joints[k - 1]).max(axis=-1)
            cost = cost + np.where(usable[row], move, 0.0)
        s, b = np.unravel_index(int(np.argmin(cost)), cost.shape)
        spins[k], joints[k] = SPIN_STEP * s + found.offset[row, s, b], found.q[row, s, b]
    return spins, joints
