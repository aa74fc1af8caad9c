"""One thread for linear algebra of small blocks.

The threads of a BLAS wait for each other after every product: with blocks of a few dozen rows that
costs more than the product. On a machine of two cores with other work, the benchmark torus3D (5000
poses) takes 0.9 s on one thread and up to 15 s on two.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager

from threadpoolctl import threadpool_limits

_nested = threading.local()
"""Attribute `depth`: the number of blocks that this thread is in."""


@contextmanager
def single_threaded() -> Iterator[None]:
    """Limit the BLAS libraries of the process to one thread, in a `with` block or as a decorator.

        with single_threaded():
            numpy.linalg.cholesky(blocks)

    Blocks may be nested: the outermost sets the limit, which takes 2 ms, and restores the numbers
    of threads at its end, also after an exception. The numbers belong to the process: while blocks
    in several threads overlap, threadpoolctl decides which of them sets the limit. Results do not
    depend on it beyond rounding. Libraries that are loaded within a block are not limited by it.
    """
    depth = getattr(_nested, "depth", 0)
    _nested.depth = depth + 1
    try:
        if depth:
            yield
        else:
            with threadpool_limits(1, user_api="blas"):
                yield
    finally:
        _nested.depth = depth
