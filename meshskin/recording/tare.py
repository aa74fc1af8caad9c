"""Taxel readings less their level at rest, with their polarity, noise and contacts.

The level at rest of each taxel and its slow drift come from the stretches without contact: in each
block of time the level around which the readings are densest, then the mean of those within the
noise of it. Readings are in contact from where one exceeds the noise with a stated false-alarm rate
to where none exceeds a lower threshold (hysteresis).
"""

from __future__ import annotations

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from ..core.arrays import MAD, Array, Index, last_known, runs
from ..core.errors import RecordingError
from ..core.value import Value
from .log_map import AUTO, FALLING

BLOCK = 10.0
"""Length of a block of time, s: contacts are shorter, and the drift of capacitive skins by their
temperature takes minutes."""
COLUMNS = 64
"""Taxels that are worked on at a time, so that memory stays near that of the readings."""
DENSE = 0.25
"""Share of a block's readings that the densest interval holds: a taxel that is at rest for longer
than this share is found at rest."""
FALSE_ALARM = 0.01
"""Expected number of false contacts that noise causes in a log, and of taxels that it keeps in
contact in a frame."""
MIN_FRAMES = 2
"""Frames above the upper threshold that make a contact: single ones are disturbances."""
GUARD = 0.3
"""Time, s, about a contact that does not count as rest: soft skins creep back for some tenths."""
MIN_REST = 0.1
"""Share of a block that must be at rest for the block to have a level of its own."""
FLOOR = 2e-3
"""Smallest noise, in ranges of a taxel: 9 bits, more than the converters of skins resolve."""
RANGE = (0.001, 0.999)
"""Quantiles of the readings between which the range of a taxel is: damaged ones are rarer."""
GLITCH = 2.0
"""Difference of the reading of a frame from those before and after, in the largest range of a
taxel, from which it is damaged: no contact has it."""
SKEWED = 3.0
"""Ratio of the excursions above and below the level at rest from which the polarity is clear: noise
alone has 1, pressed taxels 10 and more."""
PASSES = 3
"""Times that levels and contacts are found in turn; they do not change after the second, in which
the polarity is known."""
JUMP = 2.0
"""Change of a level from block to block, in upper thresholds, from which it may be a jump."""
SUDDEN = 0.15
"""Share of the readings between two levels, in the middle half of their difference, up to which the
level jumped: a drift has 0.5, a contact that begins 0.02 and less."""


@dataclass(frozen=True, eq=False)
class Tared(Value):
    """Readings that rise from zero under pressure."""

    readings: NDArray[np.floating]
    """(n, t), in the unit of the log."""
    noise: Array
    """Standard deviation (t,) of a reading at rest; 0 for taxels that never change."""
    drift: Array
    """Range (t,) of the level at rest over the log."""
    in_contact: NDArray[np.bool_]
    """Frames (n,) in contact."""
    falling: bool
    """Whether the raw readings fall under pressure."""
    glitches: int = 0
    """How many readings of single frames are damaged, and NaN in `readings`."""
    jumps: Array = field(default_factory=lambda: np.empty(0))
    """Times, s, of the blocks at the start of which the level at rest of a taxel jumps for good."""


