"""Where a result comes from: seeds, input hashes, versions; written into every output."""

from __future__ import annotations

import functools
import hashlib
import platform
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from importlib import metadata
from numbers import Integral
from time import perf_counter, process_time
from typing import Any

import numpy as np

from .errors import ConfigError

_PACKAGES = ("meshskin", "casadi", "numpy", "scipy", "trimesh", "embreex", "adam-robotics")


def digest(*parts: bytes | str | np.ndarray) -> str:
    """SHA-256 (first 16 hex digits) of the given parts, arrays by shape, type and content."""
    h = hashlib.sha256()
    for part in parts:
        if isinstance(part, np.ndarray):
            h.update(f"{part.shape}{part.dtype}".encode())
            h.update(np.ascontiguousarray(part).tobytes())
        else:
            h.update(part.encode() if isinstance(part, str) else part)
    return h.hexdigest()[:16]


def versions() -> dict[str, str]:
    """Versions of Python and of the packages that numbers depend on."""
    return {"python": platform.python_version()} | {name: _version(name) for name in _PACKAGES}


@functools.cache
def _version(package: str) -> str:
    try:
        return metadata.version(package)
    except metadata.PackageNotFoundError:
        return "not installed"


def provenance(**inputs: Any) -> dict[str, Any]:
    """A record of the inputs given by name, the versions, the platform and the time (UTC)."""
    return {
        **inputs,
        "versions": versions(),
        "platform": f"{platform.system()} {platform.machine()}",
        "created": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def check_seed(seed: object) -> None:
    """Raise ConfigError for what is no seed."""
    if isinstance(seed, bool) or not isinstance(seed, Integral) or seed < 0:
        raise ConfigError("a seed is a whole number from 0", value=repr(seed))


def random_stream(seed: int, name: str) -> np.random.Generator:
    """An independent random stream for one named consumer (an effect, a sampler) of one seed.

    Raises ConfigError for what is no seed.
    """
    check_seed(seed)
    key = [int.from_bytes(hashlib.sha256(name.encode()).digest()[k : k + 4]) for k in (0, 4, 8)]
    return np.random.default_rng(np.random.SeedSequence(entropy=seed, spawn_key=key))


@dataclass
class StageTimer:
    """Seconds of every stage."""

    seconds: dict[str, float] = field(default_factory=dict)
    began: tuple[float, float] = field(default_factory=lambda: (perf_counter(), process_time()))
    """On the wall and of the processor."""

    @property
    def processor(self) -> float:
        """Processor seconds since the beginning."""
        return process_time() - self.began[1]

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        """Measure the time spent inside."""
        start = perf_counter()
        try:
            yield
        finally:
            self.seconds[name] = self.seconds.get(name, 0.0) + perf_counter() - start
