"""The offset between the clock of a skin and that of its robot, from contact onsets and ends.

Within one contact that stays in its place the sum of its readings is a function of the force, or of
the posture where the robot presses and retracts along the same path. With the right offset both
onset and end lie on one curve; with a wrong one they lie on two. The function is piecewise linear,
fitted by least squares to each contact at each candidate offset d. The estimate of one contact is
the peak of its log likelihood

    L(d) = - (n / 2) log(R(d) / n + s^2),

R the sum of squares, n the frames, s the noise of the sum. A contact that slides is left out: other
taxels answer at its end than at its onset, and the onset of its readings is that of the force only
where it lands among taxels. What is left of such errors differs from contact to contact; the
estimates are pooled as random effects (DerSimonian and Laird, Controlled Clinical Trials 7, 1986),
with the standard deviation that their scatter shows. A lag of the skin itself, such as creep, is
part of the offset: the two are not distinguished.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import Array, runs
from ..robot.contact_kinematics import continuous_angles
from .log_map import Pairs
from .stream import JOINTS, WRENCH
from .tare import Tared

LARGEST = 0.5
"""Largest offset that is looked for, s: clocks that are synchronized at all, or stamps at receipt,
are nearer."""
COARSE, FINE = 4e-3, 5e-4
"""Steps, s, of the candidates: the first finds the peak, which is some tens of ms wide, the second
resolves it."""
NEAR = 0.04
"""Candidates of the fine step lie within this time, s, of the coarse peak."""
WINDOW = 0.25
"""Time, s, before and after an onset or an end that is compared."""
KNOTS = 8
"""Knots of the function: readings are smooth in force and depth but for the kink at zero."""
FRAMES_PER_KNOT = 2
"""Fewest frames of a contact for each knot."""
MIN_CONTACTS = 5
"""Fewest contacts for a standard deviation by their scatter."""
SAME_PLACE = 0.95
"""Cosine between the mean readings at the onset and at the end of a contact from which it is in one
place: 0.997 and more in presses of `tests/recording/robot_log.py`, at most 0.02 in strokes of 30 mm
over taxels 6 mm apart. A disc of readings that is displaced by a fifth of its radius has 0.95.
"""
MAX_CONTACTS = 200
"""Contacts that are compared, evenly chosen: more make the offset no better than its systematic
errors."""
STRAIGHT, RETURNING = 0.98, 0.6
"""Share of the variance of the postures along one line, and share of the line that is passed both
before and after the middle of the contact, from which the robot retracts along the path on which it
pressed. A path that does not return fits the readings at every offset."""
EXPLAINED = 0.7
"""Share of the variance of the readings that the function must explain."""
PRESSED = 6.0
"""Reading in standard deviations of noise from which a taxel belongs to a contact."""
USABLE = 0.01
"""Standard deviation, s, up to which an offset is applied: half a frame at 50 Hz."""
RIDGE = 1e-6
"""Added to the normal matrix, frames, so that knots without frames do not make it singular."""

DIFFERENT = 3.0
"""Standard deviations up to which two estimates of an offset agree: 1 in 400 pairs are farther."""


@dataclass(frozen=True)
class ClockOffset:
    """How late the stamps of the skin are against those of the robot."""

    offset: float
    """s."""
    sigma: float
    """Standard deviation, s."""
    contacts: int
    """How many contacts were compared."""
    by: str
    """"force" or "motion"."""

    def __str__(self) -> str:
        return (
            f"{1e3 * self.offset:.1f} +- {1e3 * self.sigma:.1f} ms, by {self.by} in "
            f"{self.contacts} contacts"
        )

    @property
    def usable(self) -> bool:
        """Whether the offset is determined well enough to be applied."""
        return self.sigma <= USABLE


def estimates(times: Array, skin: Tared, pairs: Pairs) -> tuple[ClockOffset, ...]:
    """Estimates of the clock offset by force and by motion: first the usable ones, of these first
    by motion, as contact points are on the clock of the joints, and of these by sigma."""
    found = []
    for stream, given in pairs:
        if given.kind not in (WRENCH, JOINTS):
            continue
        states = (stream.values * given.factors(stream.fields)).astype(float)
        states = states[:, :3] if given.kind == WRENCH else states
        whole = np.isfinite(states).all(axis=0)
        if not whole.any() or len(stream) < 2:
            continue
        by = "force" if given.kind == WRENCH else "motion"
        estimate = clock_offset(
            times, skin.readings, skin.noise, skin.in_contact,
            stream.times - (given.delay or 0.0),
            states[:, whole] if by == "force" else continuous_angles(states[:, whole]), by,
        )  # fmt: skip
        if estimate is not None:
            found.append(estimate)
    return tuple(sorted(found, key=lambda one: (not one.usable, one.by != "motion", one.sigma)))


def one_clock(pairs: Pairs, offsets: tuple[ClockOffset, ...]) -> tuple[Pairs, list[str]]:
    """The streams with the wrench on the clock of the joints, and the note on it, where the offset
    of the skin by force differs from that by motion."""
    best = {one.by: one for one in reversed(offsets) if one.usable}
    if len(best) < 2 or any(m.kind == WRENCH and m.delay is not None for _, m in pairs):
        return pairs, []
    force, motion = best["force"], best["motion"]
    late = motion.offset - force.offset
    if abs(late) <= DIFFERENT * float(np.hypot(force.sigma, motion.sigma)):
        return pairs, []
    note = (
        f"the wrench is {1e3 * abs(late):.1f} ms {'late' if late > 0 else 'early'} against the "
        f"joints, as the skin is late by {force} and by {motion}: the wrench is moved by that; "
        "give its delay_ms if it is known"
    )
    return [
        (s, replace(m, delay=(m.delay or 0.0) + late) if m.kind == WRENCH else m) for s, m in pairs
    ], [note]


def clock_offset(
    times: Array,
    readings: NDArray[np.floating],
    noise: Array,
    in_contact: NDArray[np.bool_],
    state_times: Array,
    states: Array,
    by: str,
) -> ClockOffset | None:
    """The offset of the times (n,), s, of tared readings (n, t) with noise (t,) against those (m,)
    of states (m, k): the force, or the joint angles.

    None where fewer than MIN_CONTACTS contacts determine it: those in one place, whose path returns
    along one line and whose readings follow it.
    """
    path = _Path.of(state_times, states, float(np.median(np.diff(np.unique(times)))))
    stretches = runs(in_contact)
    count = min(len(stretches), MAX_CONTACTS)
    found = []
    for k in np.unique(np.linspace(0, len(stretches) - 1, count).astype(int)):
        rows = _rows(times, stretches, int(k))
        about = np.nan_to_num(readings[rows])
        pressed = np.max(about, axis=0, initial=0.0) > PRESSED * noise
        about = about[:, pressed]
        if len(rows) >= FRAMES_PER_KNOT * KNOTS and _in_one_place(about, in_contact[rows]):
            sums = about.sum(axis=1, dtype=float)
            found.append(_of_contact(path, times[rows], sums, float(np.sum(noise[pressed] ** 2))))
    known = np.array([one for one in found if one is not None])
    if len(known) < MIN_CONTACTS:
        return None
    offset, sigma = _pooled(*known.T)
    return ClockOffset(offset, sigma, len(known), by)


def _in_one_place(readings: NDArray[np.floating], in_contact: NDArray[np.bool_]) -> bool:
    """Whether the readings (n, t) in contact have one pattern about the onset and about the end."""
    early = np.arange(len(readings)) < len(readings) // 2
    onset, end = (readings[half & in_contact].sum(axis=0, dtype=float) for half in (early, ~early))
    size = np.linalg.norm(onset) * np.linalg.norm(end)
    return bool(size > 0 and onset @ end >= SAME_PLACE * size)


def _of_contact(
    path: _Path, times: Array, sums: Array, variance: float
) -> tuple[float, float] | None:
    """Offset, s, that one contact tells, and its standard deviation; None where it tells none.
    times (n,), s, sums (n,) and variance as of `_gain`."""
    coarse = np.arange(-LARGEST, LARGEST + COARSE / 2, COARSE)
    gain = _gain(path, coarse, times, sums, variance)
    fine = coarse[np.argmax(gain)] + np.arange(-NEAR, NEAR + FINE / 2, FINE)
    gain = _gain(path, fine, times, sums, variance)
    k = int(np.argmax(gain))
    if not 0 < k < len(fine) - 1 or gain[k - 1 : k + 2].min() <= 0:
        return None
    # two standard deviations from the peak: noise counts twice in L, in R as in s
    low = np.flatnonzero(gain < gain[k] - 1.0)
    ends = np.concatenate([[0], low[low < k][-1:], low[low > k][:1], [len(fine) - 1]])
    width = float(np.diff(fine[[ends[ends < k][-1], ends[ends > k][0]]])[0])
    return peak(fine, gain), width / 4


def _pooled(values: Array, sigma: Array) -> tuple[float, float]:
    """Mean of the values (n,) with standard deviations (n,), and its own, with what they scatter
    beyond these.

    The variance is that of Student's t with n - 1 degrees of freedom.
    """
    weight, count = 1 / sigma**2, len(values)
    excess = np.sum(weight * (values - np.average(values, weights=weight)) ** 2) - (count - 1)
    between = max(0.0, excess / (weight.sum() - np.sum(weight**2) / weight.sum()))
    weight = 1 / (sigma**2 + between)
    mean = float(np.average(values, weights=weight))
    share = weight / weight.sum()
    scatter = count / (count - 3) * np.sum(share**2 * (values - mean) ** 2)
    return mean, float(np.sqrt(max(scatter, 1 / weight.sum(), (FINE / 2) ** 2)))


def _rows(times: Array, stretches: list[slice], k: int) -> NDArray[np.intp]:
    """Frames about the onset and the end of contact k, none nearer to another contact."""
    contact = stretches[k]
    start, end = times[contact.start], times[contact.stop - 1]
    before = times[stretches[k - 1].stop - 1] if k else -np.inf
    after = times[stretches[k + 1].start] if k + 1 < len(stretches) else np.inf
    low, high = max(start - WINDOW, (start + before) / 2), min(end + WINDOW, (end + after) / 2)
    rows = np.arange(*np.searchsorted(times, [low, high]))
    inside = (times[rows] > start + WINDOW) & (times[rows] < end - WINDOW)
    return np.asarray(rows[~inside])


@dataclass(frozen=True)
class _Path:
    """The state over time, averaged over a frame of the skin."""

    times: Array
    integral: Array
    """Integral (m, k) of the state over time."""
    width: float
    """Time, s, that is averaged over: at least two samples of the state, so that its noise does not
    depend on how a candidate falls between them."""

    @classmethod
    def of(cls, times: Array, states: Array, frame: float) -> _Path:
        steps = np.diff(times)[:, None]
        integral = np.zeros(states.shape)
        np.cumsum(0.5 * (states[1:] + states[:-1]) * steps, axis=0, out=integral[1:])
        return cls(times, integral, max(frame, 2 * float(np.median(steps))))

    def at(self, times: Array) -> Array:
        """States (..., k) at the times (...)."""
        late, early = times + 0.5 * self.width, times - 0.5 * self.width
        first, last = np.searchsorted(self.times, [early.min(), late.max()])
        part = slice(max(first - 1, 0), last + 1)  # np.interp works on all of what it is given
        known = self.times[part]
        out = np.empty((*times.shape, self.integral.shape[1]))
        for k, column in enumerate(self.integral[part].T):
            out[..., k] = np.interp(late, known, column) - np.interp(early, known, column)
        return out / self.width


def _gain(path: _Path, offsets: Array, times: Array, sums: Array, variance: float) -> Array:
    """Log likelihood (d,) of the offsets (d,), s, over that of readings that follow no path.

    times (n,), s, and sums (n,) of the readings of one contact, whose noise has the `variance`.
    0 at offsets where the path leaves the log, is not straight, does not return, or explains too
    little.
    """
    shifted = times - offsets[:, None]
    states = path.at(shifted)
    states -= states.mean(axis=1, keepdims=True)
    size, axes = np.linalg.eigh(np.swapaxes(states, 1, 2) @ states)
    along = (states @ axes[:, :, -1:])[..., 0]
    low, high = along.min(axis=1, keepdims=True), along.max(axis=1, keepdims=True)
    along = (along - low) / np.maximum(high - low, np.finfo(float).tiny)
    first = times < 0.5 * (times[0] + times[-1])
    both = np.minimum(along[:, first].max(axis=1), along[:, ~first].max(axis=1)) - np.maximum(
        along[:, first].min(axis=1), along[:, ~first].min(axis=1)
    )
    inside = (shifted[:, 0] >= path.times[0]) & (shifted[:, -1] <= path.times[-1])
    straight = size[:, -1] >= STRAIGHT * size.sum(axis=1)
    left = _misfit(along * (KNOTS - 1), sums) / len(sums) + variance
    whole = np.var(sums) + variance
    usable = inside & straight & (both >= RETURNING) & (left < (1 - EXPLAINED) * whole)
    return np.where(usable, -0.5 * len(sums) * np.log(left / whole), 0.0)


def _misfit(along: Array, sums: Array) -> Array:
    """Sum of squares (d,) that is left of the sums (n,) by piecewise linear functions of `along`
    (d, n), from 0 to KNOTS - 1."""
    knot = np.minimum(along.astype(int), KNOTS - 2)
    share = along - knot
    basis = np.zeros((*along.shape, KNOTS))
    np.put_along_axis(basis, knot[..., None], (1 - share)[..., None], axis=2)
    np.put_along_axis(basis, knot[..., None] + 1, share[..., None], axis=2)
    normal = np.swapaxes(basis, 1, 2) @ basis + RIDGE * np.eye(KNOTS)
    right = np.swapaxes(basis, 1, 2) @ sums
    fitted = (basis @ np.linalg.solve(normal, right[..., None]))[..., 0]
    return np.asarray(np.sum((sums - fitted) ** 2, axis=1))


def peak(offsets: Array, likelihood: Array) -> float:
    """Offset of the largest likelihood, by a parabola through it and its neighbours."""
    k = int(np.clip(np.argmax(likelihood), 1, len(offsets) - 2))
    before, at, after = likelihood[k - 1 : k + 2]
    bend = before - 2 * at + after
    shift = 0.5 * (before - after) / bend if bend < 0 else 0.0
    return float(offsets[k] + np.clip(shift, -1.0, 1.0) * (offsets[1] - offsets[0]))
