"""Postures along a way: which joint angles, which spin about the normal, and where to regrasp.

At every sample of the way the body may be turned about the contact's normal, and the arm may reach
that pose in several postures. All of them, on a grid of spins, are nodes; two of consecutive
samples are joined where the joints need not jump. The cheapest chain, by Bellman's dynamic
programming, keeps off the joint limits, moves the joints little, and is broken (the arm lifts off
and takes another posture) only where it must.

Source: Descartes, "Cartesian path planning" of ROS-Industrial (ladder graph); Bellman (1957).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..core.se3 import Array
from .arm import Arm
from .inverse_kinematics import TOLERANCE, flat, unwound

SPINS = 24
"""Spins about the normal that are tried at every sample."""
SPIN_STEP = 2 * np.pi / SPINS
"""Angle from spin to spin, rad."""
ANCHORED = 4
"""Every so many spins are solved from random starts; the others are followed from these."""
STRETCH = 25
"""Samples from one that is solved from random starts to the next."""
STARTS = 48
"""Random starts at each."""
POSTURES = 8
"""Most postures kept for a pose (whole turns apart)."""
ROUNDS, FOLLOWING = 40, 5
"""Newton steps from a random start, and from a neighbour."""
MIN_MARGIN = 0.03
"""Distance that is kept from every joint limit, rad."""
NEAR = 0.3
"""Distance from a joint limit below which a posture costs, rad."""
NEAR_PRICE, MOVE_PRICE, SPIN_PRICE, BREAK_PRICE = 0.05, 1.0, 0.002, 10.0
"""Of being at a limit, of one rad^2 of the joints, of one spin of the grid, of a regrasp."""
JUMP = 0.3
"""Largest move of a joint from sample to sample, rad."""


@dataclass(frozen=True)
class Nodes:
    """Postures of m samples at s spins, b each (entries that do not exist are not `solved`)."""

    q: Array
    """(m, s, b, n), rad."""
    solved: NDArray[np.bool_]
    """(m, s, b): the pose is reached."""
    margin: Array
    """(m, s, b) distance to the nearest joint limit, rad; negative beyond it."""
    joint: NDArray[np.intp]
    """(m, s, b) the joint nearest to its limit."""

    @property
    def within_limits(self) -> NDArray[np.bool_]:
        """(m, s, b): the pose is reached within the joint limits."""
        return np.asarray(self.solved & (self.margin >= MIN_MARGIN))

    def take(self, rows: NDArray[np.intp]) -> Nodes:
        """The nodes of some samples."""
        return Nodes(self.q[rows], self.solved[rows], self.margin[rows], self.joint[rows])


def solve_nodes(arm: Arm, targets: Array, stretch: int = STRETCH, seed: int = 0) -> Nodes:
    """The postures for poses T_w_tip `targets` (m, s, 4, 4).

    Every `stretch`-th sample is solved from random starts, the others from their neighbours, which
    must be near then.
    """
    m, s = targets.shape[:2]
    rows = flat(targets).reshape(m, s, 12)
    n = len(arm.joint_names)
    q = np.full((m, s, POSTURES, n), np.nan)
    anchors = np.unique(
        np.linspace(0, m - 1, max(math.ceil((m - 1) / stretch), 1) + 1).round().astype(int)
    )
    rng = np.random.default_rng(seed)
    for k in anchors:
        q[k] = _anchor(arm, rows[k], rng)
    middles = (anchors[:-1] + anchors[1:]) // 2
    for away in range(1, stretch + 1):  # from all anchors at once
        on, back = anchors[:-1] + away, anchors[1:] - away
        on, back = on[on <= middles], back[back > middles]
        here, there = np.concatenate([on, back]), np.concatenate([on - 1, back + 1])
        if len(here):
            moved = _follow(arm, q[there].reshape(-1, POSTURES, n), rows[here].reshape(-1, 12))
            q[here] = moved.reshape(-1, s, POSTURES, n)
    q = _whole_turns(arm, q)
    solved = np.isfinite(q[..., 0])
    room = np.minimum(q - arm.lower, arm.upper - q)
    room = np.where(np.isfinite(room), room, np.where(np.isnan(room), -np.inf, np.inf))
    return Nodes(q, solved, room.min(axis=-1), room.argmin(axis=-1))


def _anchor(arm: Arm, rows: Array, rng: np.random.Generator) -> Array:
    """Postures (s, b, n) of one sample at all spins, from random starts."""
    s, n = len(rows), len(arm.joint_names)
    low = np.where(np.isfinite(arm.lower), arm.lower, -math.pi)
    high = np.where(np.isfinite(arm.upper), arm.upper, math.pi)
    out = np.full((s, POSTURES, n), np.nan)
    some = np.arange(0, s, ANCHORED)
    start = rng.uniform(low, high, (len(some) * STARTS, n))
    found = _newton(arm, start, np.repeat(rows[some], STARTS, axis=0), ROUNDS)
    for k, mine in zip(some, found.reshape(len(some), STARTS, n), strict=True):
        mine = mine[np.isfinite(mine[:, 0])]
        distinct = _distinct(unwound(arm, mine))
        out[k, : len(distinct)] = distinct
    for shift in range(1, ANCHORED // 2 + 1):
        for way in (1, -1):
            here = (some + way * shift) % s
            there = (some + way * (shift - 1)) % s
            empty = np.isnan(out[here]).all(axis=(1, 2))
            here, there = here[empty], there[empty]
            if len(here):
                out[here] = _follow(arm, out[there], rows[here])
    return out


def _follow(arm: Arm, q: Array, rows: Array) -> Array:
    """Postures (s, b, n) at `rows` (s, 12) from near ones; NaN where lost."""
    b = q.shape[1]
    out = np.full(q.shape, np.nan)
    live = np.isfinite(q[..., 0])
    targets = np.repeat(rows[:, None], b, axis=1)
    moved = _newton(arm, q[live], targets[live], FOLLOWING)
    jumped = np.abs(moved - q[live]).max(axis=-1, initial=0.0) > 3.0 * JUMP
    out[live] = np.where(jumped[:, None], np.nan, moved)
    return out


def _newton(arm: Arm, q: Array, targets: Array, rounds: int) -> Array:
    """Newton from `q` (k, n) to `targets` (k, 12); NaN where it did not arrive."""
    q, residual = arm.newton.arrive(q, targets, rounds + 1)
    q[residual >= TOLERANCE] = np.nan
    return q


def _distinct(q: Array) -> Array:
    """The different ones of `q` (k, n), at most POSTURES."""
    kept: list[Array] = []
    for one in q:
        if len(kept) < POSTURES and all(np.abs(one - other).max() > 1e-3 for other in kept):
            kept.append(one)
    return np.array(kept).reshape(-1, q.shape[1])


def endless(arm: Arm) -> NDArray[np.bool_]:
    """The joints (n,) whose whole turns are not told apart here: with a range of two or more."""
    return np.asarray(arm.upper - arm.lower > 4 * math.pi - 0.1)


def _whole_turns(arm: Arm, q: Array) -> Array:
    """`q` (m, s, b, n) with what whole turns of a joint with a range of more add."""
    for j in np.flatnonzero((arm.upper - arm.lower > 2 * math.pi) & ~endless(arm)):
        for turn in (-2 * math.pi, 2 * math.pi):
            other = q.copy()
            other[..., j] += turn
            out = (other[..., j] < arm.lower[j]) | (other[..., j] > arm.upper[j])
            other[out] = np.nan
            keep = np.isfinite(other[..., 0]).any(axis=(0, 1))
            q = np.concatenate([q, other[:, :, keep]], axis=2)
    return q


@dataclass(frozen=True)
class Choice:
    """The cheapest chain of postures over m samples."""

    q: Array
    """(m, n), rad."""
    spin: NDArray[np.intp]
    """(m,) index of the spin, going on over whole turns."""
    breaks: NDArray[np.bool_]
    """(m,) True where the chain begins anew."""


def cheapest_chain(
    arm: Arm, found: Nodes, usable: NDArray[np.bool_], starts: NDArray[np.bool_]
) -> Choice:
    """The cheapest chain over nodes that are `usable` (m, s, b), at least one a sample.

    starts (m,): samples that begin anew whatever came before.
    """
    q, spins = found.q, found.q.shape[1]
    price = NEAR_PRICE * np.maximum(0.0, 1.0 - found.margin / NEAR) ** 2
    q, price = _packed(q, np.where(usable, price, np.inf))
    turning, width = endless(arm), price.shape[2]
    cost = price[0]
    parents: NDArray[np.intp] = np.zeros(price.shape, dtype=np.intp)
    fresh = np.ones(price.shape, dtype=bool)
    turns = np.array([-1, 0, 1])
    rows = (np.arange(spins)[:, None] - turns) % spins  # (s, 3): the spins that one is turned from
    sources = (rows[:, :, None] * width + np.arange(width)).reshape(spins, -1)  # (s, 3 b): nodes
    spun = np.repeat(SPIN_PRICE * np.abs(turns), width)
    for k in range(1, len(q)):
        best = np.full(cost.shape, cost.min() + (0.0 if starts[k] else BREAK_PRICE))
        parents[k] = int(np.argmin(cost))
        if not starts[k]:
            there = q[k - 1, rows].reshape(spins, 3 * width, -1)
            total = cost.ravel()[sources][:, None] + _move(q[k], there, turning) + spun
            from_ = np.argmin(total, axis=2)
            least = np.take_along_axis(total, from_[:, :, None], axis=2)[:, :, 0]
            fresh[k] = least >= best
            best = np.minimum(best, least)
            before = np.take_along_axis(sources, from_, axis=1)
            parents[k] = np.where(fresh[k], parents[k], before)
        cost = best + price[k]
    return _trace(q, cost, parents, fresh)


def _packed(q: Array, price: Array) -> tuple[Array, Array]:
    """`q` (m, s, b, n) and `price` (m, s, b) with what is usable (of finite price) first, in order,
    and only as many of each as are usable anywhere.
    """
    usable = np.isfinite(price)
    width = int(usable.sum(axis=2).max())
    order = np.argsort(~usable, axis=2, kind="stable")[:, :, :width]
    packed = np.take_along_axis(q, order[..., None], axis=2)
    return packed, np.take_along_axis(price, order, axis=2)


def _move(here: Array, there: Array, turning: NDArray[np.bool_]) -> Array:
    """Price (s, b, c) of moving from postures `there` (s, c, n) to `here` (s, b, n)."""
    # joint by joint in memory, so that sums over the joints run along the pairs
    here, there = (np.ascontiguousarray(np.moveaxis(x, -1, 0)) for x in (here, there))
    move = np.abs(here[:, :, :, None] - there[:, :, None, :])
    around = move[turning] % (2 * math.pi)
    move[turning] = np.minimum(around, 2 * math.pi - around)
    price = MOVE_PRICE * np.square(move).sum(axis=0)
    return np.where(move.max(axis=0) <= JUMP, price, np.inf)


def _trace(q: Array, cost: Array, parents: NDArray[np.intp], fresh: NDArray[np.bool_]) -> Choice:
    """Back along the parents from the cheapest end."""
    count, spins = len(parents), cost.shape[0]
    at = int(np.argmin(cost))
    node = np.empty(count, dtype=np.intp)
    breaks = np.zeros(count, dtype=bool)
    for k in range(count - 1, -1, -1):
        node[k] = at
        s, b = divmod(at, cost.shape[1])
        breaks[k] = fresh[k, s, b]
        at = int(parents[k, s, b])
    s, b = node // cost.shape[1], node % cost.shape[1]
    spin = s.copy()
    for k in range(1, count):
        step = (s[k] - s[k - 1] + spins // 2) % spins - spins // 2
        spin[k] = s[k] if breaks[k] else spin[k - 1] + step
    return Choice(q[np.arange(count), s, b], spin, breaks)


def nearest_postures(
    found: Nodes, usable: NDArray[np.bool_], rows: NDArray[np.intp]
) -> tuple[NDArray[np.intp], Array]:
    """Spins (k,) and joint angles (k, n) at some samples, each near the one before and off limits.

    The joints may move in the air between them, so that nothing need follow on.
    """
    spins, joints = np.empty(len(rows), dtype=np.intp), np.empty((len(rows), found.q.shape[-1]))
    price = np.where(usable, np.maximum(0.0, 1.0 - found.margin / NEAR) ** 2, np.inf)
    for k, row in enumerate(rows):
        cost = price[row]
        if k:
            move = np.abs(found.q[row] - joints[k - 1]).max(axis=-1)
            cost = cost + np.where(usable[row], move, 0.0)
        s, b = np.unravel_index(int(np.argmin(cost)), cost.shape)
        spins[k], joints[k] = s, found.q[row, s, b]
    return spins, joints