def tare(
    times: Array, values: NDArray[np.number], polarity: str = AUTO, name: str = "the skin"
) -> Tared:
    """Tare the readings `values` (n, t) at `times` (n,), s; those that are NaN stay so, but for
    single ones of a taxel that is at rest before and after: it is at rest between, too.

    polarity: "rising", "falling", or "auto" to find out. Raises RecordingError for a skin that
    never answers and for a polarity that the readings do not tell.
    """
    n, t = values.shape
    if n <= MIN_FRAMES:
        raise _silent(name, f"it has {n} frames")
    columns = [slice(k, min(k + COLUMNS, t)) for k in range(0, t, COLUMNS)]
    lost = ~np.isfinite(values)
    values, span, glitches = _without_glitches(values, lost, columns)
    noise, floor = np.concatenate([_noise(values[:, p], span[p]) for p in columns], axis=1)
    if not noise.any():
        raise _silent(name, "no reading ever changes")
    edges = blocks(times)
    densest = np.concatenate([_densest(values[:, part], edges) for part in columns], axis=1)
    levels = _smoothed(densest)
    on, off = thresholds(n, t)
    readings = np.empty((n, t), dtype=np.float32)
    rest, jumps = np.ones(n, dtype=bool), None
    for _ in range(PASSES):
        strongest = np.zeros((2, n))
        for part in columns:
            level = _refined(values[:, part], times, edges, levels[:, part], noise[part], off, rest)
            above = values[:, part].astype(float) - _interpolated(times, edges, level)
            levels[:, part], readings[:, part] = level, above
            relative = above / np.where(noise[part] > 0, noise[part], np.inf)
            np.maximum(strongest, [relative.max(axis=1), -relative.min(axis=1)], out=strongest)
        up, down = np.sum(np.maximum(strongest - on, 0.0), axis=1)
        falling = polarity == FALLING or (polarity == AUTO and down > up)
        in_contact = segment(strongest[int(falling)], on, off)
        rest = at_rest(times, in_contact)
        if rest.mean() >= MIN_REST:
            for part in columns:
                noise[part] = _scatter(readings[rest, part], noise[part], floor[part], on)
        if jumps is None and (polarity != AUTO or SKEWED * min(up, down) <= max(up, down)):
            least = JUMP * on * noise
            found = [_held(values[:, p], edges, densest[:, p], least[p], falling) for p in columns]
            held, jumped = np.concatenate(found, axis=2)
            jumps = times[edges[:-1]][jumped.any(axis=1)]
            if held.any():
                levels = _smoothed(_between(np.where(held, np.nan, densest), densest))
    if polarity == AUTO and max(up, down) > 0:
        _check_polarity(up, down, name)
    if not in_contact.any():
        raise _silent(
            name, f"no reading exceeds its noise by {on:.1f} standard deviations in {n} frames"
        )
    if falling:
        np.negative(readings, out=readings)
    readings[lost | glitches] = np.nan
    _fill_rest(readings, lost, off * noise)
    return Tared(
        readings, noise, np.ptp(levels, axis=0), in_contact, falling, int(glitches.sum()),
        times[:0] if jumps is None else jumps,
    )  # fmt: skip


def _without_glitches(
    values: NDArray[np.number], lost: NDArray[np.bool_], columns: list[slice]
) -> tuple[NDArray[np.number], Array, NDArray[np.bool_]]:
    """The values (n, t) with known ones in place of those that are lost and of glitches, the ranges
    (t,) of the taxels, and the glitches (n, t)."""
    if lost.any():
        values = last_known(values, lost)
    largest, span = np.concatenate([_ranges(values[:, part]) for part in columns], axis=1)
    glitches = np.hstack([_jumps(values[:, part], GLITCH * largest.max()) for part in columns])
    glitches &= (np.convolve(glitches.any(axis=1), [1, 1, 1], "same") == 1)[:, None]  # alone
    if glitches.any():
        values = last_known(values, lost | glitches)
    return values, span, glitches


def _fill_rest(readings: NDArray[np.floating], lost: NDArray[np.bool_], limit: Array) -> None:
    """Put the mean of those before and after for readings (n, t) that are lost (n, t), where both
    are within `limit` (t,) of the level at rest."""
    frame, taxel = np.nonzero(lost[1:-1])
    before, after = readings[frame, taxel], readings[frame + 2, taxel]
    rest = (np.abs(before) <= limit[taxel]) & (np.abs(after) <= limit[taxel])
    readings[frame[rest] + 1, taxel[rest]] = 0.5 * (before + after)[rest]


def thresholds(frames: int, taxels: int) -> tuple[float, float]:
    """Standard deviations of noise at which a contact begins and below which it ends."""
    from scipy.special import ndtri

    return (
        float(-ndtri(FALSE_ALARM / max(frames * taxels, 1))),
        float(-ndtri(FALSE_ALARM / max(taxels, 1))),
    )


def segment(strongest: Array, on: float, off: float) -> NDArray[np.bool_]:
    """Frames (n,) in contact: stretches above `off` with at least MIN_FRAMES frames above `on`.

    strongest (n,): the largest reading of a frame, in standard deviations of noise.
    """
    in_contact = strongest > off
    for stretch in runs(in_contact):
        if np.count_nonzero(strongest[stretch] > on) < MIN_FRAMES:
            in_contact[stretch] = False
    return in_contact


