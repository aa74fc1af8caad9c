"""Checks that the samples of a stream are of one sensor: garbage, and two publishers in turn."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ..core.arrays import Array
from ..core.errors import RecordingError
from .stream import JOINTS, TAXELS, WRENCH, Stream

FAR = 1e3
"""Value, in ranges of its stream, beyond which a sample is garbage: bytes that were overwritten are
numbers of any magnitude."""
RANGE = (0.005, 0.995)
"""Quantiles of the values between which the range is: garbage is rare."""
SAMPLES = 20_000
"""Samples, evenly chosen, of which the range is found."""
BLOCK, BLOCKS = 500, 40
"""Consecutive samples that are compared, and blocks of them along the stream."""
ALTERNATING = 2.0
"""Ratio of the mean squared difference of consecutive samples to that of every other sample, from
which the samples are of two streams: 1 for noise, less for motion."""
EVEN = 0.1
"""Difference of every other interval from the ones between, in their sum, up to which samples are
evenly spaced: those of two publishers are by chance alone."""
COMMON = 0.5
"""Median sum of the differences of all taxels, in the root mean square of the sum of their
magnitudes, from which they are of mains hum: it is in all taxels and all the time. Noise of 16
taxels has 0.2, touches that one of two streams has less."""


def without_garbage(stream: Stream) -> tuple[Stream, str]:
    """The stream without samples that hold a value beyond FAR ranges, and the note on them, empty
    where there is none."""
    if stream.kind not in (JOINTS, TAXELS, WRENCH) or not stream.values.size:
        return stream, ""
    some = stream.values[:: 1 + len(stream) // SAMPLES].astype(float)
    finite = some[np.isfinite(some)]
    if not len(finite):
        return stream, ""
    low, high = np.quantile(finite, RANGE)
    limit = FAR * max(high - low, abs(low), abs(high))
    sound = ~(np.abs(stream.values) > limit).any(axis=1)
    if limit == 0 or sound.all():
        return stream, ""
    note = (
        f"{(~sound).sum()} samples of {stream.name} hold values beyond {FAR:g} times its range: "
        "damaged messages, which are left out"
    )
    return replace(stream, times=stream.times[sound], values=stream.values[sound]), note


def check_single(stream: Stream) -> None:
    """Raise RecordingError for a stream of joints or taxels whose samples are of two in turn."""
    if stream.kind not in (JOINTS, TAXELS):
        return
    starts = np.linspace(0, max(len(stream) - BLOCK, 0), BLOCKS).astype(int)
    for start in np.unique(starts):
        block = stream.values[start : start + BLOCK].astype(float)
        ratio = _alternation(block)
        if ratio > ALTERNATING and not (
            stream.kind == TAXELS and _has_mains_hum(stream.times[start : start + BLOCK], block)
        ):
            at = stream.times[start] - stream.times[0]
            raise RecordingError(
                f"{stream.name} holds two streams in turn",
                value=f"differences of consecutive samples {ratio:.2g} times those of every other "
                f"one (mean squares), {at:.1f} s after its start",
                limit=f"{ALTERNATING:g}",
                remedy="keep one of the publishers, or give each a topic of its own",
            )


def _alternation(values: Array) -> float:
    """Mean square of the differences of consecutive samples (n, k), in relation to that of every
    other one; 0 where nothing changes."""
    known = values[:, np.isfinite(values).all(axis=0)]
    if len(known) < BLOCK or not known.size:
        return 0.0
    one, two = (float(np.mean((known[k:] - known[:-k]) ** 2)) for k in (1, 2))
    return one / two if two > 0 else float("inf" if one > 0 else 0)


def _has_mains_hum(times: Array, values: Array) -> bool:
    """Whether samples (n, k) that alternate are of one publisher, with mains hum of nearly half
    their rate."""
    steps = np.diff(times)
    odd, even = steps[::2].mean(), steps[1::2].mean()
    change = np.nan_to_num(np.diff(values, axis=0))
    common, size = change.sum(axis=1), np.abs(change).sum(axis=1)
    steady = np.median(np.abs(common)) >= COMMON * np.sqrt(np.mean(size**2))
    return bool(steady and abs(odd - even) <= EVEN * (odd + even))
