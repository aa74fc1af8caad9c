"""Groups of taxels that respond otherwise than the rest: two skins, or two amplifiers, in one log.

A learned response is that of all taxels, but for gain and offset. The scores of a compression and
of a patch's size that each taxel had of its own tell whether those of one module, or of one part of
the ids, differ from the others' by more than taxels of one group do among themselves. What divides
them best is what a response of two groups is tried for (departure_search.py).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from ...core.arrays import Array
from ..joint.departures import FittedReadings, normal_score
from ..result import OTHER_RESPONSE

TESTED = ("compression", "modulus")
"""Parameters whose scores are compared: compression of strong readings, and size of the patch."""
MODULE_SIZES = (8, 12, 16)
"""Ids of a module where the belief does not say: channels of a converter, a power of 2, or 10
taxels and 2 thermal pads."""
MIN_TAXELS = 5
"""Taxels of a part of the ids, at least, that is compared with the rest."""
MIN_GROUP = 3
"""Taxels of a module, at least."""


@dataclass(frozen=True)
class ResponseGroups:
    """The grouping of the taxels whose responses differ most."""

    score: float = 0.0
    """In standard deviations."""
    where: str = "some taxels"
    """The group that differs most, in words."""
    second: np.ndarray = field(default_factory=lambda: np.empty(0, dtype=int))
    """Ids of the smaller of the two parts that the grouping is best divided in."""

    @property
    def departure(self) -> dict[str, float]:
        """Its score, by a name that says which taxels differ."""
        return {OTHER_RESPONSE.format(self.where): self.score}


def response_groups(fitted: FittedReadings) -> ResponseGroups:
    """The most significant grouping; where groups have responses of their own, beyond these."""
    data, best = fitted.data, ResponseGroups()
    ids, slots = data.ids[fitted.readings.live], data.belief.module_slots
    sizes = MODULE_SIZES if slots is None else (len(slots),)
    for name in TESTED:
        at = data.parameters.columns[name]
        first = len(fitted.own) + at.start
        column = fitted.jacobian[:, first : len(fitted.own) + at.stop].sum(axis=1)
        slope, information = fitted.each(column)
        seen = information > 1e-6 * max(float(np.max(information, initial=0.0)), 1e-300)
        slope, information = np.where(seen, slope, 0.0), np.where(seen, information, 0.0)
        for words, group in (*_halves(ids, slope, information), *_modules(ids, seen, sizes)):
            score, which = _score(slope, information, group)
            if score > best.score:
                second = ids[_second(slope, information, group)]
                best = ResponseGroups(score, words.format(which, which + 1), second)
    return best


def _halves(ids: np.ndarray, slope: Array, information: Array) -> list[tuple[str, np.ndarray]]:
    """The taxels from an id on as group 1 of 2, by the id that parts them best; with words for it;
    none of too few taxels."""
    order = np.argsort(ids)
    order = order[information[order] > 0]
    first = np.arange(MIN_TAXELS, len(order) - MIN_TAXELS + 1)
    if len(first) == 0:
        return []
    before, total = (np.cumsum(a[order])[first - 1] for a in (slope, information))
    apart = before - total * (slope.sum() / information.sum())
    begin = ids[order][first[np.argmax(apart**2 / (total * (information.sum() - total)))]]
    return [(f"the taxels from id {begin} on", (ids >= begin).astype(int))]


def _modules(
    ids: np.ndarray, seen: np.ndarray, sizes: tuple[int, ...]
) -> Iterator[tuple[str, np.ndarray]]:
    """Groups (n,) of taxels by module of each size, numbers from 0, -1 less the number of those
    that are not compared; with words for one of them. seen (n,): whether readings tell."""
    for size in sizes:
        module = ids // size
        _, inverse = np.unique(module, return_inverse=True)
        enough = np.bincount(inverse, seen) >= MIN_GROUP
        if np.sum(enough) > 1:
            group = np.where(enough[inverse], module, -1 - module)
            yield f"modules of {size} ids, most of number {{}},", group


def _score(slope: Array, information: Array, group: np.ndarray) -> tuple[float, int]:
    """Score of differences between groups (n,), and the number of the one that differs most; by the
    slopes (n,) of the log-likelihood in a parameter of each taxel, with their information (n,)."""
    used = (group >= 0) & (information > 0)
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


def _second(slope: Array, information: Array, group: np.ndarray) -> np.ndarray:
    """Taxels (n,) bool of the smaller of two parts that the groups (n,) are best divided in, by
    their means; those that are not compared, with negative numbers, go where theirs are nearer."""
    numbers, at = np.unique(group, return_inverse=True)
    total = np.bincount(at, information)
    mean = np.bincount(at, slope) / np.maximum(total, 1e-300)
    used = np.flatnonzero((numbers >= 0) & (total > 0))
    order = used[np.argsort(mean[used])]
    below, count = np.cumsum(total[order] * mean[order]), np.cumsum(total[order])
    above, rest = below[-1] - below[:-1], count[-1] - count[:-1]
    low, high = below[:-1] / count[:-1], above / rest
    cut = int(np.argmax(count[:-1] * rest * (high - low) ** 2))
    upper = (mean > (low[cut] + high[cut]) / 2)[at]
    return np.asarray(upper if 2 * np.sum(upper) <= len(upper) else ~upper)
