"""What is built once for inputs of the same content, whichever object holds them.

Cases of a study, seeds of a scene and touches of an exploration each make an arm and a loop of
their own; the functions that follow from these are the same, and take longer to build than to run.
"""

from __future__ import annotations

import functools
import pickle
from collections.abc import Callable
from typing import Any, TypeVar

X = TypeVar("X")
Y = TypeVar("Y")

KEPT = 8
"""How many of the last results a function keeps."""


class _Key:
    """An input, equal to another with the same content."""

    def __init__(self, value: Any) -> None:
        self.value = value
        self._content = pickle.dumps(value, protocol=pickle.HIGHEST_PROTOCOL)

    def __hash__(self) -> int:
        return hash(self._content)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Key) and self._content == other._content


def cached_by_content(build: Callable[[X], Y]) -> Callable[[X], Y]:
    """`build`, a pure function of one input that can be pickled, run once for equal contents.

    Its results are shared: they must be immutable.
    """
    kept = functools.lru_cache(maxsize=KEPT)(lambda key: build(key.value))

    @functools.wraps(build)
    def built(value: X) -> Y:
        return kept(_Key(value))

    return built
