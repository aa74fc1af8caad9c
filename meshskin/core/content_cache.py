"""Caches of function results: by the content of their argument, or on the argument itself.

Each case of a study and each seed of a scene makes an arm and a closed loop of its own. The
functions compiled for them are equal, and take longer to build than to run.
"""

from __future__ import annotations

import functools
import pickle
from collections.abc import Callable
from typing import Any, TypeVar

X = TypeVar("X")
Y = TypeVar("Y")

CACHE_SIZE = 8
"""Results that a function keeps, the least recently used dropped first: one each for the scenes and
beliefs that a process alternates between, which are at most a handful."""


class _Key:
    """An argument, equal to any other with the same content."""

    def __init__(self, value: Any) -> None:
        self.value = value
        self._content = pickle.dumps(value, protocol=pickle.HIGHEST_PROTOCOL)

    def __hash__(self) -> int:
        return hash(self._content)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Key) and self._content == other._content


def cached_by_content(build: Callable[[X], Y]) -> Callable[[X], Y]:
    """Decorator of a pure function of one picklable argument: called once for equal contents.

    Results are shared between callers: they must be immutable.
    """
    cached = functools.lru_cache(maxsize=CACHE_SIZE)(lambda key: build(key.value))

    @functools.wraps(build)
    def built(value: X) -> Y:
        return cached(_Key(value))

    return built


def cached_on_argument(build: Callable[[X], Y]) -> Callable[[X], Y]:
    """Decorator of a function of one immutable object: called once for each, which keeps the result
    among its attributes, as `functools.cached_property` does."""
    name = f"{build.__module__}.{build.__qualname__}"

    @functools.wraps(build)
    def built(owner: X) -> Y:
        kept = vars(owner)
        if name not in kept:
            kept[name] = build(owner)
        found: Y = kept[name]
        return found

    return built
