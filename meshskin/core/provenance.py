"""What a result depends on (seeds, hashes of inputs, versions), and how long its stages took."""

from __future__ import annotations

import functools
import hashlib
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib import metadata
from time import perf_counter
from typing import Any

import numpy as np

from .arguments import check_integer

_PACKAGES = ("meshskin", "casadi", "numpy", "scipy", "trimesh", "embreex", "adam-robotics")
"""Packages whose versions results depend on."""


def digest(*parts: bytes | str | np.ndarray) -> str:
    """SHA-256 of the given parts, its first 16 hex digits; arrays by shape, type and content."""
    h = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            h.update(f"{part.shape}{part.dtype}".encode())
            h.update(np.ascontiguousarray(part).tobytes())
        else:
            h.update(part.encode() if isinstance(part, str) else part)
    return h.hexdigest()[:16]


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that results depend on."""
    return {"python": platform.python_version()} | {name: _version(name) for name in _PACKAGES}


@functools.cache
def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed"


def provenance(**inputs: Any) -> dict[str, Any]:
    """The inputs given by name, the versions, the platform and the time (UTC)."""
    return {
        **inputs,
        "versions": versions(),
        "platform": f"{platform.system()} {platform.machine()}",
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def random_stream(seed: int, name: str) -> np.random.Generator:
    """The random generator of one consumer (an effect, a sampler), independent of all others.

    Raises ConfigError unless `seed` is an integer of at least 0.
    """
    check_integer("seed", seed, least=0)
    key = [int.from_bytes(hashlib.sha256(name.encode()).digest()[k : k + 4]) for k in (0, 4, 8)]
    return np.random.default_rng(np.random.SeedSequence(entropy=seed, spawn_key=key))


@dataclass
class StageTimer:
    """Measures the stages of a run."""

    seconds: dict[str, float] = field(default_factory=dict)
    """Wall-clock time of each stage, s"""

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Add the time spent inside the context to the stage `name`."""
        start = perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + perf_counter() - start
