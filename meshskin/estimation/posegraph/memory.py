"""Memory that stays with the process between factorisations.

MUMPS asks for its whole workspace anew at every factorisation. glibc gives blocks of that size back
to the system as soon as they are freed, and the system clears every page again: up to a fifth of
a solve. While IPOPT runs, such blocks are cut from the heap instead; the heap keeps what was freed,
for the next solve. This concerns the whole process, so it is done only where `MESHSKIN_MALLOC=keep`
asks for it.
"""

from __future__ import annotations

import ctypes
import functools
import os
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

TRIM_THRESHOLD, MMAP_THRESHOLD, MMAP_MAX = -1, -3, -4  # names of malloc.h
LARGEST = 2**31 - 1
MAPPED = 32 * 2**20
"""Bytes from which on a block is mapped outside of solves: where glibc's own rule ends up."""
DEFAULT_MAPS = 65536
_running = 0
_lock = threading.Lock()


@contextmanager
def kept() -> Iterator[None]:
    """While in here, large blocks come from the heap, which keeps them when they are freed."""
    global _running
    mallopt = _mallopt()
    if mallopt is None:
        yield
        return
    with _lock:
        _running += 1
        mallopt(MMAP_MAX, 0)
    try:
        yield
    finally:
        with _lock:
            _running -= 1
            if not _running:
                mallopt(MMAP_MAX, DEFAULT_MAPS)


@functools.cache
def _mallopt() -> Callable[[int, int], int] | None:
    """glibc's function, its thresholds set; None where there is none, or it is not to be used."""
    if os.environ.get("MESHSKIN_MALLOC") != "keep" or not sys.platform.startswith("linux"):
        return None
    mallopt: Callable[[int, int], int] | None = getattr(ctypes.CDLL(None), "mallopt", None)
    if mallopt is None or not (
        mallopt(TRIM_THRESHOLD, LARGEST) and mallopt(MMAP_THRESHOLD, MAPPED)
    ):
        return None
    return mallopt