def _silent(name: str, why: str) -> RecordingError:
    return RecordingError(
        f"{name} never answers: {why}",
        remedy="check the wiring, that the log contains touches, and the field path in the map",
    )


def _ranges(values: NDArray[np.number]) -> Array:
    """Range of readings (n, t) without those of single frames, and without all rare ones (2, t)."""
    one, two, three = values[:-2], values[1:-1], values[2:]  # in their own type: less memory
    middle = np.maximum(np.minimum(one, two), np.minimum(np.maximum(one, two), three)).astype(float)
    low, high = np.quantile(middle, RANGE, axis=0)
    return np.stack([np.ptp(middle, axis=0), high - low])


def _jumps(values: NDArray[np.number], least: float) -> NDArray[np.bool_]:
    """Whether readings (n, t) differ by more than `least`, upwards or downwards, from the one
    before and from the one after."""
    steps = np.diff(values.astype(float), axis=0)
    way = np.sign(steps) * (np.abs(steps) > least)
    before = np.concatenate([-way[:1] * (way[1:2] == 0), way])
    after = np.concatenate([way, -way[-1:] * (way[-2:-1] == 0)])
    return np.asarray(before * after < 0)


def _noise(values: NDArray[np.number], span: Array) -> Array:
    """Standard deviation of a reading at rest from the differences of consecutive ones, and the
    smallest that it can be, (2, t): that of the rounding, and FLOOR. span (t,): their ranges."""
    steps = np.abs(np.diff(values.astype(float), axis=0))
    noise = np.median(steps, axis=0) / (np.sqrt(2.0) * MAD)
    smallest = np.min(steps, axis=0, where=steps > 0, initial=np.inf)
    step = np.where(np.isfinite(smallest), smallest, 0.0)
    floor = np.maximum(step / np.sqrt(12.0), FLOOR * span)
    return np.stack([np.maximum(noise, floor), floor])


def _scatter(readings: NDArray[np.floating], noise: Array, floor: Array, on: float) -> Array:
    """Standard deviation (t,) of readings at rest (n, t), without those beyond the upper threshold:
    disturbances, and excursions against the polarity."""
    within = np.abs(readings) <= on * noise
    scatter = np.std(readings, axis=0, where=within, dtype=float)
    return np.asarray(np.where(noise > 0, np.maximum(scatter, floor), 0.0))


def blocks(times: Array) -> NDArray[np.intp]:
    """Rows (b + 1,) where blocks of time begin and end, none much shorter than BLOCK."""
    count = max(1, round((times[-1] - times[0]) / BLOCK))
    edges = np.searchsorted(times, np.linspace(times[0], times[-1], count + 1)[:-1])
    return np.unique(np.append(edges, len(times)))


def _densest(values: NDArray[np.number], edges: NDArray[np.intp]) -> Array:
    """Middle (b, t) of the shortest interval that holds the share DENSE of a block's readings."""
    levels = np.empty((len(edges) - 1, values.shape[1]))
    for k, (first, last) in enumerate(pairwise(edges)):
        block = np.sort(values[first:last].astype(float), axis=0)
        held = min(max(2, int(np.ceil(DENSE * len(block)))), len(block)) - 1
        width = block[held:] - block[: len(block) - held]
        best = width.argmin(axis=0)[None]
        low, high = (np.take_along_axis(block, best + k, axis=0)[0] for k in (0, held))
        levels[k] = 0.5 * (low + high)
    return levels


def _smoothed(levels: Array) -> Array:
    """Levels (b, t) of which single blocks, in which a taxel is pressed for most of the time, take
    that of a neighbour."""
    if len(levels) < 3:
        return levels
    ends = 2 * levels[[1, -2]] - levels[[2, -3]]  # as the drift goes on
    padded = np.concatenate([ends[:1], levels, ends[1:]])
    return np.asarray(np.median(np.stack([padded[:-2], padded[1:-1], padded[2:]]), axis=0))


