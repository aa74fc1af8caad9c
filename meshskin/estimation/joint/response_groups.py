"""Groups of taxels that respond otherwise than the rest: two skins, or two amplifiers, in one log.

A learned response is that of all taxels, but for gain and offset. The score of a compression that
each taxel had of its own tells whether those of one module, or of one part of the ids, differ from
the others' by more than taxels of one group do among themselves.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from ...core.arrays import Array
from .departures import FittedReadings, normal_score

MODULE_SIZES = (12, 16)
"""Ids of a module where the belief does not say: of 10 taxels and 2 thermal pads, or a power of 2.
"""
MIN_TAXELS = 5
"""Taxels of a part of the ids, at least, that is compared with the rest."""
MIN_GROUP = 3
"""Taxels of a module, at least."""
NAME = "another response (saturation or exponent) of {} than of the others"


@dataclass(frozen=True)
class ResponseGroups:
    """The grouping of the taxels whose responses differ most."""

    score: float = 0.0
    """In standard deviations."""
    where: str = "some taxels"
    """The group that differs most, in words."""

    @property
    def departure(self) -> dict[str, float]:
        """Its score, by a name that says which taxels differ."""
        return {NAME.format(self.where): self.score}


def response_groups(fitted: FittedReadings, ids: np.ndarray, slots: int | None) -> ResponseGroups:
    """The most significant grouping; ids (n,): of the taxels of the readings; slots: ids of a
    module, None where the belief has no modules."""
    pressure = np.maximum(fitted.mu - fitted.offset, 0.0)
    slope, information = fitted.each(pressure**2 * fitted.data.sigma / fitted.data.nominal_peak)
    seen = np.flatnonzero(information > 1e-6 * max(float(np.max(information, initial=0.0)), 1e-300))
    ids, slope, information = ids[seen], slope[seen], information[seen]
    best = ResponseGroups()
    halves = _halves(ids, slope, information)
    for words, group in (*halves, *_modules(ids, (slots,) if slots else MODULE_SIZES)):
        score, which = _score(slope, information, group)
        if score > best.score:
            best = ResponseGroups(score, words.format(which, which + 1))
    return best


def _halves(ids: np.ndarray, slope: Array, information: Array) -> list[tuple[str, np.ndarray]]:
    """The taxels from an id on as group 1 of 2, by the id that parts them best; with words for it;
    none of too few taxels."""
    order = np.argsort(ids)
    first = np.arange(MIN_TAXELS, len(ids) - MIN_TAXELS + 1)
    if len(first) == 0:
        return []
    before, total = (np.cumsum(a[order])[first - 1] for a in (slope, information))
    apart = before - total * (slope.sum() / information.sum())
    begin = ids[order][first[np.argmax(apart**2 / (total * (information.sum() - total)))]]
    return [(f"the taxels from id {begin} on", (ids >= begin).astype(int))]


def _modules(ids: np.ndarray, sizes: tuple[int, ...]) -> Iterator[tuple[str, np.ndarray]]:
    """Groups (n,) of taxels by module of each size, numbers from 0, -1 of those that are not
    compared; with words for one of them."""
    for size in sizes:
        module = ids // size
        _, inverse, count = np.unique(module, return_inverse=True, return_counts=True)
        if np.sum(count >= MIN_GROUP) > 1:
            group = np.where(count[inverse] >= MIN_GROUP, module, -1)
            yield f"modules of {size} ids, most of number {{}},", group


def _score(slope: Array, information: Array, group: np.ndarray) -> tuple[float, int]:
    """Score of differences between groups (n,), and the number of the one that differs most; by the
    slopes (n,) of the log-likelihood in each taxel's compression, with their information (n,)."""
    used = group >= 0
    numbers, at = np.unique(group[used], return_inverse=True)
    total = np.bincount(at, information[used])
    mean = np.bincount(at, slope[used]) / total
    within = slope[used] - information[used] * mean[at]
    freedom = max(len(at) - len(numbers), 1)
    scatter = max(float(np.sum(within**2 / information[used])) / freedom, 1.0)
    apart = mean - float(np.sum(total * mean) / np.sum(total))
    squares = total * apart**2 / scatter
    score = normal_score(float(np.sum(squares)), len(numbers) - 1)
    return score, int(numbers[np.argmax(np.abs(apart) * np.sqrt(total))])