def at_rest(times: Array, in_contact: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Frames (n,) that are not in contact nor within GUARD of one."""
    rest = ~in_contact
    for contact in runs(in_contact):
        first = np.searchsorted(times, times[contact.start] - GUARD)
        last = np.searchsorted(times, times[contact.stop - 1] + GUARD, side="right")
        rest[first:last] = False
    return rest


def _refined(
    values: NDArray[np.number],
    times: Array,
    edges: NDArray[np.intp],
    levels: Array,
    noise: Array,
    off: float,
    rest: NDArray[np.bool_],
) -> Array:
    """Levels (b, t) with the mean added of those of the `values` (n, t) that are within noise of
    them, in frames at rest where a block has enough; interpolated for blocks with too few."""
    above = values.astype(float) - _interpolated(times, edges, levels)
    out = np.empty(levels.shape)
    for k, (first, last) in enumerate(pairwise(edges)):
        near = np.abs(above[first:last]) <= off * noise
        if rest[first:last].mean() >= MIN_REST:
            near &= rest[first:last, None]
        count = np.asarray(near.sum(axis=0))
        total = np.asarray(np.sum(above[first:last], axis=0, where=near))
        enough = count >= MIN_REST * (last - first)
        out[k] = np.where(enough, levels[k] + total / np.maximum(count, 1), np.nan)
    return _between(out, levels)


def _between(levels: Array, otherwise: Array) -> Array:
    """Levels (b, t) with those that are NaN interpolated; `otherwise` (b, t) where all are."""
    out = levels.copy()
    for level, before in zip(out.T, otherwise.T, strict=True):
        known = np.flatnonzero(np.isfinite(level))
        level[:] = np.interp(np.arange(len(level)), known, level[known]) if len(known) else before
    return out


def _held(
    values: NDArray[np.number], edges: Index, levels: Array, least: Array, falling: bool
) -> NDArray[np.bool_]:
    """Blocks (2, b, t) in which a taxel is pressed all the time, as its level jumps by `least` (t,)
    before them and back after them; and those at the start of which it jumps otherwise."""
    change = np.diff(levels, axis=0)
    sudden = (np.abs(change) > least) & (least > 0)
    for k, taxel in np.argwhere(sudden):
        between = slice((edges[k] + edges[k + 1]) // 2, (edges[k + 1] + edges[k + 2]) // 2)
        share = (values[between, taxel].astype(float) - levels[k, taxel]) / change[k, taxel]
        sudden[k, taxel] = np.mean(np.abs(share - 0.5) < 0.25) < SUDDEN
    jump = np.concatenate([0 * levels[:1], np.where(sudden, change, 0.0)])
    height = np.cumsum(-jump if falling else jump, axis=0)
    around = np.maximum(
        np.minimum.accumulate(height, axis=0), np.minimum.accumulate(height[::-1], axis=0)[::-1]
    )
    held = height - around > least
    before = np.concatenate([held[:1], held[:-1]])
    return np.stack([held, (jump != 0) & ~held & ~before])


def _interpolated(times: Array, edges: NDArray[np.intp], levels: Array) -> Array:
    """Levels (n, t) at the times, linear between the middles of the blocks and beyond them."""
    middles = np.array([times[a:b].mean() for a, b in pairwise(edges)])
    if len(middles) == 1:
        return np.broadcast_to(levels, (len(times), levels.shape[1]))
    cuts = [0, *np.searchsorted(times, middles[1:-1]), len(times)]
    slopes = np.diff(levels, axis=0) / np.diff(middles)[:, None]
    out = np.empty((len(times), levels.shape[1]))
    for k, (first, last) in enumerate(pairwise(cuts)):
        np.multiply((times[first:last] - middles[k])[:, None], slopes[k], out=out[first:last])
        out[first:last] += levels[k]
    return out


def _check_polarity(up: float, down: float, name: str) -> None:
    """Refuse excursions above and below the level at rest of which neither dominates."""
    if SKEWED * min(up, down) > max(up, down):
        raise RecordingError(
            f"whether the readings of {name} rise or fall under pressure is not clear",
            value=f"excursions of {up:.3g} above and {down:.3g} below the level at rest",
            limit=f"one of them at least {SKEWED:g} times the other",
            remedy='give polarity = "rising" or "falling" in the map',
        )
